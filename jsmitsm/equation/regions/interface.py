"""What a user may say of an interface."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from jsmitsm.equation.bcs import Condition, checked_value
from jsmitsm.runtime.arrays import ValueOrFunction
from jsmitsm.runtime.errors import explaining, short

INTERFACE = "interface"


@explaining
def interface(
    flux: Mapping[str, Callable[..., Any]] | None = None,
    jump: ValueOrFunction = 0.0,
    source: ValueOrFunction = 0.0,
    resistance: ValueOrFunction | None = None,
    *,
    residual: Callable[..., Any] | None = None,
) -> Condition:
    """The conditions on an interface ``"a|b"`` of two regions:

        u_a - u_b + resistance flux_a = jump,      flux_a - flux_b = source.

    Parameters
    ----------
    flux : mapping of two functions, optional
        Maps the names of both regions to functions ``(u, x, n)`` (and ``params`` last, where given) that return +k
        n . grad u, for elasticity +traction; (F,) for a system. ``n`` is the same for both, from a to b.
    jump : float, array or function
        u_a - u_b, a number, an array over the pairs of the interface (P,) or a function of x (and of params); for a
        system for all fields, (F,), (P, F) or a function returning (F,).
    source : float, array or function
        What the interface feeds in (heat per area for k n . grad u), as ``jump``.
    resistance : float, array or function, optional
        Of an imperfect contact, a number, an array over the pairs or a function of x; none if not given. In heat
        conduction with k n . grad u the temperature falls in the direction of n where the gradient points against
        it, u_a - u_b = -resistance k n . grad u: a resistance is positive.
    residual : function, optional
        In place of all others ``residual(a, b, x, n)`` (and ``params`` last), with the local fields a and b of both
        sides, returning the two conditions, (2 F,) for a system; nonlinear ones too.

    Returns
    -------
    Condition
        To be put under ``"a|b"`` in ``bcs``.

    Raises
    ------
    ValueError
        For neither or both of ``flux`` and ``residual``, a flux that is no dict of two functions, and values that are
        no numbers, arrays or functions.

    Examples
    --------
    >>> import jsmitsm as js
    >>> k = {"steel": 50.0, "wool": 0.05}
    >>> js.interface(
    ...     flux={name: lambda u, x, n, k=k[name]: k * n @ js.grad(u)(x) for name in k}
    ... )
    interface(flux of 'steel' and 'wool', jump=0.0, source=0.0)
    """
    if (flux is None) == (residual is None):
        raise ValueError(
            'interface: give either flux={"a": f, "b": g} or residual=function(a, b, x, n), '
            f"{'not both' if flux is not None else 'got neither'}"
        )
    if residual is not None:
        if not callable(residual):
            raise ValueError(f"residual: expected a function residual(a, b, x, n), got {type(residual).__name__}")
        for name, value, default in (("jump", jump, 0.0), ("source", source, 0.0), ("resistance", resistance, None)):
            if value is not default and not (default == 0.0 and isinstance(value, float) and value == 0.0):
                raise ValueError(f"{name}: the residual says everything; put the {name} into it")
        return Condition(INTERFACE, residual=residual)
    if not isinstance(flux, Mapping) or len(flux) != 2 or not all(map(callable, flux.values())):
        raise ValueError(
            'flux: expected a dict of two functions (u, x, n), one for each region, as {"a": f, "b": g}, '
            f"got {short(flux)}"
        )
    parts: dict[str, Any] = {"jump": checked_value(jump, "jump"), "source": checked_value(source, "source")}
    if resistance is not None:
        parts["resistance"] = checked_value(resistance, "resistance")
    first, second = flux
    return Condition(INTERFACE, sides=(first, second), one=flux[first], two=flux[second], **parts)
