"""The error of a solution in the measure of the tolerance, what particles contribute to it, and how far it is gone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.runtime.errors import SolveError, in_words
from jsmitsm.solution.estimate import Correction
from jsmitsm.solution.solution import Solution

NORMS = ("max", "l2")
Quantity = Callable[[Solution], Any]


@dataclass(frozen=True)
class Measured:
    """error: relative, in the measure of the tolerance; infinite where there is none. contribution (N,): of every
    particle to it, in a scale of their own. scale: the largest |u|. apart: the distance to the solution of another
    order, infinite where that is not known to the last. number: of the quantity, if there is one. gathered: the error
    that contributions (N,) of random signs make, in the scale of theirs; None where that is not known. local (N,): the
    estimate at every particle, relative to the largest |u|; None where the tolerance is on something else. missed (N,):
    the same of what is not seen between the particles."""

    error: float
    contribution: np.ndarray
    scale: float
    apart: float = np.inf
    number: float | None = None
    gathered: Callable[[np.ndarray], float] | None = None
    local: np.ndarray | None = None
    missed: np.ndarray | float = 0.0


def measured(sol: Solution, spacing: np.ndarray, order: int, norm: str, quantity: Quantity | None) -> Measured:
    """What the estimate says of a solution; order: that of the operator."""
    values = np.asarray(sol.u).reshape(len(sol.cloud), -1)
    scale = float(np.abs(values).max(initial=0.0))
    try:
        found = _corrected(sol)
        error = np.asarray(found.error)
        fine = np.isfinite(values).all() and np.isfinite(error).all()
    except (ValueError, SolveError):
        fine = False
    if not fine:
        return Measured(np.inf, np.ones(len(values)), scale)
    # A defect of u is one of the equation times spacing^order; with the volume around it counts for all of the domain.
    far = (spacing / spacing.max()) ** min(0, sol.cloud.dim - order) if found.adjoint is not None else 1.0
    defect = np.abs(np.asarray(found.error if found.defect is None else found.defect))
    missed = found.missed
    if missed is not None:
        defect = np.maximum(defect, np.abs(missed[1]))
    contribution = far * defect.max(axis=1)
    of = lambda x: size(np.asarray(x), values, spacing, norm, sol.cloud.dim)  # noqa: E731
    relative = of(error) if missed is None else max(of(error), of(missed[0]))
    if quantity is None:
        # A step of Newton's method leads to another order but about.
        exact = sol.iterations == 1 and sol.defects
        apart = of(found.towards) if exact else np.inf
        known = norm == "max" and scale > 0
        local = np.abs(error).max(axis=1) / scale if known else None
        unseen = np.abs(missed[0]).max(axis=1) / scale if known and missed is not None else 0.0
        gathered = _gathering(found, far, defect.shape, norm)
        return Measured(relative, contribution, scale, apart, gathered=gathered, local=local, missed=unseen)
    number, weights = _weights(sol, quantity)
    if not np.isfinite(number):
        return Measured(np.inf, np.ones(len(values)), scale, number=number)
    if weights is None:  # nothing differentiable: the whole solution stands for the number
        return Measured(relative, contribution, scale, number=number)
    away = abs(float(np.sum(weights * error)))
    if missed is not None:
        away = max(away, abs(float(np.sum(weights * missed[0]))))
    if found.adjoint is not None:
        contribution = np.abs(found.adjoint(weights) * defect).max(axis=1)
    return Measured(away / (abs(number) or scale or 1.0), contribution, scale, number=number)


def _gathering(found: Correction, far: Any, shape: tuple[int, ...], norm: str) -> Callable[[np.ndarray], float] | None:
    """Defects of random signs taken through the inverse: from one place to another they fade, or add up."""
    through = found.through
    if through is None or norm != "max":
        return None
    signs = np.random.default_rng(0).choice([-1.0, 1.0], shape)

    def gathered(contribution: np.ndarray) -> float:
        return float(np.abs(through((contribution / far)[:, None] * signs)).max(initial=0.0))

    return gathered


def _corrected(sol: Solution) -> Correction:
    """What the estimate knows; of several regions the size of the error alone."""
    if sol.defects:
        return sol.correction()
    error = np.asarray(sol.error_estimate()).reshape(len(sol.cloud), -1)
    return Correction(error, error, None, None)


def size(error: np.ndarray, values: np.ndarray, spacing: np.ndarray, norm: str, dim: int) -> float:
    """An error (N, F) of values (N, F), relative to the largest or, by the volumes, to their root mean square."""
    if norm == "max":
        part, whole = np.abs(error).max(initial=0.0), np.abs(values).max(initial=0.0)
    else:
        largest = max(float(np.abs(values).max(initial=0.0)), 1e-300)
        volume = spacing[:, None] ** dim
        part, whole = (np.sqrt(np.mean((x / largest) ** 2 * volume)) for x in (error, values))
    return float(part / whole) if whole > 0 else float(part)


def _weights(sol: Solution, quantity: Quantity) -> tuple[float, np.ndarray | None]:
    """The number, and its derivatives (N, F) by the values; None where JAX cannot differentiate it."""
    values = jnp.asarray(sol.u).reshape(len(sol.cloud), -1)

    def number(values: Any) -> Any:
        (_, *rest), recipe = sol.tree_flatten()
        rest[2] = None  # the local polynomials follow the values
        return jnp.sum(_alone(jnp.asarray(quantity(Solution.tree_unflatten(recipe, (values, *rest))))))

    try:
        made, slope = jax.value_and_grad(number)(values)
        return float(made), np.asarray(slope)
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError, TypeError):
        pass  # it is not written in jax.numpy, or fails
    try:
        return float(_alone(np.asarray(quantity(sol))).sum()), None
    except TypeError as error:
        raise ValueError(
            f"quantity: fails ({in_words(error)}); expected a function of a Solution that returns a number"
        ) from error


def _alone(number: Any) -> Any:
    """What a quantity returned, refused where it is not one number."""
    if number.size != 1:
        raise ValueError(
            f"quantity: returns an array of shape {number.shape}, expected one number; search for each by itself, or "
            "for the largest of their errors, norm='max' without a quantity"
        )
    return number


def spent(history: dict[str, np.ndarray], tol: float) -> float:
    """The part of a search's time that is spent, about: the last two rounds tell how the error falls with particles.

    Rounds to come have the last one's seconds a particle, and grow as the last one did; one that checks is as the last.

    >>> rows = {"particles": [100, 400], "error": [1e-1, 1e-2], "seconds": [1.0, 2.0]}
    >>> round(spent({name: np.array(row) for name, row in rows.items()}, 1e-3), 2)
    0.27
    """
    count, error, seconds = (history[name] for name in ("particles", "error", "seconds"))
    gone = seconds.sum()
    if error[-1] <= tol:
        return float(gone / (gone + seconds[-1]))
    if len(count) < 2 or not (count[-1] > count[-2] and error[-1] < error[-2] < np.inf):
        return 0.0
    growth = count[-1] / count[-2]
    more = np.log(error[-1] / tol) / np.log(error[-2] / error[-1])  # rounds to come, and parts of one
    rest = seconds[-1] * growth * (growth**more - 1.0) / (growth - 1.0)
    return float(gone / (gone + rest))
