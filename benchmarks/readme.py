"""Put measured tables into the README and the documentation: ``python -m benchmarks.readme``.

A page holds a place ``<!-- table: NAME ... -->`` up to ``<!-- end of table -->``; the table of that name comes from
the ``tables`` of the files in benchmarks/data, each with ``columns``, ``rows`` and a ``note``. A place without
data stays empty. With ``--check`` nothing is written, and a page that would change is an error.
"""

import json
import re
import sys
from pathlib import Path

from benchmarks.commandline import arguments

ROOT = Path(__file__).parent.parent
PLACE = re.compile(r"(<!-- table: ([\w-]+)[^\n]*-->\n)(.*?)(<!-- end of table -->)", re.DOTALL)


def tables():
    """All tables by name."""
    found = {}
    for path in sorted((ROOT / "benchmarks" / "data").glob("*.json")):
        data = json.loads(path.read_text())
        if isinstance(data, dict):
            found |= data.get("tables", {})
    return found


def markdown(table):
    """A table as markdown, its note above it."""
    lines = [table["columns"], ["---"] * len(table["columns"]), *table["rows"]]
    body = "\n".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in line) + " |" for line in lines)
    return (f"\n{table['note']}\n" if table.get("note") else "") + f"\n{body}\n\n"


def filled(text, found):
    """A page with its places filled."""
    return PLACE.sub(lambda m: m[1] + (markdown(found[m[2]]) if m[2] in found else m[3]) + m[4], text)


def main(check=False):
    found, stale = tables(), []
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        old = page.read_text()
        new = filled(old, found)
        if new != old:
            stale.append(page.name)
            if not check:
                page.write_text(new)
    print(("differ from the data: " if check else "written: ") + (", ".join(stale) or "none"))
    return bool(check and stale)


if __name__ == "__main__":
    sys.exit(main(arguments(__doc__, "check").check))
