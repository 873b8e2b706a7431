"""Poisson's equation and its kin on irregular domains and on clouds of very uneven density."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jsmitsm as js
from benchmarks import scenes
from benchmarks.problems.case import Case, curved, diffusion, laplace, robin, scattered, slope, smooth, table


def _balanced(x):
    """The smooth function in the star's coordinates."""
    return jnp.exp(0.7 * x[0]) * jnp.cos(1.8 * x[1] + 0.4) + x[0] * x[1] ** 3


def _star(name: str, about: str, **more: Any) -> Case:
    return Case(name, f"laplacian(u) = f in a star, {about}", laplace, _balanced, scenes.star, ("boundary",), **more)


def _half_star() -> js.Cloud:
    return scenes.star(groups=scenes.STAR_PARTS)


def _in_ball(x):
    return jnp.exp(0.8 * x[0]) * jnp.sin(1.5 * x[1] + 0.2) * jnp.cos(x[2]) + x[0] * x[2] ** 2


def _in_3d(x):
    return jnp.exp(0.5 * x[0]) * jnp.sin(x[1] + 0.3) * jnp.cos(x[2])


def _oscillating(x: Any) -> Any:
    return jnp.sin(30.0 * x[0] + 0.3) * jnp.cos(24.0 * x[1])


def conducting(x):
    return 1.5 + jnp.sin(2 * x[0] + x[1])


def _on_plate(x):
    return jnp.exp(x[0] / 2) * jnp.sin(2 * x[1]) + x[0] * x[1]


# ------------------------------------------------------------------ how good particles are


def quality(points: np.ndarray) -> tuple[float, float]:
    """Separation and fill distance of particles in the amoeba over the mean distance to the nearest neighbour."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    near = tree.query(points, k=2)[0][:, 1]
    trial = np.random.default_rng(0).uniform(-1.2, 1.2, (400_000, 2))
    inside = np.hypot(*trial.T) < 1 + 0.2 * np.cos(5 * np.arctan2(trial[:, 1], trial[:, 0]))
    return near.min() / near.mean(), tree.query(trial[inside])[0].max() / near.mean()


def _crowding(case: Case, sol: js.Solution) -> float:
    return 1.0 / quality(np.asarray(sol.cloud.points))[0]


def _holes(case: Case, sol: js.Solution) -> float:
    return quality(np.asarray(sol.cloud.points))[1]


def _off_boundary(case: Case, sol: js.Solution) -> float:
    """Largest distance of a boundary particle from the amoeba's boundary, to first order."""
    rim = jnp.asarray(np.asarray(sol.cloud.points)[sol.cloud.groups["boundary"]])
    level, gradient = jax.vmap(jax.value_and_grad(scenes.amoeba_level))(rim)
    return float(jnp.max(jnp.abs(level) / jnp.linalg.norm(gradient, axis=1)))


# What min_energy_nodes of treverhines-rbf reaches with 5000 nodes (benchmarks/data/nodes.json): the bounds of ours.
PARTICLES = {
    "mean / least distance": (_crowding, {4: 1.35}),
    "fill / mean distance": (_holes, {4: 0.92}),
    "off the boundary": (_off_boundary, {4: 1e-10}),
}


LOOSE = {4: 5e-6, 6: 5e-9, 8: 5e-12}
JUMPS = {2: 0.1, 4: 1e-2, 6: 1e-3, 8: 1e-5}
SHAPES = table(
    _star("star", "Dirichlet", ceilings={4: 1e-7, 6: 1e-10, 8: 1e-13}, estimates=(4, 6)),
    Case(
        "star mixed", "laplacian(u) = f in a star, Dirichlet below, Neumann above", laplace, _balanced, _half_star,
        ("lower", "upper"), bcs={"upper": slope(_balanced)}, ceilings=LOOSE, estimates=(4, 6),
    ),
    _star("star robin", "Robin", bcs={"boundary": robin(_balanced)}, ceilings=LOOSE, estimates=(4, 6)),
    _star("star neumann", "Neumann, up to a constant", bcs={"boundary": slope(_balanced)}, ceilings=LOOSE,
          floating=(0,), estimates=(4, 6)),
    Case(
        "ball", "laplacian(u) = f, 7300 random particles in 3D", laplace, _in_ball, scenes.ball, ("sphere",),
        ceilings={2: 2e-3, 4: 2e-5, 6: 2e-7}, estimates=(2, 4, 6),
    ),
    scattered("step", "laplacian(u) = f, the density jumps 1:100", laplace, smooth, JUMPS, cloud=scenes.step),
    scattered("lattice step", "laplacian(u) = f, lattices of spacing 10:1 side by side", laplace, smooth, {4: 1e-5},
              cloud=scenes.stepped_lattice),
    scattered("cluster", "laplacian(u) = f, a cluster 100 times as dense", laplace, smooth, JUMPS,
              cloud=scenes.cluster),
    Case(
        "amoeba", "laplacian(u) = f on 5000 particles of an irregular domain", laplace, curved, scenes.amoeba,
        ("boundary",), ceilings={4: 1e-7}, further=PARTICLES, seconds={5000: 0.5, 100_000: 10.0}, estimates=(4,),
    ),
    Case(
        "conducting amoeba", "div((1.5 + sin(2x + y)) grad u) = f", diffusion(conducting), curved,
        scenes.amoeba, ("boundary",), ceilings={4: 1e-7},
    ),
    Case("oscillating disk", "laplacian(u) = f, u = sin(30 x + 0.3) cos(24 y)", laplace, _oscillating, scenes.disk,
         ("boundary",)),
    Case("smooth ball", "laplacian(u) = f in 3D, u smoother than in the ball", laplace, _in_3d, scenes.ball,
         ("sphere",), ceilings={4: 1e-6}),
    Case("two holes", "laplacian(u) = f on a plate with two holes", laplace, _on_plate, scenes.two_holes,
         ("outer", "hot", "cold"), ceilings={4: 1e-5}),
)  # fmt: skip
