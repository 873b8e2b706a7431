"""A boundary-value problem: a residual written as a Python function, and what holds on the boundary."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jsmitsm.equation.bcs import Condition
from jsmitsm.equation.regions.per_region import PerRegion, per_region
from jsmitsm.equation.traced import Traced
from jsmitsm.runtime.errors import did_you_mean, short


@jax.tree_util.register_pytree_node_class
class Problem:
    """A boundary-value problem.

    A problem is a pytree: params and the numbers in the conditions are leaves.

    Parameters
    ----------
    pde : function
        Function ``(u, x)`` or ``(u, x, params)`` returning the residual at the point x (D,): a scalar, or (F,) for
        a system. ``u`` is a local field, see ``jsmitsm.equation.operators``. For a cloud of several regions
        (``js.regions``) a dict of them, one for each region by its name.
    bcs : mapping
        Maps each boundary group to a condition, or to a list of them where the operator's order or the number of
        fields needs several; and each interface ``"a|b"`` to ``js.interface``.
    fields : int
        Number F of unknown fields.
    params : pytree, optional
        Any pytree of numbers. Where it is given, every function of the problem takes it as its last argument, and
        new numbers in it never recompile.

    Raises
    ------
    ValueError
        For a pde that is no function, conditions that are none or of fields that do not exist, and
        params that are not finite numbers.

    Examples
    --------
    >>> import jsmitsm as js
    >>> js.Problem(lambda u, x: js.laplacian(u)(x) - 1.0, {"left": js.dirichlet(0.0), "right": js.neumann(0.0)})
    Problem(fields=1, left: dirichlet(value=0.0), right: neumann(value=0.0))
    """

    def __init__(
        self,
        pde: Callable[..., Any] | Mapping[str, Callable[..., Any]],
        bcs: Mapping[str, Condition | Sequence[Condition]],
        fields: int = 1,
        params: Any = None,
    ):
        if isinstance(pde, Mapping):
            pde = per_region(pde)
        elif not callable(pde):
            raise ValueError(f"pde: expected a function pde(u, x) returning the residual, got {type(pde).__name__}")
        if isinstance(fields, bool) or not isinstance(fields, (int, np.integer)) or fields < 1:
            raise ValueError(f"fields: expected the number of unknown fields (1, 2, ...), got {short(fields)}")
        if not isinstance(bcs, Mapping):
            raise ValueError(
                f"bcs: expected a dict from group name to condition, got {type(bcs).__name__}; "
                'write e.g. {"left": js.dirichlet(0.0)}'
            )
        _check_params(params)
        self.pde: Any = pde
        self.fields = int(fields)
        self.params = params
        self.bcs = {name: _listed(name, value, self.fields) for name, value in bcs.items()}

    def replace(self, **changes: Any) -> Problem:
        """The same problem with other parts.

        Parameters
        ----------
        **changes : any
            ``params``, ``pde``, ``bcs`` or ``fields``.

        Returns
        -------
        Problem
            A new one; this one stays.

        Raises
        ------
        ValueError
            For other names.

        Examples
        --------
        >>> import jsmitsm as js
        >>> problem = js.Problem(lambda u, x, k: k * js.laplacian(u)(x), {"left": js.dirichlet(0.0)}, params=1.0)
        >>> problem.replace(params=2.0).params
        2.0
        """
        unknown = sorted(set(changes) - {"pde", "bcs", "fields", "params"})
        if unknown:
            raise ValueError(f"{unknown[0]}: no part of a Problem; it has pde, bcs, fields and params"
                             + did_you_mean(unknown[0], ("pde", "bcs", "fields", "params")))  # fmt: skip
        parts = {"pde": self.pde, "bcs": self.bcs, "fields": self.fields, "params": self.params}
        return Problem(**{**parts, **changes})

    def tree_flatten(self):
        if isinstance(self.pde, (Traced, PerRegion)):
            return (self.bcs, self.params, self.pde), (None, self.fields)
        return (self.bcs, self.params), (self.pde, self.fields)

    @classmethod
    def tree_unflatten(cls, aux, leaves):
        new = object.__new__(cls)
        new.pde, new.fields = aux
        new.bcs, new.params, *recorded = leaves
        if recorded:
            (new.pde,) = recorded
        return new

    def __repr__(self) -> str:
        shown = ", ".join(f"{name}: {', '.join(map(repr, value))}" for name, value in self.bcs.items())
        of = f"regions={list(self.pde)}, " if isinstance(self.pde, PerRegion) else ""
        return f"Problem({of}fields={self.fields}, {shown})"


def _check_params(params: Any) -> None:
    """Parameters are finite numbers; traced ones pass."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        if isinstance(leaf, jax.core.Tracer):
            continue
        where = f"params{jax.tree_util.keystr(path)}"
        if getattr(leaf, "dtype", np.asarray(leaf).dtype if np.isscalar(leaf) else np.dtype(object)).kind not in "biuf":
            raise ValueError(
                f"{where}: expected a real number or array, got {short(leaf)}; let the pde close over it instead"
            )
        if not np.isfinite(np.asarray(leaf)).all():
            raise ValueError(f"{where}: NaN or infinite numbers; give finite ones")


def _listed(name: Any, value: Any, fields: int) -> list[Condition]:
    """The conditions of one group as a list."""
    if not isinstance(name, str):
        raise ValueError(f"bcs: the key {name!r} is no string; use the name of a boundary group")
    given = list(value) if isinstance(value, (list, tuple)) else [value]
    for c in given:
        if not isinstance(c, Condition):
            came = short(c)
            raise ValueError(
                f"bcs[{name!r}]: expected a condition, got {came}; write js.dirichlet({came}), js.neumann(...) or such"
            )
        if c.field is not None and c.field >= fields:
            raise ValueError(f"bcs[{name!r}]: field={c.field}, but the problem has fields 0 to {fields - 1}")
    if not given:
        raise ValueError(f"bcs[{name!r}]: no condition; give one, e.g. js.dirichlet(0.0)")
    return given
