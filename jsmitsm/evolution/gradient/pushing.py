"""The nonlinear part -B N(u, x, t) of a run as a function of what it may be differentiated by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.evolution.space.semidiscrete import Semidiscrete
from jsmitsm.runtime.tracers import is_traced


@jax.tree_util.register_dataclass
@dataclass
class Push:
    """source: the values of B; record: N; params."""

    source: Any
    record: Any
    params: Any


class Pushing:
    """-B N for the states of a run. What is given as Push is taken from there, the rest is static."""

    def __init__(self, semi: Semidiscrete):
        self.semi, self.points = semi, np.asarray(semi.points)
        self.apart, self.slopes = semi.apart, semi.slopes
        self.lender = semi.disc.partner
        self._last: tuple[Any, Any] | None = None

    def given(self) -> Push:
        semi = self.semi
        return Push(semi.source.values, semi.rest, semi.params)

    def field(self, record: Any, params: Any, slots: Any, t: Any) -> Any:
        """N (E, N) from its slots' derivatives (S, N)."""
        found = record.residuals(self.points, params=(t, params), slots=slots)
        if self.apart:
            found = found - record.residuals(self.points, params=(t, params), slots=np.zeros(np.shape(slots)))
        xp = jnp if is_traced(found) else np
        return xp.broadcast_to(found, (self.semi.fields, len(self.points)))

    def slots(self, y: Any, known: Any) -> Any:
        return self.semi.slot_values(self.semi.placed(y[: self.semi.system.n], known))

    def value(self, push: Push, y: Any, known: Any, t: Any) -> Any:
        """-B N on the equations of a state."""
        found = self.field(push.record, push.params, self.slots(y, known), t)
        matrix = self.semi.source.with_values(push.source)
        if not is_traced(push.source):
            matrix = self._kept(push.source)
        return self.semi.system.force(-matrix.times(found.T.reshape(-1)))

    def _kept(self, values: Any) -> Any:
        """The matrix with its form for the host kept from one call to the next."""
        if self._last is None or self._last[0] is not values:
            self._last = values, self.semi.source.with_values(values)
        return self._last[1]

    def pull(self, at: Any) -> Pull:
        return Pull(self, at)


class Pull:
    """The way back through -B N: cotangents of states at once, those of all else collected."""

    def __init__(self, pushing: Pushing, at: Any):
        self.pushing, self.at = pushing, at
        self.matrix = pushing.semi.source.with_values(at.push.source)
        self.known = np.zeros(at.known.shape)
        self.source = np.zeros(np.shape(at.push.source))
        self.seen: list[tuple[Any, Any, int]] = []

    def __call__(self, bar: np.ndarray, y: np.ndarray, number: int) -> np.ndarray:
        """Q'(y)^T bar."""
        pushing, semi, at = self.pushing, self.pushing.semi, self.at
        n, fields = semi.system.n, semi.fields
        bar = bar[n:] if semi.second else bar
        record, t = at.push.record, at.times[number]
        slots = pushing.slots(y, at.known[number])
        jac, _ = record.coefficients(pushing.points, 0, params=(t, at.push.params), slots=slots[:, None])
        jac = np.broadcast_to(jac[:, :, 0], (fields, len(slots), len(pushing.points)))
        found = pushing.field(record, at.push.params, slots, t).T.reshape(-1)
        self.source -= bar[self.matrix.rows] * found[self.matrix.cols]
        z = -(self.matrix.host_transposed @ bar).reshape(-1, fields).T  # (E, N)
        self.seen.append((slots, z, number))
        slots_bar = np.einsum("esn,en->sn", jac, z)
        u_bar = np.zeros((len(pushing.points), fields))
        for (k, _), d, row in zip(record.slots, pushing.slopes, slots_bar):
            u_bar[:, k] += row if d is None else d.host_transposed @ row
        lent = np.zeros_like(u_bar)
        np.add.at(lent, pushing.lender, u_bar)
        flat = lent.reshape(-1)
        self.known[number] += flat[semi.held]
        out = flat[semi.free]
        return np.concatenate([out, np.zeros(n)]) if semi.second else out

    def finished(self) -> tuple[Any, np.ndarray, np.ndarray]:
        """Cotangents of what N takes, of the held values and of the times."""
        at, pushing = self.at, self.pushing
        slots, z = (jnp.asarray(np.stack([v[k] for v in self.seen])) for k in (0, 1))
        numbers = np.array([v[2] for v in self.seen])

        def total(record: Any, params: Any, times: Any) -> Any:
            one = lambda s, w, t: jnp.sum(w * pushing.field(record, params, s, t))  # noqa: E731
            return jnp.sum(jax.vmap(one)(slots, z, times))

        moved = jnp.asarray(at.times[numbers])
        record_bar, params_bar, times_bar = jax.grad(total, argnums=(0, 1, 2), allow_int=True)(
            at.push.record, at.push.params, moved
        )
        times = np.zeros(at.times.shape)
        np.add.at(times, numbers, np.asarray(times_bar))
        return Push(self.source, record_bar, params_bar), self.known, times
