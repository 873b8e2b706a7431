"""Cotangents of a run, collected on the way back."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.pencil.sparse import sampled
from jsmitsm.evolution.gradient.inputs import Inputs, Push
from jsmitsm.evolution.space.semidiscrete import Semidiscrete

# Products of cotangents and states that are taken together.
MANY = 100


class Bars:
    """Cotangents of all inputs; those of the matrices at their entries, many products at a time."""

    def __init__(self, semi: Semidiscrete, at: Inputs, timed: bool):
        self.semi, self.at, self.timed = semi, at, timed
        self.system = system = semi.system
        self.still = np.flatnonzero(system.undriven())
        self.force, self.jump = np.zeros(at.force.shape), np.zeros(at.jump.shape)
        self.h = 0.0
        self.pull = None if at.push is None else Pull(semi, at)
        self._lower = slice(system.n if system.second else 0, None)
        self._matrices = [np.zeros(np.shape(v)) for v in system.values]
        self._mass: list[tuple[np.ndarray, np.ndarray]] = []
        self._stiff: list[tuple[np.ndarray, np.ndarray]] = []

    def mass(self, left: np.ndarray, right: np.ndarray) -> None:
        """E* += left^T right, of rows (m, size); the upper half of E, where there is one, is not differentiated."""
        self._mass.append((left[:, self._lower], right[:, self._lower]))
        if sum(len(v) for v, _ in self._mass) >= MANY:
            self._flush()

    def stiff(self, left: np.ndarray, right: np.ndarray) -> None:
        """A* += left^T right."""
        self._stiff.append((left[:, self._lower], right))

    def _flush(self) -> None:
        system, n = self.system, self.system.n
        if self._mass:
            self._matrices[-1] += sampled(system.masses[-1], *_columns(self._mass))
        if self._stiff:
            left, right = _columns(self._stiff)
            self._matrices[0] += sampled(system.stiffness, left, right[:n])
            if system.second:  # A = [0, -1; A, M1]
                self._matrices[1] += sampled(system.masses[0], left, right[n:])
        self._mass, self._stiff = [], []

    def finished(self, y_bar: np.ndarray) -> Inputs:
        """All of them."""
        self._flush()
        at = self.at
        push, known, times = (
            (None, np.zeros(at.known.shape), np.zeros(at.times.shape)) if self.pull is None else self.pull.finished()
        )
        return Inputs(tuple(self._matrices), push, y_bar, np.asarray(self.h), self.force, self.jump, known, times)


def _columns(pairs: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, ...]:
    return tuple(np.ascontiguousarray(np.concatenate(v).T) for v in zip(*pairs))


class Pull:
    """The way back through Q = -B N: cotangents of states at once, those of all else collected."""

    def __init__(self, semi: Semidiscrete, at: Inputs):
        self.semi, self.at = semi, at
        self.known = np.zeros(at.known.shape)
        self.source = np.zeros(np.shape(at.push.source))
        self._seen: list[tuple[Any, Any, int]] = []
        self._last: tuple[Any, int, Any] = (None, -1, None)

    def _looked(self, y: np.ndarray, number: int) -> tuple[Any, Any]:
        """Slots (S, N) of a state, and how N depends on them (E, S, N)."""
        if self._last[0] is not y or self._last[1] != number:
            semi = self.semi
            u = semi.placed(y[: semi.system.n], self.at.known[number])
            slots = semi.slot_values(u)
            self._last = y, number, (slots, semi.steepness(u, self.at.times[number]))
        return self._last[2]

    def _through(self, bar: np.ndarray, y: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Q'^T bar, of all values (N F,); and -B^T bar (E, N)."""
        semi = self.semi
        _, jac = self._looked(y, number)
        z = -(semi.source.host_transposed @ bar[semi.system.size - semi.system.n :]).reshape(-1, semi.fields).T
        u_bar = np.zeros((semi.n, semi.fields))
        for (k, _), d, row in zip(semi.rest.slots, semi.slopes, np.einsum("esn,en->sn", jac, z)):
            u_bar[:, k] += row if d is None else d.host_transposed @ row
        lent = np.zeros_like(u_bar)
        np.add.at(lent, semi.disc.partner, u_bar)
        return lent.reshape(-1), z

    def state(self, bar: np.ndarray, y: np.ndarray, number: int) -> np.ndarray:
        """Q'(y)^T bar."""
        semi = self.semi
        out = self._through(bar, y, number)[0][semi.free]
        return np.concatenate([out, np.zeros(semi.system.n)]) if semi.second else out

    def collect(self, bar: np.ndarray, y: np.ndarray, number: int) -> None:
        """What Q owes to all but the state."""
        semi = self.semi
        flat, z = self._through(bar, y, number)
        slots, _ = self._looked(y, number)
        found = semi.nonlinear(slots, self.at.times[number], semi.params)
        source = semi.source
        self.source -= bar[semi.system.size - semi.system.n :][source.rows] * np.asarray(found)[source.cols]
        self.known[number] += flat[semi.held]
        self._seen.append((slots, z, number))

    def finished(self) -> tuple[Any, np.ndarray, np.ndarray]:
        """Cotangents of what N takes, of the held values and of the times."""
        at, semi = self.at, self.semi
        slots, z = (jnp.asarray(np.stack([v[k] for v in self._seen])) for k in (0, 1))
        numbers = np.array([v[2] for v in self._seen])

        def total(push: Push, times: Any) -> Any:
            now = semi.stated(at.values, push)
            one = lambda s, w, t: jnp.vdot(w.T.reshape(-1), now.nonlinear(s, t, push.params))  # noqa: E731
            return jnp.sum(jax.vmap(one)(slots, z, times))

        push_bar, times_bar = jax.grad(total, argnums=(0, 1), allow_int=True)(at.push, jnp.asarray(at.times[numbers]))
        times = np.zeros(at.times.shape)
        np.add.at(times, numbers, np.asarray(times_bar))
        push_bar.source = self.source
        return push_bar, self.known, times
