"""What a notebook shows: words and dots, nothing computed for it."""

import jax
import jax.numpy as jnp

import jsmitsm as js
from jsmitsm.runtime import notebooks

ENDS = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
ROD = js.interval(0.0, 1.0, 9)


def test_clouds_problems_solutions_and_evolutions():
    cloud = js.rectangle((0, 0), (2, 1), (5, 4))
    shown = cloud._repr_html_()
    assert shown.count("<circle") == 20 and "top" in shown and "0 to 2 x 0 to 1" in shown
    problem = js.Problem(lambda u, x: js.laplacian(u)(x), ENDS)
    assert "dirichlet" in problem._repr_html_()
    sol = js.solve(problem, ROD, order=2)
    shown = sol._repr_html_()
    assert "0 to 1" in shown and "S, 2" in shown and "estimated error" not in shown and "seconds" in shown
    sol.error_estimate()
    assert "estimated error" in sol._repr_html_()
    heat = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), ENDS)
    run = js.evolve(heat, ROD, lambda x: x[0], t=(0.0, 0.1), steps=4, order=2, progress=False)
    assert "u at the end" in run._repr_html_() and "2 saved" in run._repr_html_()
    held = dict.fromkeys(ENDS, js.dirichlet(0.0))
    modes = js.eigen(js.Problem(lambda u, x: -js.laplacian(u)(x), held), ROD, 2, order=2)
    assert "9.8" in modes._repr_html_() and "error" not in modes._repr_html_() and "<circle" in modes._repr_html_()
    modes.error_estimate()
    assert modes._repr_html_().count(", error ") == 2
    found = js.adapt(problem, lambda h: js.interval(0.0, 1.0, spacing=h), 1e-3, order=2, depth=0, progress=False)
    assert "0.001 asked for" in found._repr_html_() and "<b>Solution</b>" in found._repr_html_()
    best = js.tune(problem, ROD, js.SuperGaussian(0.25, 2.0), method="SSPH", order=2, steps=2, progress=False)
    assert "SuperGaussian" in best._repr_html_() and "objective" in best._repr_html_()
    shells = js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=0.125)
    assert "RegionCloud" in shells._repr_html_()


def test_what_is_traced_or_complex_or_has_letters_of_html():
    seen = []

    @jax.jit
    def inside(points):
        seen.append(ROD.replace(points=points)._repr_html_())
        return points

    inside(jnp.asarray(ROD.points))
    assert seen[0].startswith("Cloud(")
    assert notebooks.span([1j, 3.0]) == "modulus 1 to 3"
    assert "&lt;b&gt;" in notebooks.shown("<b>", [])
    many = notebooks.dots(jnp.linspace(0, 1, 5000)[:, None], jnp.zeros(5000), 0)
    assert many.count("<circle") == 1500
