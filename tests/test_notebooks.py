"""Every notebook runs from its first cell to its last; the numbers are asserted inside of it."""

import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")


def execute(name):
    notebook = nbformat.read(NOTEBOOKS / name, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert any("assert" in cell.source for cell in code), f"{name} asserts no number"
    assert any(cell.outputs for cell in code), f"{name} was committed without its outputs"
    # The limit is far above the minute that a notebook may take on a quiet machine: a busy one is no fault of its.
    nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(NOTEBOOKS)}}).execute()


@pytest.fixture(scope="module")
def begun(request):
    """Two at a time: each is a process of its own, and no others may be left to run beside them."""
    run = [item for item in request.session.items if item.path == request.path and "name" in item.callspec.params]
    names = [item.callspec.params["name"] for item in run]
    with ThreadPoolExecutor(2) as pool:
        yield {name: pool.submit(execute, name) for name in names}
        pool.shutdown(cancel_futures=True)


@pytest.mark.parametrize("name", sorted(path.name for path in NOTEBOOKS.glob("*.ipynb")))
def test_notebook_runs(begun, name):
    begun[name].result()


@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.ipynb")), ids=lambda path: path.stem)
def test_notebook_stands_alone(path):
    """It runs where nothing but the package is installed."""
    code = [cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    assert not re.search(r"^\s*(from|import) (benchmarks|tests)\b|sys\.path", "\n".join(code), re.M)
