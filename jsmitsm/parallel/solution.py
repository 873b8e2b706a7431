"""What the processes found: values of own particles, and the whole by asking one another."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.parallel.halo import from_box
from jsmitsm.parallel.local import OfOwn
from jsmitsm.parallel.look.flags import told, unseen
from jsmitsm.parallel.look.towards import corrected
from jsmitsm.parallel.team import Team, collective, team
from jsmitsm.runtime.arrays import ArrayLike
from jsmitsm.runtime.errors import SolveError, explained, is_one_of
from jsmitsm.runtime.tracers import frozen
from jsmitsm.solution.evaluation import checked_points
from jsmitsm.solution.fit import Recipe
from jsmitsm.solution.flags import too_large
from jsmitsm.solution.look.sizes import share
from jsmitsm.solution.solution import Solution


class ParallelSolution(OfOwn):
    """A solution of which every process has a part.

    Attributes
    ----------
    u : array (n,) or (n, F)
        Values at this process's own particles.
    points : array (n, D)
        Where these are.
    numbers : array (n,)
        Their numbers in the whole cloud.
    local : Solution
        A solution on the own particles and those around them, with all that a ``js.Solution`` can do there.
    flags : list of str
        What speaks against the solution; see ``js.Solution``.
    iterations : int
        Steps of Newton's method; 1 for a linear problem.
    stats : dict
        Seconds per phase, sizes, iterations, what was repaired (numbers in the whole cloud).
    """

    def __init__(self, us: Team, local: Any, recipe: Recipe, values: Any, system: Any,
                 seconds: dict[str, float]):  # fmt: skip
        self._team, self._local, self.system = us, local, system
        self._values, self._recipe = values, recipe
        self._taylor: Any = None
        self._linearised: Any = None  # the expansions at which a nonlinear problem was linearised last
        self._error: np.ndarray | None = None  # the estimate (n, F), once asked for
        self._share = 0.0  # of the solution
        self._found: list[str] | None = None
        self.iterations = 1
        halo, health = local.halo, local.run.health
        sent = sum(len(at) for at in halo.lent)
        name = lambda ids: np.concatenate(us.gather(halo.slab.number[np.asarray(ids, int)]))  # noqa: E731
        self.stats: dict[str, Any] = {
            "seconds": seconds, "particles": local.mine.count, "own": len(halo.ids),
            "ghosts": len(halo) - len(halo.ids), "reach": halo.reach, "processes": us.size,
            "halo_bytes": 8 * sent * recipe.fields, "halo_messages": sum(len(at) > 0 for at in halo.lent),
            "depth": recipe.depth, "linear": system.info, "residual": system.info.get("residual", 0.0),
            "lebesgue_max": us.most(health.largest), "repaired": np.sort(name(health.repaired)),
            "weak": np.sort(name(health.weak)),
        }  # fmt: skip

    @property
    def u(self) -> np.ndarray:
        """Values (n,) or (n, F) of the own particles."""
        own = self._values[self._local.halo.ids]
        return own[:, 0] if self._recipe.fields == 1 else own

    @property
    def local(self) -> Solution:
        """The solution on the own particles and those around them; asked for by all processes together."""
        if self._taylor is None:
            self._taylor = self._local.coefficients(self._values, self._linearised)
        return Solution(
            self._values, self._local.cloud, self._recipe, None, True, 1, dict(self.stats), fitted=frozen(self._taylor)
        )

    @property
    def flags(self) -> list[str]:
        """The sentences of one process, the same on all, which ask together; tested when first asked for."""
        if self._found is None:
            self._found = told(self._local, self.system, self._values, self._linearised, self._estimated)
        return explained([*self._found, *too_large(self._share)])

    def _corrected(self) -> np.ndarray:
        """The size of the estimated error (n, F) of the own values."""
        if self._error is None:
            towards, units = corrected(self._local, self._values, self._linearised)
            known = np.abs(towards)
            self._error = np.maximum(known, unseen(self._local, self.system, self._values, self._linearised, known))
            own = self._values[self._local.halo.ids]
            self._share = share(self._error * units, own * units, told=self._local.whole)
        return self._error

    def _estimated(self) -> float:
        """Over the solution, infinite where there is no estimate."""
        try:
            self._corrected()
        except (ValueError, SolveError):
            return np.inf
        return self._share if np.isfinite(self._share) else np.inf

    def gathered(self) -> np.ndarray | None:
        """Values (N,) or (N, F) of the whole cloud in its order, on the first process; None on the others."""
        self._team.gather(None)  # who failed says so here
        parts = self._team.comm.gather((self.numbers, self.u), root=0)
        if parts is None:
            return None
        number, values = (np.concatenate(some) for some in zip(*parts))
        return values[np.argsort(number)]

    def __repr__(self) -> str:
        return (f"ParallelSolution({len(self.numbers)} of {self._local.mine.count} particles here, "
                f"method={self._recipe.method!r}, order={self._recipe.order})")  # fmt: skip


@collective
def norm(values: ArrayLike, kind: str = "max") -> float:
    """A norm of values of which every process has its own.

    Parameters
    ----------
    values : array_like (n, ...)
        This process's.
    kind : {"max", "rms"}
        The largest size, or the root of the mean square.

    Returns
    -------
    float
        The same on all processes; NaN where a value is none.

    Raises
    ------
    ValueError
        For another kind.

    Examples
    --------
    ``error = jp.norm(sol.u - exact(sol.points))``
    """
    us = team()
    with us.phase():
        own = np.abs(np.asarray(values))
        if not is_one_of(kind, ("max", "rms")):
            raise ValueError(f"kind: {kind!r} is none of 'max', 'rms'")
    if kind == "max":
        return float(np.max(us.gather(float(own.max(initial=0.0)))))
    total, count = us.total(np.array([(own**2).sum(), own.size]))
    return float(np.sqrt(total / max(count, 1)))


@collective
def evaluate(sol: ParallelSolution, points: ArrayLike, multi_index: tuple[int, ...] | None = None, *,
             outside: str = "nan") -> np.ndarray:  # fmt: skip
    """Values or a derivative anywhere: every process asks for points of its own choice.

    Parameters
    ----------
    sol : ParallelSolution
        What ``jp.solve`` returned.
    points : array_like (M, D)
        Anywhere in the domain; each process its own, none is an array (0, D).
    multi_index : tuple of int (D,), optional
        A derivative, as in ``sol.derivative``.
    outside : {"nan", "extrapolate", "raise"}
        As for a ``js.Solution``.

    Returns
    -------
    array (M,) or (M, F)
        For the points that this process asked for.

    Raises
    ------
    ValueError
        As for a ``js.Solution``, on all processes.

    Examples
    --------
    ``centre = jp.evaluate(sol, [[0.5, 0.5]])``
    """
    us, halo = sol._team, sol._local.halo
    with us.phase():
        places = np.asarray(checked_points(points, halo.slab.dim))
        away = np.stack([from_box(places, *box) for box in halo.boxes], axis=1)
        whom = np.argmin(away, axis=1) if len(places) else np.zeros(0, int)
    local = sol.local
    asked = us.trade([places[whom == rank] for rank in range(us.size)])
    b = multi_index or (0,) * halo.slab.dim
    with us.phase():
        fields = () if sol._recipe.fields == 1 else (sol._recipe.fields,)
        told = [np.asarray(local.derivative(x, b, outside=outside)) if len(x) else np.zeros((0, *fields))
                for x in asked]  # fmt: skip
    out = np.zeros((len(places), *fields))
    for rank, came in enumerate(us.trade(told)):
        out[whom == rank] = came
    return out
