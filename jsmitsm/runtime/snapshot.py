"""A user's function as it is now, whatever JAX has seen of it before and whatever becomes of it."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.runtime.compiled import fingerprint
from jsmitsm.runtime.jaxprs import ClosedJaxpr, comes_up, inner_jaxprs, jaxpr_as_fun
from jsmitsm.runtime.tracers import is_traced

# JAX looks up functions by their identity in caches of its own: not the one that it is given here, but those that this
# one gives on, as the body of a loop. In a context that it has not seen before it finds none of them; but then it
# records its own functions anew too, which takes ten times as long, and keeps them.
_never_seen = jax.make_user_context(None)
_JAX = os.path.join(os.path.dirname(jax.__file__), "_src")
# Files of JAX whose jitted functions call none of the user's, but for those named.
_OF_ARRAYS = tuple(os.path.join(_JAX, place) for place in ("numpy", "nn", "lax", os.path.join("scipy", "special")))
_CALLING = ("ufunc_api.py", "_piecewise at ")


def snapshot(function: Callable[..., Any], *arguments: Any) -> tuple[ClosedJaxpr, Any]:
    """The operations of a function on such arguments, with numbers that nobody else can change; its results' shapes.

    What the function hands to JAX to be called is recorded as it is now as well. A jitted function with
    ``inline=True`` leaves no mark by which it could be told: what such a one reads must not change.
    """
    record = lambda: jax.make_jaxpr(lambda *a: function(*a), return_shape=True)(*arguments)  # noqa: E731
    try:
        closed, shape = record()
        old = any(_may_be_old(eqn) for eqn in closed.jaxpr.eqns)
    except Exception:  # an older state may not fit; an error of the user's comes again
        old = True
    if old:
        with _never_seen(object()):
            closed, shape = record()
    if comes_up(closed.jaxpr, jax.dtypes.extended):
        raise ValueError(
            "random keys of JAX within a function are not followed; draw the numbers before, and let it read them"
        )
    consts = [_own(c, v.aval.dtype) for c, v in zip(closed.consts, closed.jaxpr.constvars, strict=True)]
    return ClosedJaxpr(closed.jaxpr, consts), shape


def _may_be_old(eqn: Any) -> bool:
    """Whether an operation holds what JAX recorded of another function, unless that is one of its own for arrays."""
    known = eqn.primitive.name in ("jit", "pjit", "custom_jvp_call")
    return any(not (known and _of_arrays(inner)) for inner in inner_jaxprs(eqn))


def _of_arrays(jaxpr: Any) -> bool:
    written = str(getattr(jaxpr.debug_info, "func_src_info", None))  # "name at file:line"
    return written.partition(" at ")[2].startswith(_OF_ARRAYS) and not any(word in written for word in _CALLING)


def _own(const: Any, dtype: Any) -> Any:
    return const if isinstance(const, jax.core.Tracer) else np.array(const, dtype)


class ScalarFunction:
    """A function of a number (and of parameters) as it was when recorded; equal to those that record the same.

    It may be a static part of arguments to compiled programs: a changed function is another one, and one that is
    written again is the same.
    """

    def __init__(self, function: Callable[..., Any], *params: Any):
        self.function = function  # as written
        self._closed, _ = snapshot(function, jax.ShapeDtypeStruct((), jnp.result_type(float)), *params)
        consts = [(c.dtype.str, c.shape, c.tobytes()) for c in self._closed.consts if not self.traced]
        self._key = fingerprint(self._closed.jaxpr), tuple(consts)

    @property
    def traced(self) -> bool:
        """Whether it closes over numbers that JAX traces: then it cannot be static."""
        return is_traced(self._closed.consts)

    def __call__(self, r: Any, *params: Any) -> Any:
        avals = self._closed.in_avals
        r, *leaves = (jnp.asarray(v, a.dtype) for v, a in zip([r, *jax.tree.leaves(params)], avals, strict=True))
        one = lambda x: jaxpr_as_fun(self._closed)(x, *leaves)[0]  # noqa: E731
        return one(r) if r.ndim == 0 else jax.vmap(one)(r.reshape(-1)).reshape(r.shape)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ScalarFunction) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def __reduce__(self) -> Any:
        return _itself, (self.function,)


def _itself(function: Any) -> Any:
    return function
