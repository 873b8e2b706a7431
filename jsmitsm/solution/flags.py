"""What a finished solve says against itself: cheap tests, and a sentence for each that fails.

None of the tests costs a moment system: some solves with the kept factors and sums over neighbours. They clear what is
linear, of one field and far from their bounds. Everywhere else the error estimate (``js.Solution.error_estimate``) is
asked, which costs another assembly of a higher order, and decides: it clears what was only suspected, and is a flag
itself where it is large. What no particle sees it does not see either, and is looked for by itself
(``jsmitsm.solution.look``). A healthy solution has none; one is no proof of an error, nor its absence of accuracy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from jsmitsm.discretization.health import LEBESGUE
from jsmitsm.discretization.leave_one_out import right_side
from jsmitsm.discretization.operator_kind import (
    cell_peclet,
    inward_growth,
    mean_spacing,
    turned,
    usual_condition,
    wave_number,
)
from jsmitsm.discretization.parts.whole import particles, whole
from jsmitsm.discretization.resolution.contradictions import contradictions
from jsmitsm.discretization.resolution.poles import said
from jsmitsm.discretization.resolution.steepness import steepness
from jsmitsm.discretization.resolution.steepness import unseen as beyond_slopes
from jsmitsm.discretization.rows import all_rows
from jsmitsm.runtime.errors import some
from jsmitsm.solution.look.between import beyond_kinks
from jsmitsm.solution.look.reach import rough_ends
from jsmitsm.solution.look.sizes import predicted, scales, share
from jsmitsm.solution.look.told import CLEARED, data, out_of_reach, unseen

# A particle may differ from the linear function through its neighbours by this part of the
# range; a sine of six particles a wavelength differs by 0.25. By order: up to 3, and above.
ROUGH = (0.2, 0.3)
# A matrix of order m on n particles in D dimensions has a condition of about n^(m/D), in the least-squares form, which
# squares the operator, n^(2m/D); so many times more is nearly singular.
SINGULAR = {"loo": 1e3, "lsq": 1e2}
# The part of the solution that hangs on what the cloud does not resolve of the source.
SOURCE = 0.3
# Where it makes more than the solution itself, a nearly singular operator leaves nothing to estimate.
OVERWHELMING = 1.0
# Weights that sum to this amplify any roughness of the neighbours; a share of FEW does no harm.
WEAK, FEW = 10.0, 0.01
# Least squares: misfit of the local fits, added up across the domain, in parts of the range.
# Measured: below 5e-4 where the solution is resolved, above 0.06 where a layer is not.
# Beyond the second, and with so much convection over diffusion beyond the first, the estimate is no judge of it: no
# order sees a layer within the spacing. Right solutions of random problems go up to 0.046.
MISFIT, HOPELESS_MISFIT, CARRIED = 0.01, 0.05, 2.0
# Convection over diffusion between neighbours from which methods I and II lose the solution.
PECLET = 1.0
# Round-off of the moment systems times the condition: this leaves two digits.
ROUND_OFF = 1e-2
# A field below this part of the largest is nothing in the least-squares form, whose systems are squared.
SQUARED = 1e-6
# Coordinates rounded by this part of the spacing put the particles somewhere else.
ROUNDED = 1e-3
# (k s)^(p+1) cells, with s the spacing: the phase error a wave gathers across the domain. By order, as above.
PHASE = (0.9, 3.5)
# Where the highest derivatives change their sign, a smooth solution has a smaller estimated error than this.
TURNED = 1e-3
# Waves of so few particles that their phase would be out so many times as far as is a doubt are in truth where two
# orders agree to this.
SHORT, LOST_PHASE = 10.0, 5e-3
# Growth from a held value to the next particle, as an exponent: from 0.75 on values were forgotten, and from 1.0 on no
# estimate knew.
GROWN = 0.8
# Two orders whose solutions agree to this part of what their local fits miss have missed the same.
BLINDLY = 0.03
# Measures below these clear a solution without an estimate, but for kinks. Of 250 random linear problems they cleared
# 53, all of them right to 0.3 %; at three times these a beam was wrong by 17 %.
CLEAR = {"roughness": 0.05, "source": 0.01, "excess": 10.0, "coefficient": 0.1}
CLEAR_WAVE = 0.1  # of PHASE
# The operator's coefficients at a neighbour differ from their Taylor polynomials by this part of the largest term.
COEFFICIENT = 0.3
# By so much more its series has nothing to do with a coefficient, and all orders agree on another problem.
DIVERGENT = 100.0
# Where it degenerates, the equation is missed at a held value by this part of its largest terms.
CONTRADICTED = 0.05
# The estimate passes through the same inverse: of a condition so many times the usual one it can tell nothing.
BLIND = 1e6
# Beyond so many particles an error estimate would cost more than a look at the flags may.
MANY = 200_000
Told = tuple[list[str], dict[str, float]]


def flags(run: Any, values: Any, nums: Any, estimated: Callable[[], float], known: bool = False) -> Told:
    """Sentences, none for a healthy solution, and the measures behind them.

    estimated: the estimated error as a part of the solution, asked for unless the cheap tests clear the solution, which
    they can do for linear problems of one field in the leave-one-out form, or find what no estimate can excuse. known:
    whether it is there already. Where several processes have a part each, all ask together and are told the same.
    """
    values, told = np.asarray(values, float), whole(run.disc)
    if told.total(int(not np.isfinite(told.own(values)).all())):
        return ["The values are not finite."], {}
    certain, doubts, found = list[str](), list[str](), dict[str, float]()
    for test in (_round_off, _far_away, _jumps, _contradictions, _growth):
        test(run, values, nums, certain, found)
    for test in DOUBTS:
        test(run, values, nums, doubts, found)
    singular = found.get("excess", 0.0) > SINGULAR[run.formulation]
    # Near a resonance the last digits of the source decide, and the estimate passes through the same inverse.
    resonant = singular and found.get("source", 0.0) > OVERWHELMING
    blind = found.get("excess", 0.0) > BLIND or hopeless(found)
    if certain or resonant or blind:
        return doubts + certain, found
    if particles(run.disc) > MANY and not known:
        return doubts, found
    cleared = _cleared(run, values, found, doubts)
    if not cleared:
        found["estimate"] = estimated()
        least, most = clearing(found, run.disc.rec.order)
        if not least <= found["estimate"] <= most:
            return [*doubts, *out_of_reach(run, values, found), *data(run, values, found)], found
    # Near a resonance any residual grows without bound, that of the truncation too; the estimate has its signs.
    return [] if singular else unseen(run, values, found, cleared, found.get("source", 0.0) > SOURCE), found


def clearing(found: dict[str, float], order: int) -> tuple[float, float]:
    """The least and the largest estimated error that clear a solution of its doubts."""
    least = BLINDLY * found.get("misfit", 0.0) if found.get("misfit", 0.0) > MISFIT else 0.0
    if found.get("turned"):
        return least, TURNED
    return least, LOST_PHASE if found.get("wave", 0.0) > SHORT * PHASE[order > 3] else CLEARED


def _turned(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    at = whole(run.disc).named(turned(run.disc, nums))
    found["turned"] = len(at)
    if len(at):
        out.append(
            f"The coefficient of the highest derivatives changes its sign, at {len(at)} particle(s), first {some(at)}, "
            "and the solution is not smooth where it vanishes: what the conditions say on one side may not hold on the "
            "other; correct the sign, or solve on each side by itself."
        )


def too_large(part: float) -> list[str]:
    """What is said of an estimated error that is this part of the solution."""
    if part <= CLEARED:
        return []
    return [f"The estimated error is {part:.0%} of the solution: refine the cloud, or change the order."]


def hopeless(found: dict[str, float]) -> bool:
    """Whether the local fits, or the series of a coefficient, miss so much that no estimate is a judge of it."""
    missed = found.get("misfit", 0.0) > (MISFIT if found["peclet"] > CARRIED else HOPELESS_MISFIT)
    return missed or found.get("coefficient", 0.0) > DIVERGENT


def _cleared(run: Any, values: np.ndarray, found: dict[str, float], doubts: list[str]) -> bool:
    """Whether the cheap tests are enough to call a solution healthy."""
    disc = run.disc
    measured = max(disc.rec.orders) <= 2 or "source" in found  # else nothing but the roughness
    if doubts or not measured or run.formulation == "lsq" or not disc.linear or disc.rec.fields > 1:
        return False
    limits = {**CLEAR, "wave": CLEAR_WAVE * PHASE[disc.rec.order > 3]}
    if not all(found.get(name, 0.0) <= limit for name, limit in limits.items()) or rough_ends(run, values):
        return False
    beyond, every = beyond_kinks(run, values), whole(disc)
    return beyond is None or share(every.own(beyond), every.own(values), told=every) <= CLEARED


def _roughness(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    disc, told = run.disc, whole(run.disc)
    points = np.asarray(disc.cloud.points, float)
    rough = np.zeros(len(values))
    for f, scale in enumerate(scales(told.own(values), told)):
        away = np.abs(values[:, f] - predicted(points, values[:, f])) / scale
        rough = np.maximum(rough, np.where(disc.held[:, f], 0.0, away))
    found["roughness"] = told.most(float(told.own(rough).max(initial=0.0)))
    bad = told.named(np.flatnonzero(rough > ROUGH[disc.rec.order > 3]))
    if len(bad):
        out.append(
            f"The values change by up to {found['roughness']:.0%} of their range between neighbours, at {len(bad)} "
            f"particle(s), first {some(bad)}: a layer, a jump or a wave finer than the cloud; refine it there."
        )


def _condition(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    if run.factor is None:
        return
    usual = usual_condition(run.disc) ** (2 if run.formulation == "lsq" else 1)
    found["excess"] = found["condition"] / usual
    if found["excess"] > SINGULAR[run.formulation]:
        out.append(
            f"The global system is nearly singular (condition {found['condition']:.1e}, {usual:.0e} is usual): the "
            "operator is near a resonance, particles nearly coincide, or the supports couple them badly."
        )


def _round_off(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    if run.factor is None:
        return
    found["condition"], told = run.factor.condition(), whole(run.disc)
    if not run.rows or not told.most(len(run.rows[1])):
        found["round_off"] = float(np.finfo(float).eps) * found["condition"]
        if found["round_off"] > ROUND_OFF:
            out.append(
                f"Round-off may reach {found['round_off']:.0e} of the solution: the least-squares form squares the "
                'operator; take fewer particles, or formulation="loo".'
            )
        return
    defect = max((float(np.max(np.asarray(row.defect), initial=0.0)) for row in run.rows[1]), default=0.0)
    found["round_off"] = told.most(defect) * found["condition"]
    if found["round_off"] > ROUND_OFF:
        single = any(np.asarray(row.weights).dtype == np.float32 for row in run.rows[1])
        out.append(
            f"Round-off may reach {found['round_off']:.0e} of the solution: "
            + ('enable float64 with jax.config.update("jax_enable_x64", True).' if single else "widen the supports.")
        )


def _source(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    """How much of the solution the unresolved part of the source makes: one solve with it alone."""
    disc, rec, told = run.disc, run.disc.rec, whole(run.disc)
    if run.factor is None or run.rows is None or not disc.linear or np.shape(nums.source)[-1] < 2:
        return
    source = np.array(nums.source, float)
    part = np.zeros_like(source)
    if rec.degree >= 2 and disc.scheme.method != "SSPH":
        # The last two degrees: on a symmetric stencil one of them has no weight.
        last = [k for k, (e, c) in enumerate(rec.row_index) if sum(c) > rec.degrees[e] - 2]
        part[last] = source[last]
    else:
        points = np.asarray(disc.cloud.points, float)[nums.ids]
        for k in rec.equation_rows:
            # Its size: what alternates from particle to particle must not cancel.
            part[k] = np.abs(source[k] - predicted(points, source[k]))
    zero = np.zeros_like
    alone = replace(nums, source=part, held=zero(nums.held), given=zero(nums.given), gamma=zero(nums.gamma))
    classes, rows = run.rows
    if disc.scheme.method in ("I", "II"):
        classes, rows = all_rows(disc, alone)  # their constant part holds the neighbours' sources
    right = np.asarray(right_side(disc, alone, classes, rows))
    right = np.concatenate([right, np.zeros(run.bordering)])
    found["source"] = made = told.norm(run.factor.solve(right)) / (told.norm(told.own(values)) or 1.0)
    if made > SOURCE:
        out.append(
            f"The part of the source that the cloud does not resolve makes {made:.0%} of the solution: the source "
            "is narrower than the spacing somewhere, or the operator amplifies it; refine there."
        )


def _coefficients(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    if np.shape(nums.jac)[-1] == 1:
        return
    told = whole(run.disc)
    steep = steepness(run.disc, nums, run.problem, lambda: run.fitted(nums, values), DIVERGENT)
    found["coefficient"] = told.most(float(steep.max(initial=0.0)))
    bad = told.named(np.flatnonzero(steep > COEFFICIENT))
    if len(bad):
        out.append(
            f"The coefficients of the operator change between neighbours by more than their Taylor terms tell, at "
            f"{len(bad)} particle(s), first {some(bad)}: they are steeper than the cloud resolves; refine it there."
        )


def _jumps(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    if np.shape(nums.jac)[-1] == 1:
        return
    lost = beyond_slopes(run.disc, nums, run.problem, lambda: run.fitted(nums, values))
    bad = whole(run.disc).named(np.flatnonzero(lost))
    found["jumps"] = len(bad)
    if len(bad):
        out.append(
            f"A coefficient of the highest derivatives jumps between neighbours, which its slopes do not tell, at "
            f"{len(bad)} particle(s), first {some(bad)}: what happens there is lost; refine until the cloud resolves "
            "it, or smooth it."
        )


def _contradictions(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    if np.shape(nums.jac)[-1] == 1:
        return
    told = whole(run.disc)
    off = contradictions(run.disc, nums, run.problem, values, lambda: run.expanded(nums, values))
    found["contradiction"] = told.most(float(off.max(initial=0.0)))
    bad = told.named(np.flatnonzero(off > CONTRADICTED))
    if len(bad):
        out.append(
            f"The values held at {len(bad)} particle(s), first {some(bad)}, contradict the equation, whose highest "
            "derivatives have no weight there and which fixes u, or its slope, by itself: correct them, or give "
            "js.free() where the equation needs no condition."
        )


def _growth(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    if run.formulation != "lsq":
        return
    held, exponent = inward_growth(run.disc, nums)
    found["growth"] = float(exponent.max(initial=0.0))
    bad = held[exponent > GROWN]
    if len(bad):
        out.append(
            f"From {len(bad)} held value(s), first {some(bad)}, the solution grows inwards, by a factor of "
            f"{np.exp(found['growth']):.1f} to the next particle: least squares would rather forget such a value; give "
            "it where the equation carries it in, or refine."
        )


def _weakness(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    if run.rows is None:
        return
    told = whole(run.disc)
    size = np.concatenate([np.zeros(0), *(np.asarray(row.lebesgue).max(axis=1) for row in run.rows[1])])
    ids = np.concatenate([np.zeros(0, int), *(cls.ids for cls in run.rows[0])])
    count, largest = told.total(len(ids)), told.most(float(size.max(initial=0.0)))
    found["weak"] = told.total(int((size > LEBESGUE).sum())) / max(count, 1)
    bad = told.named(ids[size > WEAK])
    found["hopeless"] = len(bad) / max(count, 1)
    if len(bad) > FEW * count:
        out.append(
            f"{len(bad)} particle(s), first {some(bad)}, amplify their neighbours' errors up to {largest:.1e} "
            "times (Lebesgue constant, up to 1.5 is healthy): choose a support with more, or more evenly spread, "
            "particles, or leave kernel out."
        )


def _misfit(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    if run.misfit is None:
        return
    cells = len(values) ** (1.0 / run.disc.rec.dim)
    found["misfit"] = float(np.sqrt(np.mean(run.misfit**2)) * cells)
    if found["misfit"] > MISFIT:
        out.append(
            f"No function fits the equation and the conditions on this cloud: the misfit adds up to "
            f"{found['misfit']:.0%} of the range, as where a layer is thinner than the spacing; refine at the outflow."
        )


def _peclet(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    disc = run.disc
    found["peclet"] = cell = cell_peclet(disc, nums)
    if cell > PECLET and disc.scheme.method in ("I", "II"):
        out.append(
            f"Convection is {cell:.1f} times diffusion between neighbours, for which method {disc.scheme.method} is "
            'not made: use method="S", or refine.'
        )


def _waves(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    """Waves of an operator such as laplacian(u) + k^2 u: few particles per wavelength put their phase out."""
    disc = run.disc
    k = wave_number(disc, nums)
    if not k:
        return
    order = disc.rec.order
    cells = particles(disc) ** (1.0 / disc.rec.dim)
    spacing = mean_spacing(disc)
    found["wave"] = float(cells * (k * spacing) ** (2 * (order // 2) + 1))
    if found["wave"] > PHASE[order > 3]:
        out.append(
            f"The operator has waves of {2 * np.pi / (k * spacing):.1f} particles a length, too few for order {order} "
            f"over {cells:.0f} particles: their phase is lost; refine, or raise the order."
        )


def _far_away(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    """Far from the origin the coordinates themselves lose digits, and with them source and boundary values."""
    told = whole(run.disc)
    if not run.rows or not told.most(len(run.rows[1])):
        return
    dtype: Any = np.asarray(run.rows[1][0].weights).dtype if run.rows[1] else np.dtype(float)
    far = told.most(float(np.abs(np.asarray(run.disc.cloud.points)).max()))
    found["rounded"] = float(np.finfo(dtype).eps) * far / (mean_spacing(run.disc) or far or 1.0)
    if found["rounded"] > ROUNDED:
        out.append(
            f"Coordinates up to {far:.0e} in {dtype} are known to {found['rounded']:.1g} of the spacing only: move the "
            "cloud to the origin, or use float64."
        )


def _poles(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    out += said(nums.poles, whole(run.disc)) if any(run.disc.traced.unbounded) else []


def unsettled(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    """Several polynomials may fit a particle equally well, and its values be right: the estimate knows."""
    found["unsettled"] = count = len(run.unsettled)
    if count:
        out.append(
            f"The expansions of {count} particle(s), first {some(run.unsettled)}, do not settle in Newton's method: it "
            "hangs on what the cloud does not resolve there; refine it."
        )


DOUBTS = (_condition, _misfit, _waves, _roughness, _source, _coefficients, _weakness, _peclet, _turned, _poles,
          unsettled)  # fmt: skip
# The tests that ask the whole system, and those that ask one region of several alone: certain ones, and doubts.
OF_THE_WHOLE = (_round_off, _condition, _far_away)
OF_A_REGION = (_jumps, _contradictions), (_misfit, _waves, _roughness, _coefficients, _peclet, _turned, _poles)
