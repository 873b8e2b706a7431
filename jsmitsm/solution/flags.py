"""What a finished solve says against itself: cheap tests, and a sentence for each that fails.

None of the tests costs a moment system: some solves with the kept factors and sums over neighbours.
What they suspect of the resolution the error estimate may clear, which is made only then. A healthy
solution has no flags. A flag is no proof of an error, nor its absence one of accuracy: the error
estimate (:meth:`Solution.error_estimate`) sees more and costs more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from jsmitsm.discretization.health import LEBESGUE
from jsmitsm.discretization.leave_one_out import right_side
from jsmitsm.discretization.operator_kind import cell_peclet, mean_spacing, wave_number
from jsmitsm.discretization.rows import all_rows
from jsmitsm.runtime.errors import some

# A particle may differ from the linear function through its neighbours by this part of the
# range; a sine of six particles a wavelength differs by 0.25. By order: up to 3, and above.
ROUGH = (0.2, 0.3)
# A matrix of order m on n particles in D dimensions has a condition of about n^(m/D), in the least-squares form, which
# squares the operator, n^(2m/D); so many times more is nearly singular.
SINGULAR = {"loo": 1e3, "lsq": 1e2}
# The part of the solution that hangs on what the cloud does not resolve of the source.
SOURCE = 0.3
# Weights that sum to this amplify any roughness of the neighbours; a share of FEW does no harm.
WEAK, FEW = 10.0, 0.01
# Least squares: misfit of the local fits, added up across the domain, in parts of the range.
# Measured: below 5e-4 where the solution is resolved, above 0.06 where a layer is not.
MISFIT = 0.01
# Convection over diffusion between neighbours from which methods I and II lose the solution.
PECLET = 1.0
# Round-off of the moment systems times the condition: this leaves two digits.
ROUND_OFF = 1e-2
# Coordinates rounded by this part of the spacing put the particles somewhere else.
ROUNDED = 1e-3
# (k s)^(p+1) cells, with s the spacing: the phase error a wave gathers across the domain. By order, as above.
PHASE = (0.9, 3.5)


# An estimated error below this part of the solution clears what only suspects the resolution. Of the wrong
# solutions of the stability sweep that were flagged for nothing else, the least estimate is 0.07.
CLEARED = 0.01
# This part of the bounds above is reason enough to ask the estimate, and nothing to say before it has answered.
HINT = 0.3
# The estimate passes through the same inverse: near a resonance it is blind, and a condition so many times the usual
# one clears nothing.
CALM = 10.0
# Beyond so many particles an error estimate would cost more than a look at the flags may.
MANY = 200_000


def flags(run: Any, values: Any, nums: Any, estimated: Callable[[], float]) -> tuple[list[str], dict[str, float]]:
    """Sentences, none for a healthy solution, and the measures behind them.

    estimated: the estimated error over the solution, asked for where that may clear or confirm a suspicion.
    """
    values = np.asarray(values, float)
    if not np.isfinite(values).all():
        return ["The values are not finite."], {}
    known: list[str] = []
    suspected: list[str] = []
    found: dict[str, float] = {}
    for test in (_condition, _misfit, _far_away, _waves):
        test(run, values, nums, known, found)
    for test in (_roughness, _source, _weakness, _peclet):
        test(run, values, nums, suspected, found)
    if not known and _telling(run) and (suspected or _hinted(found, run.disc.rec.order)):
        found["estimate"] = estimated()
        if found["estimate"] <= CLEARED and found.get("excess", np.inf) <= CALM:
            suspected = []
    return suspected + known, found


def _telling(run: Any) -> bool:
    """Whether the error estimate is known to be large where the solution is wrong.

    It is not in the least-squares form; systems and nonlinear problems are not in the stability sweep.
    """
    disc = run.disc
    return run.formulation == "loo" and disc.linear and disc.rec.fields == 1 and len(disc.cloud) <= MANY


def _hinted(found: dict[str, float], order: int) -> bool:
    """Whether a measure comes near its bound: fronts are wrong by their whole size at a third of the bounds."""
    high = order > 3
    bounds = {"roughness": ROUGH[high], "source": SOURCE, "wave": PHASE[high], "excess": CALM / HINT}
    return any(found.get(name, 0.0) > HINT * bound for name, bound in bounds.items())


def _roughness(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    disc = run.disc
    points = np.asarray(disc.cloud.points, float)
    rough = np.zeros(len(values))
    for f in range(values.shape[1]):
        spread = float(np.ptp(values[:, f])) or 1.0
        away = np.abs(values[:, f] - predicted(points, values[:, f])) / spread
        rough = np.maximum(rough, np.where(disc.held[:, f], 0.0, away))
    found["roughness"] = float(rough.max(initial=0.0))
    bad = np.flatnonzero(rough > ROUGH[disc.rec.order > 3])
    if len(bad):
        out.append(
            f"The values change by up to {rough.max():.0%} of their range between neighbours, at {len(bad)} "
            f"particle(s), first {some(bad)}: a layer, a jump or a wave finer than the cloud; refine it there."
        )


def predicted(points: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Each particle's value from the linear function that fits its 2 D + 1 nearest neighbours best."""
    from scipy.spatial import cKDTree

    n, dim = points.shape
    k = min(2 * dim + 2, n)
    if k < dim + 3:
        return values
    near = cKDTree(points).query(points, k=k)[1][:, 1:]
    offset = points[near] - points[:, None]
    size = np.sqrt((offset**2).sum(axis=2)).max(axis=1)
    p = np.concatenate([np.ones((n, k - 1, 1)), offset / size[:, None, None]], axis=2)
    # A little ridge: neighbours on one line say nothing of the slope across it.
    gram = np.einsum("nki,nkj->nij", p, p) + 1e-6 * np.eye(dim + 1)
    return np.linalg.solve(gram, np.einsum("nki,nk->ni", p, values[near])[..., None])[:, 0, 0]


def _condition(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    if run.factor is None:
        return
    rec = run.disc.rec
    order = max(rec.orders)
    found["condition"] = run.factor.condition()
    usual = len(values) ** ((2 if run.formulation == "lsq" else 1) * order / rec.dim)
    found["excess"] = found["condition"] / usual
    if found["excess"] > SINGULAR[run.formulation]:
        out.append(
            f"The global system is nearly singular (condition {found['condition']:.1e}, {usual:.0e} is usual): the "
            "operator is near a resonance, particles nearly coincide, or the supports couple them badly."
        )
    if run.rows is None:
        found["round_off"] = float(np.finfo(float).eps) * found["condition"]
        if found["round_off"] > ROUND_OFF:
            out.append(
                f"Round-off may reach {found['round_off']:.0e} of the solution: the least-squares form squares the "
                'operator; take fewer particles, or formulation="loo".'
            )
        return
    defect = max(float(np.max(np.asarray(row.defect), initial=0.0)) for row in run.rows[1])
    found["round_off"] = defect * found["condition"]
    if found["round_off"] > ROUND_OFF:
        single = any(np.asarray(row.weights).dtype == np.float32 for row in run.rows[1])
        out.append(
            f"Round-off may reach {found['round_off']:.0e} of the solution: "
            + ('enable float64 with jax.config.update("jax_enable_x64", True).' if single else "widen the supports.")
        )


def _source(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    """How much of the solution the unresolved part of the source makes: one solve with it alone."""
    disc, rec = run.disc, run.disc.rec
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
    right = np.concatenate([right, np.zeros(len(disc.floating))])
    share = float(np.linalg.norm(run.factor.solve(right)) / (np.linalg.norm(values) or 1.0))
    found["source"] = share
    if share > SOURCE:
        out.append(
            f"The part of the source that the cloud does not resolve makes {share:.0%} of the solution: the source "
            "is narrower than the spacing somewhere, or the operator amplifies it; refine there."
        )


def _weakness(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    if run.rows is None:
        return
    size = np.concatenate([np.asarray(row.lebesgue).max(axis=1) for row in run.rows[1]])
    ids = np.concatenate([cls.ids for cls in run.rows[0]])
    found["weak"] = float((size > LEBESGUE).mean())
    found["lebesgue50"] = float(np.median(size))
    bad = ids[size > WEAK]
    found["hopeless"] = len(bad) / len(ids)
    if len(bad) > FEW * len(ids):
        out.append(
            f"{len(bad)} particle(s), first {some(bad)}, amplify their neighbours' errors up to {size.max():.1e} "
            "times (Lebesgue constant, up to 1.5 is healthy): choose a support with more, or more evenly spread, "
            "particles, or leave kernel out."
        )


def _misfit(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    if run.misfit is None:
        return
    spread = float(np.ptp(values)) or 1.0
    cells = len(values) ** (1.0 / run.disc.rec.dim)
    found["misfit"] = float(np.sqrt(np.mean((run.misfit / spread) ** 2)) * cells)  # no square overflows
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
    cells = len(values) ** (1.0 / disc.rec.dim)
    spacing = mean_spacing(disc)
    found["wave"] = float(cells * (k * spacing) ** (2 * (order // 2) + 1))
    if found["wave"] > PHASE[order > 3]:
        out.append(
            f"The operator has waves of {2 * np.pi / (k * spacing):.1f} particles a length, too few for order {order} "
            f"over {cells:.0f} particles: their phase is lost; refine, or raise the order."
        )


def _far_away(run: Any, values: np.ndarray, nums: Any, out: list[str], found: dict[str, float]) -> None:
    """Far from the origin the coordinates themselves lose digits, and with them source and boundary values."""
    if run.rows is None:
        return
    dtype = np.asarray(run.rows[1][0].weights).dtype
    far = float(np.abs(np.asarray(run.disc.cloud.points)).max())
    found["rounded"] = float(np.finfo(dtype).eps) * far / (mean_spacing(run.disc) or far or 1.0)
    if found["rounded"] > ROUNDED:
        out.append(
            f"Coordinates up to {far:.0e} in {dtype} are known to {found['rounded']:.1g} of the spacing only: move the "
            "cloud to the origin, or use float64."
        )
