"""What a user with a strict type checker writes (tests/test_types.py has it checked)."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jsmitsm as js

Field = Callable[[jax.Array], jax.Array]
jax.config.update("jax_enable_x64", True)


def exact(x: jax.Array) -> jax.Array:
    return jnp.sin(x[0]) * jnp.exp(x[1])


def pde(u: Field, x: jax.Array, k: jax.Array) -> jax.Array:
    flux: Field = lambda y: (1.0 + k * y[0]) * js.grad(u)(y)
    return js.divergence(flux)(x) - js.laplacian(exact)(x) + 0.1 * (js.partial(u, (1, 1))(x) + js.hessian(u)(x)[0, 0])


def problem(k: float) -> js.Problem:
    sides = dict.fromkeys(("left", "right", "bottom"), js.dirichlet(lambda x, k: exact(x)))
    return js.Problem(pde, {**sides, "top": js.robin(1.0, lambda x, k: x[0], 0.0)}, params=jnp.asarray(k))


def answer(sol: js.Solution) -> float:
    values: np.ndarray[Any, Any] | jax.Array = sol.u
    slopes: jax.Array = sol.grad([[0.3, 0.4]], blend=True)
    worst = np.abs(sol.u - jax.vmap(exact)(jnp.asarray(sol.cloud.points))).max()
    if not sol.converged or sol.flags:
        print(sol.diagnose(), sol.stats["seconds"], sol.iterations)
    print(values[3], values.mean(), slopes.shape, worst, sol.coefficients.shape, sol.error_estimate().max())
    return float(sol(np.array([[0.3, 0.4]]))[0] + sol.integral("top") + sol.flux("left", lambda x: 1.0 + x[0]))


def studied(cloud: js.Cloud, methods: tuple[js.Method, ...] = ("III", "S")) -> dict[str, js.Solution]:
    solver: js.Solver = "sparse"
    formulation: js.Formulation = "loo"
    held = dict.fromkeys(cloud.groups.keys() - {"interior"}, js.dirichlet(exact))
    smooth = js.Problem(lambda u, x: js.laplacian(u)(x), held)
    return {m: js.solve(smooth, cloud, method=m, solver=solver, formulation=formulation, throw=False) for m in methods}


def sensitivity(cloud: js.Cloud, near: js.Stencils) -> float:
    def total(h: jax.Array) -> jax.Array:
        sol = js.solve(problem(0.3), cloud, kernel=js.SuperGaussian(h=h, d=4.0), stencils=near, solver="dense")
        return jnp.sum(jnp.asarray(sol.u) ** 2)

    return float(jax.grad(total)(1.2 * cloud.spacing))


def tuned(cloud: js.Cloud) -> js.TuneResult:
    found = js.tune(problem(0.3), cloud, js.Wendland(h=cloud.spacing, d=4.0), steps=3, order=3, progress=False)
    print(found.kernel.h, found.history["objective"], found.solution.u, found.messages)
    return found


def shaped() -> js.Cloud:
    plate = js.sdf.difference(js.sdf.rectangle((0, 0), (2, 1)), js.sdf.circle((1, 0.5), 0.25))
    cloud = js.from_sdf(plate, ((0, 0), (2, 1)), 0.1, groups={"right": lambda x: x[:, 0] > 1.99, "rest": all_of})
    print(js.quality(cloud).mesh_ratio, js.quadrature(cloud, "right").weights.sum(), len(cloud), cloud.boundary)
    return cloud


def all_of(x: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return np.ones(len(x), bool)


def main() -> None:
    square = js.rectangle((0, 0), (1, 1), (9, 9), jitter=0.2)
    mine = js.Cloud(np.asarray(square.points), dict(square.groups), square.normals)
    stages = js.continuation(problem, mine, [0.0, 0.3], order=4, kernel=None)
    ready = js.factorize(problem(0.3), mine)
    print(answer(ready.solve(problem(0.3))), ready, studied(shaped()), tuned(mine))
    print(sensitivity(mine, js.stencils(mine, size=25)))
    js.files.to_csv(stages[-1], "values.csv")
    ax = js.plot.solution(stages[-1])
    ax.set_title("a solution")


if __name__ == "__main__":
    main()
