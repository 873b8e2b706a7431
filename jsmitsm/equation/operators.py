"""Differential operators acting on a local field, or on any function of a point."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar, overload

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name

from jsmitsm.equation.field import RATE, Field, LocalField, total, unit
from jsmitsm.equation.marks import ALONG, DIFFERENTIATED
from jsmitsm.taylor.multi_indices import MultiIndex

Function: TypeAlias = Callable[[Any], jax.Array]
Same = TypeVar("Same", Field, LocalField)


@overload
def partial(u: Same, multi_index: MultiIndex | int) -> Same: ...
@overload
def partial(u: Function, multi_index: MultiIndex | int) -> Function: ...
def partial(u: Any, multi_index: MultiIndex | int) -> Any:
    """The derivative d^a u, a function of the point.

    Parameters
    ----------
    u : field or function
        A local field, or any function of a point (D,).
    multi_index : tuple of int, or int
        D non-negative integers, the order along each axis; in 1D an integer will do.

    Returns
    -------
    field or function
        Of the kind of ``u``.

    Raises
    ------
    ValueError
        If the length of ``multi_index`` is not D.

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> float(partial(lambda y: y[0] ** 2 * y[1], (1, 1))(jnp.array([3.0, 5.0])))
    6.0
    """
    try:
        index = (multi_index,) if isinstance(multi_index, int) else tuple(int(k) for k in multi_index)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(
            f"multi_index: expected D whole numbers such as (1, 0), got {multi_index!r} (docs: problems)"
        ) from None
    if isinstance(u, Field):
        return u._shifted(index)
    if isinstance(u, LocalField):
        return u._map(lambda f: f._shifted(index))

    def derivative(x: Any) -> Any:
        x = _point(x)
        if len(index) != len(x) or any(k < 0 for k in index):
            raise ValueError(f"multi_index must be {len(x)} non-negative integers, got {index} (docs: problems)")
        function = _array_valued(u)
        for axis, times in enumerate(index):
            for _ in range(times):
                function = _along(function, axis)
        return function(x)

    return derivative


@overload
def grad(u: Field | LocalField) -> LocalField: ...
@overload
def grad(u: Function) -> Function: ...
def grad(u: Any) -> Any:
    """The gradient of ``u``, a function of the point; derivatives on the last axis.

    Parameters
    ----------
    u : field or function
        A local field, or any function of a point (D,).

    Returns
    -------
    field or function
        ``grad(u)(x)`` is (D,) for a scalar ``u``, (F, D) for a vector.

    Raises
    ------
    ValueError
        For what is neither a field nor a function.

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> grad(lambda y: y[0] * y[1])(jnp.array([3.0, 5.0])).tolist()
    [5.0, 3.0]
    """
    if isinstance(u, Field):
        return LocalField(u.dim, [u._shifted(unit(u.dim, i)) for i in range(u.dim)])
    if isinstance(u, LocalField):
        return u._map(grad)
    function = _array_valued(u)
    return lambda x: jnp.stack([_along(function, i)(_point(x)) for i in range(len(_point(x)))], -1)


@overload
def hessian(u: Field | LocalField) -> LocalField: ...
@overload
def hessian(u: Function) -> Function: ...
def hessian(u: Any) -> Any:
    """The second derivatives of ``u``, a function of the point.

    Parameters
    ----------
    u : field or function
        A local field, or any function of a point (D,).

    Returns
    -------
    field or function
        ``hessian(u)(x)`` is (D, D), or (F, D, D) for a vector ``u``.

    Raises
    ------
    ValueError
        For what is neither a field nor a function.

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> hessian(lambda y: y[0] ** 2 * y[1])(jnp.array([3.0, 5.0])).tolist()
    [[10.0, 6.0], [6.0, 0.0]]
    """
    if isinstance(u, Field | LocalField):
        return grad(grad(u))
    function = _array_valued(u)

    def matrix(x: Any) -> jax.Array:
        x = _point(x)
        dim = len(x)
        upper = {
            (i, j): _along(_along(function, i), j)(x) for i, j in itertools.combinations_with_replacement(range(dim), 2)
        }
        rows = [jnp.stack([upper[min(i, j), max(i, j)] for j in range(dim)], -1) for i in range(dim)]
        return jnp.stack(rows, -2)

    return matrix


@overload
def laplacian(u: Same) -> Same: ...
@overload
def laplacian(u: Function) -> Function: ...
def laplacian(u: Any) -> Any:
    """The sum of the second derivatives of ``u``, a function of the point.

    Parameters
    ----------
    u : field or function
        A local field, or any function of a point (D,).

    Returns
    -------
    field or function
        ``laplacian(u)(x)`` is a scalar, or (F,) for a vector ``u``.

    Raises
    ------
    ValueError
        For what is neither a field nor a function.

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> float(laplacian(lambda y: y[0] ** 2 * y[1])(jnp.array([3.0, 5.0])))
    10.0
    """
    if isinstance(u, Field):
        return total(u._shifted(tuple(2 * k for k in unit(u.dim, i))) for i in range(u.dim))
    if isinstance(u, LocalField):
        return u._map(laplacian)
    function = _array_valued(u)
    return lambda x: total(_along(_along(function, i), i)(_point(x)) for i in range(len(_point(x))))


@overload
def divergence(v: LocalField) -> Field | LocalField: ...
@overload
def divergence(v: Function) -> Function: ...
def divergence(v: Any) -> Any:
    """The divergence of ``v``, a function of the point, summed over the last axis.

    Parameters
    ----------
    v : field or function
        ``v(x)`` is (D,), or (F, D) for one divergence a row.

    Returns
    -------
    field or function
        ``divergence(v)(x)`` is a scalar, or (F,).

    Raises
    ------
    ValueError
        If the last axis is not of length D.

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> float(divergence(lambda y: y ** 2)(jnp.array([3.0, 5.0])))
    16.0
    """
    if isinstance(v, Field):
        raise ValueError(
            "v must be a vector field with D components, got a scalar field; did you mean grad(u)? (docs: problems)"
        )
    if isinstance(v, LocalField):
        _check_last_axis(v.shape, v.dim)
        rows = (slice(None),) * (v.ndim - 1)
        return total(partial(v[(*rows, i)], unit(v.dim, i)) for i in range(v.dim))
    function = _array_valued(v)

    def total_slope(x: Any) -> Any:
        x = _point(x)
        dim = len(x)

        def component(i: int) -> Callable[[Any], Any]:
            def part(y: Any) -> Any:
                value = function(y)
                _check_last_axis(value.shape, dim)
                return value[..., i]

            return part

        return total(_along(component(i), i)(x) for i in range(dim))

    return total_slope


def dt(u: Same, order: int = 1) -> Same:
    """The derivative of ``u`` in time, a function of the point; for the problems of ``js.evolve``.

    Parameters
    ----------
    u : field
        The unknown, or some of a system's fields.
    order : int
        1 or 2.

    Returns
    -------
    field
        Of the kind of ``u``.

    Raises
    ------
    ValueError
        For what is no unknown, such as a derivative of it or a function of the point.

    Examples
    --------
    >>> import jsmitsm as js
    >>> heat = lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x)
    """
    if isinstance(order, bool) or order not in (1, 2):
        raise ValueError(f"order: js.dt(u, order) takes 1 or 2, got {order!r} (docs: time)")
    if isinstance(u, LocalField):
        return u._map(lambda f: dt(f, order))
    if not isinstance(u, Field) or any(sum(index) for _, index in u.terms):
        raise ValueError(
            "u: js.dt takes the unknown u itself, or u[k] of a system; write the rate of a product by its rule, and a "
            "derivative of a rate as an unknown of its own (docs: time)"
        )
    return Field(u.dim, {(k + order * RATE, index): c for (k, index), c in u.terms.items()})


def _check_last_axis(shape: tuple[int, ...], dim: int) -> None:
    if not shape or shape[-1] != dim:
        raise ValueError(
            f"v must give {dim} components on its last axis, one per dimension of the point, got shape {tuple(shape)} "
            "(docs: problems)"
        )


def _point(x: Any) -> jax.Array:
    x = jnp.asarray(x)
    if x.ndim != 1:
        raise ValueError(f"x must be one point of shape (D,), got shape {x.shape} (docs: problems)")
    return x


def _array_valued(function: Any) -> Callable[[Any], Any]:
    if not callable(function):
        raise ValueError(
            f"an operator takes a field or a function of the point, got {type(function).__name__}; "
            "write js.grad(u)(x), not js.grad(u(x)), and pde(u, x), the field first (docs: problems)"
        )

    def value(y: Any) -> Any:
        out = function(y)
        if isinstance(out, Field | LocalField):
            raise ValueError(
                "the function returned a field instead of its value: evaluate it, as in js.grad(u)(y) (docs: problems)"
            )
        return jnp.stack(out) if isinstance(out, list | tuple) else jnp.asarray(out)

    return value


def _along(function: Callable[[Any], Any], axis: int) -> Callable[[Any], Any]:
    """The derivative of a function of the point along one axis, by forward mode."""

    def named(y: Any) -> Any:
        return checkpoint_name(function(y), f"{DIFFERENTIATED}{axis}")

    def slope(y: Any) -> Any:
        # By operations, not as an array: of arrays nobody may assume that their numbers stay.
        direction = (jax.lax.iota(np.int32, len(y)) == axis).astype(y.dtype)
        with jax.named_scope(ALONG):
            return jax.jvp(named, (y,), (direction,))[1]

    return slope
