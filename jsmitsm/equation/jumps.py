"""Whether what an operator differentiates jumps inside of a cloud.

The differentiated values are evaluated on both sides of the places where the outcome of a branch differs between
neighbouring particles: the sides of a jump differ, those of a kink, of a safe division or of an interpolated table do
not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from jsmitsm.equation.branches import FIELD, PARAMETER, TRACED, Branches, Differentiated
from jsmitsm.runtime.tracers import any_number, concrete
from jsmitsm.taylor.jets import evaluate

# A jump is more than this part of the value: beside a smooth function's change over 1e-14 of a spacing, and a root's.
_JUMP = 1e-6
# Halvings between two particles, down to rounding; steps, in the distance of two particles, that tell on which axis a
# jump is crossed.
_HALVINGS, _ASIDE = 48, 1e-9
# Pairs of particles looked at for each two outcomes.
_PAIRS = 100


def jumps(of: Branches, points: Any, near: Any, params: Any, consts: Sequence[Any], slots: Any = None) -> str | None:
    """What jumps between which particles, in words; None where nothing does.

    points (M, D); near (N, w) the neighbours of the first N; slots (S, M) the derivatives of the field in
    ``of.slots``, None where no outcome depends on them.
    """
    leaves = [any_number(v) for v in jax.tree.leaves(params)]
    ready = all(concrete(x) is not None for x in (points, near, *(() if slots is None else (slots,))))
    if any(o.depends & TRACED for o in of.outcomes) or not ready or (
        of.depends & PARAMETER and any(concrete(v) is None for v in jax.tree.leaves(params))
    ):  # fmt: skip
        return (
            f"{of.outcomes[0].place} is differentiated, and JAX only traces what decides it here: whether it jumps "
            "inside of the cloud cannot be seen under jit. Solve without jit (derivatives alone do no harm), or mark "
            "the function with js.meant where it does not jump"
        )
    here = _Sampled(of, np.asarray(concrete(points), float), leaves, [any_number(c) for c in consts],
                    None if slots is None else np.asarray(concrete(slots)))  # fmt: skip
    return here.jump(np.asarray(concrete(near)))


class _Sampled:
    """The differentiated values and the outcomes at points between the particles."""

    def __init__(self, of: Branches, points: np.ndarray, leaves: list[Any], consts: list[Any], slots: Any):
        self.of, self.points, self.leaves, self.consts, self.slots = of, points, leaves, consts, slots
        self.seen = [k for k, o in enumerate(of.outcomes) if o.value is not None]

    def run(self, x: np.ndarray, slots: np.ndarray, values: bool) -> list[np.ndarray]:
        """Values (size, n), or outcomes, at points x (n, D)."""
        of, n = self.of, len(x)
        data = [x.T[None], *(s[None] for s in slots), *(np.asarray(v)[None, ..., None] for v in self.leaves)]
        count = len(of.values)
        wanted = [2 * int((k < count) == values) for k in range(len(of.jaxpr.outvars))]
        consts = [*of.consts, *self.consts][: len(of.jaxpr.constvars)]
        out = evaluate(of.jaxpr, consts, data, x.shape[1], 0, np, wanted)
        some = out[:count] if values else out[count:]
        return [np.broadcast_to(v[0], (*v.shape[1:-1], n)).reshape(-1, n) for v in some]

    def outcome(self, x: np.ndarray, slots: np.ndarray) -> np.ndarray:
        """All outcomes that can be seen at points, (sum of sizes, n)."""
        parts = self.run(x, slots, False)
        return np.concatenate([p.astype(float) for p in parts]) if parts else np.zeros((0, len(x)))

    def at(self, i: np.ndarray, j: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points, and slots, a part t of the way from particles i to j."""
        p, s = self.points, self.field
        return p[i] + t[:, None] * (p[j] - p[i]), s[:, i] + t * (s[:, j] - s[:, i])

    @property
    def field(self) -> np.ndarray:
        """The slots (S, M): as given, or any where no outcome depends on them."""
        if self.slots is not None:
            return self.slots
        some = np.random.default_rng(1).uniform(0.5, 1.5, len(self.of.slots))
        return np.broadcast_to(some[:, None], (len(some), len(self.points)))

    def jump(self, near: np.ndarray) -> str | None:
        i, j = self.pairs(near)
        i, j = np.concatenate([i, j]), np.concatenate([j, i])  # the first change from either side
        if not len(i):
            return None
        low, high = np.zeros(len(i)), np.ones(len(i))
        first = self.outcome(*self.at(i, j, low))
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            same = self.same_side(i, j, low, middle, high, first)
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        apart = self.thick(near, i, j, high) & self.thick(near, j, i, 1.0 - low)
        return self.found(*(x[apart] for x in (i, j, low, high)))

    def thick(self, near: np.ndarray, i: np.ndarray, j: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Whether the side of j, reached from i at t, is more than j itself or a line of particles.

        What differs on an axis alone, as where(r > 0, r, 1), is no jump inside of the cloud.
        """
        out = np.ones(len(i), bool)
        at = np.flatnonzero(t > 1.0 - _ASIDE)
        if len(at) and len(self.seen) == len(self.of.outcomes):
            i, j = i[at], j[at]
            near = near[np.where(j < len(near), j, i)]
            here = self.outcome(*self.at(i, j, np.ones(len(at))))
            out[at] = False
            for k in near.T[1:]:
                # Half way on to the next neighbour, and a little back.
                on, field = self.at(j, np.maximum(k, 0), np.full(len(at), 0.5))
                back = on + 1e-6 * (self.points[i] - self.points[j])
                out[at] |= (k >= 0) & (k != i) & (self.outcome(back, field) == here).all(axis=0)
        return out

    def same_side(self, i: Any, j: Any, low: Any, middle: Any, high: Any, first: Any) -> np.ndarray:
        """Whether the middle lies on the side of ``low``; where outcomes hide in a loop, the values tell."""
        if len(self.seen) == len(self.of.outcomes):
            return (self.outcome(*self.at(i, j, middle)) == first).all(axis=0)
        left, mid, right = (np.concatenate(self.run(*self.at(i, j, t), True)) for t in (low, middle, high))
        return np.nansum(np.abs(mid - left), axis=0) <= np.nansum(np.abs(right - mid), axis=0)

    def pairs(self, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Neighbours with different outcomes, a number of them for every two outcomes."""
        n = len(near)
        i, j = np.repeat(np.arange(n), near.shape[1] - 1), near[:, 1:].reshape(-1)
        i, j = i[j >= 0], j[j >= 0]
        if len(self.seen) == len(self.of.outcomes):
            made = self.outcome(self.points, self.field)
            code = np.unique(made, axis=1, return_inverse=True)[1].reshape(-1)
            i, j = i[code[i] != code[j]], j[code[i] != code[j]]
            kind = np.minimum(code[i], code[j]) * (code.max(initial=0) + 1) + np.maximum(code[i], code[j])
        else:
            kind = i  # of every particle its nearest, below
        distance = np.linalg.norm(self.points[i] - self.points[j], axis=1)
        order = np.lexsort((distance, kind))
        i, j, kind = i[order], j[order], kind[order]
        start = np.flatnonzero(np.diff(kind, prepend=-1))
        rank = np.arange(len(kind)) - np.repeat(start, np.diff(np.append(start, len(kind))))
        size = np.diff(np.append(start, len(kind)))
        most = 2 * self.points.shape[1] if len(self.seen) < len(self.of.outcomes) else _PAIRS
        # The shortest third of a kind, evenly: interfaces are long, and a jump may vanish on parts of them.
        step = np.maximum(np.repeat(size, size) // (3 * most), 1)
        keep = (rank % step == 0) & (rank // step < most)
        return i[keep], j[keep]

    def found(self, i: np.ndarray, j: np.ndarray, low: np.ndarray, high: np.ndarray) -> str | None:
        """The first value that differs between the two sides."""
        if not len(i):
            return None
        of = self.of
        sides = [self.at(i, j, t) for t in (low, high)]
        ends = [self.at(i, j, t) for t in (np.zeros(len(i)), np.ones(len(i)))]
        crossed = self.crossed(i, j, sides[0])
        changed = self.outcome(*sides[0]) != self.outcome(*sides[1])
        for field in self.fields(len(i)):
            made = [self.run(x, s if field is None else field, True) for x, s in (*sides, *ends)]
            for k, value in enumerate(of.values):
                one, two, *others = (m[k] for m in made)
                size = np.max([np.nanmax(np.abs(v), axis=0, initial=0.0) for v in (one, two, *others)], axis=0)
                with np.errstate(invalid="ignore"):
                    off = np.nanmax(np.abs(two - one), axis=0, initial=0.0)
                across = np.ones(len(i), bool) if value.axis is None else crossed[value.axis]
                bad = np.flatnonzero((off > _JUMP * size) & across)
                # On one place in the plane meet no two sides of a line: it is a point, as the origin of an angle.
                place = sides[0][0][bad]
                if len(bad) and (place.shape[1] == 1 or np.ptp(place, axis=0).max() > 1e-6 * np.ptp(self.points)):
                    worst = bad[np.argmax(off[bad])]
                    return self.words(value, sides[0][0][worst], one[:, worst], two[:, worst], changed[:, worst])
        return None

    def fields(self, n: int) -> list[np.ndarray | None]:
        """The slots to try: those given, else each alone and none, whatever their units."""
        if self.slots is not None:
            return [None]
        units = np.eye(len(self.of.slots) + 1)[:, : len(self.of.slots)]
        return [None, *(np.broadcast_to(u[:, None], (len(u), n)) for u in units)]

    def crossed(self, i: np.ndarray, j: np.ndarray, side: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Along which axes (D, n) the outcome changes here: a jump along another does not enter a derivative."""
        dim = self.points.shape[1]
        if self.of.depends & FIELD or len(self.seen) < len(self.of.outcomes) or dim == 1:
            return np.ones((dim, len(i)), bool)
        x, s = side
        here, step = self.outcome(x, s), _ASIDE * np.linalg.norm(self.points[i] - self.points[j], axis=1)
        out = []
        for e in np.eye(dim):
            moved = [self.outcome(x + sign * step[:, None] * e, s) for sign in (-1.0, 1.0)]
            out.append(np.any([(m != here).any(axis=0) for m in moved], axis=0))
        return np.array(out)

    def words(self, value: Differentiated, x: Any, one: Any, two: Any, changed: np.ndarray) -> str:
        rows = [self.outcome_rows(k) for k in self.seen]
        sure = [k for k, some in zip(self.seen, rows) if k in value.reached and changed[some].any()]
        place = self.of.outcomes[min(sure or value.reached)].place
        entry = int(np.nanargmax(np.abs(two - one)))
        return (
            f"{place} jumps near x = {np.round(x, 6).tolist()}, between particles, and what it makes jump there (from "
            f"{one[entry]:.6g} to {two[entry]:.6g}) is differentiated; the derivative of a jump holds a delta, without "
            "which the equation says nothing of what happens there, as the balance of fluxes: make it a smooth "
            "transition over several spacings (jnp.tanh), solve each side with conditions at the interface, or mark "
            "the function with js.meant where its pieces alone are meant"
        )

    def outcome_rows(self, k: int) -> slice:
        sizes = [int(np.prod(self.of.outcomes[m].value)) for m in self.seen]
        at = self.seen.index(k)
        return slice(sum(sizes[:at]), sum(sizes[: at + 1]))
