"""Every notebook runs from its first cell to its last; the numbers are asserted inside of it."""

import re
from pathlib import Path

import pytest

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
nbformat = pytest.importorskip("nbformat")


@pytest.fixture(params=sorted(NOTEBOOKS.glob("*.ipynb")), ids=lambda path: path.stem)
def notebook(request):
    return request.param


def cells(path):
    return [cell for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]


def test_notebook_runs(notebook, monkeypatch):
    """Top to bottom in a namespace of its own; all in one process, which imports and compiles once for all of them."""
    pyplot = pytest.importorskip("matplotlib.pyplot")
    pyplot.switch_backend("Agg")
    monkeypatch.chdir(NOTEBOOKS)
    names = {"__name__": "__main__"}
    try:
        for k, cell in enumerate(cells(notebook)):
            exec(compile(cell.source, f"{notebook.name}[{k}]", "exec"), names)
    finally:
        pyplot.close("all")


def test_notebook_stands_alone(notebook):
    """It runs where nothing but the package is installed and nothing was set before, and was committed as it ran."""
    code = cells(notebook)
    text = "\n".join(cell.source for cell in code)
    assert not re.search(r"^\s*(from|import) (benchmarks|tests)\b|sys\.path|^[%!]", text, re.M)
    assert 'jax.config.update("jax_enable_x64", True)' in code[0].source
    assert "assert" in text, "asserts no number"
    assert any(cell.outputs for cell in code), "was committed without its outputs"
