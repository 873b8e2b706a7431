"""What the README shows runs, prints what it says, and its commands name what exists."""

import contextlib
import io
import re
from pathlib import Path

import numpy as np
import pytest

import jsmitsm as js

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def blocks(text, language="python"):
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def ran():
    """Names left and text printed by the README's Python blocks, run top to bottom."""
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    names: dict = {}
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        for k, block in enumerate(blocks(README)):
            if "jax_compilation_cache_dir" not in block:  # would change the directory for all other tests
                exec(compile(block, f"README.md[{k}]", "exec"), names)
    yield names, printed.getvalue()
    matplotlib.pyplot.close("all")


def test_first_block_prints_what_the_readme_says(ran):
    """v = x^5 / 20 + 2 x + 1 is of degree 5: method III of order 5 has it exactly at x = 1.25."""
    _, printed = ran
    value, slope = map(float, re.findall(r"[\d.]+", printed.splitlines()[0]))
    assert abs(value - (1.25**5 / 20 + 2 * 1.25 + 1)) < 1e-8  # eight digits are printed
    assert abs(slope - (1.25**4 / 4 + 2)) < 1e-8
    assert f"`{printed.splitlines()[0]}`" in README


def test_nonlinear_plate(ran):
    names, _ = ran
    sol = names["sol"]
    assert bool(sol.converged) and abs(float(sol.u.max()) - 0.3225) < 2e-3  # its own order 6 says 0.3224


def test_the_cache_block_names_real_options():
    import jax

    (block,) = [b for b in blocks(README) if "jax_compilation_cache_dir" in b]
    for name in re.findall(r'update\("(\w+)"', block):
        assert hasattr(jax.config, name)


@pytest.mark.parametrize("mark, needed", [("paper", "-m benchmarks.paper"), ("tests", "-m pytest")])
def test_the_two_commands_are_there(mark, needed):
    """CI runs the second one as it stands; the first one's module exists."""
    (command,) = re.findall(rf"<!-- {mark} -->\n```bash\n(.+)\n```", README)
    assert command.startswith("python3 -m venv .venv && .venv/bin/pip install ") and needed in command
    for extra in re.findall(r"\[(\w+)\]", command):
        assert f"\n{extra} = [" in (ROOT / "pyproject.toml").read_text()
    if mark == "paper":
        assert (ROOT / "benchmarks" / "paper.py").exists()


def test_files_and_pictures_linked_exist():
    for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        for target in re.findall(r"\]\(([^)#:$\\]+\.\w+)(?:#[^)]*)?\)", page.read_text()):
            source = re.sub(r"^notebooks/(\w+)\.md$", r"../notebooks/\1.ipynb", target)  # of which the page is made
            source = re.sub(r"^(gallery/\w+)\.md$", r"\1.py", source)
            assert (page.parent / source).exists(), f"{page.name} links to {target}"


def test_tables_agree_with_the_data():
    """Numbers in tables come from benchmarks/data and from nowhere else."""
    from benchmarks.readme import PLACE, filled, tables

    found = tables()
    for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        text = page.read_text()
        assert filled(text, found) == text, f"run python -m benchmarks.readme: {page.name} differs from the data"
        for _, name, body, _ in PLACE.findall(text):
            assert not body.strip() or name in found, f"{page.name}: the table {name} has no data"


def refusals():
    """What the README's table says it does not do, and part of the message that says so."""
    sides = ("left", "right", "bottom", "top")
    held = {side: js.dirichlet(0.0) for side in sides}
    square = js.rectangle((0, 0), (1, 1), (6, 6))

    def solve(pde=lambda u, x: js.laplacian(u)(x) + 1.0, bcs=held, fields=1, **options):
        return lambda: js.solve(js.Problem(pde, bcs, fields), square, **options)

    yield "a point other than x", solve(lambda u, x: js.laplacian(u)(x) - u(0.9 * x))
    yield "must be real", solve(lambda u, x: js.laplacian(u)(x) + 1j)
    yield "D = 1, 2 or 3", lambda: js.Cloud(np.eye(4), {"interior": [0, 1], "rim": [2, 3]})
    clamped = {side: [js.dirichlet(0.0), js.neumann(0.0)] for side in sides}
    around = {"left": js.periodic("left", "right"), "bottom": held["bottom"], "top": held["top"]}
    for method in ("I", "II", "III"):
        two = lambda u, x: js.laplacian(u)(x) - u(x)[::-1]
        yield "treats one field", solve(two, fields=2, method=method)
        plate = lambda u, x: js.laplacian(js.laplacian(u))(x) - 1.0
        yield "takes one condition where values are held", solve(plate, clamped, method=method, order=6)
        if method != "III":
            yield "does not follow periodic", solve(bcs=around, method=method)


@pytest.mark.parametrize("message, call", list(refusals()))
def test_what_the_table_says_it_does_not_do_is_refused(message, call):
    with pytest.raises(ValueError, match=message):
        call()


def test_every_benchmark_prints_its_help_and_refuses_unknown_flags(monkeypatch, capsys):
    """Both before anything is measured."""
    from benchmarks.commandline import arguments

    scripts = [path for path in (ROOT / "benchmarks").glob("*.py") if "\nif __name__ == " in path.read_text()]
    assert len(scripts) > 10
    for path in scripts:
        main = path.read_text().rpartition('if __name__ == "__main__":')[2]
        assert "arguments(__doc__" in main or "ArgumentParser(description=__doc__" in path.read_text(), path.name
    for given, told in (["--help"], "What it is."), (["--bogus"], "unrecognized arguments: --bogus"), (["x"], "x"):
        monkeypatch.setattr("sys.argv", ["script", *given])
        with pytest.raises(SystemExit):
            arguments("What it is.", "quick", "only=")
        seen = capsys.readouterr()
        assert told in seen.out + seen.err
    monkeypatch.setattr("sys.argv", ["script", "--quick", "--only=S", "one", "two"])
    found = arguments("", "quick", "only=", names="scene")
    assert (found.quick, found.only, found.names) == (True, "S", ["one", "two"])
