"""What the site needs beyond Markdown: formulas as MathML, names that link to the reference, tables that scroll, pages
of the notebooks and of the gallery's examples."""

import ast
import html
import json
import re
from itertools import chain, groupby
from pathlib import Path

import griffe
from latex2mathml.converter import convert
from mkdocs.structure.files import File

ROOT = Path(__file__).parents[2]
MATH = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.S)
NAME = re.compile(r"(?<!<pre>)<code>(?:js|jsmitsm)((?:\.\w+)+)(\([^<]*\))?</code>")


def public_names():
    """``__all__`` of the package, read and not imported."""
    tree = ast.parse((ROOT / "jsmitsm" / "__init__.py").read_text())
    (names,) = [node.value for node in tree.body if isinstance(node, ast.Assign) and node.targets[0].id == "__all__"]
    return ast.literal_eval(names)


def mathml(match):
    """One formula, rendered here and not in the reader's browser."""
    display = "block" if match[2] == "[" else "inline"
    made = convert(html.unescape(match[3]).strip(), display=display)
    return f'<div class="formula">{made}</div>' if display == "block" else made


def linked(match):
    """A name of the package in running text, linked to where the reference explains it."""
    if match[1].split(".")[1] not in public_names():
        return match[0]
    return f'<autoref identifier="jsmitsm{match[1]}" optional>{match[0]}</autoref>'


def on_files(files, config):
    """The executed notebooks become pages."""
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        content = notebook(json.loads(path.read_text()))
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=content))
    for path in sorted((ROOT / "docs" / "gallery").glob("*.py")):
        files.append(File.generated(config, f"gallery/{path.stem}.md", content=example(path)))
    return files


def parted(path):
    """The title of an example of the gallery, what is said of it, and its code."""
    text = path.read_text()
    told, code = text.split('"""', 2)[1:]
    title, _, words = told.partition("\n\n")
    return title, words.strip(), code.strip()


def example(path):
    """The page of an example: what it shows, its picture, its code."""
    title, words, code = parted(path)
    return "\n\n".join(
        (f"# {title}", words, f"![{title}]({path.stem}.png)", f"```python\n{code}\n```",
         f"The number is checked at every change of the package. [The file]({path.name}){{:download}},"
         " [all examples](../gallery.md).")
    )  # fmt: skip


def cards(match):
    """Pictures of examples with their titles, each a link to its page."""
    made = []
    for name in match[1].split():
        title = parted(ROOT / "docs" / "gallery" / f"{name}.py")[0]
        made.append(f"[![]({'gallery/' + name}.png){{ loading=lazy }}<span>{title}</span>](gallery/{name}.md)")
    return '<div class="gallery" markdown>\n' + "\n".join(made) + "\n</div>"


def fenced(lines):
    return f"```text\n{''.join(lines).rstrip()}\n```"


def shown(data):
    """What a cell showed: a picture, or else its text."""
    if "image/png" not in data:
        return fenced(data.get("text/plain", []))
    picture = "".join(data["image/png"]).replace("\n", "")
    return f'<img alt="drawn by the code above" src="data:image/png;base64,{picture}">'


def notebook(content):
    """A notebook as Markdown: text, code, what the code printed, pictures."""
    parts = []
    for cell in content["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for name, outputs in groupby(cell.get("outputs", []), lambda output: output.get("name")):
            if name == "stdout":  # one text, however often it was flushed
                parts.append(fenced(chain.from_iterable(output["text"] for output in outputs)))
            elif name != "stderr":
                parts += [shown(output["data"]) for output in outputs]
    return "\n\n".join(parts)


def on_page_markdown(markdown, page, config, files):
    """The table of all names, and entries for those that no other page of the reference has; cards of the gallery."""
    markdown = re.sub(r"<!-- gallery: ([\w ]+) -->", cards, markdown)
    if page.file.src_uri == "reference.md":
        rows = "\n".join(f"| `js.{name}` | {summary(name)} |" for name in public_names())
        markdown = markdown.replace("<!-- names -->", f"| name | what it is |\n| --- | --- |\n{rows}")
        pages = "".join(path.read_text() for path in (ROOT / "docs" / "reference").glob("*.md"))
        rest = [name for name in public_names() if not re.search(rf"^::: jsmitsm\.{name}$", pages, re.M)]
        markdown += "\n\n" + "\n".join(f"::: jsmitsm.{name}" for name in rest)
    return markdown


def on_page_content(content, page, config, files):
    """Formulas, links and wide tables, once the page is HTML."""
    content = MATH.sub(mathml, content)
    content = NAME.sub(linked, content)
    content = re.sub(r"<td>(-?[\d.]+e[-+]\d+)</td>", r'<td class="number">\1</td>', content)
    content = re.sub(r"<table>(.*?)</table>", r'<div class="wide"><table>\1</table></div>', content, flags=re.S)
    # Tables of measured numbers: nobody searches for them, and they would stand before what is searched for.
    measured = re.compile(r'(<!-- table: [^>]*>(?:(?!<div).)*<div class="wide")', re.S)
    return measured.sub(r"\1 data-search-exclude", content)


def summary(name):
    """The first line of a docstring, read and not imported."""
    if "package" not in _read:
        loader = griffe.GriffeLoader(search_paths=[str(ROOT)])
        _read["package"] = loader.load("jsmitsm")
        loader.resolve_aliases()
    thing = _read["package"][name]
    text = thing.final_target.docstring if thing.is_alias else thing.docstring
    first = re.split(r"\n\s*\n", text.value.strip())[0] if text else ""
    return " ".join(first.split()).replace("``", "`").replace("|", "\\|")


_read: dict = {}
