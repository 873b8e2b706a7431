"""Taylor coefficients of traced functions, by interpreting their jaxpr in truncated Taylor arithmetic.

Values are arrays (L, *shape, B), see ``series``.  The same rules run on numpy, without any
compilation, and on traced JAX arrays.  Sources: Griewank and Walther, Evaluating Derivatives
(2008), chapter 13, for the recursions in one variable; in several, the Euler operator
sum_i s_i d/ds_i takes the place of d/ds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jsmitsm.taylor.matrices  # noqa: F401  (registers its rules)
import jsmitsm.taylor.movement  # noqa: F401  (registers its rules)
import jsmitsm.taylor.reductions  # noqa: F401  (registers its rules)
from jsmitsm.runtime.compiled import fingerprint, kept
from jsmitsm.runtime.jaxprs import (
    CONSTANT_TERM,
    EVERYTHING,
    NOTHING,
    Literal,
    bind,
    called,
    derivative,
    levels,
    literal,
    scan_sizes,
    unsupported,
)
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.taylor.elementwise import ELEMENTWISE, RULES, plain_elementwise, rule
from jsmitsm.taylor.series import (
    Array,
    Ring,
    choose,
    euler,
    full_series,
    integrate,
    on_host,
    truncate,
    unify,
    variable,
    xp_of,
)

# A loop with more operations than this stays a loop in a compiled program.
UNROLL = 200


def plain(value: Any) -> np.ndarray | jax.Array:
    """A value shared by all particles, independent of x: (1, *shape, 1)."""
    value = value if isinstance(value, jax.Array) else np.asarray(value)
    return value.reshape(1, *value.shape, 1)


def _literal(v: Any) -> np.ndarray:
    return literal(v).reshape(1, *v.aval.shape, 1)


Operations = Sequence[tuple[Any, int]]


def run(ring: Ring, operations: Operations, env: dict[Any, Array], linear: bool = False) -> None:
    """Interpret the operations, adding their results to ``env``.

    ``linear``: inside the derivative of a primitive, where every operation is linear in the tangents.
    """
    low = Ring(ring.dim, 0)
    for eqn, level in operations:
        vals = [_literal(v) if isinstance(v, Literal) else env.get(v) for v in eqn.invars]
        if level == CONSTANT_TERM:
            vals = [v if v is None else v[:1] for v in vals]
        out = _apply(low if level == CONSTANT_TERM else ring, eqn, vals, linear)
        env.update(zip(eqn.outvars, out, strict=True))


def _apply(ring: Ring, eqn: Any, vals: list[Any], linear: bool) -> list[Array]:
    name = eqn.primitive.name
    known = RULES.get(name)
    if known is not None:
        out = known(ring, eqn, *vals)
        return out if eqn.primitive.multiple_results else [out]
    inner = called(eqn)
    if inner is not None:
        # custom_vjp functions are expanded through their body: their rule knows only reverse mode.
        return evaluate(inner.jaxpr, inner.consts, vals[len(vals) - len(inner.jaxpr.invars) :], *ring)
    active = [v for v in vals if v.shape[0] > 1]
    if not active:
        return [plain_elementwise(eqn, vals)] if name in ELEMENTWISE else _plain_any(eqn, vals)
    if linear:
        # What is linear in its one series acts on each coefficient, whatever it is.
        if len(active) > 1:
            raise unsupported(name)
        return _termwise(eqn, vals)
    return _by_derivative(ring, eqn, vals)


def _termwise(eqn: Any, vals: list[Array]) -> list[Array]:
    """A primitive linear in its one series operand: coefficient by coefficient."""
    (active,) = [k for k, v in enumerate(vals) if v.shape[0] > 1]
    terms = [_plain_any(eqn, [v[j:j + 1] if k == active else v for k, v in enumerate(vals)])
             for j in range(vals[active].shape[0])]  # fmt: skip
    return [xp_of(*parts).concatenate(parts) for parts in zip(*terms, strict=True)]


def _plain_any(eqn: Any, vals: list[Array]) -> list[Array]:
    """Any primitive on values independent of x, by JAX itself, mapped over the particles."""
    if eqn.primitive.name == "custom_jvp_call":
        inner = eqn.params["call_jaxpr"]
        return evaluate(inner.jaxpr, inner.consts, vals, 1, 0)
    batched = [v.shape[-1] > 1 for v in vals]
    args = [v[0] if b else v[0, ..., 0] for v, b in zip(vals, batched, strict=True)]

    def call(*some: Any) -> Any:
        return bind(eqn, *some)

    function = jax.vmap(call, [-1 if b else None for b in batched], -1) if any(batched) else call
    try:
        if on_host(*vals):
            with jax.ensure_compile_time_eval():
                out = [np.asarray(v) for v in function(*map(jnp.asarray, args))]
        else:
            out = function(*args)
    except NotImplementedError as error:
        raise unsupported(eqn.primitive.name) from error
    return [v[None] if any(batched) else v[None, ..., None] for v in out]


def _by_derivative(ring: Ring, eqn: Any, vals: list[Array]) -> list[Array]:
    """A primitive w = g(v) through its own derivative rule: E(w) = Dg(v)[E(v)], E the Euler operator.

    E(v) has no constant term, so Dg(v) is needed one degree lower than w: expanding the parts of the
    rule that depend on v alone may meet g again, but the recursion ends at degree 0.
    """
    active = tuple(k for k, v in enumerate(vals) if v.shape[0] > 1)
    starts = _apply(Ring(ring.dim, 0), eqn, [v[:1] for v in vals], False)
    jaxpr, consts = derivative(eqn, active)
    slopes_of = jaxpr.invars[len(vals) :]
    moving = set(slopes_of)
    still: list[tuple[Any, int]] = []
    going: list[tuple[Any, int]] = []
    for eqn_, level in levels(jaxpr, [EVERYTHING] * len(jaxpr.outvars)):
        depends = any(not isinstance(v, Literal) and v in moving for v in eqn_.invars)
        (going if depends else still).append((eqn_, level))
        if depends:
            moving.update(eqn_.outvars)
    lower = Ring(ring.dim, ring.degree - 1)
    env = dict(zip(jaxpr.constvars, map(plain, consts), strict=True))
    env.update(zip(jaxpr.invars, [truncate(lower, v) for v in vals], strict=False))
    run(lower, still, env)
    env.update(zip(slopes_of, [euler(ring, vals[k]) for k in active], strict=True))
    run(ring, going, env, linear=True)
    slopes = iter(jaxpr.outvars)
    out = []
    for v, start in zip(eqn.outvars, starts, strict=True):
        if not np.issubdtype(v.aval.dtype, np.inexact):
            out.append(start)
            continue
        slope = next(slopes)
        out.append(integrate(ring, start, _literal(slope) if isinstance(slope, Literal) else env[slope]))
    return out


def evaluate(
    jaxpr: Any,
    consts: Sequence[Any],
    args: Sequence[Any],
    dim: int,
    degree: int,
    xp: Any = None,
    wanted: Sequence[int] | None = None,
) -> list[Any]:
    """Interpret a jaxpr on series.

    ``args``: arrays (L, *shape, B), one per input; ``consts``: ordinary arrays.  ``xp``: numpy to
    move everything to the host first (nothing may be traced); by default each operation runs with
    numpy if all its operands are numpy arrays.  ``wanted``: per output NOTHING (the result is None),
    CONSTANT_TERM or EVERYTHING.  Returns arrays (L, *shape, B).

    Raises ``ValueError`` naming a primitive that has no Taylor expansion.
    """  # fmt: skip
    if xp is np:
        args, consts = [np.asarray(v) for v in args], [np.asarray(c) for c in consts]
    wanted = [EVERYTHING] * len(jaxpr.outvars) if wanted is None else list(wanted)
    env = dict(zip(jaxpr.constvars, map(plain, consts), strict=True))
    env.update(zip(jaxpr.invars, args, strict=True))
    with np.errstate(all="ignore"):
        run(Ring(dim, degree), levels(jaxpr, wanted), env)
    out = []
    for v, level in zip(jaxpr.outvars, wanted, strict=True):
        value = None if level == NOTHING else _literal(v) if isinstance(v, Literal) else env[v]
        out.append(value[:1] if level == CONSTANT_TERM and value is not None else value)
    return out


def taylor_coefficients(function: Callable[..., Any], points: Any, degree: int, *args: Any) -> Any:
    """Taylor coefficients of a function of the point about many points.

    Parameters: ``function(x, *args)`` -> array, x (D,); ``points`` (N, D); ``args`` any pytrees,
    the same for every point.  Returns (T, *shape, N): d^a f / a! in the order of
    ``multi_indices(D, degree)``; numpy where nothing is traced.

    >>> import jax.numpy as jnp, numpy as np
    >>> taylor_coefficients(lambda x: jnp.exp(x[0]), np.zeros((1, 1)), 2)[:, 0].tolist()
    [1.0, 1.0, 0.5]
    """
    n, dim = np.shape(points)
    point = jax.ShapeDtypeStruct((dim,), points.dtype)
    closed = jax.make_jaxpr(lambda x, a: jnp.asarray(function(x, *a)))(point, args)
    leaves = jax.tree.leaves(args)

    def series(points: Any, leaves: Any, consts: Any) -> Any:
        inputs = [variable(points, degree), *map(plain, leaves)]
        return full_series(Ring(dim, degree), evaluate(closed.jaxpr, consts, inputs, dim, degree)[0], n)

    data = (points, leaves, closed.consts)
    if is_traced(data):
        return kept((fingerprint(closed.jaxpr), dim, degree), lambda: jax.jit(series))(*data)
    return series(*jax.tree.map(np.asarray, data))


def _promote(ring: Ring, vals: Sequence[Array], batch: int) -> list[Array]:
    """Loop state of a fixed shape: whole series for floats, degree 0 for the rest."""
    return [
        jnp.asarray(full_series(ring if np.issubdtype(v.dtype, np.inexact) else Ring(ring.dim, 0), v, batch))
        for v in vals
    ]


@rule("scan")
def _scan(ring: Ring, eqn: Any, *vals: Array) -> list[Array]:
    p = eqn.params
    body, length = p["jaxpr"], p["length"]
    n, m = scan_sizes(p)
    fixed, carry, rows = list(vals[:n]), list(vals[n : n + m]), vals[n + m :]
    if on_host(*vals) or length * len(body.jaxpr.eqns) <= UNROLL:
        outs: list[list[Array]] = []
        for k in reversed(range(length)) if p["reverse"] else range(length):
            new = evaluate(body.jaxpr, body.consts, [*fixed, *carry, *(r[:, k] for r in rows)], *ring)
            carry = new[:m]
            outs.append(new[m:])
        outs = outs[::-1] if p["reverse"] else outs
        stacked = []
        for k, v in enumerate(eqn.outvars[m:]):
            parts = unify(*(o[k] for o in outs)) if outs else [np.zeros((1, *v.aval.shape[1:], 1), v.aval.dtype)]
            stack = xp_of(*parts).stack(parts, 1)
            stacked.append(stack if outs else stack[:, :0])
        return [*carry, *stacked]
    batch = max(v.shape[-1] for v in vals)

    def step(state: list[Array], row: list[Array]) -> tuple[list[Array], list[Array]]:
        new = evaluate(body.jaxpr, body.consts, [*fixed, *state, *row], *ring)
        return _promote(ring, new[:m], batch), _promote(ring, new[m:], batch)

    moved = [jnp.moveaxis(jnp.asarray(r), 1, 0) for r in rows]
    carry, ys = jax.lax.scan(step, _promote(ring, carry, batch), moved, length, p["reverse"])
    return [*carry, *(jnp.moveaxis(y, 0, 1) for y in ys)]


@rule("while")
def _while(ring: Ring, eqn: Any, *vals: Array) -> list[Array]:
    p = eqn.params
    n, m = p["cond_nconsts"], p["body_nconsts"]
    test_consts, body_consts, carry = list(vals[:n]), list(vals[n : n + m]), list(vals[n + m :])
    test, body = p["cond_jaxpr"], p["body_jaxpr"]

    def goes_on(state: list[Array]) -> Array:
        some = [v[:1] for v in (*test_consts, *state)]
        return evaluate(test.jaxpr, test.consts, some, ring.dim, 0)[0]

    def advance(state: list[Array]) -> list[Array]:
        return evaluate(body.jaxpr, body.consts, [*body_consts, *state], *ring)

    def masked(going: Array, state: list[Array]) -> list[Array]:
        """Particles that are done keep their state."""
        new = advance(state)
        return new if going.size == 1 else [choose(going, a, b) for a, b in zip(new, state, strict=True)]

    host, steps = on_host(*vals), 0
    while host or steps * len(body.jaxpr.eqns) <= UNROLL:
        going = goes_on(carry)
        if not on_host(going):
            break
        if not going.any():
            return carry
        carry, steps = masked(going, carry), steps + 1
    batch = max(v.shape[-1] for v in vals)
    return jax.lax.while_loop(
        lambda state: jnp.any(goes_on(state)),
        lambda state: _promote(ring, masked(goes_on(state), state), batch),
        _promote(ring, carry, batch),
    )


@rule("cond")
def _cond(ring: Ring, eqn: Any, index: Array, *vals: Array) -> list[Array]:
    branches = eqn.params["branches"]
    index = index[:1].astype(int)
    if on_host(index) and (index == index.flat[0]).all():
        chosen = branches[int(np.clip(index.flat[0], 0, len(branches) - 1))]
        return evaluate(chosen.jaxpr, chosen.consts, vals, *ring)
    outs = [evaluate(b.jaxpr, b.consts, vals, *ring) for b in branches]
    result = outs[-1]
    for k in reversed(range(len(outs) - 1)):
        result = [choose(index <= k, a, b) for a, b in zip(outs[k], result, strict=True)]
    return result


@rule("custom_linear_solve")
def _linear_solve(ring: Ring, eqn: Any, *vals: Array) -> list[Array]:
    """The solver itself, in series arithmetic: factors and substitutions have rules of their own."""
    lengths, solve = eqn.params["const_lengths"], eqn.params["jaxprs"].solve
    first = lengths.matvec + lengths.vecmat
    consts, rhs = vals[first : first + lengths.solve], vals[sum(lengths) :]
    return evaluate(solve.jaxpr, solve.consts, [*consts, *rhs], *ring)
