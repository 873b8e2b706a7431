"""Values that JAX only traces: whether there are any, and the numbers behind them."""

from __future__ import annotations

import copy
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import mlir

from jsmitsm.runtime.jaxprs import Primitive

# An operation on nothing: what is recorded records it, and it does not compute, nor compile, where nothing is.
_probe_p = Primitive("jsmitsm_probe")
_probe_p.def_impl(lambda: None)
_probe_p.def_abstract_eval(lambda: jax.core.ShapedArray((), np.dtype(np.float32)))
mlir.register_lowering(_probe_p, mlir.lower_fun(lambda: jnp.zeros((), np.float32), False))


def is_traced(*trees: Any) -> bool:
    """Whether any leaf is under a JAX transform."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def recorded() -> bool:
    """Whether every operation is recorded here, one on constants too, as under jit."""
    return isinstance(_probe_p.bind(), jax.core.Tracer)


def computed() -> AbstractContextManager[Any]:
    """Where what is known is computed, under jit too.

    Elsewhere it is nothing: JAX's own context computes the constants of every program that is traced in it, each by a
    program of its own.
    """
    return jax.ensure_compile_time_eval() if recorded() else nullcontext()


def closes_over_traced(function: Any, depth: int = 4) -> bool:
    """Whether a function refers to traced values by its closure, or by those of functions in it."""
    for cell in getattr(function, "__closure__", None) or ():
        try:
            value = cell.cell_contents
        except ValueError:  # still empty
            continue
        if is_traced(value) or (depth and closes_over_traced(value, depth - 1)):
            return True
    return False


def owned(x: Any) -> Any:
    """A read-only copy of a numpy array that its owner may change; what nobody can change passes, as all else."""
    if not isinstance(x, np.ndarray) or (not x.flags.writeable and x.base is None):
        return x
    return frozen(np.array(x))


def frozen(x: Any) -> Any:
    """An array of our own, read-only from now on; other things pass."""
    if isinstance(x, np.ndarray):
        x.setflags(write=False)
    return x


class Copied:
    """Copied with all that it knows, though pickled without its records: its arrays are read-only, and shared."""

    def __copy__(self) -> Self:
        new = object.__new__(type(self))
        new.__dict__.update(self.__dict__)
        return new

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        new = self.__copy__()
        new.__dict__["stats"] = copy.deepcopy(self.__dict__["stats"], memo)
        return new


def concrete(x: Any) -> Any:
    """The numbers behind a value that only carries derivatives; None behind an abstract one."""
    while isinstance(x, jax.core.Tracer):
        x = getattr(x, "primal", None)
    return x


def any_number(value: Any) -> np.ndarray:
    """The number itself, or some for one that is only traced: where only the form of a result is asked for."""
    known = concrete(value)
    if known is not None:
        return np.asarray(known)
    return np.random.default_rng(0).uniform(0.5, 1.5, np.shape(value)).astype(value.dtype)
