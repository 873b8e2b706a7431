"""Copies of a particle in several regions: one fit for all of them, bound by the conditions of the interfaces.

Every copy s has its own recursion, solved for its free coefficients as elsewhere, U_s = Q_s F_s + B_s c_s, and its
neighbours in its own region. The conditions between the copies (u_a - u_b + R q_a = g, q_a - q_b = f, q the fluxes) and
the conditions that they carry of their own bind the c_s exactly; what is left free is fitted to the neighbours of all.
Each side counts with the root of its conductivity kappa_s, V_s = sqrt(kappa_s) U_s: the energies of the two sides
compare, the values do not. Measured at ratios from 1e-6 to 1e6; without it the error grows with the ratio.

Both copies' own values are left out, and each is an equation: it is predicted by the neighbours of all. The difference
of the two equations is the condition on the jump, exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.particle import batches, moments
from jsmitsm.particle.elimination import Elimination, Scheme, eliminate
from jsmitsm.particle.moments import Row, Support
from jsmitsm.particle.polynomials import functionals, monomials
from jsmitsm.particle.recursion import row_lifts
from jsmitsm.particle.small_systems import gram_inverse, min_norm, null_space, safe_root, solve_gram
from jsmitsm.runtime.compiled import at_hand
from jsmitsm.runtime.size_classes import cloud_size, largest_at_hand, open_size, padded_size
from jsmitsm.runtime.tracers import is_traced, recorded
from jsmitsm.runtime.whole_program import called
from jsmitsm.taylor.multi_indices import Slot, factorial, index_of, multi_indices


@dataclass(frozen=True)
class JointScheme:
    """What is static about particles with copies in the same regions.

    sides : the scheme of each copy; its ``n_own`` counts the outer conditions that it carries.
    slots : what the conditions between the copies speak of: a side and a slot of its field.
    n_rows : the number of those conditions.
    """

    sides: tuple[Scheme, ...]
    slots: tuple[tuple[int, Slot], ...]
    n_rows: int


class Side(NamedTuple):
    """The numbers of one side of n joints: ``moments`` and ``batches`` say what they are."""

    ids: Any  # (n,)
    neighbours: Any  # (n, w)
    jac: Any  # (n, E, S, T), or (1, E, S, 1) where one serves all
    own: Any  # (n, n_own, S_own)
    shared: Elimination | None


class _Joint(NamedTuple):
    """The fit of one joint, in V."""

    basis: Any  # of all sides, before the conditions
    particular: Any
    reduced: Any
    rows: Any  # of all conditions
    scale: Any
    solve: Any
    values: Any
    phi: Any
    weight: Any
    data_scale: Any  # what a neighbour's value is multiplied with, per row of data
    lifts: Any  # of all sides' sources
    length: Any
    root: tuple[Any, ...]  # of the conductivities
    balance: tuple[Any, ...]  # what the values of each side's fields are multiplied with


def _in_size_class(function: Any) -> Any:
    """Compile ``function(scheme, points, sides, coef, count, more)`` for padded arrays; what is padding is cut off.

    All sides are padded alike, so that one program serves joints of regions of several sizes.
    """
    inner = jax.jit(function, static_argnames="scheme")
    compiled: dict[Any, set[int]] = {}

    def padded(scheme: JointScheme, points: Any, sides: tuple[Side, ...], coef: Any, more: Any = ()) -> Any:
        n = coef.shape[0]
        loose = not (recorded() or is_traced(points, sides, coef, more))
        widths = tuple(s.neighbours.shape[1] for s in sides)
        known = compiled.setdefault((scheme, widths, recorded()), set())
        size = at_hand(known, n, largest_at_hand(n), open_size(n)) if loose else padded_size(n)
        largest = cloud_size(max(len(x) for x in points))
        points = tuple(batches.widened(x, len(x), largest) for x in points)
        if more:
            more = tuple(batches.widened(x, len(x), largest) for x in more[0]), *batches.widened(more[1:], n, size)
        made = []
        for s in sides:
            ids, near, own = batches.widened((s.ids, s.neighbours, s.own), n, size)
            jac = s.jac if s.jac.shape[0] == 1 else batches.widened(s.jac, n, size)
            made.append(Side(ids, near, jac, own, s.shared))
        given = {"points": points, "sides": tuple(made), "coef": batches.widened(coef, n, size), "more": more}
        given["count"] = np.int32(n)
        if recorded():
            return batches.cut(inner(scheme, **given), n)
        return batches.cut(called(function, {"scheme": scheme}, given, tuple(batches.effort(size).items())), n)

    return padded


@_in_size_class
def joint_rows(
    scheme: JointScheme, points: Any, sides: tuple[Side, ...], coef: Any, count: Any, more: Any = ()
) -> tuple[Row, ...]:
    """The equations of all copies of n joints, a ``Row`` for every side with the joint's axis first.

    Their weights run over the neighbours of all sides, one side after the other; ``source`` over the rows of all
    sides' recursions, ``condition`` over the conditions between the copies, whose coefficients are ``coef``
    (n, n_rows, S), and then over every side's own.
    """

    batches.TRACES["joints"] += 1

    def one(given: Any) -> tuple[Row, ...]:
        return _rows(scheme, _joint(scheme, points, sides, *given))

    made = batches.in_blocks(one, (_each(sides), coef), count)
    # No neighbour's condition is data here.
    return tuple(row._replace(data=jnp.zeros((*row.weights.shape[:3], 0))) for row in made)


@_in_size_class
def joint_coefficients(
    scheme: JointScheme, points: Any, sides: tuple[Side, ...], coef: Any, count: Any, more: Any
) -> Any:
    """Taylor coefficients (n, F, K) of the copies on every side.

    more: the values (N_s, F) of every side's particles; source (n, rows of all) and given (n, conditions) as the rows
    of ``joint_rows`` have them.
    """

    data, source, given = more

    def one(arguments: Any) -> tuple[Any, ...]:
        (each, c), f, g = arguments
        joint = _joint(scheme, points, sides, each, c)
        seen = [u[jnp.where(s[1] >= 0, s[1], s[0])].reshape(-1) for u, s in zip(data, each)]
        return _expanded(scheme, joint, jnp.concatenate(seen), f, g)

    return batches.in_blocks(one, ((_each(sides), coef), source, given), count)


def _each(sides: tuple[Side, ...]) -> Any:
    """What every joint has of its own on each side; arrays without numbers cannot be cut into blocks."""
    return tuple(
        (s.ids, s.neighbours, None if s.jac.shape[0] == 1 else s.jac, s.own if s.own.size else None) for s in sides
    )


def _joint(scheme: JointScheme, points: Any, sides: tuple[Side, ...], each: Any, coef: Any) -> _Joint:
    from jax.scipy.linalg import block_diag  # takes a hundredth of a second, which only regions need

    near = [
        moments.support(at, ids, neighbours, None, s.decay)
        for s, at, (ids, neighbours, *_) in zip(scheme.sides, points, each)
    ]
    length = jnp.max(jnp.stack([n.length for n in near]))
    near = [moments.at_length(n, length) for n in near]
    root = _roots(scheme, coef)
    made = [_solved(s, side, e[2], length) for s, side, e in zip(scheme.sides, sides, each)]
    rows, scale = _conditions(scheme, coef, [e[3] for e in each], length, root, made)
    basis = block_diag(*(m.basis for m in made))
    particular = block_diag(*(r * (m.particular @ jnp.eye(len(m.lift))) for r, m in zip(root, made)))
    z, solve = null_space(rows @ basis)
    reduced = basis @ z
    values = block_diag(*(_values(s, n) for s, n in zip(scheme.sides, near)))
    data_scale = [jnp.tile(r * moments.balance(s.rec, length, m), len(n.weight))
                  for r, s, n, m in zip(root, scheme.sides, near, made)]  # fmt: skip
    weight = jnp.concatenate([jnp.repeat(n.weight.at[0].set(0.0), s.rec.fields) for s, n in zip(scheme.sides, near)])
    return _Joint(
        basis, particular, reduced, rows, scale, solve, values, values @ reduced, weight, jnp.concatenate(data_scale),
        jnp.concatenate([m.lift for m in made]), length, tuple(root),
        tuple(moments.balance(s.rec, length, m) for s, m in zip(scheme.sides, made)),
    )  # fmt: skip


def _roots(scheme: JointScheme, coef: Any) -> list[Any]:
    """The root of each side's conductivity: the size of its first derivatives in the conditions; 1 without any."""
    out = []
    for k in range(len(scheme.sides)):
        first = [c for c, (side, (_, b)) in enumerate(scheme.slots) if side == k and sum(b) == 1]
        square = jnp.sum(coef[:, np.array(first, int)] ** 2) if first else jnp.zeros(())
        out.append(jnp.where(square > 0, jnp.where(square > 0, square, 1.0) ** 0.25, 1.0))
    return out


def _solved(scheme: Scheme, side: Side, jac: Any, length: Any) -> Elimination:
    if side.shared is None:
        return eliminate(scheme, side.jac[0] if jac is None else jac, length)
    return side.shared._replace(lift=side.shared.lift * row_lifts(scheme.rec, length))


def _conditions(
    scheme: JointScheme, coef: Any, owns: list[Any], length: Any, root: list[Any], made: list[Elimination]
) -> tuple[Any, Any]:
    """All conditions as rows over V, of unit size, and what their values are multiplied with."""
    sizes = [s.rec.fields * s.rec.size for s in scheme.sides]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    between = jnp.zeros((scheme.n_rows, int(starts[-1])), coef.dtype)
    terms = []
    for c, (k, (f, b)) in enumerate(scheme.slots):
        rec = scheme.sides[k].rec
        term = coef[:, c] * factorial(b) * length ** (-sum(b) - rec.weights[f]) * made[k].units[f] / root[k]
        between = between.at[:, int(starts[k]) + f * rec.size + index_of(rec.dim, rec.reach)[b]].add(term)
        terms.append(jnp.abs(term))
    size = jnp.max(jnp.stack(terms), axis=0)
    scales = [1.0 / jnp.where(size > 0, size, 1.0)]
    rows = [between * scales[0][:, None]]
    for k, (s, own) in enumerate(zip(scheme.sides, owns)):
        if s.n_own:
            at = jnp.zeros(s.rec.size, coef.dtype).at[0].set(1.0)
            mine, scale = functionals(s.own, own, at, s.rec, length, made[k].units)
            rows.append(jnp.pad(mine, ((0, 0), (int(starts[k]), int(starts[-1] - starts[k + 1])))))
            scales.append(scale * root[k])
    return jnp.concatenate(rows), jnp.concatenate(scales)


def _values(scheme: Scheme, near: Support) -> Any:
    """The neighbours' values as functionals of U, (ns F, F K)."""
    p, fields = monomials(near.offset, scheme.rec.reach), scheme.rec.fields
    return p if fields == 1 else jnp.einsum("gk,fh->gfhk", p, jnp.eye(fields)).reshape(len(p) * fields, -1)


def _targets(scheme: JointScheme) -> np.ndarray:
    """The constants of all sides among all coefficients, (M F, sum F K)."""
    sizes = [(s.rec.fields, s.rec.size) for s in scheme.sides]
    starts = np.cumsum([0] + [fields * size for fields, size in sizes])
    places = [int(start) + f * size for start, (fields, size) in zip(starts, sizes) for f in range(fields)]
    return np.eye(int(starts[-1]))[places]


def _rows(scheme: JointScheme, joint: _Joint) -> tuple[Row, ...]:
    """The equations of all copies of one joint."""
    wanted = jnp.asarray(_targets(scheme))
    root = safe_root(joint.weight)[:, None]
    a, target = root * joint.phi, joint.reduced.T @ wanted.T
    # Normal equations lose digits where a side hardly counts; what they miss is fitted again.
    w = min_norm(a, target)
    w = root * (w + min_norm(a, target - a.T @ w))
    size = jnp.max(jnp.abs(target), axis=0)
    defect = jnp.max(jnp.abs(target - joint.phi.T @ w), axis=0) / jnp.where(size > 0, size, 1.0)
    rest = wanted.T - joint.values.T @ w
    v_own = joint.solve.T @ (joint.basis.T @ rest)
    v = joint.particular.T @ rest - (joint.rows @ joint.particular).T @ v_own
    powers = [root * power for power, root in zip(joint.balance, joint.root)]
    lift = 1.0 / jnp.concatenate(powers)[:, None]
    weights = (w * joint.data_scale[:, None]).T * lift
    source, condition = (v * joint.lifts[:, None]).T * lift, (v_own * joint.scale[:, None]).T * lift
    fields, out = scheme.sides[0].rec.fields, []
    for k in range(len(scheme.sides)):
        own = slice(k * fields, (k + 1) * fields)
        mine = weights[own].reshape(fields, -1, fields)
        size = jnp.einsum("fgf->f", jnp.abs(mine))
        out.append(Row(mine, None, source[own], condition[own], size, jnp.max(defect[own]), jnp.zeros(fields)))
    return tuple(out)


def _expanded(scheme: JointScheme, joint: _Joint, values: Any, source: Any, given: Any) -> tuple[Any, ...]:
    """The copies' Taylor coefficients, unscaled, from their neighbours' values."""
    part = joint.particular @ (joint.lifts * source)
    part = part + joint.basis @ (joint.solve @ (joint.scale * given - joint.rows @ part))
    root = safe_root(joint.weight)
    a = root[:, None] * joint.phi
    rest = root * (values * joint.data_scale - joint.values @ part)
    inverse = gram_inverse(a)
    free = solve_gram(a, inverse, a.T @ rest)
    free = free + solve_gram(a, inverse, a.T @ (rest - a @ free))
    scaled, start, out = part + joint.reduced @ free, 0, []
    for k, s in enumerate(scheme.sides):
        rec = s.rec
        mine = scaled[start : start + rec.fields * rec.size].reshape(rec.fields, rec.size) / joint.root[k]
        degrees = np.array([float(sum(a)) for a in multi_indices(rec.dim, rec.reach)])
        out.append(mine * joint.length ** (-degrees) / joint.balance[k][:, None])
        start += rec.fields * rec.size
    return tuple(out)
