"""The pictures of the README and the documentation, drawn into docs/images: ``python -m benchmarks.pictures``."""

from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import jsmitsm as js
from benchmarks.adaptation import true_error
from benchmarks.commandline import arguments
from benchmarks.nist import CASES as NIST
from benchmarks.problems import CASES

matplotlib.use("Agg")
jax.config.update("jax_enable_x64", True)
IMAGES = Path(__file__).parent.parent / "docs" / "images"


PLATE = CASES["two holes"]


def relative_error(cloud, order):
    """Relative L2 error of method S for Poisson's equation on the plate."""
    return PLATE.error(PLATE.solve(order, cloud))


def first(plt):
    """What the package does, in one row: particles, a solution, its order of convergence."""
    fig, axes = plt.subplots(1, 3, figsize=(13, 3.5), layout="constrained", width_ratios=(1.25, 1.45, 1))
    heat = js.Problem(
        lambda u, x: js.laplacian(u)(x),
        {"hot": js.dirichlet(100.0), "cold": js.dirichlet(0.0), "outer": js.neumann(0.0)},
    )
    cloud = PLATE.cloud(0.09)
    sol = js.solve(heat, cloud, order=4)
    middle = int(np.argmin(np.linalg.norm(cloud.points - np.array([1.6, 1.45]), axis=1)))
    js.plot.cloud(sol, support=middle, ax=axes[0], legend=False)
    axes[0].set_title(f"{len(cloud)} particles, one of their supports")
    js.plot.solution(sol, ax=axes[1])
    axes[1].set_title("a temperature: hot hole, cold hole, insulated rim")
    spacings = [0.2, 0.14, 0.1, 0.07]
    clouds = [PLATE.cloud(h) for h in spacings]
    errors = {f"degree {p}": [relative_error(c, p) for c in clouds] for p in (2, 4, 6, 8)}
    js.plot.convergence(spacings, errors, ylabel="relative error", ax=axes[2])
    axes[2].set_title("method S, a smooth solution on this plate")
    for ax in axes:
        ax.title.set_fontsize("medium")
    return fig


def slices(plt):
    """A solid: a ball with an eccentric cavity."""
    ball = js.sdf.difference(js.sdf.ball((0.0, 0.0, 0.0), 1.0), js.sdf.ball((0.3, 0.0, 0.0), 0.4))
    groups = {"cavity": lambda x: np.linalg.norm(x, axis=1) < 0.9, "surface": lambda x: x[:, 0] > -2}
    cloud = js.from_sdf(ball, ((-1.0,) * 3, (1.0,) * 3), 0.16, groups=groups)
    problem = js.Problem(lambda u, x: js.laplacian(u)(x), {"cavity": js.dirichlet(1.0), "surface": js.dirichlet(0.0)})
    return js.plot.solution(js.solve(problem, cloud, order=4))[0].figure


def errors(plt):
    """The true error beside the estimate that knows no exact solution."""
    sol = PLATE.solve(3, PLATE.cloud(0.1))
    fig, (left, right) = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
    js.plot.error(sol, PLATE.exact, ax=left)
    js.plot.estimate(sol, ax=right)
    return fig


def modes(plt):
    """Modes of a round drum and of a clamped plate."""
    fig, axes = plt.subplots(2, 4, figsize=(9.5, 5.2), layout="constrained")
    disk = js.from_sdf(js.sdf.circle((0.0, 0.0), 1.0), ((-1.1, -1.1), (1.1, 1.1)), 0.07)
    drum = js.Problem(lambda u, x: -js.laplacian(u)(x), {"boundary": js.dirichlet(0.0)})
    square = js.rectangle((0, 0), (1, 1), (25, 25))
    rim = dict.fromkeys(("left", "right", "bottom", "top"), [js.dirichlet(0.0), js.neumann(0.0)])
    plate = js.Problem(lambda u, x: js.laplacian(js.laplacian(u))(x), rim)
    for row, (cloud, problem) in zip(axes, ((disk, drum), (square, plate))):
        found = js.eigen(problem, cloud, 6, order=8)
        for ax, k in zip(row, (0, 1, 3, 5)):
            size = float(np.abs(found.u[:, k]).max())
            js.plot.values(cloud, found.u[:, k] / size, colorbar=False, ax=ax)
            ax.set_title(f"root of lambda {found.values[k] ** 0.5:.6f}", fontsize="medium")
            ax.set_axis_off()
    return fig


def time(plt):
    """A blow on a drum, four moments."""
    cloud = js.from_sdf(js.sdf.circle((0.0, 0.0), 1.0), ((-1.1, -1.1), (1.1, 1.1)), 0.06)
    drum = js.Problem(lambda u, x, t: js.dt(u, 2)(x) - js.laplacian(u)(x), {"boundary": js.dirichlet(0.0)})
    run = js.evolve(
        drum, cloud, (lambda x: jnp.exp(-((x[0] - 0.3) ** 2 + x[1] ** 2) / 0.04), 0.0), t=(0.0, 1.8), steps=72,
        order=6, save=3,
    )  # fmt: skip
    fig, axes = plt.subplots(1, 4, figsize=(11, 3.2), layout="constrained")
    for ax, t, u in zip(axes, run.t, run.u):
        js.plot.values(cloud, u, colorbar=False, ax=ax)
        ax.set_title(f"t = {t:.1f}, {float(u.min()):.2f} to {float(u.max()):.2f}", fontsize="medium")
        ax.set_axis_off()
    return fig


def following(plt):
    """A torch that circles on a plate, four moments: temperature and particles."""
    disk = lambda spacing: js.from_sdf(js.sdf.circle((0.0, 0.0), 1.0), ((-1.1, -1.1), (1.1, 1.1)), spacing)  # noqa: E731

    def torch(x, t):
        centre = 0.5 * jnp.stack([jnp.cos(2.0 * t), jnp.sin(2.0 * t)])
        return 20.0 * jnp.exp(-jnp.sum((x - centre) ** 2) / 0.005)

    plate = js.Problem(
        lambda u, x, t: js.dt(u)(x) - 0.1 * js.laplacian(u)(x) - torch(x, t), {"boundary": js.dirichlet(0.0)}
    )
    run = js.evolve(plate, disk(0.06), 0.0, t=(0.0, 2.4), steps=96, readapt=js.Readapt(disk, 1e-2, times=12))
    print(run.diagnose())
    fig, axes = plt.subplots(1, 4, figsize=(11, 3.2), layout="constrained")
    for ax, t in zip(axes, (0.2, 0.8, 1.6, 2.4)):
        state = run.at(t)
        js.plot.solution(state, colorbar=False, ax=ax)
        ax.scatter(*state.cloud.points.T, s=2.0, color="white", linewidths=0)
        ax.set_title(f"t = {t:.1f}, {len(state.cloud)} particles", fontsize="medium")
        ax.set_axis_off()
    return fig


def adaptation(plt):
    """A corner singularity to 1e-6, its place unknown."""
    case = NIST["corner-270"]()
    found = js.adapt(case.problem, case.make, 1e-6)
    axes = js.plot.adaptation(found)
    axes[0].set_title(f"{len(found.cloud)} particles; true error {true_error(case, found):.0e}", fontsize="medium")
    return axes[0].figure


def regions(plt):
    """A disk in a plate, whose contact is imperfect: particles, and a temperature that jumps."""
    disk = js.sdf.circle((0.0, 0.0), 0.5)
    around = js.sdf.difference(js.sdf.rectangle((-1, -1), (1, 1)), disk)
    cloud = js.regions({"disk": disk, "plate": around}, ((-1, -1), (1, 1)), 0.08)
    k = {"disk": 10.0, "plate": 1.0}
    contact = js.interface({name: lambda u, x, n, c=c: c * n @ js.grad(u)(x) for name, c in k.items()}, resistance=0.5)
    bcs = {"boundary": js.dirichlet(lambda x: x[0]), "disk|plate": contact}
    sol = js.solve(js.Problem({name: lambda u, x: js.laplacian(u)(x) for name in k}, bcs), cloud)
    fig, (left, right) = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
    js.plot.cloud(cloud, ax=left)
    js.plot.solution(sol, ax=right)
    return fig


PICTURES = ("first", "slices", "errors", "regions", "modes", "time", "following", "adaptation")


def main(names=PICTURES):
    import matplotlib.pyplot as plt

    IMAGES.mkdir(parents=True, exist_ok=True)
    for name in names:
        figure = globals()[name](plt)
        figure.savefig(IMAGES / f"{name}.png", dpi=110)
        plt.close(figure)
        print(IMAGES / f"{name}.png")


if __name__ == "__main__":
    main(arguments(__doc__, names="picture").names or PICTURES)
