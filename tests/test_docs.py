"""Every Python block under docs/ runs, page by page, and so does every example in a docstring."""

import doctest
import importlib
import pkgutil
import re
from pathlib import Path
from typing import Literal, get_origin

import pytest

import jsmitsm

DOCS = Path(__file__).parent.parent / "docs"
MODULES = sorted(m.name for m in pkgutil.walk_packages(jsmitsm.__path__, "jsmitsm."))


@pytest.fixture(autouse=True)
def no_windows():
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    yield
    importlib.import_module("matplotlib.pyplot").close("all")


@pytest.mark.parametrize("page", sorted(p.name for p in DOCS.glob("*.md")))
def test_blocks_of_a_page_run(page, capsys, tmp_path, monkeypatch):
    """Top to bottom in one namespace, files in a directory of their own; the asserts in them are the test."""
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for k, block in enumerate(re.findall(r"^```python\n(.*?)^```", (DOCS / page).read_text(), re.M | re.S)):
        exec(compile(block, f"{page}[{k}]", "exec"), names)


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings(name):
    module = importlib.import_module(name)
    result = doctest.testmod(module, optionflags=doctest.NORMALIZE_WHITESPACE)
    assert result.failed == 0


def test_every_public_name_is_documented():
    """What the pages of the reference show of it is read in tests/test_site.py."""
    for name in jsmitsm.__all__:
        thing = getattr(jsmitsm, name)
        if callable(thing) and get_origin(thing) is not Literal:  # an alias, which knows not what it means
            assert thing.__doc__, f"{name} has no docstring"


def test_the_site_is_complete():
    """Every page stands in the navigation, and every object of the reference exists."""
    config = (DOCS.parent / "mkdocs.yml").read_text()
    pages = {str(p.relative_to(DOCS)) for p in DOCS.rglob("*.md")}
    notebooks = {f"notebooks/{p.stem}.md" for p in (DOCS.parent / "notebooks").glob("*.ipynb")}
    assert set(re.findall(r": ([\w/]+\.md)$", config, re.M)) == pages | notebooks
    for page in (DOCS / "reference").glob("*.md"):
        for target in re.findall(r"^::: ([\w.]+)$", page.read_text(), re.M):
            assert pkgutil.resolve_name(target) is not None, target


def test_code_of_pages_is_at_most_80_columns_wide():
    for page in DOCS.glob("*.md"):
        for block in re.findall(r"^```python\n(.*?)^```", page.read_text(), re.M | re.S):
            assert max(map(len, block.splitlines())) <= 80, (page.name, max(block.splitlines(), key=len))
    for example in (DOCS / "gallery").glob("*.py"):
        assert max(map(len, example.read_text().splitlines())) <= 80, example.name
