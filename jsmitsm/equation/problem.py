"""A boundary-value problem: a residual written as a Python function, and what holds on the boundary."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jsmitsm.equation.bcs import Condition
from jsmitsm.equation.regions.per_region import PerRegion, by_region, per_region
from jsmitsm.equation.traced import Traced
from jsmitsm.equation.unknowns.constraint import Constraint
from jsmitsm.equation.unknowns.extras import Extras, extras
from jsmitsm.equation.unknowns.point_source import PointSource
from jsmitsm.runtime import notebooks
from jsmitsm.runtime.errors import did_you_mean, explaining, is_whole, short


@jax.tree_util.register_pytree_node_class
class Problem:
    """A boundary-value problem.

    A problem is a pytree: params and the numbers in the conditions are leaves.

    Parameters
    ----------
    pde : function
        Function ``(u, x)`` or ``(u, x, params)`` returning the residual at the point x (D,): a scalar, or (F,) for
        a system. ``u`` is a local field, see ``js.grad``. For a cloud of several regions
        (``js.regions``) a dict of them, one for each region by its name.
    bcs : mapping
        Maps each boundary group to a condition, or to a list of them where the operator's order or the number of
        fields needs several; and each interface ``"a|b"`` to ``js.interface``. Where a group bounds several regions
        a dict of them by region, arrays in them over the group or over its particles in that region.
    fields : int
        Number F of unknown fields.
    params : pytree, optional
        Any pytree of numbers. Where it is given, every function of the problem takes it as its last argument, and
        new numbers in it never recompile.
    constraints : sequence of Constraint
        From ``js.constraint``: numbers made of the solution that have given values. As many as there are unknowns; or
        without unknowns one for every field that the conditions leave free up to a constant.
    unknowns : mapping, optional
        Maps names to the numbers to start from: scalars that are found together with u, such as the potential of an
        electrode or a Lagrange multiplier. Where there are some, every function of the problem takes them, as a dict,
        as its last argument: ``pde(u, x, g)``, or ``pde(u, x, params, g)``.
    dtype : float or complex
        ``complex`` where u, the residual and the values of the conditions are complex.
    sources : sequence of PointSource
        From ``js.point_source``: what the residual is besides zero, strength delta(x - x0) each.
    integral : function, optional
        ``kernel(x, y)`` (and ``params`` last, where given), smooth in both: the residual is pde(u, x) plus the integral
        of kernel(x, y) u(y) over the whole domain; (F, F) for a system. With several regions a dict gives some
        equations one. It couples all particles, up to 5000 unknowns.

    Raises
    ------
    ValueError
        For a pde that is no function, conditions that are none or of fields that do not exist, and
        params that are not finite numbers.

    Examples
    --------
    >>> import jsmitsm as js
    >>> js.Problem(
    ...     lambda u, x: js.laplacian(u)(x) - 1.0,
    ...     {"left": js.dirichlet(0.0), "right": js.neumann(0.0)},
    ... )
    Problem(fields=1, left: dirichlet(value=0.0), right: neumann(value=0.0))
    """

    @explaining
    def __init__(
        self,
        pde: Callable[..., Any] | Mapping[str, Callable[..., Any]],
        bcs: Mapping[str, Condition | Sequence[Condition]],
        fields: int = 1,
        params: Any = None,
        *,
        constraints: Sequence[Constraint] = (),
        unknowns: Mapping[str, Any] | None = None,
        dtype: Any = float,
        sources: Sequence[PointSource] = (),
        integral: Callable[..., Any] | Mapping[str, Callable[..., Any]] | None = None,
    ):
        if isinstance(pde, Mapping):
            pde = per_region(pde)
        elif not callable(pde):
            raise ValueError(f"pde: expected a function pde(u, x) returning the residual, got {type(pde).__name__}")
        if not is_whole(fields, 1, 999):
            raise ValueError(f"fields: expected the number of unknown fields (1, 2, ... 999), got {short(fields)}")
        if not isinstance(bcs, Mapping):
            raise ValueError(
                f"bcs: expected a dict from group name to condition, got {type(bcs).__name__}; "
                'write e.g. {"left": js.dirichlet(0.0)}'
            )
        _check_params(params, dtype is not float)
        self.pde: Any = pde
        self.fields = int(fields)
        self.params = params
        self.bcs = {name: _listed(name, value, self.fields) for name, value in by_region(bcs, self.pde).items()}
        self.extras = extras(constraints, unknowns, dtype, sources, integral, self.pde, self.bcs)

    # Constraints and unknowns; most problems have none.
    extras: Extras | None = None

    @property
    def constraints(self) -> tuple[Constraint, ...]:
        """The constraints, in their order."""
        return () if self.extras is None else self.extras.constraints

    @property
    def unknowns(self) -> dict[str, Any]:
        """The global unknowns and the numbers they start from."""
        return {} if self.extras is None else dict(self.extras.unknowns)

    @property
    def dtype(self) -> type:
        """What u is: float or complex."""
        return complex if self.extras is not None and self.extras.complex_values else float

    @property
    def sources(self) -> tuple[PointSource, ...]:
        """The point sources."""
        return () if self.extras is None else self.extras.sources

    @property
    def integral(self) -> Any:
        """The kernel of the integral term, those of the regions in a dict; None without one."""
        found = () if self.extras is None else self.extras.kernels
        if not found:
            return None
        return found[0][1] if found[0][0] is None else {str(name): kernel for name, kernel in found}

    @explaining
    def replace(self, **changes: Any) -> Problem:
        """The same problem with other parts.

        Parameters
        ----------
        **changes : any
            ``params``, ``pde``, ``bcs``, ``fields``, ``constraints``, ``unknowns``, ``dtype``,
            ``sources`` or ``integral``.

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
        >>> problem = js.Problem(
        ...     lambda u, x, k: k * js.laplacian(u)(x),
        ...     {"left": js.dirichlet(0.0)},
        ...     params=1.0,
        ... )
        >>> problem.replace(params=2.0).params
        2.0
        """
        names = ("pde", "bcs", "fields", "params", "constraints", "unknowns", "dtype", "sources", "integral")
        unknown = sorted(set(changes) - set(names))
        if unknown:
            raise ValueError(f"{unknown[0]}: no part of a Problem; it has {', '.join(names[:-1])} and {names[-1]}"
                             + did_you_mean(unknown[0], names))  # fmt: skip
        return Problem(**{**{name: getattr(self, name) for name in names}, **changes})

    def tree_flatten(self):
        if isinstance(self.pde, (Traced, PerRegion)):
            return (self.bcs, self.params, self.extras, self.pde), (None, self.fields)
        return (self.bcs, self.params, self.extras), (self.pde, self.fields)

    @classmethod
    def tree_unflatten(cls, aux, leaves):
        new = object.__new__(cls)
        new.pde, new.fields = aux
        new.bcs, new.params, new.extras, *recorded = leaves
        if recorded:
            (new.pde,) = recorded
        return new

    def __repr__(self) -> str:
        shown = ", ".join(f"{name}: {', '.join(map(repr, value))}" for name, value in self.bcs.items())
        of = f"regions={list(self.pde)}, " if isinstance(self.pde, PerRegion) else ""
        return f"Problem({of}fields={self.fields}, {shown})"

    def _repr_html_(self) -> str:
        rows = [("fields", self.fields), *((name, ", ".join(map(repr, held))) for name, held in self.bcs.items())]
        if isinstance(self.pde, PerRegion):
            rows.insert(0, ("regions", ", ".join(self.pde)))
        rows += [] if self.params is None else [("params", short(self.params))]
        return notebooks.shown("Problem", rows)


def of_parts(pde: Any, bcs: Any, fields: int, params: Any) -> Problem:
    """A problem of parts that were judged when a user stated them, and recorded ones among them; without extras."""
    new = object.__new__(Problem)
    new.pde, new.bcs, new.fields, new.params = pde, bcs, fields, params
    return new


def _check_params(params: Any, complex_too: bool) -> None:
    """Parameters are finite numbers; traced ones pass."""
    kinds = "biufc" if complex_too else "biuf"
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        if isinstance(leaf, jax.core.Tracer):
            continue
        where = f"params{jax.tree_util.keystr(path)}"
        if getattr(leaf, "dtype", np.asarray(leaf).dtype if np.isscalar(leaf) else np.dtype(object)).kind not in kinds:
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
