"""A signed distance as it was recorded: its values and gradients at many points, on the host."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.runtime.compiled import fingerprint, kept
from jsmitsm.runtime.errors import IN_FUNCTIONS, in_words
from jsmitsm.runtime.jaxprs import ClosedJaxpr, inlined, inner_jaxprs
from jsmitsm.runtime.recall.recording import recalled
from jsmitsm.runtime.snapshot import snapshot
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.taylor import jets, series
from jsmitsm.taylor.first_degree import first_degree

# Points of one call of a compiled program, which is compiled for these two numbers only.
_CALLS = (512, 8192)
# Numbers computed for a batch up to which numpy will do: some milliseconds. The batch alone decides, not what
# has been compiled before: the same shape gives the same cloud, bit by bit, at any time.
_AT_ONCE = 300_000


class Recorded:
    """A function of one point (D,) -> scalar as it is now, evaluated for many.

    Small batches are interpreted in numpy, which takes no compilation; large ones run in one program for all
    functions that record the same but for their numbers.
    """

    def __init__(self, sdf: Any, dim: int):
        make = lambda: _recorded(sdf, dim)  # noqa: E731
        self._closed: ClosedJaxpr = recalled(sdf, ("sdf", dim), make, lambda closed: not is_traced(closed.consts))
        self._dim = dim
        self._cost = _numbers(self._closed.jaxpr)

    def __call__(self, x: np.ndarray, gradients: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Values (M,) and gradients (M, D) at points (M, D), the latter without meaning where not asked for."""
        if not len(x):
            return np.zeros(0), np.zeros(x.shape)
        if len(x) * self._cost <= _AT_ONCE:
            return self._interpreted(x, gradients)
        return self._compiled(x)

    def _interpreted(self, x: np.ndarray, gradients: bool) -> tuple[np.ndarray, np.ndarray]:
        steps = first_degree(self._closed.jaxpr)
        if steps is not None:
            return steps(self._closed.consts, x, gradients)
        degree = int(gradients)
        closed, point = self._closed, series.variable(np.ascontiguousarray(x), degree)
        (out,) = jets.evaluate(closed.jaxpr, closed.consts, [point], self._dim, degree)
        terms = np.zeros((1 + self._dim, len(x)))
        terms[: len(out)] = out
        return terms[0], terms[1:].T

    def _compiled(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        few, many = _CALLS
        values, gradients, start = np.empty(len(x)), np.empty(x.shape), 0
        while start < len(x):
            size = few if len(x) - start <= 4 * few else many
            part = slice(start, start + size)
            padded = x[part]
            if len(padded) < size:
                padded = np.concatenate([padded, np.broadcast_to(x[-1:], (size - len(padded), self._dim))])
            v, g = self._program(size)(padded)
            values[part], gradients[part] = np.asarray(v)[: len(x) - start], np.asarray(g)[: len(x) - start]
            start += size
        return values, gradients

    def _program(self, size: int) -> Callable[[np.ndarray], tuple[jax.Array, jax.Array]]:
        closed = self._closed

        def value_and_gradient(consts: Any, x: Any) -> Any:
            return jax.vmap(jax.value_and_grad(lambda y: inlined(closed.jaxpr, consts, [y])[0]))(x)

        program = kept(("sdf", size, fingerprint(closed.jaxpr)), lambda: jax.jit(value_and_gradient))
        return lambda x: program(closed.consts, x)


def _numbers(jaxpr: Any) -> float:
    """About how many numbers one point takes; less than none for loops of unknown length, which are always interpreted:
    JAX has no gradient of them."""
    total = 0.0
    for eqn in jaxpr.eqns:
        inner = sum(map(_numbers, inner_jaxprs(eqn)))
        if eqn.primitive.name == "while":
            return -math.inf
        total += inner * eqn.params.get("length", 1) if inner else sum(v.aval.size for v in eqn.outvars)
    return total


def _recorded(sdf: Any, dim: int) -> ClosedJaxpr:
    """The function as it is now, of one point."""
    if not callable(sdf):
        raise ValueError(f"sdf: expected a function x (D,) -> scalar, got {sdf!r}")
    if jax.dtypes.canonicalize_dtype(np.float64) != np.float64:
        raise ValueError(
            "sdf: JAX computes in float32 here, boundary particles to 1e-10 need float64; put "
            'jax.config.update("jax_enable_x64", True) at the beginning of the program'
        )
    try:
        closed, out = snapshot(sdf, jax.ShapeDtypeStruct((dim,), jnp.float64))
    except IN_FUNCTIONS as error:
        raise ValueError(
            f"sdf: failed for one point x of shape ({dim},), the dimension of the bounds; write it with "
            "jax.numpy, jnp.where in place of if, for points of that dimension "
            f"({type(error).__name__}: {in_words(error).splitlines()[0]})"
        ) from error
    if getattr(out, "shape", None) != () or not jnp.issubdtype(out.dtype, jnp.floating):
        raise ValueError(
            f"sdf: returned {out} for one point x of shape ({dim},), expected a real scalar; "
            "it is mapped over points here, write it for a single one"
        )
    if out.dtype != jnp.float64:
        raise ValueError(
            f"sdf: computes in {out.dtype}, float64 was expected; drop casts and constants of lower precision"
        )
    return closed
