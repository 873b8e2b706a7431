"""One random case: drawn from a seed and a number, described by a dataclass, built into a problem on a cloud."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import jax.numpy as jnp
import numpy as np

import jsmitsm as js
from benchmarks.random_cases import domains, solutions
from benchmarks.random_cases.operators import OPERATORS, Operator, residual

# So many cases in a row share a recipe (operator, domain, conditions, method), and with it the compiled programs.
MEMBERS = 40
# Every fifth recipe is in 3D; of five recipes two are nonlinear or systems.
DIMS, KINDS = (2, 1, 2, 1, 3), ("linear", "linear", "nonlinear", "linear", "system")
METHODS = {"S": 0.64, "I": 0.08, "II": 0.08, "III": 0.08, "SSPH": 0.12}
ORDERS = {
    1: {2: 0.2, 3: 0.08, 4: 0.32, 5: 0.06, 6: 0.22, 7: 0.03, 8: 0.09},
    2: {2: 0.22, 3: 0.06, 4: 0.36, 5: 0.05, 6: 0.22, 7: 0.02, 8: 0.07},
    3: {2: 0.55, 3: 0.1, 4: 0.35},
}
# Those of the others, whose programs compile long.
OTHERS = {1: {2: 0.35, 4: 0.65}, 2: {2: 0.4, 4: 0.6}, 3: {2: 1.0}}
FORMS = {"auto": 0.8, "loo": 0.1, "lsq": 0.1}
SEEDS = 2  # of every domain, so that clouds and programs are shared


@dataclass(frozen=True)
class Case:
    """A random boundary-value problem and how it is solved; ``numbers`` are the parameters of its functions."""

    seed: int
    number: int
    dim: int
    operator: str
    coefficient: str
    solution: str
    width: float  # of the solution's features, in spacings
    steep: float  # of the coefficient's, in spacings
    domain: str
    size: int
    cloud_seed: int
    conditions: tuple[tuple[str, tuple[str, ...]], ...]  # of every group, one kind for each field
    method: str
    order: int
    formulation: str
    start: str  # of Newton's method: "none", "near"
    numbers: Any

    @property
    def kind(self) -> str:
        """ "linear", "nonlinear" or "system"."""
        return OPERATORS[self.operator].kind

    @property
    def fields(self) -> int:
        return OPERATORS[self.operator].fields(self.dim)

    @property
    def cloud(self) -> js.Cloud:
        return domains.cloud(self.domain, self.dim, self.size, self.cloud_seed)

    @property
    def exact(self) -> np.ndarray:
        """The solution at the particles, (N, F)."""
        return solutions.values(self.solution, self.fields, self.cloud.points, self.numbers).reshape(-1, self.fields)

    def problem(self) -> js.Problem:
        """The boundary-value problem."""
        exact = solutions.exact(self.solution, self.fields)
        bcs = {group: [c for f, kind in enumerate(kinds) for c in self._condition(group, f, kind)]
               for group, kinds in self.conditions}  # fmt: skip
        pde = residual(self.operator, self.coefficient, exact)
        return js.Problem(pde, bcs, fields=self.fields, params=self.numbers)

    def solve(self, **options: Any) -> js.Solution:
        """Its solution by the case's own method."""
        start = {"u0": self._near()} if self.start == "near" else {}
        chosen = {"method": self.method, "order": self.order, "formulation": self.formulation, **start, **options}
        return js.solve(self.problem(), self.cloud, **chosen)

    def _near(self) -> np.ndarray:
        """A start near the solution: a tenth off in size, and a little bent."""
        x = np.asarray(self.cloud.points)
        return self.exact * (0.9 + 0.1 * np.sin(2.0 * x.sum(axis=1)))[:, None]

    def _condition(self, group: str, field: int, kind: str) -> list[js.Condition]:
        """The conditions of one field on one group."""
        only = field if self.fields > 1 else None
        cloud, ids = self.cloud, np.asarray(self.cloud.groups[group])
        if kind == "free":
            return [js.free()] if field == 0 else []
        points, normals = np.asarray(cloud.points)[ids], np.asarray(cloud.normals)[ids]
        u = solutions.values(self.solution, self.fields, points, self.numbers).reshape(len(ids), -1)[:, field]
        held = js.dirichlet(u, field=only)
        if kind == "dirichlet":
            return [held]
        grad = solutions.values(self.solution, self.fields, points, self.numbers, slopes=True)
        slope = np.einsum("nd,nd->n", grad.reshape(len(ids), self.fields, -1)[:, field], normals)
        if kind == "neumann":
            return [js.neumann(slope, field=only)]
        if kind == "robin":
            return [js.robin(1.5, 1.0, 1.5 * u + slope, field=only)]
        if kind == "clamped":
            return [held, js.neumann(slope, field=only)]
        if kind == "supported":
            return [held, js.condition(_states(self.solution, self.fields, "bent"))]
        if kind == "moving":
            return [held, js.condition(_states(self.solution, self.fields, "rate"))]
        return [js.condition(_states(self.solution, self.fields, kind, field))]  # "oblique", "radiating"


_STATES: dict[Any, Callable[..., Any]] = {}


def _states(name: str, fields: int, kind: str, field: int = 0) -> Callable[..., Any]:
    """A residual (u, x, n, q) that the solution fulfils, one function object for all cases."""
    key = name, fields, kind, field
    if key not in _STATES:
        f = solutions.exact(name, fields)
        of = (lambda u: lambda y: u(y)[field]) if fields > 1 else (lambda u: u)

        def residual(u, x, n, q):
            return _stated(kind, of(u), x, n) - _stated(kind, of(lambda y: f(y, q)), x, n)

        _STATES[key] = residual
    return _STATES[key]


def _stated(kind: str, u: Any, x: Any, n: Any) -> Any:
    if kind == "bent":
        return js.laplacian(u)(x)
    if kind == "rate":
        return js.partial(u, (0, 1))(x)
    slope = n @ js.grad(u)(x)
    if kind == "radiating":
        return slope + 0.3 * u(x) ** 3
    return slope + 0.4 * js.grad(u)(x)[0] + jnp.exp(-x[0]) * u(x)


# ------------------------------------------------------------------ drawing


@dataclass(frozen=True)
class Recipe:
    """What compiled programs depend on: the parts of the same names of a case."""

    dim: int
    operator: str
    varying: bool
    domain: str
    size: int
    conditions: tuple[tuple[str, tuple[str, ...]], ...]
    method: str
    order: int
    formulation: str


@lru_cache(maxsize=8)
def recipe(seed: int, number: int) -> Recipe:
    """The recipe of this number, drawn from its own stream."""
    rng = np.random.default_rng([seed, 0, number])
    dim = DIMS[number % len(DIMS)]
    kind = KINDS[(number // len(DIMS)) % len(KINDS)]
    names = [name for name, op in OPERATORS.items() if op.kind == kind and dim in op.dims]
    share = np.array([OPERATORS[name].share for name in names])
    operator = str(rng.choice(names, p=share / share.sum()))
    op = OPERATORS[operator]
    method = _method(rng, op, dim)
    orders = ORDERS[dim] if method == "S" else OTHERS[dim]
    most = 8 if op.fields(dim) < 3 else 6  # beyond, their programs compile for minutes
    fits = {p: w for p, w in orders.items() if max(op.order, 2) <= p <= most}
    order = int(_drawn(rng, fits or {4: 1.0}))
    form = _drawn(rng, FORMS) if method == "S" and op.conditions == "elliptic" else "auto"
    domain, size = _domain(rng, dim, op, order)
    cloud = domains.cloud(domain, dim, size, 0)
    varying = len(op.coefficients) > 1 and rng.random() < 0.75
    return Recipe(dim, operator, varying, domain, size, _conditions(rng, cloud, op, dim), method, order, form)


def case(seed: int, number: int) -> Case:
    """The case of this number; each is drawn from its own stream, whatever was drawn before."""
    made = recipe(seed, number // MEMBERS)
    rng = np.random.default_rng([seed, 1, number])
    op, cloud_seed = OPERATORS[made.operator], int(rng.integers(SEEDS))
    cloud = domains.cloud(made.domain, made.dim, made.size, cloud_seed)
    solution = str(rng.choice(list(solutions.SOLUTIONS), p=(0.16, 0.2, 0.1, 0.18, 0.08, 0.18, 0.1)))
    width, steep = (float(np.exp(rng.uniform(np.log(0.4), np.log(16.0)))) for _ in range(2))
    coefficient = str(rng.choice(op.coefficients[1:])) if made.varying else "even"
    if (made.operator, coefficient) == ("diffusion", "step") and rng.random() < 0.6:
        solution = "laminate"
    elif coefficient in ("waves", "step", "bump"):
        # The source that a solution needs makes up for steps which the particles do not see: only laminates have those.
        steep = max(steep, 0.8 * domains.widest(cloud) / domains.spacing(cloud))
    start = "near" if made.dim == 3 or rng.random() < 0.7 else "none"
    return Case(
        seed, number, made.dim, made.operator, coefficient, solution, width, steep, made.domain, made.size, cloud_seed,
        made.conditions, made.method, made.order, made.formulation, start,
        _numbers(rng, cloud, op, solution, width, steep),
    )  # fmt: skip


def _drawn(rng: np.random.Generator, weights: dict) -> Any:
    p = np.array(list(weights.values()), float)
    return list(weights)[rng.choice(len(p), p=p / p.sum())]


def _method(rng: np.random.Generator, op: Operator, dim: int) -> str:
    if op.conditions != "elliptic":
        return "S"
    if op.fields(dim) > 1:
        return "SSPH" if rng.random() < 0.3 else "S"
    method = _drawn(rng, METHODS)
    return "III" if dim == 3 and method in ("I", "II") else method


def _domain(rng: np.random.Generator, dim: int, op: Operator, order: int) -> tuple[str, int]:
    boxes = op.conditions in ("inflow", "heat", "wave", "hilliard") or (op.conditions == "flow" and rng.random() < 0.7)
    domain = str(rng.choice([f.__name__ for f in (domains.BOXES if boxes else domains.DOMAINS[dim])]))
    sizes = domains.SIZES[dim]
    last = len(sizes) - (dim == 3 and (op.kind != "linear" or order > 2))
    return domain, int(rng.choice(sizes[1 if order > 4 else 0 : last]))


def _numbers(rng: np.random.Generator, cloud: js.Cloud, op: Operator, solution: str, width: float, steep: float) -> Any:
    points, dim, gap = np.asarray(cloud.points), cloud.dim, domains.spacing(cloud)
    across = rng.normal(size=dim)
    fields = op.fields(dim)
    scales = [1.0] * fields if fields == 1 or rng.random() < 0.6 else list(rng.choice([1.0, 0.1, 10.0], fields))
    name = "smooth" if solution == "laminate" else solution
    wide = lambda: width * rng.choice([1.0, 1.0, 2.0])
    drawn = [solutions.numbers(rng, name, points, gap, wide()) for _ in range(fields)]
    for scale, p in zip(scales, drawn):
        p.update({name: np.float64(p[name] * scale) for name in ("size", "constant")}, slope=p["slope"] * scale)
    velocity = rng.uniform(0.3, 1.0, dim)
    per = np.exp(rng.uniform(np.log(3.0), np.log(40.0)))  # particles a wavelength
    many = lambda lo, hi: np.float64(np.exp(rng.uniform(np.log(lo), np.log(hi))))
    if solution == "laminate":
        drawn = []
    return {
        "fields": drawn,
        "across": across / np.linalg.norm(across),
        "at": points[rng.integers(len(points))] + gap * rng.uniform(-0.5, 0.5, dim),
        "steep": np.float64(steep * gap),
        "contrast": many(0.3, 100.0),
        "angle": np.float64(rng.uniform(0.0, 6.3)),
        "aspect": many(0.1, 300.0),
        "small": many(1e-3, 1.0),
        "square": np.float64((2.0 * np.pi / (per * gap)) ** 2),
        "speed": np.float64(rng.uniform(-5.0, 5.0)),
        "rate": np.float64(rng.uniform(-5.0, 5.0)) if op.kind == "linear" else np.float64(rng.uniform(0.0, 3.0)),
        "velocity": velocity,
        "lame": many(0.3, 10.0),
    }


def _conditions(rng: np.random.Generator, cloud: js.Cloud, op: Operator, dim: int) -> Any:
    """The kinds of conditions of every boundary group, one for each field."""
    groups = [g for g in cloud.groups if g != "interior"]
    fields = op.fields(dim)
    if op.conditions == "third":
        return (("left", ("clamped",)), ("right", ("dirichlet",)))
    if op.conditions == "clamped":
        return tuple((g, (str(rng.choice(["clamped", "clamped", "supported"])),)) for g in groups)
    if op.conditions == "inflow":
        return tuple((g, ("dirichlet" if g in ("left", "bottom", "front") else "free",)) for g in groups)
    if op.conditions in ("heat", "wave", "hilliard"):
        kinds = {"top": "free", "bottom": "moving" if op.conditions == "wave" else "dirichlet"}
        sides = "supported" if op.conditions == "hilliard" else "dirichlet"
        return tuple((g, (kinds.get(g, sides),)) for g in groups)
    if op.conditions == "flow":
        return tuple((g, ("dirichlet",) * dim) for g in groups)
    usual = {"dirichlet": 0.55, "neumann": 0.18, "robin": 0.12, "oblique": 0.15}
    if op.kind == "nonlinear":
        usual = {"dirichlet": 0.6, "neumann": 0.15, "robin": 0.1, "radiating": 0.15}
    if fields > 1:
        usual = {"dirichlet": 0.7, "neumann": 0.15, "robin": 0.15}
    drawn = []
    for g in groups:
        kind = _drawn(rng, usual)
        drawn.append((g, (kind,) * fields))
    # Mostly some value is held; without one the data need not fix the solution.
    if rng.random() < 0.95 and not any("dirichlet" in kinds for _, kinds in drawn):
        k = int(rng.integers(len(drawn)))
        drawn[k] = (drawn[k][0], ("dirichlet",) * fields)
    return tuple(drawn)
