"""The public interface as type checkers see it: scripts of users, right ones without a complaint, mistakes found."""

import ast
import importlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import jsmitsm as js

ROOT = Path(__file__).parent.parent
SCRIPTS = Path(__file__).parent / "user_scripts"
PYRIGHT = Path(sys.executable).parent / "pyright"


def test_checkers_and_python_are_told_the_same_of_the_lazy_names():
    tree = ast.parse(Path(js.__file__).read_text())
    (told,) = (n.body for n in tree.body if isinstance(n, ast.If) and ast.unparse(n.test) == "TYPE_CHECKING")
    names = {alias.name: node.module for node in told for alias in node.names}
    assert set(names) == set(js._LAZY)
    for name, module in names.items():
        home = importlib.import_module(module)
        assert getattr(js, name) is (getattr(home, name, None) or importlib.import_module(f"{module}.{name}"))


@pytest.fixture(scope="module")
def scripts(tmp_path_factory):
    """The README's examples as a script, what is right, and what is wrong."""
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.M | re.S)
    readme = tmp_path_factory.mktemp("readme") / "readme.py"
    readme.write_text("\n".join(blocks))
    return [readme, SCRIPTS / "right.py", SCRIPTS / "wrong.py"]


def expected(which):
    """(script, line, rule) of every mistake, from the comment behind it: mypy's name is the first, pyright's second."""
    lines = (SCRIPTS / "wrong.py").read_text().splitlines()
    marks = [(k, line.split("# wrong: ")[1].split(", ")) for k, line in enumerate(lines, 1) if "# wrong: " in line]
    assert len(marks) > 20
    return {("wrong.py", k, rules[which]) for k, rules in marks}


def said(command, **more):
    done = subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, cwd=ROOT, env={**os.environ, **more}
    )
    assert done.returncode == 1, done.stdout + done.stderr  # mistakes were found; 2 is a checker that failed
    return done.stdout


def test_mypy_strict(scripts):
    """As for an installed package: what is inside of it is none of the script's business, nor what is inside of JAX."""
    options = ["--strict", "--config-file=", "--follow-imports=silent", "--ignore-missing-imports"]
    options += ["--untyped-calls-exclude=jax", "--cache-dir", ROOT / ".mypy_cache" / "scripts", "--no-error-summary"]
    out = said([sys.executable, "-m", "mypy", *options, *scripts], MYPYPATH=str(ROOT))
    found = re.findall(r"^(?:.*/)?(\w+\.py):(\d+): error: .*\[([\w-]+)\]$", out, re.M)
    assert {(name, int(line), rule) for name, line, rule in found} == expected(0), out


@pytest.mark.skipif(not PYRIGHT.exists(), reason="pyright is not installed")
def test_pyright(scripts):
    out = said([PYRIGHT, "--outputjson", "--pythonpath", sys.executable, *scripts])
    found = [d for d in json.loads(out)["generalDiagnostics"] if d["severity"] == "error"]
    seen = {(Path(d["file"]).name, d["range"]["start"]["line"] + 1, d["rule"]) for d in found}
    assert seen == expected(1), out
