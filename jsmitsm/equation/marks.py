"""Marks in what is recorded: what an operator differentiates, and functions whose jumps are meant."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax

# Names that the operators leave in what is recorded, for ``branches`` to read: the result that is differentiated along
# an axis; what an operator differentiates, and not the user's own jax.grad; what lies in a function that is meant.
DIFFERENTIATED, ALONG, MEANT = "jsmitsm.differentiated:", "jsmitsm.along", "jsmitsm.meant"


def meant(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function, whose jumps and kinks under a derivative are meant.

    The derivative of a branch (``jnp.where``, ``jnp.sign``, ``jnp.floor``, a look-up in a table) is that of the piece
    taken: what happens at the jump itself is lost, the condition that fluxes agree there for instance. A problem that
    differentiates a jump inside of its cloud is therefore refused. Marking the function of the jump, a coefficient or
    the whole pde, says that the pieces alone are what is to be solved.

    Parameters
    ----------
    function : function
        Any function; it is called with the same arguments and returns the same.

    Returns
    -------
    function
        The same, marked.

    Raises
    ------
    ValueError
        For what is no function.

    Examples
    --------
    A rod whose material changes at 0.5, and nothing is asked of the flux there: k u'' = 0 on either side.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> k = js.meant(lambda y: jnp.where(y[0] < 0.503, 1.0, 100.0))
    >>> rod = js.Problem(
    ...     pde=lambda u, x: js.divergence(lambda y: k(y) * js.grad(u)(y))(x),
    ...     bcs={"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)},
    ... )
    >>> round(float(js.solve(rod, js.interval(0.0, 1.0, 11)).u[5]), 10)
    0.5
    """
    if not callable(function):
        raise ValueError(
            f"function: expected a function, such as a coefficient of x, got {type(function).__name__} (docs: problems)"
        )

    @functools.wraps(function)
    def marked(*args: Any, **options: Any) -> Any:
        with jax.named_scope(MEANT):
            return function(*args, **options)

    return marked
