"""When may a recorded function be used again? When nothing that it can see has changed.

JAX remembers functions by identity, so that a lambda written anew is recorded anew, and one that
reads a changed global is not. Here a function is remembered by its code and by the values that the
code refers to; where those cannot be compared (an object of unknown kind, a traced value) it is
not remembered at all.
"""

from __future__ import annotations

import functools
import threading
import types
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

# Recorded functions kept, and the largest array compared by its contents.
_KEPT = 256
_LARGEST = 100_000
# Their functions do not change between calls, whatever globals they read.
_TRUSTED = ("jax", "jaxlib", "jsmitsm", "numpy", "builtins", "math")


class Unknown(Exception):
    """Something that cannot be compared."""


class _Same:
    """Equal only to itself; keeps the object, so that its identity is not given away."""

    def __init__(self, value: Any):
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.value is self.value

    def __hash__(self) -> int:
        return id(self.value)


def identity(function: Callable[..., Any]) -> Any:
    """A hashable that is equal for functions which do the same; raises :class:`Unknown`."""
    return _value(function, {})


def _trusted(name: Any) -> bool:
    return isinstance(name, str) and name.partition(".")[0] in _TRUSTED


def _value(value: Any, seen: dict[int, int]) -> Any:
    """What stands for one value in the comparison; ``seen`` numbers functions, which may be recursive."""
    kind = type(value)
    if value is None or kind in (bool, int, str, bytes, complex):
        return kind, value
    if kind is float:
        return kind, value.hex()  # 0.0 and -0.0 differ
    if isinstance(value, (np.ndarray, np.generic)):
        if value.size > _LARGEST or value.dtype.hasobject:
            raise Unknown
        return kind, value.shape, value.dtype.str, value.tobytes()
    if isinstance(value, jax.core.Tracer):
        raise Unknown
    if isinstance(value, (jax.Array, types.ModuleType, types.BuiltinFunctionType, np.ufunc)):
        return _Same(value)
    if kind in (tuple, list):
        return kind, tuple(_value(v, seen) for v in value)
    if kind is dict:
        return kind, tuple((_value(k, seen), _value(v, seen)) for k, v in value.items())
    if isinstance(value, functools.partial):
        return kind, *(_value(v, seen) for v in (value.func, value.args, value.keywords))
    if isinstance(value, types.FunctionType):
        return _function(value, seen)
    if callable(value) and not isinstance(value, type) and _trusted(kind.__module__) and _trusted(
        getattr(value, "__module__", None)
    ):  # fmt: skip
        return _Same(value)  # jax.numpy's compiled functions
    raise Unknown


def _function(function: types.FunctionType, seen: dict[int, int]) -> Any:
    """Code, defaults, closure, and the globals that the code names."""
    if id(function) in seen:
        return "again", seen[id(function)]
    seen[id(function)] = len(seen)
    try:
        cells = tuple(cell.cell_contents for cell in function.__closure__ or ())
    except ValueError:  # a cell that is still empty
        raise Unknown from None
    visible: list[Any] = [cells, function.__defaults__, function.__kwdefaults__]
    if not _trusted(function.__globals__.get("__name__")):
        names = sorted(_names(function.__code__))
        visible.append({n: function.__globals__[n] for n in names if n in function.__globals__})
    return function.__code__, _value(visible, seen)


def _names(code: types.CodeType) -> set[str]:
    """All names that a code and the functions inside of it may look up."""
    inner = (c for c in code.co_consts if isinstance(c, types.CodeType))
    return set(code.co_names).union(*map(_names, inner))


_records: OrderedDict[Any, Any] = OrderedDict()
_lock = threading.Lock()  # solves may run in several threads


def recalled(function: Callable[..., Any], rest: Any, make: Callable[[], Any], keep: Callable[[Any], bool]) -> Any:
    """``make()``, or what it returned when the function was last seen with the same hashable ``rest``."""
    try:
        key = identity(function), rest, jax.config.read("jax_enable_x64")
        hash(key)
    except (Unknown, TypeError, RecursionError):
        return make()
    with _lock:
        if key in _records:
            _records.move_to_end(key)
            return _records[key]
    made = make()
    if keep(made):
        with _lock:
            _records[key] = made
            if len(_records) > _KEPT:
                _records.popitem(last=False)
    return made
