"""A whole program as one kernel of XLA's compiler for CPUs.

XLA makes one kernel of each loop over an array, starts them one by one, and shares them among its threads where they do
not wait for each other. A block of particles has some hundred of them, as short as a microsecond: starting and sharing
them takes up to two fifths of the time, and more where other programs run beside. Loops over a few bytes XLA makes one
kernel of, with all that is called inside of them, by an attribute of a call, which is set here.

Such a kernel cannot call a library for its matrix products, so it is for small ones alone, and they are written
otherwise ``inside()`` of one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextvars import ContextVar
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.runtime.jaxprs import ClosedJaxpr, Jaxpr, Literal

# The attribute is XLA's own and what sets it is experimental in JAX: only versions that the tests have passed with.
_TRIED = ((0, 10),)
# Vectors of eight numbers, where the processor has them; no products by a library, and scatters as loops: kernels hold
# no others.
OPTIONS = {
    "xla_cpu_prefer_vector_width": 512,
    "xla_cpu_experimental_ynn_fusion_type": "",
    "xla_cpu_use_fusion_emitters": False,
}
# The compiler loses constants above 10 kB that it moves into a loop, and aborts.
_CONSTANT = 8192


_inside: ContextVar[bool] = ContextVar("inside of one kernel", default=False)


def inside() -> bool:
    """Whether what is traced here becomes part of one kernel."""
    return _inside.get()


def available() -> bool:
    """Whether this version of JAX, on this device, makes one kernel of a program."""
    return jax.default_backend() == "cpu" and jax.__version_info__[:2] in _TRIED


def one_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """``function`` of arrays, marked to become one kernel, and its result beside numbers to be ignored."""
    from jax.experimental.xla_metadata import set_xla_metadata

    @jax.jit
    def inner(*arguments: Any) -> tuple[Any, Any]:
        before = _inside.set(True)
        try:
            # An argument that nothing uses aborts the compiler: a number of each of them is a result.
            return function(*arguments), _firsts(arguments)
        finally:
            _inside.reset(before)

    def run(*arguments: Any) -> tuple[Any, Any]:
        made, firsts = inner(*arguments)
        if _largest_constant(inner.trace(*map(jax.typeof, arguments)).jaxpr) <= _CONSTANT:
            firsts = set_xla_metadata(firsts, xla_cpu_small_call="true", inlineable="false")
        return made, firsts

    return run


def _firsts(arrays: Sequence[Any]) -> Any:
    firsts = [jax.lax.slice(jnp.ravel(x), (0,), (1,)) for x in arrays if x.size]
    return jax.lax.concatenate([jnp.zeros(1), *(x.astype(float) for x in firsts)], 0)


def _largest_constant(closed: ClosedJaxpr) -> int:
    """Bytes of the largest array that a program, or one it calls, brings along."""
    sizes = [np.asarray(x).nbytes for x in closed.consts]
    for eqn in closed.jaxpr.eqns:
        sizes += [np.asarray(v.val).nbytes for v in eqn.invars if isinstance(v, Literal)]
        for x in jax.tree.leaves(eqn.params, is_leaf=lambda x: isinstance(x, ClosedJaxpr | Jaxpr)):
            if isinstance(x, ClosedJaxpr | Jaxpr):
                sizes.append(_largest_constant(x if isinstance(x, ClosedJaxpr) else ClosedJaxpr(x, ())))
    return max(sizes, default=0)
