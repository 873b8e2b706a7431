"""Said in words: a run has first derivatives, and these backward.

What enters a run passes ``backward``, an identity whose tangents pass another operation. On the way back that is turned
round and never done; who asks for the tangents themselves does it, at once or when a program of it is compiled. What is
left to the host passes ``once``, an identity without derivatives.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import ad, batching, mlir

from jsmitsm.runtime.jaxprs import Primitive
from jsmitsm.runtime.tracers import is_traced

_FORWARD = (
    "js.evolve: a run has derivatives backward alone, and jax.jvp, jax.jacfwd and jax.hessian ask for those "
    "forward; use jax.grad, jax.vjp or jax.jacrev"
)
_SECOND = (
    "js.evolve: what the host does of a run has first derivatives alone, and a derivative of its gradient, as of "
    "jax.hessian or jax.grad(jax.grad(f)), asks for second ones; take differences of jax.grad"
)


def backward(tree: Any) -> Any:
    """The same tree, whose derivatives are refused forward."""
    return _through(_value_p, tree)


def once(tree: Any) -> Any:
    """The same tree, whose derivatives are refused."""
    return _through(_once_p, tree)


def _through(primitive: Any, tree: Any) -> Any:
    leaves, form = jax.tree.flatten(tree)
    some = [k for k, v in enumerate(leaves) if is_traced(v) and jnp.issubdtype(v.dtype, jnp.inexact)]
    if not some:
        return tree
    # All at once: a tangent that is known to be nothing stays with those that are not.
    for k, v in zip(some, primitive.bind(*(leaves[k] for k in some))):
        leaves[k] = v
    return jax.tree.unflatten(form, leaves)


def _identity(name: str) -> Any:
    made = Primitive(name)
    made.multiple_results = True
    made.def_impl(lambda *values: list(values))
    made.def_abstract_eval(lambda *avals: list(avals))
    batching.primitive_batchers[made] = lambda values, axes: (made.bind(*values), axes)
    mlir.register_lowering(made, lambda _, *values: list(values))
    return made


_value_p, _tangent_p, _once_p = (_identity(f"jsmitsm_{name}") for name in ("backward", "tangent", "once"))


def _value_jvp(values: Any, tangents: Any) -> Any:
    if all(type(t) is ad.Zero for t in tangents):
        return _value_p.bind(*values), list(tangents)
    # The value without its guard: a gradient may be differentiated forward where no part of it is the host's.
    return list(values), _tangent_p.bind(*map(ad.instantiate_zeros, tangents))


def _tangent_jvp(values: Any, tangents: Any) -> Any:
    return _tangent_p.bind(*values), _tangent_p.bind(*map(ad.instantiate_zeros, tangents))


def _tangent_transpose(bars: Any, *values: Any) -> Any:
    return [ad.instantiate_zeros(bar) if ad.is_undefined_primal(v) else None for bar, v in zip(bars, values)]


def _tangent(*tangents: Any) -> Any:
    if any(np.any(np.asarray(t)) for t in tangents):
        raise ValueError(_FORWARD)
    return list(tangents)


def _no_tangent(*_: Any) -> Any:
    raise ValueError(_FORWARD)


def _once_jvp(*_: Any) -> Any:
    raise ValueError(_SECOND)


ad.primitive_jvps[_value_p] = _value_jvp
ad.primitive_jvps[_tangent_p] = _tangent_jvp
ad.primitive_transposes[_tangent_p] = _tangent_transpose
_tangent_p.def_impl(_tangent)
mlir.register_lowering(_tangent_p, _no_tangent)
batching.primitive_batchers[_tangent_p] = _no_tangent
ad.primitive_jvps[_once_p] = _once_jvp
