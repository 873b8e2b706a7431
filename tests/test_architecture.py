"""The house: packages on one way, read off the imports."""

import ast
from pathlib import Path

import jsmitsm

ROOT = Path(jsmitsm.__file__).parent
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
    "tuning": ("runtime", "taylor", "particle", "cloud", "equation", "linear", "discretization", "solution"),
    "show": ("runtime", "taylor", "particle", "cloud", "equation", "linear", "discretization", "solution"),
}
MODULES = sorted(p for p in ROOT.rglob("*.py") if p.parent != ROOT)
NAMES = {p: ".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for p in MODULES}


def package_imports(path, tree=None):
    """Modules of the package that ``path`` imports anywhere, as "package.module", and where: (name, node)."""
    for node in ast.walk(tree or ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.startswith("jsmitsm."):
                    yield alias.name.removeprefix("jsmitsm."), node
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "jsmitsm":
            module = node.module.removeprefix("jsmitsm").lstrip(".")
            for alias in node.names:
                whole = f"{module}.{alias.name}".lstrip(".")
                yield (whole if whole in NAMES.values() else module), node


def test_every_room_stands_in_a_package_on_the_way():
    assert {p.name for p in ROOT.iterdir() if p.is_dir() and (p / "__init__.py").exists()} == set(MAY_IMPORT)
    assert [p.name for p in ROOT.glob("*.py")] == ["__init__.py"]


def test_no_import_runs_against_the_order():
    wrong = []
    for path in MODULES:
        own = NAMES[path].split(".")[0]
        for name, _ in package_imports(path):
            other = name.split(".")[0]
            if other != own and other not in MAY_IMPORT[own]:
                wrong.append(f"{NAMES[path]} imports {name or 'jsmitsm'}")
    assert not wrong, wrong


def test_no_circle_between_modules():
    """Peel off what imports nothing that is left."""
    left = {NAMES[p]: {name for name, _ in package_imports(p)} - {NAMES[p]} for p in MODULES}
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
                hidden += [f"{NAMES[path]}.{function.name}: {name}" for name, _ in package_imports(path, function)]
    assert not hidden, hidden


def test_modules_fit_on_a_few_screens_and_packages_on_a_page():
    long = {NAMES[p]: n for p in MODULES if (n := len(p.read_text().splitlines())) > 400}
    assert not long, long
    crowded = {d.name: n for d in ROOT.iterdir() if d.is_dir() and (n := len(list(d.glob("[!_]*.py")))) > 16}
    assert not crowded, crowded


def test_every_package_and_module_says_what_it_is_for():
    assert all(ast.get_docstring(ast.parse(p.read_text())) for p in MODULES)
