"""A complex problem as a real one of twice as many fields: the real parts first, then the imaginary ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.equation.bcs import Condition
from jsmitsm.equation.field import LocalField
from jsmitsm.equation.operators import grad
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.regions.interface import INTERFACE
from jsmitsm.equation.regions.per_region import PerRegion
from jsmitsm.equation.unknowns.parts import parts

I = np.complex128(1j)


def two_fields(problem: Problem) -> Problem:
    """The real problem of the two parts of every field."""
    real, whole = _params(problem.params)

    def split(function: Callable[..., Any]) -> Callable[..., Any]:
        """A complex function of (x, ...[, params]) as a real one: all real parts, then all imaginary ones."""

        def both(*args: Any) -> Any:
            if real is None:
                found = parts(function, *args)
            else:
                found = parts(lambda *a: function(*a[:-1], whole(a[-1])), *args)
            return jnp.concatenate([jnp.ravel(p) for p in found])

        return both

    def stated(pde: Callable[..., Any]) -> Callable[..., Any]:
        return lambda u, x, *more: split(lambda x, *p: pde(_complex(u), x, *p))(x, *more)

    given: Any = problem.pde
    pde = {name: stated(one) for name, one in given.items()} if isinstance(given, PerRegion) else stated(given)
    bcs = {
        name: [new for c in listed for new in _condition(c, problem.fields, split, f"bcs[{name!r}]")]
        for name, listed in problem.bcs.items()
    }
    return Problem(pde, bcs, 2 * problem.fields, real)


def two_parts(start: Any, fields: int) -> Any:
    """A start for Newton's method, (N,), (N, F), a function or a dict of these, as one of the two parts."""
    if start is None:
        return None
    if isinstance(start, Mapping):
        whole = {n: v if callable(v) or jnp.ndim(v) else lambda x, v=v: v for n, v in start.items()}
        return {n: two_parts(v, fields) for n, v in whole.items()}
    if callable(start):
        return lambda x: jnp.concatenate([jnp.ravel(p) for p in parts(start, x)])
    start = jnp.reshape(jnp.asarray(start), (-1, fields))
    return jnp.concatenate([jnp.real(start), jnp.imag(start)], axis=1)


def _complex(u: Any) -> Any:
    """The complex field, or fields, of the real ones."""
    count = len(u) // 2
    each = [u[k] + I * u[count + k] for k in range(count)]
    return each[0] if count == 1 else LocalField(u.dim, each)


def _params(params: Any) -> tuple[Any, Callable[[Any], Any]]:
    """Parameters whose complex numbers are pairs, and what makes of these the user's again."""
    leaves, tree = jax.tree.flatten(params)
    paired = [jnp.iscomplexobj(v) for v in leaves]
    real = tuple((jnp.real(v), jnp.imag(v)) if two else v for v, two in zip(leaves, paired, strict=True))

    def whole(given: Any) -> Any:
        back = [jax.lax.complex(*v) if two else v for v, two in zip(given, paired, strict=True)]
        return jax.tree.unflatten(tree, back)

    return (None if params is None else real), whole


def _condition(c: Condition, fields: int, split: Any, where: str) -> list[Condition]:
    """The real conditions that a complex one amounts to."""
    if c.kind in ("periodic", "free"):
        return [c]
    if c.kind == INTERFACE:
        return [_between(c, fields, split, where)]
    if c.kind == "condition":

        def residual(u: Any, x: Any, n: Any, *more: Any) -> Any:
            return split(lambda x, n, *p: c.residual(_complex(u), x, n, *p))(x, n, *more)

        return [Condition("condition", residual=residual)]
    if c.kind not in ("dirichlet", "neumann", "robin", "fix"):
        raise ValueError(f"{where}: js.{c.kind} is not made for complex unknowns")
    if c.kind == "robin" and any(callable(v) or jnp.iscomplexobj(v) for v in (c.a, c.b)):
        return [_robin(c, fields, split, where)]
    rest = {name: v for name, v in c.parts.items() if name != "value"}
    if c.field is None:
        return [Condition(c.kind, None, **rest, value=_value(c.value, fields, split))]
    both = (c.field, _part(c.value, 0, split)), (fields + c.field, _part(c.value, 1, split))
    return [Condition(c.kind, f, **rest, value=v) for f, v in both]


def _between(c: Condition, fields: int, split: Any, where: str) -> Condition:
    """The conditions on an interface, of both parts."""
    parts = dict(c.parts)
    if "residual" in parts:

        def residual(a: Any, b: Any, x: Any, n: Any, *more: Any) -> Any:
            return split(lambda x, n, *p: c.residual(_complex(a), _complex(b), x, n, *p))(x, n, *more)

        return Condition(c.kind, residual=residual)

    def flux(given: Any) -> Any:
        return lambda u, x, n, *more: split(lambda x, n, *p: given(_complex(u), x, n, *p))(x, n, *more)

    if jnp.iscomplexobj(parts.get("resistance")):
        raise ValueError(f"{where}.resistance: complex, which couples the parts; write it as a residual(a, b, x, n)")
    for name in ("one", "two"):
        parts[name] = flux(parts[name])
    for name in ("jump", "source"):
        if parts.get(name) is not None:
            parts[name] = _value(parts[name], fields, split)
    return Condition(c.kind, **parts)


def _robin(c: Condition, fields: int, split: Any, where: str) -> Condition:
    """a u + b n . grad u = value couples the two parts where a or b is complex."""
    for name, v in c.parts.items():
        if not callable(v) and np.ndim(v):
            raise ValueError(f"{where}: {name} as an array does not go with a complex a or b; give a function of x")

    def residual(u: Any, x: Any, n: Any, *more: Any) -> Any:
        def whole(x: Any, n: Any, *p: Any) -> Any:
            a, b, value = (v(x, *p) if callable(v) else v for v in (c.a, c.b, c.value))
            w = _complex(u)
            w = w if c.field is None else w if fields == 1 else w[c.field]
            return a * w(x) + b * (grad(w)(x) @ n) - value

        return split(whole)(x, n, *more)

    return Condition("condition", residual=residual)


def _value(value: Any, fields: int, split: Any) -> Any:
    """A value for all fields."""
    if callable(value):
        if fields == 1:
            return split(value)
        return split(lambda x, *p: jnp.broadcast_to(value(x, *p), (fields,)))
    value = jnp.asarray(value) if isinstance(value, jax.core.Tracer) else np.asarray(value)
    if value.ndim == 0:
        value = (jnp if isinstance(value, jax.core.Tracer) else np).broadcast_to(value, (fields,))
    elif fields == 1:
        value = value.reshape(-1, 1)
    xp: Any = jnp if isinstance(value, jax.core.Tracer) else np
    return xp.concatenate([xp.real(value), xp.imag(value)], axis=-1)


def _part(value: Any, k: int, split: Any) -> Any:
    if callable(value):
        return lambda *args: split(value)(*args)[k]
    return (jnp.real, jnp.imag)[k](value)
