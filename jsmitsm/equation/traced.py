"""A traced residual: which derivatives it holds, of what kind, and the Taylor series of its coefficients."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.equation.branches import Branches, decides
from jsmitsm.equation.jumps import jumps
from jsmitsm.equation.linearizing import Record, open_fields, slots_of
from jsmitsm.equation.record_form import Form, is_fixed
from jsmitsm.runtime.compiled import Same, fingerprint, kept, remembered
from jsmitsm.runtime.jaxprs import EVERYTHING, NOTHING, Literal, inner_jaxprs, levels
from jsmitsm.runtime.tracers import any_number, frozen, is_traced
from jsmitsm.runtime.whole_program import in_one_program
from jsmitsm.taylor.jets import evaluate, plain
from jsmitsm.taylor.multi_indices import Slot, count
from jsmitsm.taylor.series import Ring, full_series, variable

# Numbers up to which what a record is evaluated on is compared with what it was before.
REMEMBERED = 6000
# Numbers of a series interpreted at a time on the host, but always so many particles: the temporaries stay in cache.
CHUNK, LEAST = 60_000, 512
# How many programs were traced for compilation since import; tests watch it.
COMPILATIONS = 0
# Operations on floats whose slope may jump, beside those whose outcomes choose or look up something.
KINKS = frozenset("abs max min clamp reduce_max reduce_min cummax cummin sort".split())
# Operations that may be infinite at a point; powers of whole numbers are, where these are negative.
POLES = frozenset("div pow log log1p rsqrt tan lgamma digamma".split())


@jax.tree_util.register_pytree_node_class
@dataclass(frozen=True, eq=False)
class Traced:
    """The record of a residual r(x, d^b u, extras, params) of E equations in S slots.

    It is closed: no function is called again, arrays are copies. A pytree, whose leaves are the arrays of floats.

    ``slots``: the (field, multi-index) pairs whose coefficient is not identically zero, graded.
    ``pattern`` (E, S) bool: which equation holds which slot.  ``order``: per equation the highest
    derivative, -1 if none.  ``linear``: no coefficient depends on the field.  ``constant``: linear,
    and no coefficient depends on x or the extras (on parameters it may).  ``source``: what a
    residual leaves at u = 0: "zero", "constant" or "variable" (in x or the extras).
    ``uses_extras``: whether an extra reaches the residual.  ``branches``: those that it differentiates, if any.
    """

    dim: int
    fields: int
    n_equations: int
    slots: tuple[Slot, ...]
    pattern: np.ndarray
    order: tuple[int, ...]
    linear: bool
    constant: bool
    source: str
    uses_extras: bool
    branches: Branches | None = field(repr=False)
    _record: Record = field(repr=False)
    _n_extras: int = field(repr=False)
    _params_tree: Any = field(repr=False)

    def tree_flatten(self) -> tuple[Any, Form]:
        return tuple(self._record.consts[k] for k in self._form.moving), self._form

    @classmethod
    def tree_unflatten(cls, form: Form, leaves: Any) -> Traced:
        consts = list(form.traced._record.consts)
        for k, leaf in zip(form.moving, leaves, strict=True):
            consts[k] = leaf
        new = replace(form.traced, _record=form.traced._record._replace(consts=tuple(consts)))
        new.__dict__["_form"] = form
        return new

    @cached_property
    def _form(self) -> Form:
        consts = self._record.consts
        moving = tuple(k for k, c in enumerate(consts) if not is_fixed(c))
        rest = self._record._replace(consts=tuple(None if k in moving else c for k, c in enumerate(consts)))
        return Form(replace(self, _record=rest), moving)

    def coefficients(
        self, points: Any, degree: int, *, extras: Sequence[Any] = (), params: Any = None, slots: Any = None
    ) -> tuple[Any, Any]:
        """Taylor coefficients, in x about every particle, of the linearised residual.

        Parameters: ``points`` (N, D); ``degree`` of the series; ``extras``, arrays (N, ...), one per
        shape given to ``trace``; ``params`` as given there; ``slots`` (S, T, N), the Taylor
        coefficients of the derivatives d^b u_k about which a nonlinear residual is linearised
        (None: zero).

        Returns ``(jac, res)``: ``jac`` (E, S, T, N), the coefficients of d r_e / d slot_s, or
        (E, S, 1, 1) if ``constant``; ``res`` (E, T, N), those of the residual at the given slots, or
        None where it vanishes (linear, no source, no slots given).  numpy arrays where nothing
        traced is needed, so no compilation either.  Raises ``ValueError`` for shapes that do not fit.
        """
        inputs = self._inputs(points, degree, extras, params, slots)
        if not self.linear:
            return self._compute(inputs, degree, True, True)
        given = None if slots is not None else self._given(inputs)
        if given is None:
            return self._linear(inputs, degree)
        made = lambda: jax.tree.map(frozen, self._linear(inputs, degree))  # noqa: E731
        return remembered((Same(self), degree, given), made)

    def _given(self, inputs: _Inputs) -> Any:
        """What a linear record is evaluated on, by its numbers; None where that is much, or traced."""
        some = [inputs.points, *inputs.extras, *inputs.leaves]
        if is_traced(some, inputs.consts) or sum(np.size(x) for x in some) > REMEMBERED:
            return None
        return tuple((x.shape, x.dtype.str, x.tobytes()) for x in map(np.asarray, some))

    def _linear(self, inputs: _Inputs, degree: int) -> tuple[Any, Any]:
        if not (self.constant or is_traced(inputs) or (self.source == "zero" and inputs.slots is None)):
            return self._compute(inputs, degree, True, True)
        # Apart: a coefficient that rests on nothing traced stays on the host.
        jac = self._one_for_all(inputs) if self.constant else self._compute(inputs, degree, True, False)[0]
        if self.source == "zero" and inputs.slots is None:
            return jac, None
        return jac, self._compute(inputs, degree, False, True)[1]

    def _one_for_all(self, inputs: _Inputs) -> Any:
        """The coefficients (E, S, 1, 1) of a constant operator, kept where they are plain numbers."""
        if self._numbers is not None:
            return self._numbers
        one = inputs._replace(points=inputs.points[:1], extras=[e[:1] for e in inputs.extras])
        return self._compute(one, 0, True, False)[0]

    @cached_property
    def _numbers(self) -> np.ndarray | None:
        """The coefficients of an operator that rest on nothing at all."""
        read = self._read(True, False)
        consts = [c for k, c in enumerate(self._record.consts) if ("consts", k) in read]
        if any(name != "consts" for name, _ in read) or is_traced(consts):
            return None
        rest = [v.aval for v in self._record.jaxpr.invars[1 + len(self._record.slots) :]]
        zeros = [np.zeros((1, *a.shape)) for a in rest[: self._n_extras]]
        leaves = [np.zeros(a.shape, a.dtype) for a in rest[self._n_extras :]]
        inputs = _Inputs(np.zeros((1, self.dim)), zeros, leaves, list(self._record.consts), None)
        return frozen(self._compute(inputs, 0, True, False)[0])

    def leading(self, points: Any, params: Any) -> Any:
        """The coefficients alone (E, S, N) of a linear operator at the points."""
        return self._compute(self._inputs(points, 0, (), params, None), 0, True, False)[0][:, :, 0]

    def residuals(self, points: Any, *, params: Any = None, slots: Any = None) -> Any:
        """The residual alone (E, N) at the points, where the slots' derivatives are ``slots`` (S, N) or zero."""
        inputs = self._inputs(points, 0, (), params, None if slots is None else slots[:, None])
        return self._compute(inputs, 0, False, True)[1][:, 0]

    def written(self, x: Any, derivative: Callable[[Slot], Any], params: Any) -> Any:
        """The residual (E,) at a point as it was written, with ``derivative`` of every slot in the fields' places."""
        r = self._record
        asked = {slot: derivative(slot) for slot in slots_of(r.written)}
        consts = r.consts[len(r.consts) - len(r.written.constvars) :]
        return open_fields(r.written, consts, [x, *jax.tree.leaves(params)], asked)[0]

    @property
    def kinked_source(self) -> bool:
        """Whether the source may have kinks or jumps, where its Taylor series end, and the coefficients have none."""
        return self._kinks == (True, False)

    @property
    def kinked(self) -> bool:
        """Whether the source or a coefficient may have kinks or jumps."""
        return any(self._kinks)

    @cached_property
    def _kinks(self) -> tuple[bool, bool]:
        """Whether the source may have kinks or jumps, and whether the coefficients may."""
        source, operator = (any(_kinked(eqn) for eqn in self._needed(jac)) for jac in (False, True))
        return source, operator

    @cached_property
    def unbounded(self) -> tuple[bool, bool]:
        """Whether the source may be infinite somewhere, and whether a coefficient may."""
        source, operator = (any(_unbounded(eqn) for eqn in self._needed(jac)) for jac in (False, True))
        return source, operator

    def _needed(self, jac: bool) -> list[Any]:
        """The operations that the coefficients, or the source, are made by."""
        return [eqn for eqn, _ in levels(self._record.jaxpr, self._wanted(jac, not jac))]

    def with_any_numbers(self) -> Traced:
        """The same with some numbers for the constants that are only traced."""
        return replace(self, _record=self._record._replace(consts=tuple(map(any_number, self._record.consts))))

    def jumps(self, points: Any, near: Any, *, params: Any = None, slots: Any = None) -> str | None:
        """What jumps under a derivative, in words, see ``jsmitsm.jumps``; None: nothing does."""
        if self.branches is None:
            return None
        consts = self._record.consts[len(self._record.consts) - len(self._record.written.constvars) :]
        return jumps(self.branches, points, near, params, consts, slots)

    def _inputs(self, points: Any, degree: int, extras: Sequence[Any], params: Any, slots: Any) -> _Inputs:
        """Check and bring in the order of the jaxpr."""
        if np.ndim(points) != 2 or np.shape(points)[1] != self.dim:
            raise ValueError(f"points must have shape (N, {self.dim}), got {np.shape(points)}")
        if degree < 0:
            raise ValueError(f"degree must not be negative, got {degree}")
        n = np.shape(points)[0]
        if len(extras) != self._n_extras:
            raise ValueError(f"extras must be {self._n_extras} arrays, as declared to trace, got {len(extras)}")
        rest = [v.aval for v in self._record.jaxpr.invars[1 + len(self._record.slots) :]]
        for k, (value, aval) in enumerate(zip(extras, rest, strict=False)):
            if np.shape(value) != (n, *aval.shape):
                raise ValueError(f"extras[{k}] must have shape {(n, *aval.shape)}, got {np.shape(value)}")
        leaves, tree = jax.tree.flatten(params)
        if tree != self._params_tree:
            raise ValueError(f"params must have the structure that was traced, {self._params_tree}, got {tree}")
        for leaf, aval in zip(leaves, rest[self._n_extras :], strict=True):
            if np.shape(leaf) != aval.shape:
                raise ValueError(f"a leaf of params has shape {np.shape(leaf)}, but {aval.shape} was traced")
        expected = (len(self.slots), count(self.dim, degree), n)
        if slots is not None and np.shape(slots) != expected:
            raise ValueError(
                f"slots must have shape {expected}, slots by Taylor coefficients by particles, got {np.shape(slots)}"
            )
        return _Inputs(points, list(extras), leaves, list(self._record.consts), slots)

    def _compute(self, inputs: _Inputs, degree: int, jac: bool, res: bool) -> tuple[Any, Any]:
        read = self._read(jac, res)
        inputs = inputs.only(read)
        if is_traced(inputs):
            return self._compiled(inputs, degree, jac, res)
        return self._on_host(jax.tree.map(np.asarray, inputs), degree, jac, res)

    def _on_host(self, inputs: _Inputs, degree: int, jac: bool, res: bool) -> tuple[Any, Any]:
        """In numpy, some particles at a time."""
        n = len(inputs.points)
        size = max(CHUNK // (self._width * count(self.dim, degree)), LEAST)
        parts = [self._series(inputs.chunk(low, size), degree, jac, res) for low in range(0, max(n, 1), size)]
        if len(parts) == 1:
            return parts[0]
        return tuple(None if p[0] is None else np.concatenate(p, -1) for p in zip(*parts, strict=True))  # type: ignore

    def _wanted(self, jac: bool, res: bool) -> list[int]:
        wanted = [NOTHING] * len(self._record.jaxpr.outvars)
        wanted[0] = EVERYTHING if res else NOTHING
        if jac:
            for k in self._coefficient_outputs:
                if k is not None:
                    wanted[k] = EVERYTHING
        return wanted

    @cached_property
    def _coefficient_outputs(self) -> list[int | None]:
        place = {slot: k for k, slot in enumerate(self._record.slots)}
        return [self._record.outputs[place[s]] for s in self.slots]

    def _read(self, jac: bool, res: bool) -> set[Any]:
        """The inputs that the wanted outputs really rest on."""
        return self._reads[jac, res]

    @cached_property
    def _reads(self) -> dict[tuple[bool, bool], set[Any]]:
        return {some: self._found_read(*some) for some in ((True, False), (False, True), (True, True))}

    def _found_read(self, jac: bool, res: bool) -> set[Any]:
        jaxpr, wanted = self._record.jaxpr, self._wanted(jac, res)
        read = {v for v, w in zip(jaxpr.outvars, wanted, strict=True) if w and not isinstance(v, Literal)}
        for eqn, _ in levels(jaxpr, wanted):
            read |= {v for v in eqn.invars if not isinstance(v, Literal)}
        first, n = 1 + len(self._record.slots), self._n_extras
        groups = {"points": jaxpr.invars[:1], "slots": jaxpr.invars[1:first], "extras": jaxpr.invars[first:first + n],
                  "leaves": jaxpr.invars[first + n:], "consts": jaxpr.constvars}  # fmt: skip
        return {(name, k) for name, group in groups.items() for k, v in enumerate(group) if v in read}

    def _series(self, inputs: _Inputs, degree: int, jac: bool, res: bool) -> tuple[Any, Any]:
        """Interpret the jaxpr; numpy or JAX, as the inputs are."""
        r, ring = self._record, Ring(self.dim, degree)
        n = inputs.points.shape[0]
        dtype = r.jaxpr.invars[0].aval.dtype
        zero = np.zeros((1, 1), dtype)
        fields = [zero] * len(r.slots)
        if inputs.slots is not None:
            place = {slot: k for k, slot in enumerate(r.slots)}
            for k, slot in enumerate(self.slots):
                fields[place[slot]] = inputs.slots[k].astype(dtype)
        last = [jnp.moveaxis(e, 0, -1) if isinstance(e, jax.Array) else np.moveaxis(e, 0, -1) for e in inputs.extras]
        params = [
            plain(v).astype(a.aval.dtype)
            for v, a in zip(inputs.leaves, r.jaxpr.invars[1 + len(fields) + len(last) :], strict=True)
        ]
        args = [variable(inputs.points.astype(dtype), degree), *fields, *(e[None].astype(dtype) for e in last), *params]
        out = evaluate(r.jaxpr, inputs.consts, args, self.dim, degree, None, self._wanted(jac, res))
        value = jnp.asarray if any(isinstance(v, jax.Array) for v in jax.tree.leaves(inputs)) else np.asarray
        result = full_series(ring, out[0], n).swapaxes(0, 1) if res else None
        if not jac:
            return None, value(result)
        rows = [None if k is None else full_series(ring, out[k], n) for k in self._coefficient_outputs]
        # A zero of the pattern is exact, whatever 0 * inf would give.
        parts = [
            np.where(p[:, None, None], c.swapaxes(0, 1), 0) if isinstance(c, np.ndarray)
            else jnp.where(p[:, None, None], c.swapaxes(0, 1), 0)
            for p, c in zip(self.pattern.T, rows, strict=True) if c is not None
        ]  # fmt: skip
        shape = (self.n_equations, count(self.dim, degree), n)
        found = iter(parts)
        full = [np.zeros(shape, dtype) if c is None else next(found) for c in rows]
        xp = np if all(isinstance(c, np.ndarray) for c in full) else jnp
        matrix = xp.stack(full, 1) if full else np.zeros((shape[0], 0, *shape[1:]), dtype)
        return value(matrix), None if result is None else value(result)

    @cached_property
    def _width(self) -> int:
        """The most elements of an intermediate value."""
        sizes = [math.prod(v.aval.shape) for eqn in self._record.jaxpr.eqns for v in eqn.outvars]
        return max(sizes, default=1) or 1

    @cached_property
    def _fingerprint(self) -> Any:
        return fingerprint(self._record.jaxpr)

    def _compiled(self, inputs: _Inputs, degree: int, jac: bool, res: bool) -> tuple[Any, Any]:
        """One program for all of it; a fresh lambda of the same form finds it again."""
        # Small integers and truth values are indices more often than not: they belong to the program.
        static = {k: np.asarray(c) for k, c in enumerate(inputs.consts) if _is_structure(c)}
        key = (
            self._fingerprint, tuple((k, c.dtype.str, c.shape, c.tobytes()) for k, c in static.items()),
            self.slots, self.pattern.tobytes(), degree, jac, res,
        )  # fmt: skip
        moving = inputs._replace(consts=[None if k in static else c for k, c in enumerate(inputs.consts)])

        def compute(moving: _Inputs) -> tuple[Any, Any]:
            consts = [static.get(k, c) for k, c in enumerate(moving.consts)]
            given = moving._replace(consts=consts)
            if not is_traced(given):
                return self._on_host(given, degree, jac, res)
            global COMPILATIONS
            COMPILATIONS += 1
            return self._series(given, degree, jac, res)

        return kept(key, lambda: in_one_program(compute))(moving)


@jax.tree_util.register_pytree_node_class
@dataclass
class _Inputs:
    """The data a record is evaluated on."""

    points: Any
    extras: list[Any]
    leaves: list[Any]
    consts: list[Any]
    slots: Any

    def _replace(self, **changes: Any) -> _Inputs:
        return _Inputs(**{**self.__dict__, **changes})

    def tree_flatten(self) -> tuple[Any, None]:
        return (self.points, self.extras, self.leaves, self.consts, self.slots), None

    @classmethod
    def tree_unflatten(cls, _: None, children: Any) -> _Inputs:
        return cls(*children)

    def only(self, read: set[Any]) -> _Inputs:
        """Zeros for whatever is not read: it may be traced without reason to compile anything."""

        def some(name: str, values: list[Any]) -> list[Any]:
            return [v if (name, k) in read else _zeros(v) for k, v in enumerate(values)]

        points = self.points if ("points", 0) in read else _zeros(self.points)
        slots = self.slots if any(name == "slots" for name, _ in read) else None
        extras, leaves, consts = (some(name, getattr(self, name)) for name in ("extras", "leaves", "consts"))
        return _Inputs(points, extras, leaves, consts, slots)

    def chunk(self, low: int, size: int) -> _Inputs:
        cut = slice(low, low + size)
        slots = None if self.slots is None else self.slots[..., cut]
        return self._replace(points=self.points[cut], extras=[e[cut] for e in self.extras], slots=slots)


def _kinked(eqn: Any) -> bool:
    own = eqn.primitive.name in KINKS or decides(eqn)
    return own or any(_kinked(e) for inner in inner_jaxprs(eqn) for e in inner.eqns)


def _unbounded(eqn: Any) -> bool:
    name = eqn.primitive.name
    own = name in POLES or name == "integer_pow" and eqn.params["y"] < 0
    return own or any(_unbounded(e) for inner in inner_jaxprs(eqn) for e in inner.eqns)


def _zeros(value: Any) -> np.ndarray:
    return np.zeros(np.shape(value), getattr(value, "dtype", float))


def _is_structure(const: Any) -> bool:
    if isinstance(const, jax.core.Tracer):
        return False
    return not np.issubdtype(const.dtype, np.inexact) and np.size(const) <= 4096
