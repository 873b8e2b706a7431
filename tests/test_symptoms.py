"""Every flag names its place in the documentation, and the place is there."""

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.runtime.errors import PAGES, REFUSALS, SYMPTOMS, explained, placed

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "symptoms.md").read_text()
SOURCE = " ".join(" ".join(path.read_text().split()) for path in (ROOT / "jsmitsm").rglob("*.py")
                  if path.name != "errors.py")  # fmt: skip
SOURCE = re.sub(r'" f?"', "", SOURCE)  # sentences over several lines


def test_every_place_is_on_the_page_and_every_sentence_in_the_code():
    anchors = re.findall(r'<span id="([\w-]+)">', PAGE)
    assert len(anchors) == len(set(anchors))
    assert {*SYMPTOMS.values(), *REFUSALS.values()} <= set(anchors) and "\n## Errors\n" in PAGE
    missing = [words for words in (*SYMPTOMS, *REFUSALS) if words not in SOURCE]
    assert not missing, missing


def test_a_flag_is_explained_once_and_one_without_a_place_names_the_page():
    once = explained(["Round-off may reach 1e-02 of the solution: widen the supports.", "Something else."])
    assert once == ["Round-off may reach 1e-02 of the solution: widen the supports. (docs: symptoms#round-off)",
                    "Something else. (docs: symptoms)"]  # fmt: skip
    assert explained(once) == once


LINE = js.interval(0.0, 1.0, 9)
ENDS = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
FLAT = {"left": js.neumann(0.0), "right": js.neumann(0.0)}


def poisson(u, x):
    return js.laplacian(u)(x) - 1.0


def theirs(u, x):
    raise ValueError("of the user's own")


def solve(bcs=ENDS, pde=poisson, **options):
    return lambda: js.solve(js.Problem(pde, bcs), LINE, **options)


REFUSED = [
    (solve(FLAT), "symptoms#balance"),
    (solve({"left": ENDS["left"]}), "symptoms#conditions"),
    (solve(order=-1), "choosing"),
    (solve(kernel=3), "choosing"),
    (solve(tol=-1.0, order="auto"), "symptoms#errors"),
    (solve(pde=lambda u, x: js.laplacian(u)(x) * jnp.where(x[0] < 0.51, 1.0, 9.0) + js.partial(
        lambda y: jnp.where(y[0] < 0.51, 1.0, 9.0) * js.grad(u)(y)[0], (1,))(x)), "symptoms#branch"),
    (solve(pde=lambda u, x: js.laplacian(u)(x) + 99 * jnp.exp(u(x))), "symptoms#newton"),
    (solve(pde=theirs), "problems"),
    (lambda: js.Cloud([0.0, 1.0], {"interior": [0, 1]}), "clouds"),
    (lambda: js.from_polygon([(0, 0), (1, 0), (0, 1)], 2.0), "symptoms#coarse"),
    (lambda: js.Gaussian(-1.0, 2.0), "choosing"),
    (lambda: js.dirichlet("a"), "symptoms#errors"),
    (lambda: js.eigen(js.Problem(poisson, ENDS), LINE, 0), "modes"),
    (lambda: js.evolve(js.Problem(poisson, ENDS), LINE, 0.0, (1.0, 0.0), steps=2), "time"),
    (lambda: js.tune(js.Problem(poisson, ENDS), LINE, js.Gaussian(0.3, 2.0), objective="best"), "gradients"),
    (lambda: js.adapt(js.Problem(poisson, ENDS), 3, 1e-3), "adaptivity"),
    (lambda: solve()()(np.zeros((2, 3))), "clouds"),
]  # fmt: skip


@pytest.mark.parametrize("call, place", REFUSED)
def test_what_is_refused_ends_with_its_place(call, place):
    with pytest.raises((ValueError, js.SolveError)) as caught:
        call()
    assert str(caught.value).endswith(f" (docs: {place})"), str(caught.value)
    assert str(caught.value).count("(docs: ") == 1 and placed(str(caught.value)) == str(caught.value)
    assert (ROOT / "docs" / f"{place.partition('#')[0]}.md").exists()


def test_pages_about_arguments_are_there_and_no_argument_has_two():
    names = [name for page in PAGES.values() for name in page.split()]
    assert len(names) == len(set(names))
    assert all((ROOT / "docs" / f"{page}.md").exists() for page in PAGES)


def test_errors_of_others_stay_as_they_are():
    with pytest.raises(ValueError) as caught:
        js.from_sdf(lambda x: theirs(None, x), ((-1, -1), (1, 1)), 0.2)
    assert "of the user's own" in str(caught.value)
    with pytest.raises(ZeroDivisionError, match="division by zero$"):
        js.continuation(lambda c: 1 / 0, LINE, [1.0, 2.0])
