"""From a problem in time and its pencil to E y' + A y = F(t) - B N(y, t) for the free values."""

from __future__ import annotations

from copy import copy
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.coefficients import conditions_of
from jsmitsm.discretization.pencil.assemble import Pencil
from jsmitsm.discretization.pencil.fits import local_fits
from jsmitsm.discretization.pencil.sparse import Sparse
from jsmitsm.evolution.space.local_fits import StateFit
from jsmitsm.evolution.space.system import System
from jsmitsm.evolution.space.timed import Timed
from jsmitsm.evolution.steps.tableaux import Sampling
from jsmitsm.runtime.collector import uncollected
from jsmitsm.runtime.tracers import any_number, concrete, is_traced

# Steps from which on those to come are looked at together, and the numbers that this may take at a time.
MANY, NUMBERS = 64, 4e6
# A start may differ from what is held by this part of its size.
ROUND_OFF = 1e-13


class Semidiscrete:
    """The equations of the free values, what drives them, and the way back to all values.

    A u = B f + Bg g with f = -(M2 u'' + M1 u' + N): rows of the free values, columns of free and of held ones.
    """

    def __init__(self, timed: Timed, pencil: Pencil, params: Any, damping: float = 0.0, reference: Any = None):
        self.timed, self.pencil, self.params = timed, pencil, params
        # What of N counts as the nonlinear part, and its coefficients (E, S, N) that the pencil has already.
        self.rest = timed.rest if reference is None else timed.space
        self.reference: Any = reference
        self.disc = disc = pencil.layout.disc
        self.n, self.fields = len(disc.cloud), timed.problem.fields
        self.free, self.held = pencil.free, pencil.held
        stiff, source, given = pencil.A, pencil.B, pencil.Bg
        masses = [self._times_mass(source, j) for j in ((1, 2) if self.second else (1,))]
        if timed.values:
            stiff = _sum(stiff, self._times_mass(source, 0))
        if damping and self.second:
            masses[0] = _sum(masses[0], self._damping(masses[1], damping))
        elif damping:
            stiff = _sum(stiff, self._damping(masses[0], damping))
        every = np.arange(self.n * self.fields)
        self.system = System(
            stiff.part(self.free, self.free), tuple(m.part(self.free, self.free) for m in masses), self.places
        )
        self.stiff_held = stiff.part(self.free, self.held)
        self.masses_held = [m.part(self.free, self.held) for m in masses]
        self.source = source.part(self.free, every)
        self.given = given.part(self.free, np.arange(given.shape[1]))
        self._still: Any = None

    def stated(self, values: tuple[Any, ...], push: Any) -> Semidiscrete:
        """The same with other numbers in its matrices and its nonlinear part; push: None where there is none."""
        new = copy(self)
        new.system = self.system.with_values(values)
        if push is not None:
            new.source, new.rest = self.source.with_values(push.source), push.record
            new.params, new.reference = push.params, push.reference
        return new

    @property
    def second(self) -> bool:
        """Whether the problem is of second order in time."""
        return bool(self.timed.masses[1].slots)

    @property
    def linear(self) -> bool:
        """Whether nothing is left of N but a source."""
        return not self.rest.slots

    @cached_property
    def apart(self) -> bool:
        """Whether N at u = 0 is a source, taken apart from N: implicitly, and so with more of the scheme's order."""
        if self.linear:
            return True
        points, params = jax.tree.map(any_number, (self.points, self.params))
        with np.errstate(all="ignore"):
            slots = np.zeros((len(self.rest.slots), self.n))
            found = concrete(self.rest.residuals(points, params=(np.asarray(0.0), params), slots=slots))
        return found is None or bool(np.isfinite(found).all())

    @property
    def points(self) -> Any:
        return self.disc.cloud.points

    @property
    def places(self) -> np.ndarray | None:
        if is_traced(self.points):
            return None
        return np.asarray(self.points)[self.free // self.fields]

    @property
    def free_fields(self) -> np.ndarray:
        """The field of each free value of a state."""
        return self.free % self.fields

    def _damping(self, mass: Sparse, amount: float) -> Sparse:
        """amount M (1 - P), P the leave-one-out prediction of each value: it damps what only the cloud sees."""
        fits = local_fits(self.disc, max(self.disc.rec.order - 2, 1), alone=True)
        n, w = fits.near.shape
        values = -fits.weights[:, 0]
        values[:, 0] += 1.0
        with uncollected():
            from scipy import sparse

        one = sparse.csr_array((values.ravel(), (np.repeat(np.arange(n), w), fits.near.ravel())), shape=(n, n))
        every = sparse.kron(one, sparse.eye_array(self.fields)).tocsr()
        kept = np.ones(n * self.fields)
        kept[self.held] = 0.0
        concrete = Sparse(jax.lax.stop_gradient(mass.values), mass.rows, mass.cols, mass.shape)
        product = (amount * (concrete.host @ sparse.diags_array(kept) @ every)).tocoo()
        rows, cols = (c.astype(int) for c in product.coords)
        return Sparse(product.data, rows, cols, mass.shape)

    def _times_mass(self, source: Sparse, order: int) -> Sparse:
        """B M: the source of a particle's equation from the rates of its fields, of order 0 from their values."""
        mass = self.timed.mass(order, self.points, (np.asarray(0.0), self.params))  # of t it is free
        fields, concrete = self.fields, not is_traced(mass, source.values)
        values, rows, cols = [], [], []
        particle, equation = source.cols // fields, source.cols % fields
        for k in range(fields):
            some = mass[:, :, k]
            use = np.flatnonzero(np.asarray(some)[particle, equation]) if concrete else np.arange(len(particle))
            if concrete and not len(use):
                continue
            values.append((source.values if concrete else jnp.asarray(source.values))[use]
                          * some[particle[use], equation[use]])  # fmt: skip
            rows.append(source.rows[use])
            cols.append(particle[use] * fields + k)
        if not values:
            return Sparse(np.zeros(0), np.zeros(0, int), np.zeros(0, int), source.shape)
        join = np.concatenate if concrete else jnp.concatenate
        return Sparse(join(values), np.concatenate(rows), np.concatenate(cols), source.shape)

    # ------------------------------------------------------------------ what drives

    def sample(self, t: Any) -> tuple[Any, ...]:
        """Held values (held,), conditions' values (G,), source (N F,) at a moment; of second order two rates more."""
        problem = self.timed.at(t, self.params)
        values, given, gamma = conditions_of(self.disc, problem)
        xp = jnp if is_traced(values, given, gamma) else np
        conditions = xp.concatenate([xp.asarray(given).reshape(-1), xp.asarray(gamma).reshape(-1)])
        source = np.zeros(self.n * self.fields)
        if self.apart and self.timed.rest.source != "zero":
            slots = None if self.linear else np.zeros((len(self.rest.slots), self.n))
            found = self.rest.residuals(self.points, params=problem.params, slots=slots)
            source = (jnp if is_traced(found) else np).broadcast_to(found, (self.fields, self.n)).T.reshape(-1)
        held = xp.asarray(values).reshape(-1)[self.held]
        return (held, conditions, source, *self._rates(t)) if self.second else (held, conditions, source)

    def _rates(self, t: Any) -> tuple[Any, Any]:
        """First and second rates of the held values."""
        if self.timed.steady or not len(self.held):
            return np.zeros(len(self.held)), np.zeros(len(self.held))

        def held(s: Any) -> Any:
            return jnp.asarray(conditions_of(self.disc, self.timed.at(s, self.params))[0]).reshape(-1)[self.held]

        t = jnp.asarray(t, float)
        one = jnp.ones_like(t)
        return jax.jvp(lambda s: jax.jvp(held, (s,), (one,))[1], (t,), (one,))

    def samples(self, times: Any) -> list[Any]:
        """The same at several moments (m,), moments last."""
        # Functions of the problem may close over what is traced, where neither times nor parameters are.
        if is_traced(times, self.params, self.points, self.timed.problem, self.timed.rest):
            return [jnp.moveaxis(v, 0, -1) for v in jax.vmap(self.sample)(jnp.asarray(times))]
        if self.timed.steady:
            if self._still is None:
                self._still = self.sample(np.asarray(float(times[0])))
            return [np.broadcast_to(np.asarray(v)[:, None], (len(v), len(times))) for v in self._still]
        found = [self.sample(np.asarray(float(t))) for t in times]
        return [np.stack([np.asarray(v) for v in column], axis=-1) for column in zip(*found)]

    def many_samples(self, times: np.ndarray) -> list[np.ndarray]:
        """The same, by one program."""
        return [np.moveaxis(np.asarray(v), 0, -1) for v in jax.vmap(self.sample)(jnp.asarray(times))]

    def forces(self, held: Any, conditions: Any, source: Any, *rates: Any) -> tuple[Any, Any]:
        """F and H (m, size) from samples, moments last."""
        force = self.given.times(conditions) - self.stiff_held.times(held) - self.source.times(source)
        if self.second:
            force = force - self.masses_held[0].times(rates[0])
            moved = self.masses_held[1].times(rates[0])
        else:
            moved = self.masses_held[0].times(held)
        return self.system.force(force).T, self.system.force(moved).T

    def blended(self, sampling: Sampling, samples: list[Any]) -> list[Any]:
        """Samples at the nodes of a step as those of its stages."""
        held, conditions, source, *rates = samples
        kept = [v[..., sampling.stages] for v in (source, *rates)]
        return [held @ sampling.blend.T, conditions @ sampling.blend.T, *kept]

    # ------------------------------------------------------------------ all values from the free ones

    def lifted(self, y: Any, t: Any, rates: bool = False) -> Any:
        """All values (N, F) from a state (or the rates of one of second order)."""
        sample = self.sample(t)
        part = y[self.system.n :] if rates else y[: self.system.n]
        return self.placed(part, sample[3] if rates else sample[0])

    def placed(self, part: Any, held: Any) -> Any:
        """Values (N, F) from those of free and of held ones."""
        flat: Any
        if is_traced(part, held):
            flat = jnp.zeros(self.n * self.fields).at[self.free].set(part).at[self.held].set(held)
        else:
            flat = np.zeros(self.n * self.fields)
            flat[self.free], flat[self.held] = part, held
        return centred(flat.reshape(self.n, self.fields)[self.disc.partner], self.floating)

    def kept(self, part: Any, held: Any) -> Any:
        """What of a state is kept: all values."""
        return self.placed(part, held)

    def begun(self, start: tuple[Any, ...], t: float) -> tuple[Any, Any, bool]:
        """The state of a start ((N, F),), or with rates; the held values' part of E in it; whether that jumps."""
        flat = [np.asarray(v).reshape(-1) for v in start]
        asked = self.system.force(self.masses_held[-1].host @ flat[-1][self.held])
        gap = np.abs(flat[0][self.held] - np.asarray(self.sample(np.asarray(t))[0])).max(initial=0.0)
        scale = max(float(np.abs(v).max(initial=0.0)) for v in flat)
        jumps = bool(gap > ROUND_OFF * scale) and self.masses_held[-1].values.size > 0
        return np.concatenate([v[self.free] for v in flat]), asked, jumps

    @property
    def floating(self) -> int | None:
        """A field that is determined up to a constant: its mean over the particles is zero."""
        flow = self.timed.flow
        return flow.pressure if flow is not None and flow.floating else None

    def state_fit(self, degree: int) -> StateFit:
        """What gives a state its local polynomials."""
        return StateFit(self.disc.cloud, degree, lambda: local_fits(self.disc, degree))

    # ------------------------------------------------------------------ the nonlinear part

    @cached_property
    def slopes(self) -> list[Sparse | None]:
        """For every slot of N the matrix of its derivative; None for the value itself."""
        highest = max((sum(b) for _, b in self.rest.slots), default=0)
        if not highest:
            return [None] * len(self.rest.slots)
        fits = local_fits(self.disc, self.disc.rec.order + highest - 1)
        made = {b: fits.derivative(b) for b in {b for _, b in self.rest.slots} if sum(b)}
        return [made.get(b) for _, b in self.rest.slots]

    def slot_values(self, u: Any) -> Any:
        """The derivatives (S, N) that N asks for, of all values (N, F)."""
        columns = [u[:, k] if d is None else d.times(u[:, k]) for (k, _), d in zip(self.rest.slots, self.slopes)]
        return (jnp if is_traced(u) else np).stack(columns)

    def nonlinear(self, slots: Any, t: Any, params: Any) -> Any:
        """N (N F,) from its slots' derivatives (S, N)."""
        found = self.rest.residuals(self.points, params=(t, params), slots=slots)
        xp = jnp if is_traced(found, slots, self.reference) else np
        if self.apart:
            found = found - self.rest.residuals(self.points, params=(t, params), slots=np.zeros(slots.shape))
        found = xp.broadcast_to(found, (self.fields, self.n))
        if self.reference is not None:
            found = found - (xp.asarray(self.reference) * slots).sum(axis=1)
        return found.T.reshape(-1)

    def steepness(self, u: Any, t: Any) -> np.ndarray:
        """The derivatives (E, S, N) of N by its slots."""
        slots = self.slot_values(u)[:, None]
        jac, _ = self.rest.coefficients(self.points, 0, params=(np.asarray(t), self.params), slots=slots)
        jac = np.broadcast_to(jac[:, :, 0], (self.fields, len(self.rest.slots), self.n))
        return jac if self.reference is None else jac - self.reference

    def linearised(self, jac: np.ndarray) -> Any:
        """B N' (n, n), N' from the coefficients (E, S, N) of its slots."""
        with uncollected():
            from scipy import sparse

        size, places = self.n * self.fields, np.arange(self.n) * self.fields
        entries = []
        for s, ((k, _), d) in enumerate(zip(self.rest.slots, self.slopes)):
            for e in range(self.fields):
                if not jac[e, s].any():
                    continue
                if d is None:
                    entries.append((jac[e, s], places + e, places + k))
                else:
                    entries.append((jac[e, s][d.rows] * d.values, d.rows * self.fields + e, d.cols * self.fields + k))
        if not entries:  # as of u^3 where u is zero
            return sparse.csr_array((self.source.host.shape[0], len(self.free)))
        values, rows, cols = (np.concatenate(v) for v in zip(*entries))
        # A partner's value is its lender's.
        lender = (self.disc.partner[:, None] * self.fields + np.arange(self.fields)).reshape(-1)
        whole = sparse.csr_array((values, (rows, lender[cols])), shape=(size, size))
        return self.source.host @ whole[:, self.free]

    def explicit(self, y: Any, t: Any, known: Any) -> Any:
        """-B N on the equations of a state, given the held values."""
        t = t if is_traced(t) else np.asarray(float(t))
        u = self.placed(y[: self.system.n], known)
        return self.system.force(-self.source.times(self.nonlinear(self.slot_values(u), t, self.params)))


def centred(values: Any, field: int | None) -> Any:
    """Values (..., N, F) with mean zero of one field, if any."""
    if field is None:
        return values
    only = np.arange(values.shape[-1]) == field
    return values - values.mean(axis=-2, keepdims=True) * only


class Driver:
    """What drives a system in the stages of one scheme.

    Samples at the end of a step serve the next. Where the steps are known (``plan``) those of many are made at once, by
    one compiled program.
    """

    def __init__(self, semi: Semidiscrete, sampling: Sampling):
        self.semi, self.sampling = semi, sampling
        self._last: tuple[float, list[Any]] | None = None
        self._starts, self._h = np.zeros(0), 0.0
        self._block: tuple[int, int, list[Any]] = (0, 0, [])

    def plan(self, starts: np.ndarray, h: float) -> None:
        """Steps to come, of one size."""
        if not self.semi.timed.steady and len(starts) >= MANY:
            self._starts, self._h = starts, h

    def start(self, t: float) -> tuple[Any, Any, Any]:
        samples = self.semi.samples(np.array([t]))
        self._last = t, samples
        force, held = self.semi.forces(*samples)
        return force[0], held[0], samples[0][:, 0]

    def step(self, t: float, h: float) -> tuple[Any, Any, Any]:
        samples = self._samples(t, h)
        self._last = t + h, [v[:, -1:] for v in samples]
        force, held = self.semi.forces(*self.semi.blended(self.sampling, samples))
        return force, held, samples[0][:, self.sampling.stages].T

    def between(self, t: float, h: float, sampling: Sampling) -> Any:
        """F elsewhere in a step."""
        return self.semi.forces(*self.semi.blended(sampling, self.semi.samples(t + h * sampling.nodes)))[0]

    def _samples(self, t: float, h: float) -> list[Any]:
        semi, nodes = self.semi, self.sampling.nodes
        k = int(np.searchsorted(self._starts, t))
        if k < len(self._starts) and self._starts[k] == t and h == self._h:
            return self._from_block(k)
        if self._last is not None and self._last[0] == t:
            rest = semi.samples(t + h * nodes[1:])
            return [np.concatenate([a[:, -1:], b], axis=1) for a, b in zip(self._last[1], rest)]
        return semi.samples(t + h * nodes)

    def _from_block(self, k: int) -> list[Any]:
        first, end, block = self._block
        m = len(self.sampling.nodes) - 1
        if not first <= k < end:
            width = self.semi.n * self.semi.fields + len(self.semi.held)
            size = max(1, min(MANY, int(NUMBERS / (width * m))))
            some = self._starts[np.minimum(np.arange(k, k + size), len(self._starts) - 1)]  # one shape, one program
            times = (some[:, None] + self._h * self.sampling.nodes[:-1]).reshape(-1)
            block = self.semi.many_samples(np.append(times, some[-1] + self._h))
            first, end, self._block = k, k + size, (k, min(k + size, len(self._starts)), block)
        at = (k - first) * m
        last = k == len(self._starts) - 1
        index = np.append(np.arange(at, at + m), block[0].shape[1] - 1 if last else at + m)
        return [v[:, index] for v in block]


def _sum(first: Sparse, second: Sparse) -> Sparse:
    join = jnp.concatenate if is_traced(first.values, second.values) else np.concatenate
    return Sparse(
        join([first.values, second.values]), np.concatenate([first.rows, second.rows]),
        np.concatenate([first.cols, second.cols]), first.shape,
    )  # fmt: skip
