"""When may a recorded function be used again? When all that it can reach is known to be the same.

JAX remembers functions by identity, so that a lambda written anew is recorded anew, and one that
reads a changed global is not. Here a function is remembered by its code and by the values that the
code can reach. Numbers, arrays, containers and functions made of such are followed; what JAX, NumPy
and Python bring along is taken as it is where it is proven to have no state (``jsmitsm.runtime.recall.stateless``).
Everything else (an object with attributes, a generator, a file, what is looked up by a name made at run
time) is ``Unknown``, and such a function is recorded at every use: that takes milliseconds.
"""

from __future__ import annotations

import builtins
import functools
import locale
import threading
import types
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jsmitsm.runtime.compiled import Same
from jsmitsm.runtime.recall.lookups import Lookups, lookups
from jsmitsm.runtime.recall.stateless import attribute, made_by_library, of_library, stateless

# Recorded functions kept, and the largest array compared by its contents.
_KEPT = 256
_LARGEST = 100_000
_ATOMS = frozenset({type(None), type(Ellipsis), bool, int, str, bytes})
# Settings of JAX that change what is recorded.
_SETTINGS = (
    "jax_enable_x64", "jax_numpy_dtype_promotion", "jax_numpy_rank_promotion", "jax_default_matmul_precision",
    "jax_disable_jit", "jax_debug_nans",
)  # fmt: skip


class Unknown(Exception):
    """Something that cannot be known to be unchanged."""


def identity(function: Callable[..., Any]) -> Any:
    """A hashable that is equal for functions which do the same; raises ``Unknown``."""
    return _value(function, {})


def _value(value: Any, seen: dict[int, int]) -> Any:
    """What stands for one value in the comparison; ``seen`` numbers what may hold itself."""
    kind = type(value)
    if kind in _ATOMS:
        return kind, value
    if kind is float:
        return kind, value.hex()  # 0.0 and -0.0 differ
    if kind is complex:
        return kind, value.real.hex(), value.imag.hex()
    if kind is range:
        return kind, value.start, value.stop, value.step
    if stateless(value):
        return Same(value)
    if id(value) in seen:
        return "again", seen[id(value)]
    seen[id(value)] = len(seen)
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return _array(value)
    if kind in (tuple, list, set, frozenset):
        return kind, tuple(_value(v, seen) for v in value)
    if kind is dict:
        return kind, tuple((_value(k, seen), _value(v, seen)) for k, v in value.items())
    if kind is functools.partial:
        return kind, *(_value(v, seen) for v in (value.func, value.args, value.keywords, vars(value)))
    if kind is types.FunctionType:
        return _function(value, seen)
    raise Unknown


def _array(value: Any) -> Any:
    """By its contents: numpy's arrays can be changed in place, and those of JAX may share their memory."""
    kind = type(value)
    if isinstance(value, jax.core.Tracer) or value.size > _LARGEST:
        raise Unknown
    if isinstance(value, jax.Array):
        if jax.dtypes.issubdtype(value.dtype, jax.dtypes.extended) or not value.is_fully_addressable:
            raise Unknown
        return kind, value.shape, str(value.dtype), value.weak_type, np.asarray(value).tobytes()
    # Subclasses have attributes, structures names; of an array without axes a record would keep the array itself.
    plain = kind is np.ndarray and value.ndim or isinstance(value, np.generic) and kind.__module__ == "numpy"
    if not plain or value.dtype.kind not in "biufc":
        raise Unknown
    return kind, value.shape, value.strides, value.dtype.str, value.tobytes()


def _function(function: types.FunctionType, seen: dict[int, int]) -> Any:
    """Code, defaults, attributes, and what the code looks up in its closure and in its globals."""
    code = function.__code__
    defaults = function.__defaults__, function.__kwdefaults__, function.__dict__
    try:
        cells = {name: cell.cell_contents for name, cell in zip(code.co_freevars, function.__closure__ or ())}
    except ValueError:  # a cell that is still empty
        raise Unknown from None
    if made_by_library(function):
        return code, tuple(Same(v) if of_library(v) else _value(v, seen) for v in (*cells.values(), *defaults))
    looks = lookups(code)
    if looks is None or function.__builtins__ is not vars(builtins):  # type: ignore[attr-defined]
        raise Unknown
    found = [_value(v, seen) for v in defaults]
    found += [_looked_up(value, looks.closure.get(name, frozenset()), seen) for name, value in cells.items()]
    return code, tuple(found), tuple(_global(function, name, looks, seen) for name in looks.names)


def _global(function: types.FunctionType, name: str, looks: Lookups, seen: dict[int, int]) -> Any:
    for scope in (function.__globals__, vars(builtins)):
        if name in scope:
            return _looked_up(scope[name], looks.globals[name], seen)
    return "missing", name


def _looked_up(value: Any, chains: frozenset[tuple[str, ...]], seen: dict[int, int]) -> Any:
    """A value by itself; a module by those of its attributes that are read, and by nothing else."""
    if isinstance(value, type) and any(chains):  # an attribute of a library's class may be of the user's
        raise Unknown
    if type(value) is not types.ModuleType:
        return _value(value, seen)
    if () in chains:  # it is handed on, and may be asked for anything
        raise Unknown
    found = []
    for name in sorted({chain[0] for chain in chains}):
        further = frozenset(chain[1:] for chain in chains if chain[0] == name)
        try:
            found.append((name, _looked_up(attribute(value, name), further, seen)))
        except AttributeError:
            raise Unknown from None
    return tuple(found)


_records: OrderedDict[Any, Any] = OrderedDict()
_lock = threading.Lock()  # solves may run in several threads


def _surroundings() -> Any:
    """Settings that change what functions give: JAX's, numpy's for errors and texts, the locale's for numbers."""
    numpys = *np.geterr().items(), *np.get_printoptions().items()
    return tuple(getattr(jax.config, name) for name in _SETTINGS), numpys, locale.setlocale(locale.LC_NUMERIC)


def _key(function: Callable[..., Any], rest: Any) -> Any:
    """What a record is kept under, or None where it is not kept."""
    try:
        key = identity(function), rest, _surroundings()
        hash(key)
    except (Unknown, TypeError, RecursionError):
        return None
    return key


def recalled(function: Callable[..., Any], rest: Any, make: Callable[[], Any], keep: Callable[[Any], bool]) -> Any:
    """``make()``, or what it returned when the function was last seen with the same hashable ``rest``."""
    key = _key(function, rest)
    if key is not None:
        with _lock:
            if key in _records:
                _records.move_to_end(key)
                return _records[key]
    made = make()
    # A function that changes what it sees does something else the next time.
    if key is not None and keep(made) and _key(function, rest) == key:
        with _lock:
            _records[key] = made
            if len(_records) > _KEPT:
                _records.popitem(last=False)
    return made
