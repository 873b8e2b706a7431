"""Boundary conditions as they are written: what holds on a group, in the user's own functions and numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jsmitsm.equation.traced import Traced
from jsmitsm.runtime.arrays import ArrayLike, ValueOrFunction
from jsmitsm.runtime.errors import explaining, is_whole, refuse_masked, short, some
from jsmitsm.runtime.tracers import is_traced


@jax.tree_util.register_pytree_node_class
class Condition:
    """A boundary condition.

    Made by ``js.dirichlet``, ``js.neumann``, ``js.robin``, ``js.condition``, ``js.interface``, ``js.periodic``,
    ``js.fix`` or ``js.free``. Numbers and arrays in it are leaves of the pytree, functions are static.

    Parameters
    ----------
    kind : str
        The name of the function that made it.
    field : int, optional
        The field it holds for; all of them if not given.
    **parts : number, array or function
        What the condition is made of, by name.

    Examples
    --------
    >>> import jsmitsm as js
    >>> isinstance(js.dirichlet(0.0), js.Condition)
    True
    """

    def __init__(self, kind: str, field: int | None = None, **parts: Any):
        self.kind = kind
        self.field = field
        self.parts = parts
        self.numbers = tuple(k for k, v in parts.items() if not callable(v) and not isinstance(v, (str, tuple)))

    def __getattr__(self, name: str) -> Any:
        try:
            return self.__dict__["parts"][name]
        except KeyError:
            raise AttributeError(name) from None

    def tree_flatten(self):
        static = tuple((k, v) for k, v in self.parts.items() if k not in self.numbers)
        return tuple(self.parts[k] for k in self.numbers), (self.kind, self.field, self.numbers, static)

    @classmethod
    def tree_unflatten(cls, aux, leaves):
        kind, field, names, static = aux
        new = cls(kind, field, **dict(zip(names, leaves)), **dict(static))
        new.numbers = names  # leaves stay leaves, whatever a tool puts in their place
        return new

    def __repr__(self) -> str:
        def short(v: Any) -> str:
            if isinstance(v, tuple) and len(v) > 6:
                return f"({v[0]}, {v[1]}, ... {len(v)} in all)"
            if callable(v) or isinstance(v, Traced):
                return "<function>"
            return f"array{v.shape}" if np.ndim(v) and hasattr(v, "shape") else str(v)

        parts = dict(self.parts)
        shown = [f"flux of {parts['sides'][0]!r} and {parts['sides'][1]!r}"] if "sides" in parts else []
        shown += [f"{k}={short(v)}" for k, v in parts.items() if shown == [] or k not in ("sides", "one", "two")]
        return f"{self.kind}({', '.join(shown + ([f'field={self.field}'] if self.field is not None else []))})"


@explaining
def dirichlet(value: ValueOrFunction, field: int | None = None) -> Condition:
    """u = value on a group.

    Parameters
    ----------
    value : float, array (n,) or function
        A number, an array over the group, or a function of x (and of params, where the problem has them). For a
        system without ``field``: a number for all fields, (F,), (n, F), or a function returning (F,).
    field : int, optional
        The field it holds for; all of them if not given.

    Returns
    -------
    Condition
        To be put under the name of a group in ``bcs``.

    Raises
    ------
    ValueError
        For what is no number, array or function, and for NaN.

    Examples
    --------
    >>> import jsmitsm as js
    >>> js.dirichlet(1.0)
    dirichlet(value=1.0)
    """
    return Condition("dirichlet", _field(field), value=checked_value(value, "value"))


@explaining
def neumann(value: ValueOrFunction, field: int | None = None) -> Condition:
    """n . grad u = value on a group, n the outward unit normal.

    Parameters
    ----------
    value : float, array (n,) or function
        As in ``js.dirichlet``.
    field : int, optional
        The field it holds for; all of them if not given.

    Returns
    -------
    Condition
        To be put under the name of a group in ``bcs``.

    Raises
    ------
    ValueError
        For what is no number, array or function, and for NaN.

    Examples
    --------
    >>> import jsmitsm as js
    >>> js.neumann(lambda x: x[0])
    neumann(value=<function>)
    """
    return Condition("neumann", _field(field), value=checked_value(value, "value"))


@explaining
def robin(
    a: ValueOrFunction, b: ValueOrFunction, value: ValueOrFunction, field: int | None = None
) -> Condition:
    """a u + b n . grad u = value on a group, n the outward unit normal.

    Parameters
    ----------
    a, b, value : float, array (n,) or function
        Each as the value of ``js.dirichlet``.
    field : int, optional
        The field it holds for; all of them if not given.

    Returns
    -------
    Condition
        To be put under the name of a group in ``bcs``.

    Raises
    ------
    ValueError
        Where ``a`` and ``b`` are both zero, for what is no number, array or function, and for NaN.

    Examples
    --------
    >>> import jsmitsm as js
    >>> js.robin(1.0, 2.0, 0.0)
    robin(a=1.0, b=2.0, value=0.0)
    """
    a, b = checked_value(a, "a"), checked_value(b, "b")
    known = not any(callable(v) or isinstance(v, jax.core.Tracer) for v in (a, b))
    if known and np.any((np.asarray(a) == 0) & (np.asarray(b) == 0)):
        raise ValueError("robin: a and b are both zero, which states nothing of u; give one of them, or js.free()")
    return Condition("robin", _field(field), a=a, b=b, value=checked_value(value, "value"))


@explaining
def condition(residual: Callable[..., Any]) -> Condition:
    """A general condition, residual = 0.

    Parameters
    ----------
    residual : function
        ``residual(u, x, n)`` (and ``params`` last, where given) with the unit outward normal ``n``; returns a
        scalar, or a vector where it states several conditions at once.

    Returns
    -------
    Condition
        To be put under the name of a group in ``bcs``.

    Raises
    ------
    ValueError
        For what is no function.

    Examples
    --------
    >>> import jsmitsm as js
    >>> js.condition(lambda u, x, n: n @ js.grad(u)(x) + u(x) ** 4)
    condition(residual=<function>)
    """
    if not callable(residual):
        raise ValueError(f"residual: expected a function residual(u, x, n), got {type(residual).__name__}")
    return Condition("condition", residual=residual)


@explaining
def periodic(first: str, second: str) -> Condition:
    """Two groups that are images of each other under a translation.

    Give it under the key of either group; the particles of ``second`` take the values of ``first``.

    Parameters
    ----------
    first, second : str
        Names of the groups.

    Returns
    -------
    Condition
        To be put under the name of either group in ``bcs``.

    Raises
    ------
    ValueError
        Unless two different names are given.

    Examples
    --------
    >>> import jsmitsm as js
    >>> js.periodic("left", "right")
    periodic(groups=('left', 'right'))
    """
    if not (isinstance(first, str) and isinstance(second, str)) or first == second:
        raise ValueError(f"periodic: expected the names of two different groups, got {first!r} and {second!r}")
    return Condition("periodic", groups=(first, second))


@explaining
def fix(indices: ArrayLike, value: ValueOrFunction, field: int | None = None) -> Condition:
    """Hold some particles, interior ones too.

    Parameters
    ----------
    indices : int or array_like of int
        Numbers of particles in the cloud's order.
    value : float, array (n,) or function
        As in ``js.dirichlet``.
    field : int, optional
        The field it holds for; all of them if not given.

    Returns
    -------
    Condition
        To be put under any free key in ``bcs``.

    Raises
    ------
    ValueError
        For numbers that are none, or given twice.

    Examples
    --------
    >>> import jsmitsm as js
    >>> js.fix([12], 0.0)
    fix(indices=(12,), value=0.0)
    """
    refuse_masked(indices, "indices")
    index = np.atleast_1d(np.array(None) if is_traced(indices) else np.asarray(indices))
    if index.ndim != 1 or index.dtype.kind not in "iu" or not index.size:
        raise ValueError(f"indices: expected particle numbers, got {short(indices)}")
    if index.min() < 0 or len(np.unique(index)) != len(index):
        raise ValueError(f"indices: particles are numbered from 0 and given once each, got {index.tolist()}")
    return Condition("fix", _field(field), indices=tuple(int(i) for i in index), value=checked_value(value, "value"))


def free() -> Condition:
    """No condition on a group: the equation alone holds there (outflow, final time).

    Returns
    -------
    Condition
        To be put under the name of a group in ``bcs``.

    Examples
    --------
    >>> import jsmitsm as js
    >>> js.free()
    free()
    """
    return Condition("free")


def _field(field: Any) -> int | None:
    if field is not None and not is_whole(field, 0):
        raise ValueError(f"field: expected the number of a field (0, 1, ...), got {short(field)}")
    return None if field is None else int(field)


def checked_value(value: Any, name: str) -> Any:
    """A number, array or function; anything else is refused here, where the user wrote it."""
    if callable(value) or isinstance(value, jax.core.Tracer):
        return value
    refuse_masked(value, name)
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "fiuc":
            raise TypeError
    except (TypeError, ValueError, OverflowError):
        raise ValueError(
            f"{name}: expected a number, an array over the group or a function of x, got {short(value)}"
        ) from None
    if not np.isfinite(array).all():
        bad = np.argwhere(~np.isfinite(array))
        where = "" if array.ndim == 0 else f" at {some(bad[:, 0])}"
        raise ValueError(f"{name}: NaN or infinite numbers{where}; give finite boundary data")
    return value if isinstance(value, jax.Array) or array.ndim == 0 else array
