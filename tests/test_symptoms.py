"""Every flag names its place in the documentation, and the place is there."""

import inspect
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
    (lambda: js.dirichlet("a"), "problems"),
    (lambda: js.constraint(3), "problems"),
    (lambda: js.point_source("here"), "problems"),
    (lambda: js.interface(), "problems"),
    (lambda: js.sdf.circle((0.0, 0.0), -1.0), "clouds"),
    (lambda: js.sdf.circle((0.0, 0.0), 1.0)(jnp.zeros(3)), "clouds"),
    (lambda: js.from_sdf(js.sdf.ball((0.0, 0.0, 0.0), 1.0), ((-1, -1), (1, 1)), 0.2), "clouds"),
    (lambda: js.plot.vectors(js.solve(js.Problem(poisson, ENDS), LINE)), "pictures"),
    (lambda: js.files.from_csv(3), "pictures"),
    (solve(pde=lambda u, x: js.partial(u, (1, 0))(x)), "problems"),
    (solve(pde=lambda u, x: js.dt(u, 3)(x)), "time"),
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


def told(error):
    """Whether an error's last words name a page of the documentation, and no other words do."""
    found = re.findall(r"\(docs: ([\w/-]+)(#[\w-]+)?\)", str(error))
    return len(found) == 1 and str(error).endswith(")") and (ROOT / "docs" / f"{found[0][0]}.md").exists()


def nonsense(call, count):
    """What a callable says of arguments that fit nothing."""
    for what in (object(), -1.5, None, "odd", [1.0, float("nan")]):
        try:
            call(*[what] * count)
        except (ValueError, ImportError, js.SolveError) as error:
            yield what, error


def of_all_names():
    """Every public function and class that is called with arguments, as many of them as it needs."""
    skipped = ("Factorization", "Formulation", "Method", "Solver", "multi_indices")  # nobody makes them; it caches
    for name in js.__all__:
        thing = getattr(js, name)
        for key in thing.__all__ if inspect.ismodule(thing) else [""]:
            call = getattr(thing, key) if key else thing
            if name not in skipped and callable(call):
                needed = [p for p in inspect.signature(call).parameters.values() if p.default is p.empty and p.kind < 2]
                if needed:
                    yield f"{name}.{key}", call, len(needed)


def test_whatever_public_name_refuses_its_arguments_tells_the_place():
    refused = [(name, what, error) for name, call, count in of_all_names() for what, error in nonsense(call, count)]
    assert not [x for x in refused if not told(x[2])]
    assert len({name for name, *_ in refused}) > 70  # of some 80; the others take anything at first


def test_methods_tell_the_place_too():
    problem = js.Problem(poisson, ENDS)
    sol, kept = js.solve(problem, LINE, order=2), js.factorize(problem, LINE, order=2)
    heat = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), ENDS)
    run = js.evolve(heat, LINE, lambda x: x[0], t=(0.0, 0.1), steps=2, order=2, progress=False)
    held = {side: js.dirichlet(0.0) for side in ENDS}
    modes = js.eigen(js.Problem(lambda u, x: -js.laplacian(u)(x), held), LINE, 1, order=2)
    kernel = js.SuperGaussian(0.2, 2.0)
    refused = [
        error
        for call, count in ((sol, 1), (sol.grad, 1), (sol.derivative, 2), (sol.integral, 1), (sol.flux, 1),
                            (kept.solve, 1), (run.at, 1), (modes, 2), (modes.grad, 2), (modes.derivative, 3),
                            (kernel.normalization, 1), (LINE.replace, 1))
        for _, error in nonsense(call, count)
    ]  # fmt: skip
    assert len(refused) > 40 and not [error for error in refused if not told(error)]
    for change in (lambda: problem.replace(nothing=1), lambda: kernel.replace(nothing=1)):
        with pytest.raises(ValueError) as caught:
            change()
        assert told(caught.value)
