"""A boundary-value problem: a residual written as a Python function, and boundary conditions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jsmitsm.equation.regions.per_region import PerRegion, per_region
from jsmitsm.equation.traced import Traced
from jsmitsm.equation.unknowns.constraint import Constraint
from jsmitsm.equation.unknowns.extras import Extras, extras
from jsmitsm.equation.unknowns.point_source import PointSource
from jsmitsm.runtime.arrays import ArrayLike, ValueOrFunction
from jsmitsm.runtime.errors import did_you_mean, refuse_masked, short
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
    if field is not None and (isinstance(field, bool) or not isinstance(field, (int, np.integer)) or field < 0):
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
        raise ValueError(f"{name}: NaN or infinite numbers; give finite boundary data")
    return value if isinstance(value, jax.Array) or array.ndim == 0 else array


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
        *,
        constraints: Sequence[Constraint] = (),
        unknowns: Mapping[str, Any] | None = None,
        dtype: Any = float,
        sources: Sequence[PointSource] = (),
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
        _check_params(params, dtype is not float)
        self.pde: Any = pde
        self.fields = int(fields)
        self.params = params
        self.bcs = {name: _listed(name, value, self.fields) for name, value in bcs.items()}
        self.extras = extras(constraints, unknowns, dtype, sources, self.bcs)

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

    def replace(self, **changes: Any) -> Problem:
        """The same problem with other parts.

        Parameters
        ----------
        **changes : any
            ``params``, ``pde``, ``bcs``, ``fields``, ``constraints``, ``unknowns``, ``dtype`` or
            ``sources``.

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
        names = ("pde", "bcs", "fields", "params", "constraints", "unknowns", "dtype", "sources")
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
