"""The gallery: every example runs by itself and asserts a number, and has its picture and its place on the page."""

import ast
import re

import pytest

from benchmarks.gallery import EXAMPLES, run

PAGE = EXAMPLES[0].parent.parent / "gallery.md"


def code(path):
    """An example without what is said of it."""
    return path.read_text().split('"""', 2)[2].strip()


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(path):
    """The assertion inside is the test. All in one module, so that they share compiled programs."""
    pytest.importorskip("matplotlib")
    if "meshio" in path.read_text():
        pytest.importorskip("meshio")
    assert run(path).axes, "nothing was drawn"


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_is_short_and_stands_alone(path):
    text = code(path)
    lines = text.splitlines()
    assert len(lines) < 40 and max(map(len, text.splitlines())) <= 80
    tree = ast.parse(text)
    assert any(isinstance(node, ast.Assert) for node in ast.walk(tree)), "asserts no number"
    modules = {node.module.split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}
    plain = [node for node in ast.walk(tree) if isinstance(node, ast.Import)]
    modules |= {name.name.split(".")[0] for node in plain for name in node.names}
    assert modules <= {"jax", "jsmitsm", "matplotlib", "meshio", "numpy", "scipy"}
    picture = path.with_suffix(".png")
    assert picture.exists(), "run python -m benchmarks.gallery"
    assert picture.stat().st_size < 150_000


def test_every_example_stands_on_the_page_once():
    shown = " ".join(re.findall(r"<!-- gallery: ([\w ]+) -->", PAGE.read_text())).split()
    assert sorted(shown) == [path.stem for path in EXAMPLES] and len(shown) >= 20
