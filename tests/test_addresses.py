"""What a release says of where it comes from: tried on a copy, as the machine that publishes does it."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent
ADDRESS = "https://example.org/someone/jsmitsm"


def test_a_release_has_whole_addresses(tmp_path):
    for name in ("README.md", "pyproject.toml", "mkdocs.yml"):
        (tmp_path / name).write_text((ROOT / name).read_text())
    subprocess.run([sys.executable, ROOT / ".github" / "addresses.py", ADDRESS, "v1.2.3"], cwd=tmp_path, check=True)
    before, readme = (ROOT / "README.md").read_text(), (tmp_path / "README.md").read_text()
    links = re.findall(r"\]\(([^)]*)\)", readme)
    assert len(links) == len(re.findall(r"\]\(([^)]*)\)", before)) and all(re.match(r"https?:|#", x) for x in links)
    for link in links:
        kind, _, path = link.removeprefix(f"{ADDRESS}/").partition("/v1.2.3/")
        if path:
            assert kind == ("raw" if path.endswith(".png") else "blob"), link
            assert (ROOT / path.partition("#")[0]).exists(), link
    project = tomllib.loads((tmp_path / "pyproject.toml").read_text())["project"]
    assert set(project["urls"]) == {"Source", "Issues", "Documentation", "Changelog"}
    assert f"\nrepo_url: {ADDRESS}\n" in (tmp_path / "mkdocs.yml").read_text()
