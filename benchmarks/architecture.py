"""The way of the data through the packages, in one picture: ``python -m benchmarks.architecture``.

Packages, their sentences, modules and arrows are read off the package itself. The picture carries what it shows as
text inside, so that a test can say when it is out of date.
"""

from __future__ import annotations

import ast
import json
from collections.abc import Iterator
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from matplotlib.textpath import TextPath

import jsmitsm
from benchmarks.commandline import arguments

ROOT = Path(jsmitsm.__file__).parent
PICTURE = ROOT.parent / "docs" / "images" / "architecture.svg"
MODULES = {
    path: ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for path in sorted(ROOT.rglob("*.py"))
    if path.parent != ROOT
}
# The sheet is 7.4 inches wide. By row: packages with their left edges and widths; what stands below uses what stands
# above. ``linear`` stands beside the three rows between ``runtime`` and ``solution``.
WIDTH, GAP = 7.4, 0.36
ROWS = [
    {"runtime": (0.0, 7.4)},
    {"taylor": (0.0, 5.6)},
    {"particle": (0.0, 1.76), "cloud": (1.92, 1.76), "equation": (3.84, 1.76)},
    {"discretization": (0.0, 5.6)},
    {"solution": (0.0, 7.4)},
    {
        "tuning": (0.0, 1.38), "adaptation": (1.505, 1.38), "evolution": (3.01, 1.38), "modes": (4.515, 1.38),
        "show": (6.02, 1.38),
    },
    {"parallel": (4.515, 2.885)},
]
BESIDE = {"linear": (5.76, 1.64)}
COLOURS = {
    "runtime": "#e6e6e6", "taylor": "#e6e6e6", "particle": "#cfe5f5", "cloud": "#cfe5f5", "equation": "#cfe5f5",
    "discretization": "#fbe3b5", "linear": "#cdebdf", "solution": "#f7d3c1", "tuning": "#f0dbe8",
    "adaptation": "#f0dbe8", "evolution": "#f0dbe8", "modes": "#f0dbe8", "show": "#f0dbe8",
    "parallel": "#e4dcf0",
}  # fmt: skip
# What goes from one package to the next on the sheet, and where.
ARROWS = {
    ("runtime", "taylor"): (0.88, ""),
    ("runtime", "linear"): (6.1, ""),
    ("taylor", "particle"): (0.88, "series"),
    ("taylor", "equation"): (4.72, "jets"),
    ("particle", "discretization"): (0.88, "moment systems"),
    ("cloud", "discretization"): (2.8, "neighbours"),
    ("equation", "discretization"): (4.72, "coefficients"),
    ("discretization", "solution"): (2.8, "rows of the global system"),
    ("linear", "solution"): (6.1, "factors"),
    ("solution", "tuning"): (0.69, "estimates"),
    ("solution", "adaptation"): (2.19, "defects"),
    ("solution", "evolution"): (3.7, "states"),
    ("solution", "modes"): (5.2, "polynomials"),
    ("solution", "show"): (6.71, "values"),
    ("show", "parallel"): (6.71, "meshes"),
}
# Sizes in points, and a line's height in inches.
NAME, SAID, LISTED, LINE, PAD = 11, 8.2, 7.4, 0.15, 0.09


def package_imports(path: Path, tree: ast.AST | None = None) -> Iterator[str]:
    """Modules of the package that ``path`` imports anywhere, as "package.module"; ``tree``: a part of it."""
    for node in ast.walk(tree or ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (a.name.removeprefix("jsmitsm.") for a in node.names if a.name.startswith("jsmitsm."))
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "jsmitsm":
            module = (node.module or "").removeprefix("jsmitsm").lstrip(".")
            for alias in node.names:
                whole = f"{module}.{alias.name}".lstrip(".")
                yield whole if whole in MODULES.values() else module


def house() -> dict[str, dict[str, list[str]]]:
    """By package: its modules, and the other packages that it imports."""
    found: dict[str, dict[str, list[str]]] = {}
    for path, name in MODULES.items():
        package, _, module = name.partition(".")
        own = found.setdefault(package, {"modules": [], "imports": []})
        if module:
            own["modules"].append(module)
        others = {other.split(".")[0] for other in package_imports(path)} - {package}
        own["imports"] = sorted(set(own["imports"]) | others)
    return found


def sentence(package: str) -> str:
    return (ast.get_docstring(ast.parse((ROOT / package / "__init__.py").read_text())) or "").split("\n\n")[0]


def wrapped(text: str, width: float, size: float) -> list[str]:
    """Lines of at most so many inches, in letters of so many points."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and TextPath((0, 0), longer, size=size).get_extents().width > 72 * width:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines


class Box:
    """A package on the sheet: what is written in it, and the height that this takes."""

    def __init__(self, name: str, left: float, width: float, modules: list[str]):
        self.name, self.left, self.width, self.top = name, left, width, 0.0
        room = 0.96 * (width - 2 * PAD)  # letters on a screen are a little wider than their outlines
        self.said = wrapped(sentence(name), room, SAID)
        self.listed = wrapped(", ".join(m for m in modules if "." not in m), room, LISTED)
        self.height = 0.26 + LINE * (len(self.said) + len(self.listed)) + 0.05 + 2 * PAD

    def draw(self, ax: Axes) -> None:
        style = "round,pad=0,rounding_size=0.08"
        place = (self.left, self.top), self.width, self.height
        ax.add_patch(FancyBboxPatch(*place, style, fc=COLOURS[self.name], ec="#777777", lw=0.8))
        left, y = self.left + PAD, self.top + PAD + 0.07
        ax.text(left, y, self.name, fontsize=NAME, weight="bold", va="center")
        for k, line in enumerate([*self.said, *self.listed]):
            listed = k >= len(self.said)
            more = {"fontsize": LISTED, "color": "#555555"} if listed else {"fontsize": SAID}
            ax.text(left, y + 0.24 + LINE * k + 0.05 * listed, line, va="center", **more)


def laid_out() -> tuple[dict[str, Box], float]:
    """Boxes by name, a row as high as its highest, and the height of the sheet."""
    packages = house()
    boxes, y = {}, 0.0
    for row in ROWS:
        made = [Box(name, *place, packages[name]["modules"]) for name, place in row.items()]
        for box in made:
            box.top, box.height = y, max(b.height for b in made)
            boxes[box.name] = box
        y += made[0].height + GAP
    beside = Box("linear", *BESIDE["linear"], packages["linear"]["modules"])
    beside.top = boxes["taylor"].top
    beside.height = boxes["solution"].top - GAP - beside.top
    return {**boxes, "linear": beside}, y - GAP


def draw() -> Figure:
    boxes, height = laid_out()
    figure = Figure(figsize=(WIDTH + 0.1, height + 0.1))
    ax = figure.add_axes((0, 0, 1, 1), xlim=(-0.05, WIDTH + 0.05), ylim=(height + 0.05, -0.05))
    ax.set_axis_off()
    for box in boxes.values():
        box.draw(ax)
    for (one, other), (x, label) in ARROWS.items():
        top, bottom = boxes[one].top + boxes[one].height, boxes[other].top
        style = {"arrowstyle": "-|>", "color": "#333333", "lw": 1.4, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 12}
        ax.annotate("", (x, bottom), (x, top), arrowprops=style)
        ax.text(x + 0.1, (top + bottom) / 2, label, fontsize=SAID, style="italic", color="#333333", va="center")
    return figure


def main() -> None:
    matplotlib.rcParams["svg.hashsalt"] = "jsmitsm"  # the same file from the same package
    shown = json.dumps(house(), sort_keys=True)
    draw().savefig(PICTURE, metadata={"Date": None, "Creator": None, "Description": shown})
    print(PICTURE)


if __name__ == "__main__":
    arguments(__doc__)
    main()
