"""A user's function as it is now, whatever JAX has seen of it before and whatever becomes of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr

from jsmitsm.runtime.compiled import fingerprint
from jsmitsm.runtime.jaxprs import inlined
from jsmitsm.runtime.tracers import is_traced

# JAX looks up functions by their identity in caches of its own: the one that it is given, and those that this one gives
# on, as the body of a loop. In a context that it has not seen before it finds none of them.
_never_seen = jax.make_user_context(None)


def snapshot(function: Callable[..., Any], *arguments: Any) -> ClosedJaxpr:
    """The operations of a function on such arguments, with numbers that nobody else can change."""
    with _never_seen(object()):
        closed = jax.make_jaxpr(lambda *a: function(*a))(*arguments)
    consts = [_own(c, v.aval.dtype) for c, v in zip(closed.consts, closed.jaxpr.constvars, strict=True)]
    return ClosedJaxpr(closed.jaxpr, consts)


def shape_of(function: Callable[..., Any], *arguments: Any) -> Any:
    """Shapes and types of what a function returns for such arguments."""
    with _never_seen(object()):
        return jax.eval_shape(lambda *a: function(*a), *arguments)


def _own(const: Any, dtype: Any) -> Any:
    if isinstance(const, jax.core.Tracer) or jax.dtypes.issubdtype(dtype, jax.dtypes.extended):
        return const
    return np.array(const, dtype)


class ScalarFunction:
    """A function of a number (and of parameters) as it was when recorded; equal to those that record the same.

    It may be a static part of arguments to compiled programs: a changed function is another one, and one that is
    written again is the same.
    """

    def __init__(self, function: Callable[..., Any], *params: Any):
        self.function = function  # as written
        self._closed = snapshot(function, jax.ShapeDtypeStruct((), jnp.result_type(float)), *params)
        self._dtype = self._closed.in_avals[0].dtype
        consts = [(c.dtype.str, c.shape, c.tobytes()) for c in self._closed.consts if not self.traced]
        self._key = fingerprint(self._closed.jaxpr), tuple(consts)

    @property
    def traced(self) -> bool:
        """Whether it closes over numbers that JAX traces: then it cannot be static."""
        return is_traced(self._closed.consts)

    def __call__(self, r: Any, *params: Any) -> Any:
        leaves = jax.tree.leaves(params)
        one = lambda x: inlined(self._closed.jaxpr, self._closed.consts, [x, *leaves])[0]  # noqa: E731
        r = jnp.asarray(r, self._dtype)
        return one(r) if r.ndim == 0 else jax.vmap(one)(r.reshape(-1)).reshape(r.shape)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ScalarFunction) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def __reduce__(self) -> Any:
        return _itself, (self.function,)


def _itself(function: Any) -> Any:
    return function
