"""Functions of JAX, NumPy, Python and this package that give the same for the same, whatever happened before."""

from __future__ import annotations

import sys
import types
from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_LIBRARIES = ("jax", "jaxlib", "numpy", "jsmitsm")
# Rooms of this package whose functions a user's function may call, or that wrap it.
_OWN = (
    "jsmitsm.equation.field", "jsmitsm.equation.operators", "jsmitsm.equation.closing", "jsmitsm.cloud.sdf",
    "jsmitsm.cloud.sdf.combine", "jsmitsm.cloud.sdf.vectors",
)  # fmt: skip
# Modules whose functions have no state, but for those named; numpy's are named one by one below.
_MODULES: dict[str, frozenset[str]] = {
    "math": frozenset(),
    "cmath": frozenset(),
    "operator": frozenset(),
    "jax.numpy": frozenset(
        "load save savez fromfile from_dlpack get_printoptions set_printoptions printoptions frompyfunc".split()
    ),
    "jax.numpy.linalg": frozenset(),
    "jax.numpy.fft": frozenset(),
    "jax.lax": frozenset("infeed outfeed rng_uniform create_token".split()),
    "jax.lax.linalg": frozenset(),
    "jax.nn": frozenset(),
    "jax.scipy.special": frozenset(),
    "jax.scipy.linalg": frozenset(),
    "numpy.linalg": frozenset(),
    "numpy.fft": frozenset(),
}
_NAMES: dict[str, frozenset[str]] = {
    "builtins": frozenset(
        "abs all any bool complex dict divmod enumerate filter float frozenset int isinstance len list map max min pow "
        "range reversed round set slice sorted str sum tuple zip ArithmeticError AssertionError Exception "
        "FloatingPointError IndexError KeyError NotImplementedError OverflowError RuntimeError TypeError ValueError "
        "ZeroDivisionError".split()
    ),
    "functools": frozenset({"partial", "reduce"}),
    "jax": frozenset(
        "checkpoint eval_shape grad hessian jacfwd jacobian jacrev jit jvp linearize remat value_and_grad vjp "
        "vmap".split()
    ),
    "numpy": frozenset(
        "all allclose amax amin any append arange argmax argmin argsort array array_equal asarray atleast_1d "
        "atleast_2d average bool bool_ broadcast_arrays broadcast_to clip column_stack complex128 complex64 "
        "concatenate copy cross cumprod cumsum delete diag diagonal diff digitize dot einsum expand_dims "
        "expm1 eye flip float32 float64 full full_like gradient hstack identity iinfo imag indices inner insert int32 "
        "int64 interp isclose isscalar ix_ kron linspace logspace max mean median meshgrid min moveaxis nan_to_num "
        "ndim nonzero ones ones_like outer pad percentile piecewise polyfit polyval prod ptp ravel real repeat reshape "
        "roll searchsorted select shape sinc size sort split squeeze stack std sum swapaxes take tensordot tile trace "
        "transpose trapezoid tri tril triu unique var vdot vstack where zeros zeros_like".split()
    ),
}  # fmt: skip


def attribute(module: types.ModuleType, name: str) -> Any:
    """What ``module.name`` is; AttributeError where a module of the user's makes it up when asked."""
    scope = vars(module)
    if name in scope:
        return scope[name]
    if module.__name__.partition(".")[0] in _LIBRARIES:  # some of theirs are imported when first asked for
        return getattr(module, name)
    raise AttributeError(name)


_proven: dict[int, Any] = {}  # what was found to have no state will never have any


def stateless(value: Any) -> bool:
    """Whether a value is a function or a type of a library, found there under its name, that has no state."""
    if _proven.get(id(value), _proven) is value:
        return True
    name = getattr(value, "__name__", None) if callable(value) else None
    if not (isinstance(name, str) and _ours(value) and any(_listed(name, value))):
        return False
    _proven[id(value)] = value
    return True


def _listed(name: str, value: Any) -> Iterator[bool]:
    for home, excluded in _MODULES.items():
        yield name not in excluded and _found(home, name, value)
    for home, included in _NAMES.items():
        yield (name in included or home == "numpy" and type(value) is np.ufunc) and _found(home, name, value)


def _found(home: str, name: str, value: Any) -> bool:
    module = sys.modules.get(home)
    return module is not None and vars(module).get(name) is value


def _ours(value: Any) -> bool:
    """Whether it is of a library, and does not only stand there (as what a user put in a function's place)."""
    if type(value) is types.BuiltinFunctionType:
        return value.__self__ is None or type(value.__self__) is types.ModuleType
    if isinstance(value, type):
        return value.__module__.partition(".")[0] in (*_LIBRARIES, "builtins", "functools")
    if type(value) is types.FunctionType:
        # This package's are read as the user's are.
        home: str = _module_of(value) or "jsmitsm"
    else:
        home = type(value).__module__
    if home.partition(".")[0] not in _LIBRARIES or home.startswith("jsmitsm"):
        return False
    # What jax.vmap or np.vectorize make of a user's function holds it; what users wrote on a function is theirs, too.
    kept = getattr(value, "__dict__", {})
    if any(not name.startswith("_") and name not in getattr(type(value), "__annotations__", ()) for name in kept):
        return False
    return all(_ours(held) for held in _held(kept))


def _held(kept: dict[str, Any]) -> Iterator[Any]:
    """The functions among the attributes of a callable object."""
    for name, part in kept.items():
        for held in part.values() if type(part) is dict and name != "__annotations__" else (part,):
            if callable(held) and not isinstance(held, type):
                yield held


def _module_of(function: types.FunctionType) -> str | None:
    """The name of the module of a library that a function was written in."""
    name = str(function.__globals__.get("__name__"))
    module = sys.modules.get(name)
    there = module is not None and vars(module) is function.__globals__
    written = there and getattr(module, "__file__", None) == function.__code__.co_filename
    return name if written and name.partition(".")[0] in _LIBRARIES else None


def of_library(value: Any) -> bool:
    """Whether a value in a library's closure is one of its modules, or a mark without any attributes."""
    return type(value) is object or (
        type(value) is types.ModuleType and value.__name__.partition(".")[0] in _LIBRARIES
    )


def made_by_library(function: types.FunctionType) -> bool:
    """Whether a library wrote a function that has no state but for its closure, as what jax.grad returns."""
    name = _module_of(function)
    if name is None:
        return False
    if name.partition(".")[0] == "jsmitsm":
        return name in _OWN
    return function.__code__ in _wrappers()


@lru_cache(maxsize=1)
def _wrappers() -> frozenset[types.CodeType]:
    """The codes of what JAX's transformations make of a function."""
    found: set[types.CodeType] = set()

    def look(value: Any) -> None:
        if type(value) is types.FunctionType and _module_of(value):
            found.add(value.__code__)
            for cell in value.__closure__ or ():
                look(cell.cell_contents)

    transforms: list[Callable[..., Any]] = [
        jax.grad, jax.value_and_grad, jax.jacfwd, jax.jacrev, jax.hessian, jax.vmap, jax.checkpoint, jnp.vectorize,
    ]  # fmt: skip
    for transform in transforms:
        look(transform(lambda x: x))
    return frozenset(found)
