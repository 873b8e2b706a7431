"""The local field that a PDE sees: what may be asked of an unknown function at one point."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import ad, batching

from jsmitsm.runtime.jaxprs import Primitive
from jsmitsm.taylor.multi_indices import MultiIndex, Slot, add

# d^a u_k at a point.  Its derivative is the next higher derivative, which is all that
# jax.grad, jax.jacfwd and the operators below need to know about an unknown field.
field_p = Primitive("field")
# Marks a factor that an operator treated as constant: it must not depend on the point.
frozen_p = Primitive("frozen")
# The time derivative of order j of field k goes by the number k + j RATE.
RATE = 1 << 20


def unit(dim: int, axis: int) -> MultiIndex:
    return tuple(int(i == axis) for i in range(dim))


@field_p.def_impl
def _field_impl(point: Any, *, field: int, index: MultiIndex) -> Any:
    raise ValueError(
        "the field u has no value here: it can be evaluated only inside a pde or a boundary condition, "
        "at the point x they receive"
    )


@field_p.def_abstract_eval
def _field_abstract(point: Any, *, field: int, index: MultiIndex) -> Any:
    return jax.core.ShapedArray((), point.dtype)


def _field_jvp(primals: Any, tangents: Any, *, field: int, index: MultiIndex) -> tuple[Any, Any]:
    (point,), (dx,) = primals, tangents
    out = field_p.bind(point, field=field, index=index)
    if isinstance(dx, ad.Zero):
        return out, ad.Zero(jax.typeof(out).to_tangent_aval())
    dim = len(index)
    higher = [add(index, unit(dim, i)) for i in range(dim)]
    if isinstance(dx, jax.core.Tracer):
        slopes = [field_p.bind(point, field=field, index=b) for b in higher]
        return out, jax.lax.dot(_stack(slopes), dx)
    # A known direction asks only for the derivatives it needs.
    parts = [
        field_p.bind(point, field=field, index=b) * c if c != 1 else field_p.bind(point, field=field, index=b)
        for b, c in zip(higher, np.asarray(dx), strict=True)
        if c != 0
    ]
    return out, total(parts) if parts else ad.Zero(jax.typeof(out).to_tangent_aval())


def _field_batch(args: Any, axes: Any, *, field: int, index: MultiIndex) -> Any:
    raise ValueError(
        "the field u was evaluated at a batch of points (jax.vmap): a pde sees u only at its own point x; "
        "write the residual for one point, the package maps it over the particles"
    )


ad.primitive_jvps[field_p] = _field_jvp
batching.primitive_batchers[field_p] = _field_batch

frozen_p.def_impl(lambda value: value)
frozen_p.def_abstract_eval(lambda value: value)
ad.deflinear2(frozen_p, lambda cotangent, _: [cotangent])
batching.defvectorized(frozen_p)


def _stack(scalars: Any) -> jax.Array:
    """Scalars to a vector, in the fewest traced operations."""
    if len(scalars) == 1:
        return jax.lax.broadcast(scalars[0], (1,))
    return jax.lax.concatenate([jax.lax.broadcast(s, (1,)) for s in scalars], 0)


def total(parts: Any) -> Any:
    """A sum without the leading zero of the builtin, which would be traced too."""
    return functools.reduce(operator.add, parts)


def _is_scalar(value: Any) -> bool:
    return isinstance(value, int | float | complex | np.number | np.ndarray | jax.Array) and np.ndim(value) == 0


def _needs_point(other: Any) -> TypeError:
    return TypeError(
        f"a field or a derivative of it was combined with {type(other).__name__}; "
        "evaluate it at the point first, as in js.laplacian(u)(x) + f(x)"
    )


class Field:
    """A scalar function of the point: a linear combination of derivatives of the unknown fields.

    Sums of fields and multiples by a scalar independent of the point are fields again, so
    composed operators are exact algebra on the derivatives.  ``u(x)`` gives a scalar.
    Raises ``ValueError`` for a point that is not of shape (D,).

    >>> import jsmitsm as js
    >>> u = local_field(2)
    >>> sorted(index for _, index in (js.laplacian(u) - 2.0 * u).terms)
    [(0, 0), (0, 2), (2, 0)]
    """

    __slots__ = ("dim", "terms")
    __array_ufunc__ = None  # numpy scalars defer to __rmul__
    ndim = 0
    shape = ()

    def __init__(self, dim: int, terms: dict[Slot, Any]):
        self.dim, self.terms = dim, terms

    def __call__(self, x: Any) -> Any:
        x = jnp.asarray(x)
        if x.shape != (self.dim,):
            raise ValueError(
                f"a field takes one point of shape ({self.dim},), got shape {x.shape}; pass the x that the pde receives"
            )
        total = None
        for (k, index), c in self.terms.items():
            value = field_p.bind(x, field=k, index=index)
            value = value if _is_one(c) else c * value
            total = value if total is None else total + value
        return jnp.zeros((), x.dtype) if total is None else total

    def _shifted(self, index: MultiIndex) -> Field:
        """The derivative d^index of this field."""
        if len(index) != self.dim or any(k < 0 for k in index):
            raise ValueError(f"multi_index must be {self.dim} non-negative integers, got {index}")
        return Field(self.dim, {(k, add(a, index)): _frozen(c) for (k, a), c in self.terms.items()})

    def __add__(self, other: Any) -> Field:
        if not isinstance(other, Field):
            if _is_scalar(other) and not isinstance(other, jax.core.Tracer) and other == 0:
                return self  # sum() starts from 0
            raise _needs_point(other)
        terms = dict(self.terms)
        for slot, c in other.terms.items():
            c = terms[slot] + c if slot in terms else c
            terms[slot] = c
            if not isinstance(c, jax.core.Tracer) and c == 0:
                del terms[slot]
        return Field(self.dim, terms)

    __radd__ = __add__

    def __mul__(self, factor: Any) -> Field:
        if not _is_scalar(factor):
            raise _needs_point(factor)
        if not isinstance(factor, jax.core.Tracer) and factor == 0:
            return Field(self.dim, {})
        return Field(self.dim, {slot: factor if _is_one(c) else c * factor for slot, c in self.terms.items()})

    __rmul__ = __mul__

    def __truediv__(self, factor: Any) -> Field:
        if not _is_scalar(factor):
            raise _needs_point(factor)
        return self * (1.0 / factor)

    def __neg__(self) -> Field:
        return -1.0 * self

    def __sub__(self, other: Any) -> Field:
        if not isinstance(other, Field):
            raise _needs_point(other)
        return self + (-other)

    def __rsub__(self, other: Any) -> Field:
        return -self + other


def _is_one(c: Any) -> bool:
    return not isinstance(c, jax.core.Tracer) and bool(c == 1)


def _frozen(c: Any) -> Any:
    return frozen_p.bind(c) if isinstance(c, jax.core.Tracer) else c


class LocalField:
    """An array of scalar fields: the unknowns of a system, a gradient, a Hessian.

    ``u(x)`` is an array of ``u.shape``; ``u[k]`` a scalar field (or a smaller array of them).
    """

    __slots__ = ("dim", "entries")
    __array_ufunc__ = None

    def __init__(self, dim: int, entries: Any):
        self.dim = dim
        self.entries = _object_array(entries)

    @property
    def shape(self) -> tuple[int, ...]:
        return self.entries.shape

    @property
    def ndim(self) -> int:
        return self.entries.ndim

    def __len__(self) -> int:
        return len(self.entries)

    def __getitem__(self, key: Any) -> Any:
        part = self.entries[key]
        return part if isinstance(part, Field) else LocalField(self.dim, part)

    def __iter__(self) -> Iterator[Any]:
        return (self[k] for k in range(len(self)))

    def __call__(self, x: Any) -> jax.Array:
        values = _stack([f(x) for f in self.entries.ravel()])
        return values if self.ndim == 1 else values.reshape(self.shape)

    def _map(self, function: Callable[[Field], Any]) -> LocalField:
        """Apply an operator to every entry; its own axes come last."""
        parts = [function(f) for f in self.entries.ravel()]
        inner = parts[0].shape
        flat = [f for p in parts for f in (p.entries.ravel() if inner else [p])]
        return LocalField(self.dim, _object_array(flat).reshape(self.shape + inner))

    def __add__(self, other: Any) -> LocalField:
        if _is_scalar(other) and not isinstance(other, jax.core.Tracer) and other == 0:
            return self
        if not isinstance(other, LocalField) or other.shape != self.shape:
            raise _needs_point(other)
        pairs = zip(self.entries.ravel(), other.entries.ravel(), strict=True)
        return LocalField(self.dim, _object_array([a + b for a, b in pairs]).reshape(self.shape))

    __radd__ = __add__

    def __mul__(self, factor: Any) -> LocalField:
        return self._map(lambda f: f * factor)

    __rmul__ = __mul__

    def __truediv__(self, factor: Any) -> LocalField:
        return self._map(lambda f: f / factor)

    def __neg__(self) -> LocalField:
        return self * -1.0

    def __sub__(self, other: Any) -> LocalField:
        if not isinstance(other, LocalField):
            raise _needs_point(other)
        return self + (-other)


def _object_array(entries: Any) -> np.ndarray:
    if isinstance(entries, np.ndarray):
        return entries
    out = np.empty(len(entries), object)
    out[:] = entries
    return out


def local_field(dim: int, fields: int = 1) -> Field | LocalField:
    """The unknown of a problem: one scalar field, or an array of several."""
    zero = (0,) * dim
    each = [Field(dim, {(k, zero): 1.0}) for k in range(fields)]
    return each[0] if fields == 1 else LocalField(dim, each)
