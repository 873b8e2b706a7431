"""Where a repository lies, written into what is built of it: ``python .github/addresses.py ADDRESS TAG``.

A package index shows pictures and follows links by whole addresses alone. They are known to the machine that builds a
release and to nobody before, so the sources name none.
"""

import re
import sys
from pathlib import Path


def whole(readme, address, tag):
    """Links of the README from the repository, pictures as they are and pages as the repository shows them."""
    pictures = re.sub(r"(!\[[^\]]*\]\()(?!https?:|#)", rf"\1{address}/raw/{tag}/", readme)
    return re.sub(r"(\]\()(?!https?:|#)", rf"\1{address}/blob/{tag}/", pictures)


def urls(address, tag):
    return f"""
[project.urls]
Source = "{address}"
Issues = "{address}/issues"
Documentation = "{address}/blob/{tag}/docs/index.md"
Changelog = "{address}/blob/{tag}/CHANGELOG.md"
"""


def write(root, address, tag):
    readme, project, site = root / "README.md", root / "pyproject.toml", root / "mkdocs.yml"
    readme.write_text(whole(readme.read_text(), address, tag))
    project.write_text(project.read_text() + urls(address, tag))
    site.write_text(site.read_text() + f"repo_url: {address}\n")


if __name__ == "__main__":
    write(Path.cwd(), *sys.argv[1:])
