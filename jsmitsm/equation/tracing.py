"""From a residual in Python to its record: operations recorded once, and what rests on what read off them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from jsmitsm.equation import dependence
from jsmitsm.equation.branches import branches
from jsmitsm.equation.dependence import EXTRAS, FIELD, JUMPS, POINT, Facts
from jsmitsm.equation.field import local_field
from jsmitsm.equation.linearizing import Record, record
from jsmitsm.equation.traced import Traced
from jsmitsm.runtime.collector import uncollected
from jsmitsm.runtime.recall.recording import recalled
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.taylor.multi_indices import Slot


def trace(
    residual: Callable[..., Any],
    dim: int,
    fields: int = 1,
    *,
    extras: Sequence[tuple[int, ...]] = (),
    params: Any = None,
) -> Traced:
    """Record and classify a residual.

    Parameters: ``residual(u, x, *extras[, params])`` -> a scalar, a vector (E,) or a sequence of
    scalars; ``dim`` D, ``fields`` F; ``extras``, the shapes of further arguments that every particle
    has of its own and that do not vary with x (its normal, a boundary value); ``params``, any
    pytree, passed last unless None.

    The function is called when it is first seen, and again where anything that it can see may have
    changed.  What it closes over may be traced by JAX.  The classification is read off the recorded
    operations, element by element; where in doubt a coefficient counts as dependent, which costs time
    but never correctness.

    Raises ``ValueError`` if the field is evaluated anywhere but at x, or if the result is not a
    scalar or a vector.

    >>> import jsmitsm as js
    >>> record = trace(lambda u, x: js.laplacian(u)(x) - x[0], 2)
    >>> record.slots, record.order, record.linear, record.constant, record.source
    (((0, (2, 0)), (0, (0, 2))), (2,), True, True, 'variable')
    """
    leaves, tree = jax.tree.flatten(params)
    rest = dim, fields, tuple(extras), tree, tuple((v.shape, v.dtype, v.weak_type) for v in map(jax.typeof, leaves))

    def make() -> Traced:
        with uncollected():
            made = record(residual, local_field(dim, fields), extras, params)
            return _classified(made, dim, fields, len(extras), tree)

    if not _is_plain(tree):
        return make()
    return recalled(residual, rest, make, lambda made: not _holds_tracers(made))


def _is_plain(tree: Any) -> bool:
    """Whether parameters stand in Python's containers: those of other kinds may hold more than the numbers."""
    node = tree.node_data()
    if node is None:
        return True
    kind, keys = node
    named = kind is dict and all(type(k) in (str, int) for k in keys)
    return (named or kind in (list, tuple, type(None))) and all(map(_is_plain, tree.children()))


def _holds_tracers(traced: Traced) -> bool:
    return is_traced(traced._record.consts)


def restricted(traced: Traced, *chosen: tuple[Sequence[Slot], bool]) -> list[Traced]:
    """The same record as residuals of some of its slots alone, the others zero: one for each (slots, affine).

    affine: the coefficients of these slots depend on no slot, and only they are wanted: a linear operator, no source.
    """
    r = traced._record
    facts = _facts_of(r, traced._n_extras)
    found = []
    for slots, affine in chosen:
        part = _classified(r, traced.dim, traced.fields, traced._n_extras, traced._params_tree, slots, facts, affine)
        found.append(replace(part, linear=True, source="zero") if affine else part)
    return found


def moving(traced: Traced, leaf: int) -> tuple[set[Slot], bool]:
    """The slots whose coefficients depend on a field or on one leaf of the parameters; whether the rest of R does.

    The rest: the residual where all slots are zero, which may depend on the leaf.
    """
    r = traced._record
    facts, place = _facts(r, traced._n_extras, None, leaf), {slot: k for k, slot in enumerate(r.slots)}
    zero = r.jaxpr.invars[0].aval.dtype.type(0)
    found = set()
    for slot in traced.slots:
        out = r.outputs[place[slot]]
        if out is None or _bits(facts[out]) & (FIELD | JUMPS):
            found.add(slot)
    return found, bool(_bits(_facts(r, traced._n_extras, zero, leaf)[0]) & FIELD)


def _classified(
    r: Record, dim: int, fields: int, n_extras: int, params_tree: Any, chosen: Sequence[Slot] | None = None,
    known: tuple[list[Facts], Facts] | None = None, affine: bool = False,
) -> Traced:  # fmt: skip
    """Read off the recorded operations what kind of residual it is, of the chosen slots (None: of all)."""
    facts, rest = known or _facts_of(r, n_extras)
    pattern, every = np.zeros((r.n_equations, len(r.slots)), bool), 0
    for k, out in enumerate(r.outputs):
        if out is not None and (chosen is None or r.slots[k] in chosen):
            pattern[:, k] = ~(facts[out].known & (facts[out].value == 0))
            every |= _bits(facts[out])
    jumps = bool(_bits(facts[0]) & JUMPS)
    linear = not every & (FIELD | JUMPS) and not jumps
    # A slot that only passes through a jump has no coefficient, yet the residual needs its value.
    keep = [k for k in range(len(r.slots)) if pattern[:, k].any() or jumps and (chosen is None or r.slots[k] in chosen)]
    pattern = pattern[:, keep]
    slots = tuple(r.slots[k] for k in keep)
    if (rest.known & (rest.value == 0)).all():
        source = "zero"
    else:
        source = "variable" if _bits(rest) & (POINT | EXTRAS) else "constant"
    written = r.written, r.consts[len(r.consts) - len(r.written.constvars) :]
    return Traced(
        dim=dim,
        fields=fields,
        n_equations=r.n_equations,
        slots=slots,
        pattern=pattern,
        order=tuple(max((sum(b) for (_, b), p in zip(slots, row, strict=True) if p), default=-1) for row in pattern),
        linear=linear,
        constant=linear and not every & (POINT | EXTRAS),
        source=source,
        uses_extras=bool((every | _bits(facts[0])) & EXTRAS),
        branches=None if affine else branches(*written, n_extras),
        _record=r,
        _n_extras=n_extras,
        _params_tree=params_tree,
    )


def _bits(facts: Facts) -> int:
    """What any element depends on."""
    return int(np.bitwise_or.reduce(facts.depends, axis=None)) if facts.depends.size else 0


def _facts_of(r: Record, n_extras: int) -> tuple[list[Facts], Facts]:
    """Facts about all outputs, and about the residual where every slot is zero."""
    zero = r.jaxpr.invars[0].aval.dtype.type(0)
    return _facts(r, n_extras, None), _facts(r, n_extras, zero)[0]


def _facts(r: Record, n_extras: int, field_value: Any, moved: int | None = None) -> list[Facts]:
    """Facts about all outputs; ``field_value``: what every slot is known to be, or None.

    moved: a leaf of the parameters that counts as a field.
    """
    first = 1 + len(r.slots)
    args = []
    for k, v in enumerate(r.jaxpr.invars):
        if 1 <= k < first and field_value is not None:
            args.append(dependence.known(field_value))
            continue
        bit = POINT if k == 0 else FIELD if k < first else EXTRAS if k < first + n_extras else 0
        bit = FIELD if moved is not None and k == first + n_extras + moved else bit
        args.append(dependence.unknown(v.aval.shape, v.aval.dtype, bit))
    return dependence.interpret(r.jaxpr, [dependence.constant(c) for c in r.consts], args)
