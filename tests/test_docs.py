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


def public():
    """The classes and functions that ``import jsmitsm`` offers, by name."""
    return {name: getattr(jsmitsm, name) for name in jsmitsm.__all__ if callable(getattr(jsmitsm, name))}


def test_every_public_name_is_documented_and_in_the_reference():
    listed = set(re.findall(r"^::: ([\w.]+)$", (DOCS / "reference.md").read_text(), re.M))
    for name, thing in public().items():
        homes = {thing.__module__, f"{thing.__module__}.{name}"}
        if get_origin(thing) is Literal:  # an alias, which knows neither what it means nor where it stands
            homes = {place for place in listed if place.endswith(f".{name}")}
        else:
            assert thing.__doc__, f"{name} has no docstring"
        assert listed & homes, f"{name} is not in docs/reference.md"


def test_the_site_is_complete():
    """Every page stands in the navigation, and every object of the reference exists."""
    config = (DOCS.parent / "mkdocs.yml").read_text()
    assert set(re.findall(r": (\w+\.md)$", config, re.M)) == {p.name for p in DOCS.glob("*.md")}
    for target in re.findall(r"^::: ([\w.]+)$", (DOCS / "reference.md").read_text(), re.M):
        module, _, name = target.rpartition(".")
        try:
            importlib.import_module(target)
        except ModuleNotFoundError:
            assert hasattr(importlib.import_module(module), name), target
