"""The house: packages on one way, read off the imports."""

import ast
import json
import re
from html import unescape

from benchmarks.architecture import ARROWS, MODULES, PICTURE, ROOT, house, package_imports, sentence

PAGE = ROOT.parent / "docs" / "architecture.md"
# What each package may import of the others. Everything runs one way.
MAY_IMPORT = {
    "runtime": (),
    "taylor": ("runtime",),
    "particle": ("runtime", "taylor"),
    "cloud": ("runtime", "taylor", "particle"),
    "equation": ("runtime", "taylor", "cloud"),
    "linear": ("runtime",),
    "discretization": ("runtime", "taylor", "particle", "cloud", "equation"),
    "solution": ("runtime", "taylor", "particle", "cloud", "equation", "linear", "discretization"),
    "adaptation": ("runtime", "taylor", "particle", "cloud", "equation", "linear", "discretization", "solution"),
    "evolution": (
        "runtime", "taylor", "particle", "cloud", "equation", "linear", "discretization", "solution", "adaptation",
    ),  # fmt: skip
    "modes": ("runtime", "taylor", "particle", "cloud", "equation", "linear", "discretization", "solution"),
    "tuning": ("runtime", "taylor", "particle", "cloud", "equation", "linear", "discretization", "solution"),
    "show": ("runtime", "taylor", "particle", "cloud", "equation", "linear", "discretization", "solution"),
    "parallel": (
        "runtime", "taylor", "particle", "cloud", "equation", "linear", "discretization", "solution", "evolution",
        "modes", "show",
    ),  # fmt: skip
}


def test_every_room_stands_in_a_package_on_the_way():
    assert {p.name for p in ROOT.iterdir() if p.is_dir() and (p / "__init__.py").exists()} == set(MAY_IMPORT)
    assert [p.name for p in ROOT.glob("*.py")] == ["__init__.py"]


def test_no_import_runs_against_the_order():
    wrong = []
    for path in MODULES:
        own = MODULES[path].split(".")[0]
        for name in package_imports(path):
            other = name.split(".")[0]
            if other != own and other not in MAY_IMPORT[own]:
                wrong.append(f"{MODULES[path]} imports {name or 'jsmitsm'}")
    assert not wrong, wrong


def test_no_circle_between_modules():
    """Peel off what imports nothing that is left."""
    left = {MODULES[p]: {name for name in package_imports(p)} - {MODULES[p]} for p in MODULES}
    while left:
        leaves = [name for name, uses in left.items() if not uses & set(left)]
        assert leaves, f"a circle of imports among {sorted(left)}"
        left = {name: uses for name, uses in left.items() if name not in leaves}


def test_no_import_of_the_package_hides_in_a_function():
    hidden = []
    for path in MODULES:
        tree = ast.parse(path.read_text())
        for function in ast.walk(tree):
            if isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef)):
                hidden += [f"{MODULES[path]}.{function.name}: {name}" for name in package_imports(path, function)]
    assert not hidden, hidden


def test_modules_fit_on_a_few_screens_and_packages_on_a_page():
    long = {MODULES[p]: n for p in MODULES if (n := len(p.read_text().splitlines())) > 400}
    assert not long, long
    crowded = {d.name: n for d in ROOT.iterdir() if d.is_dir() and (n := len(list(d.glob("[!_]*.py")))) > 16}
    assert not crowded, crowded


def test_every_package_and_module_says_what_it_is_for():
    assert all(ast.get_docstring(ast.parse(p.read_text())) for p in MODULES)


# ------------------------------------------------------------------ the picture and its page


def test_the_picture_shows_the_packages_modules_and_arrows_of_today():
    description = re.search(r"<dc:description>(.*?)</dc:description>", PICTURE.read_text(), re.S).group(1)
    assert json.loads(unescape(description)) == house(), "draw it again: python -m benchmarks.architecture"


def test_every_arrow_of_the_picture_is_an_import():
    packages = house()
    assert all(one in packages[other]["imports"] for one, other in ARROWS)


def test_every_package_has_a_paragraph_and_every_module_a_place_in_it():
    paragraphs = re.split(r"^## ", PAGE.read_text(), flags=re.M)
    for package, parts in house().items():
        (own,) = [p for p in paragraphs if p.startswith(f"{package}\n")]
        assert " ".join(sentence(package).split()) in " ".join(own.split()), package
        assert not [m for m in parts["modules"] if f"`{m.split('.')[0]}`" not in own], package


def test_the_sentence_of_a_package_says_what_it_may_import():
    for package, allowed in MAY_IMPORT.items():
        said = ast.get_docstring(ast.parse((ROOT / package / "__init__.py").read_text())).split("\n\n")[1]
        named = set(re.findall(r"\w+", said)) & set(MAY_IMPORT)
        assert named <= {*allowed, "linear"}, package
