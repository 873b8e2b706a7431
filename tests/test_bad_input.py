"""Whatever is wrong with an input, the error names the argument and what to do about it.

Each entry: a name, what is called, a pattern that names the argument, a pattern of the remedy
(or of what was expected). Both must be found in the message, ignoring case.
"""

import pickle
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jsmitsm as js
from jsmitsm.solution.fit import Recipe

# No warning of numpy's about its own arithmetic reaches the user: the error says what is wrong.
pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

LINE = js.interval(0.0, 1.0, 9)
SQUARE = js.rectangle((0, 0), (1, 1), (5, 5))
BARE = js.Cloud(LINE.points, LINE.groups)
ENDS = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
KERNEL = js.SuperGaussian(h=0.125, d=3.0)
NAN, INF = float("nan"), float("inf")
DATA = np.linspace(0.0, 1.0, 3)[:, None]
THREE = {"interior": [1], "ends": [0, 2]}


def poisson(u, x):
    return js.laplacian(u)(x) - 1.0


def cloud(points=DATA, groups=THREE, normals=None):
    return lambda: js.Cloud(points, groups, normals)


def solve(pde=poisson, bcs=ENDS, cloud=LINE, fields=1, params=None, **options):
    return lambda: js.solve(js.Problem(pde, bcs, fields, params), cloud, **options)


def residual(pde, **rest):
    return solve(pde=pde, **rest)


def ends(left=ENDS["left"], right=ENDS["right"], **rest):
    return lambda: js.solve(js.Problem(poisson, {"left": left, "right": right}), rest.get("cloud", LINE))


def evaluate(call):
    sol = js.Solution(np.zeros((9, 1)), LINE, Recipe("S", 2, None, "auto", 1), None, True, 1, {},
                      fitted=np.zeros((9, 1, 3)))  # fmt: skip
    return lambda: call(sol)


def shifted(values):
    normals = np.array(LINE.normals)
    normals[[0, -1], 0] = values
    return js.Cloud(LINE.points, LINE.groups, normals)


CLOUDS = [
    ("points-flat", cloud(np.linspace(0, 1, 3)), "points", r"points\[:, None\]"),
    ("points-3d-array", cloud(np.zeros((3, 1, 1))), "points", r"shape \(N, D\)"),
    ("points-4-dims", cloud(np.zeros((3, 4))), "points", "D = 1, 2 or 3"),
    ("points-no-dims", cloud(np.zeros((3, 0))), "points", "D = 1, 2 or 3"),
    ("points-none-at-all", cloud(np.zeros((0, 2)), {"interior": []}), "points", r"shape \(N, D\)"),
    ("points-nan", cloud([[0.0], [NAN], [1.0]]), "points", "remove"),
    ("points-huge", cloud([[0.0], [0.5e300], [1e300]]), "points", "unit of length"),
    ("points-tiny", cloud([[0.0], [0.5e-300], [1e-300]]), "points", "unit of length"),
    ("points-inf", cloud([[0.0], [INF], [1.0]]), "points", "remove"),
    ("points-complex", cloud(DATA + 1j), "points", "real array"),
    ("points-text", cloud([["a"], ["b"], ["c"]]), "points", "real array"),
    ("points-bool", cloud(np.array([[True], [False], [True]])), "points", "real array"),
    ("points-None", cloud(None), "points", "real array"),
    ("points-ragged", cloud([[0.0], [0.5, 1.0], [1.0]]), "points", "real array"),
    ("points-duplicate", cloud([[0.0], [0.5], [0.5]]), "points.*duplicate", "keep one"),
    ("points-duplicate-signed-zero", cloud([[0.0], [-0.0], [0.5]]), "points.*duplicate", "keep one"),
    ("groups-None", cloud(groups=None), "groups", "dict"),
    ("groups-list", cloud(groups=[[0, 1, 2]]), "groups", "dict"),
    ("groups-no-interior", cloud(groups={"ends": [0, 1, 2]}), "groups", '"interior"'),
    ("groups-mask", cloud(groups={"interior": np.array([False, True, False]), "ends": [0, 2]}), r"groups\['interior'\]",
     "flatnonzero"),
    ("groups-float", cloud(groups={"interior": [1.0], "ends": [0, 2]}), r"groups\['interior'\]", "integer"),
    ("groups-2d", cloud(groups={"interior": [[1]], "ends": [0, 2]}), r"groups\['interior'\]", "1D"),
    ("groups-text", cloud(groups={"interior": "b", "ends": [0, 2]}), r"groups\['interior'\]", "integer"),
    ("groups-negative", cloud(groups={"interior": [1], "ends": [0, -1]}), r"groups\['ends'\]", "expected 0 to 2"),
    ("groups-too-large", cloud(groups={"interior": [1], "ends": [0, 3]}), r"groups\['ends'\]", "expected 0 to 2"),
    ("groups-overlap", cloud(groups={"interior": [1], "ends": [0, 1, 2]}), r"groups\['ends'\].*\[1\]", "exactly one"),
    ("groups-twice", cloud(groups={"interior": [1, 1], "ends": [0, 2]}), r"groups\['interior'\].*\[1\]", "exactly one"),
    ("groups-not-covered", cloud(groups={"interior": [1], "ends": [0]}), r"groups.*\[2\]", "add them"),
    ("groups-name-no-string", cloud(groups={"interior": [1], 7: [0, 2]}), "groups.*7", "string"),
    ("groups-of-another-cloud", cloud(groups=js.interval(0, 1, 4).groups), r"groups\['right'\]", "expected 0 to 2"),
    ("groups-ragged", cloud(groups={"interior": [[1], [0, 2]], "ends": []}), r"groups\['interior'\]", "integer"),
    ("normals-shape", cloud(normals=np.zeros((3, 2))), "normals", r"expected shape \(3, 1\)"),
    ("normals-flat", cloud(normals=np.array([-1, NAN, 1.0])), "normals", r"expected shape \(3, 1\)"),
    ("normals-length", cloud(normals=[[-2.0], [NAN], [1.0]]), "normals.*unit", "divide by"),
    ("normals-zero", cloud(normals=[[0.0], [NAN], [1.0]]), "normals.*unit", "divide by"),
    ("normals-inf", cloud(normals=[[INF], [NAN], [1.0]]), "normals", "divide by|finite"),
    ("normals-text", cloud(normals=[["a"], ["b"], ["c"]]), "normals", "real|number"),
    ("normals-complex", cloud(normals=np.array([[-1j], [NAN], [1j]])), "normals", "real"),
    ("replace-points-shape", lambda: LINE.replace(points=np.zeros((8, 1))), "points", "new Cloud"),
    ("replace-points-nan", lambda: LINE.replace(points=np.full((9, 1), NAN)), "points", "remove"),
    ("replace-normals-shape", lambda: LINE.replace(normals=np.zeros((8, 1))), "normals", r"expected shape \(9, 1\)"),
    ("spacing-of-one", lambda: js.Cloud([[0.0]], {"interior": [0]}).spacing, "spacing", "two particles"),
    ("spacing-traced", lambda: jax.jit(lambda x: LINE.replace(points=x).spacing)(LINE.points), "spacing", "before the"),
    ("interval-reversed", lambda: js.interval(1.0, 0.0, 5), "b:", "greater than a"),
    ("interval-empty", lambda: js.interval(1.0, 1.0, 5), "b:", "greater than a"),
    ("interval-nan", lambda: js.interval(NAN, 1.0, 5), "a:", "finite"),
    ("interval-date", lambda: js.interval(np.datetime64("2020-01-01"), 1.0, 5), "a:", "finite number"),
    ("interval-span", lambda: js.interval(0.0, np.timedelta64(1), 5), "b:", "finite number"),
    ("interval-span-n", lambda: js.interval(0.0, 1.0, np.timedelta64(5)), "n:", "whole number"),
    ("interval-huge", lambda: js.interval(0.0, 1e300, 5), "^b:", "unit of length"),
    ("box-huge", lambda: js.box((0, -1e200, 0), (1, 1, 1), (3, 3, 3)), "^lo:", "unit of length"),
    ("polygon-text", lambda: js.from_polygon([("0", "0"), ("1", "0"), ("0", "1")], 0.2), "vertices", "array of shape"),
    ("circle-date", lambda: js.sdf.circle((0, 0), np.datetime64("2020-01-01")), "radius:", "expected"),
    ("interval-text", lambda: js.interval("a", 1.0, 5), "a:", "finite number"),
    ("interval-one-particle", lambda: js.interval(0.0, 1.0, 1), "n:", "at least 2"),
    ("interval-float-n", lambda: js.interval(0.0, 1.0, 5.0), "n:", "whole number"),
    ("interval-negative-n", lambda: js.interval(0.0, 1.0, -5), "n:", "at least 2"),
    ("interval-bool-n", lambda: js.interval(0.0, 1.0, True), "n:", "whole number"),
    ("rectangle-lo-shape", lambda: js.rectangle((0, 0, 0), (1, 1), (5, 5)), "lo:", "expected 2 finite"),
    ("rectangle-lo-scalar", lambda: js.rectangle(0, (1, 1), (5, 5)), "lo:", "expected 2 finite"),
    ("rectangle-hi-inf", lambda: js.rectangle((0, 0), (1, INF), (5, 5)), "hi:", "finite"),
    ("rectangle-hi-below", lambda: js.rectangle((0, 0), (1, 0), (5, 5)), "hi:", "greater than lo"),
    ("rectangle-shape-length", lambda: js.rectangle((0, 0), (1, 1), (5, 5, 5)), "shape:", "expected 2 whole"),
    ("rectangle-shape-scalar", lambda: js.rectangle((0, 0), (1, 1), 5), "shape:", "expected 2 whole"),
    ("rectangle-shape-one", lambda: js.rectangle((0, 0), (1, 1), (5, 1)), "shape:", "at least 2"),
    ("rectangle-shape-float", lambda: js.rectangle((0, 0), (1, 1), (5.0, 5.0)), "shape:", "whole"),
    ("rectangle-jitter-half", lambda: js.rectangle((0, 0), (1, 1), (5, 5), jitter=0.5), "jitter:", "0 <= jitter < 0.5"),
    ("rectangle-jitter-negative", lambda: js.rectangle((0, 0), (1, 1), (5, 5), -0.1), "jitter:", "0 <= jitter < 0.5"),
    ("rectangle-jitter-nan", lambda: js.rectangle((0, 0), (1, 1), (5, 5), NAN), "jitter:", "0 <= jitter < 0.5"),
    ("rectangle-jitter-text", lambda: js.rectangle((0, 0), (1, 1), (5, 5), "big"), "jitter:", "0 <= jitter < 0.5"),
    ("rectangle-seed", lambda: js.rectangle((0, 0), (1, 1), (5, 5), 0.1, seed=-1), "seed:", "whole number"),
    ("rectangle-seed-text", lambda: js.rectangle((0, 0), (1, 1), (5, 5), 0.1, seed="x"), "seed:", "whole number"),
    ("box-shape", lambda: js.box((0, 0, 0), (1, 1, 1), (5, 5)), "shape:", "expected 3 whole"),
    ("box-hi", lambda: js.box((0, 0, 0), (1, 1), (5, 5, 5)), "hi:", "expected 3 finite"),
    ("box-lo-nan", lambda: js.box((0, 0, NAN), (1, 1, 1), (5, 5, 5)), "lo:", "finite"),
]

CLOUDS += [
    ("spacing-of-nothing", lambda: js.interval(0.0, 1.0, spacing=lambda: 0.1), "spacing:", r"points \(M, D\)"),
    ("spacing-by-name", lambda: js.from_polygon([(0, 0), (1, 0), (0, 1)], lambda x: x.size * x.hight), "spacing:",
     r"lengths \(M,\)"),
    ("holes-number", lambda: js.from_polygon([(0, 0), (1, 0), (0, 1)], 0.3, holes=jnp.zeros(())), "holes:", "list"),
]

BAD_H = [("zero", 0.0), ("negative", -1.0), ("nan", NAN), ("inf", INF), ("text", "a"), ("None", None),
         ("complex", 1j), ("bool", True), ("ragged", [[1.0], [1.0, 2.0]])]  # fmt: skip
KERNELS = [
    *((f"h-{k}", lambda v=v: js.SuperGaussian(h=v, d=2.0), r"\bh:", "positive") for k, v in BAD_H),
    *((f"d-{k}", lambda v=v: js.Gaussian(h=1.0, d=v), r"\bd:", "positive") for k, v in BAD_H),
    ("h-2d", lambda: js.Wendland(h=np.ones((3, 3)), d=2.0), r"\bh:", r"scalar or an \(N,\)"),
    ("h-one-negative", lambda: js.CubicSpline(h=np.array([1.0, -1.0]), d=2.0), r"\bh:", "positive"),
    ("h-empty", lambda: js.Constant(h=np.zeros(0), d=2.0), r"\bh:", r"scalar or an \(N,\)"),
    ("d-array", lambda: js.Constant(h=1.0, d=np.ones(3)), r"\bd:", "a scalar"),
    ("profile-number", lambda: js.Kernel(3.0, 1.0, 2.0), "profile:", "function"),
    ("profile-kernel", lambda: js.Kernel(KERNEL, 1.0, 2.0), "profile:", "function"),
    ("replace-unknown", lambda: KERNEL.replace(radius=2.0), "radius:", "'h', 'd'"),
    ("replace-negative-h", lambda: KERNEL.replace(h=-2.0), r"\bh:", "positive"),
    ("replace-nan-d", lambda: KERNEL.replace(d=NAN), r"\bd:", "positive"),
    ("h-length", solve(kernel=js.SuperGaussian(h=np.full(8, 0.125), d=3.0)), r"kernel.*\bh\b", r"\(9,\)"),
    ("h-length-1", solve(kernel=js.SuperGaussian(h=np.full(1, 0.125), d=3.0)), r"kernel.*\bh\b", r"\(9,\)"),
    ("profile-shape", lambda: js.Kernel(lambda r: jnp.stack([r, r]), 0.125, 3.0), "profile", "scalar"),
    ("profile-arguments", lambda: js.Kernel(lambda: 1.0, 0.125, 3.0), "profile", "scaled distance"),
    ("normalization-dim", lambda: KERNEL.normalization(4), "dim", "1, 2 or 3"),
]

STENCILS = [
    ("neither", lambda: js.stencils(LINE), "stencils:", "either size or radius"),
    ("both", lambda: js.stencils(LINE, size=5, radius=1.0), "stencils:", "either size or radius"),
    ("size-one", lambda: js.stencils(LINE, size=1), "size:", "at least 2"),
    ("size-negative", lambda: js.stencils(LINE, size=-5), "size:", "at least 2"),
    ("size-fraction", lambda: js.stencils(LINE, size=2.5), "size:", "whole number"),
    ("size-nan", lambda: js.stencils(LINE, size=NAN), "size:", "whole number"),
    ("size-text", lambda: js.stencils(LINE, size="many"), "size:", "whole number"),
    ("size-array", lambda: js.stencils(LINE, size=np.array([3, 4])), "size:", "whole number"),
    ("size-bool", lambda: js.stencils(LINE, size=True), "size:", "whole number"),
    ("size-beyond-cloud", lambda: js.stencils(LINE, size=10), "size:", "add particles"),
    ("radius-zero", lambda: js.stencils(LINE, radius=0.0), "radius:", "positive"),
    ("radius-negative", lambda: js.stencils(LINE, radius=-1.0), "radius:", "positive"),
    ("radius-nan", lambda: js.stencils(LINE, radius=NAN), "radius:", "positive"),
    ("radius-text", lambda: js.stencils(LINE, radius="wide"), "radius:", "positive"),
    ("radius-shape", lambda: js.stencils(LINE, radius=np.ones(8)), "radius:", r"\(9,\)"),
    ("cloud-array", lambda: js.stencils(LINE.points, size=5), "cloud:", "js.Cloud"),
    ("cloud-traced", lambda: jax.jit(lambda x: js.stencils(LINE.replace(points=x), size=5))(LINE.points), "cloud:",
     "before the transform"),
    ("of-another-cloud", solve(stencils=js.stencils(js.interval(0, 1, 8), size=5)), "stencils:", "build them again"),
    ("bare-array", solve(stencils=np.zeros((9, 5), int)), "stencils:", "js.stencils"),
    ("too-few", solve(stencils=js.stencils(LINE, radius=0.05), order=4), "stencils|neighbours", "larger|more|lower"),
]

PROBLEMS = [
    ("component-of-a-function", lambda: js.solve(js.Problem(
        lambda u, x: js.laplacian(u)(x) + js.laplacian(poisson[0])(x), ENDS), LINE), "pde:",
     r"js.laplacian\(u\)\(x\)\[k\]"),
    ("dtype-number", lambda: js.Problem(poisson, ENDS, dtype=np.float32(0.3)), "dtype:", "float or complex"),
    ("pde-None", lambda: js.Problem(None, ENDS), "pde:", "function"),
    ("pde-number", lambda: js.Problem(1.0, ENDS), "pde:", "function"),
    ("bcs-None", lambda: js.Problem(poisson, None), "bcs:", "dict"),
    ("bcs-list", lambda: js.Problem(poisson, [js.dirichlet(0.0)]), "bcs:", "dict"),
    ("bcs-number", lambda: js.Problem(poisson, {"left": 1.0}), r"bcs\['left'\]", "js.dirichlet"),
    ("bcs-None-value", lambda: js.Problem(poisson, {"left": None}), r"bcs\['left'\]", "js.dirichlet"),
    ("bcs-function", lambda: js.Problem(poisson, {"left": poisson}), r"bcs\['left'\]", "js.dirichlet"),
    ("bcs-uncalled", lambda: js.Problem(poisson, {"left": js.dirichlet}), r"bcs\['left'\]", "js.dirichlet"),
    ("bcs-empty-list", lambda: js.Problem(poisson, {"left": []}), r"bcs\['left'\]", "give one"),
    ("bcs-key", lambda: js.Problem(poisson, {3: js.dirichlet(0.0)}), r"bcs.*3", "name"),
    ("fields-zero", lambda: js.Problem(poisson, ENDS, fields=0), "fields:", "number of unknown fields"),
    ("fields-fraction", lambda: js.Problem(poisson, ENDS, fields=1.5), "fields:", "number of unknown fields"),
    ("fields-bool", lambda: js.Problem(poisson, ENDS, fields=True), "fields:", "number of unknown fields"),
    ("fields-text", lambda: js.Problem(poisson, ENDS, fields="two"), "fields:", "number of unknown fields"),
    ("fields-beyond-all", lambda: js.Problem(poisson, ENDS, fields=10**400), "fields:", "999"),
    *((f"sources-{s}", lambda s=s: js.Problem(poisson, ENDS, sources=s), r"sources\b", "js.point_source")
      for s in (None, 3.0, "ab")),
    ("point-source-beyond-all", lambda: js.point_source((10**400,)), "x0:", "one point"),
    ("params-text", lambda: js.Problem(poisson, ENDS, params={"k": "big"}), r"params.*k", "number"),
    ("params-nan", lambda: js.Problem(poisson, ENDS, params={"k": NAN}), r"params.*k", "finite"),
    ("field-beyond", lambda: js.Problem(poisson, {"left": js.dirichlet(0.0, field=1)}), "field=1", "fields 0 to 0"),
    ("replace-unknown", lambda: js.Problem(poisson, ENDS).replace(param=1.0), "param:", "params"),
    ("replace-bad-bcs", lambda: js.Problem(poisson, ENDS).replace(bcs=0), "bcs:", "dict"),
]

BAD_VALUES = [("nan", NAN), ("inf", INF), ("text", "a"), ("None", None),
              ("ragged", [[1.0], [1.0, 2.0]]), ("bool", True), ("nan-in-array", np.array([0.0, NAN]))]  # fmt: skip
NUMBERS = "number|finite"
CONDITIONS = [
    *((f"dirichlet-{k}", lambda v=v: js.dirichlet(v), "value:", NUMBERS) for k, v in BAD_VALUES),
    *((f"neumann-{k}", lambda v=v: js.neumann(v), "value:", NUMBERS) for k, v in BAD_VALUES),
    *((f"robin-a-{k}", lambda v=v: js.robin(v, 1.0, 0.0), r"\ba:", NUMBERS) for k, v in BAD_VALUES),
    *((f"robin-b-{k}", lambda v=v: js.robin(1.0, v, 0.0), r"\bb:", NUMBERS) for k, v in BAD_VALUES),
    *((f"robin-value-{k}", lambda v=v: js.robin(1.0, 1.0, v), "value:", NUMBERS) for k, v in BAD_VALUES),
    ("complex-values", lambda: js.Problem(poisson, {**ENDS, "left": js.neumann(1j)}),
     r"bcs\['left'\]", "dtype=complex"),
    ("complex-factor", lambda: js.Problem(poisson, {**ENDS, "left": js.robin(1j, 1.0, 0.0)}),
     r"\ba of", "dtype=complex"),
    ("robin-nothing", lambda: js.robin(0.0, 0.0, 1.0), r"\ba\b.*\bb\b", "js.free|not both"),
    ("field-negative", lambda: js.dirichlet(0.0, field=-1), "field:", "number of a field"),
    ("field-fraction", lambda: js.neumann(0.0, field=0.5), "field:", "number of a field"),
    ("field-text", lambda: js.robin(1.0, 1.0, 0.0, field="u"), "field:", "number of a field"),
    ("condition-number", lambda: js.condition(1.0), "residual:", "function"),
    ("periodic-same", lambda: js.periodic("left", "left"), "periodic:", "two different"),
    ("periodic-numbers", lambda: js.periodic(0, 1), "periodic:", "names"),
    ("fix-nothing", lambda: js.fix([], 0.0), "indices:", "particle numbers"),
    ("fix-floats", lambda: js.fix([0.5], 0.0), "indices:", "particle numbers"),
    ("fix-2d", lambda: js.fix([[1, 2]], 0.0), "indices:", "particle numbers"),
    ("fix-mask", lambda: js.fix(np.array([True, False]), 0.0), "indices:", "particle numbers"),
    ("fix-negative", lambda: js.fix([-1], 0.0), "indices:", "from 0"),
    ("fix-twice", lambda: js.fix([1, 1], 0.0), "indices:", "once"),
    ("fix-nan", lambda: js.fix([1], NAN), "value:", NUMBERS),
]

ON_A_CLOUD = [
    ("missing", solve(bcs={"left": js.dirichlet(0.0)}), r"bcs.*'right'", "give each|js.free"),
    ("none", solve(bcs={}), r"bcs.*'left'.*'right'", "give each|js.free"),
    ("superfluous", solve(bcs={**ENDS, "top": js.dirichlet(0.0)}), "bcs.*'top'", "it has.*'left', 'right'"),
    ("misspelt", solve(bcs={"left": js.dirichlet(0.0), "rigth": js.dirichlet(0.0)}), "bcs.*'rig", "'left', 'right'"),
    ("interior", solve(bcs={**ENDS, "interior": js.dirichlet(0.0)}), "bcs.*interior", "js.fix"),
    ("two-values", ends(left=[js.dirichlet(0.0), js.dirichlet(1.0)]), r"bcs\['left'\]", "remove"),
    ("value-and-robin-value", ends(left=[js.dirichlet(0.0), js.condition(lambda u, x, n: u(x))]), r"bcs\['left'\]",
     "remove"),
    ("value-and-slope", ends(left=[js.dirichlet(0.0), js.neumann(1.0)]), r"bcs\['left'\]: 2 conditions", "remove some"),
    ("three-at-a-start", ends(left=[js.dirichlet(0.0), js.neumann(1.0), js.robin(1.0, 1.0, 1.0)], right=js.free()),
     r"bcs\['left'\]: 3 conditions", "remove some"),
    ("clamped-and-more", solve(
        pde=lambda u, x: js.laplacian(js.laplacian(u))(x),
        bcs=dict.fromkeys(
            ENDS, [js.dirichlet(0.0), js.neumann(0.0), js.condition(lambda u, x, n: js.laplacian(u)(x))])),
     r"bcs\['left'\]: 3 conditions", "order 4 takes 2"),
    ("too-few-for-a-beam", solve(pde=lambda u, x: js.laplacian(js.laplacian(u))(x) - 1.0), r"bcs\['left'\].*1 cond",
     "2 on every side.*neumann"),
    ("too-few-for-a-plate", solve(pde=lambda u, x: js.laplacian(js.laplacian(u))(x) - 1.0, cloud=SQUARE, bcs={
        **dict.fromkeys(("right", "bottom", "top"), [js.dirichlet(0.0), js.neumann(0.0)]), "left": js.dirichlet(0.0)}),
     r"bcs\['left'\].*1 cond", "2 on every side.*neumann"),
    ("function-complex", ends(left=js.dirichlet(lambda x: 1j * x[0])), r"bcs\['left'\].value", "real numbers"),
    ("array-length", ends(left=js.dirichlet(np.zeros(2))), r"bcs\['left'\].value", r"scalar or \(1,\)"),
    ("array-2d", ends(left=js.dirichlet(np.zeros((1, 1)))), r"bcs\['left'\].value", r"scalar or \(1,\)"),
    ("array-neumann", ends(left=js.neumann(np.zeros(2))), r"bcs\['left'\].value", r"scalar or \(1,\)"),
    ("array-robin", ends(left=js.robin(np.ones(2), 1.0, 0.0)), r"bcs\['left'\].a", r"scalar or \(1,\)"),
    ("function-shape", ends(left=js.dirichlet(lambda x: jnp.stack([x, x]))), r"bcs\['left'\].value", "scalar"),
    ("function-None", ends(left=js.dirichlet(lambda x: None)), r"bcs\['left'\].value", "scalar"),
    ("function-text", ends(left=js.dirichlet(lambda x: "hot")), r"bcs\['left'\].value", "scalar"),
    ("function-nan", ends(left=js.dirichlet(lambda x: jnp.log(x[0] - 1))), r"bcs\['left'\].value", "finite|NaN"),
    ("function-inf", ends(left=js.neumann(lambda x: 1.0 / x[0])), r"bcs\['left'\].value", "finite|infinity"),
    ("function-arguments", ends(left=js.dirichlet(lambda x, t: t)), r"bcs\['left'\].value", "function of"),
    ("no-normals", ends(left=js.neumann(0.0), cloud=BARE), r"bcs\['left'\]", "normals="),
    ("no-normals-robin", ends(left=js.robin(1.0, 1.0, 0.0), cloud=BARE), r"bcs\['left'\]", "normals="),
    ("nan-normals", ends(left=js.neumann(0.0), cloud=shifted([NAN, 1.0])), r"bcs\['left'\]", "unit outward normal"),
    ("condition-ignores-u", ends(left=js.condition(lambda u, x, n: x[0])), r"bcs\['left'\]", "involve the solution"),
    ("condition-too-high", ends(left=js.condition(lambda u, x, n: js.laplacian(u)(x))), r"bcs\['left'\]", "lower"),
    ("condition-matrix", ends(left=js.condition(lambda u, x, n: u(x) * jnp.ones((2, 2)))), r"bcs\['left'\]",
     "scalar|vector"),
    ("condition-None", ends(left=js.condition(lambda u, x, n: None)), r"bcs\['left'\]", "scalar|return"),
    ("condition-arguments", ends(left=js.condition(lambda u, x: u(x))), r"bcs\['left'\]", r"residual\(u, x, n"),
    ("condition-elsewhere", ends(left=js.condition(lambda u, x, n: u(x + n))), r"bcs\['left'\]|field u",
     r"at the point x|\bx\b"),
    ("condition-nan", ends(left=js.condition(lambda u, x, n: js.grad(u)(x)[0] + jnp.log(-1 - x[0]))), r"bcs\['left'\]",
     "finite|NaN"),
    ("fix-beyond", solve(bcs={**ENDS, "pin": js.fix([9], 0.0)}), r"bcs\['pin'\]", "has 9"),
    ("fix-boundary-again", solve(bcs={**ENDS, "pin": js.fix([0], 0.0)}), r"bcs\['pin'\]", "remove"),
    ("periodic-unknown", solve(bcs={"left": js.periodic("left", "top")}), "bcs.*'top'", "'left', 'right'"),
    ("periodic-and-more", solve(bcs={"left": js.periodic("left", "right"), "right": js.dirichlet(0.0)}), "bcs.*'right'",
     "remove"),
    ("periodic-incongruent", lambda: js.solve(
        js.Problem(poisson, {"left": js.periodic("left", "bottom"), "right": js.free(), "top": js.dirichlet(0.0)}),
        SQUARE), "periodic|bcs", "translation|congruent"),
]

SOLVE = [
    ("problem-function", lambda: js.solve(poisson, LINE), "problem:", "js.Problem"),
    ("problem-None", lambda: js.solve(None, LINE), "problem:", "js.Problem"),
    ("swapped", lambda: js.solve(LINE, js.Problem(poisson, ENDS)), "problem:", "js.Problem"),
    ("cloud-array", lambda: js.solve(js.Problem(poisson, ENDS), LINE.points), "cloud:", "js.Cloud"),
    ("method-unknown", solve(method="IV"), "method:", "'III'"),
    ("method-lower", solve(method="ssph"), "method:", "'SSPH'"),
    ("method-None", solve(method=None), "method:", "'SSPH'"),
    ("method-number", solve(method=3), "method:", "'III'"),
    ("method-list", solve(method=["S"]), "method:", "'S'"),
    ("order-zero", solve(order=0), "order:", "whole number"),
    ("order-negative", solve(order=-2), "order:", "whole number"),
    ("order-huge", solve(order=100), "order:", r"1 to \d+"),
    ("order-float", solve(order=4.0), "order:", "whole number"),
    ("order-bool", solve(order=True), "order:", "whole number"),
    ("order-None", solve(order=None), "order:", "whole number"),
    ("order-text", solve(order="4"), "order:", "whole number"),
    ("order-of-estimate", lambda: solve(cloud=js.interval(0, 1, 41), order=13)().error_estimate(), "error_estimate:",
     "order 12"),
    ("order-below-operator", solve(order=1), "order:", "order=2"),
    ("order-below-biharmonic", solve(pde=lambda u, x: js.laplacian(js.laplacian(u))(x), order=3), "order:", "order=4"),
    ("order-beyond-cloud", solve(cloud=js.interval(0, 1, 4), order=8, method="SSPH"), "cloud:|stencils|neighbours",
     "lower the order"),
    ("kernel-number", solve(kernel=0.1), "kernel:", "js.SuperGaussian"),
    ("kernel-function", solve(kernel=lambda r: r), "kernel:", "js.Kernel"),
    ("kernel-class", solve(kernel=js.SuperGaussian), "kernel:", "js.SuperGaussian"),
    ("kernel-name", solve(kernel="gauss"), "kernel:", "js.SuperGaussian"),
    ("basis_terms-with-S", solve(basis_terms=2), "basis_terms:", "I, II and III"),
    ("basis_terms-zero", solve(method="III", basis_terms=0), "basis_terms:", "1 to 2"),
    ("basis_terms-many", solve(method="III", basis_terms=9), "basis_terms:", "1 to 2"),
    ("basis_terms-float", solve(method="III", basis_terms=1.5), "basis_terms:", "1 to 2"),
    ("basis_terms-text", solve(method="III", basis_terms="two"), "basis_terms:", "1 to 2"),
    ("formulation", solve(formulation="galerkin"), "formulation:", "'loo'"),
    ("formulation-None", solve(formulation=None), "formulation:", "'loo'"),
    ("solver", solve(solver="lu"), "solver:", "'sparse'"),
    ("solver-None", solve(solver=None), "solver:", "'sparse'"),
    ("u0-shape", solve(u0=np.zeros(8)), "u0:", r"\(9,\)"),
    ("u0-nan", solve(u0=np.full(9, NAN)), "u0:", "finite"),
    ("u0-complex", solve(u0=1j * np.ones(9)), "u0:", "array|function"),
    ("u0-text", solve(u0="zero"), "u0:", "array|function"),
    *((f"{name}-array", solve(**{name: np.zeros((2, 2))}), f"{name}:", "is none of") for name in
      ("method", "formulation", "solver")),
    ("u0-empty-dict", solve(u0={}), "u0:", "regions"),
    ("u0-text", solve(u0=["1"] * 9), "u0:", "function of x"),
    ("depth-span", solve(depth=np.timedelta64(2)), "depth:", "whole number"),
    ("throw-text", solve(throw="no"), "throw:", "True or False"),
    ("method-I-for-a-system", solve(
        pde=lambda u, x: js.laplacian(u)(x), fields=2, method="I"), "method:", 'method="S"'),
    ("constant-kernel-III", solve(method="III", kernel=js.Constant(0.125, 3.0)), "kernel|method",
     "another kernel|derivative"),
    ("support-of-one", solve(kernel=js.SuperGaussian(h=0.01, d=2.0)), "kernel", "larger|increase"),
    ("support-too-small", solve(kernel=js.SuperGaussian(h=0.07, d=2.0), order=4, method="SSPH"), "kernel",
     "larger|increase"),
    ("no-unknowns", lambda: js.solve(js.Problem(
        poisson, dict.fromkeys(("left", "right", "bottom", "top"), js.dirichlet(0.0))),
        js.rectangle((0, 0), (1, 1), (2, 2)), order=2), "cloud:", "add particles"),
    ("no-pure-derivative", lambda: js.solve(js.Problem(
        lambda u, x: js.partial(u, (1, 1))(x), dict.fromkeys(("left", "right", "bottom", "top"), js.dirichlet(0.0))),
        SQUARE, method="III", kernel=js.SuperGaussian(0.25, 3.0)), "method:", 'method="S"'),
]

RESIDUALS = [
    ("vector", residual(lambda u, x: jnp.ones(2) * u(x)), "pde:", "F residuals|fields"),
    ("gradient", residual(lambda u, x: js.grad(u)(x), cloud=SQUARE), "pde:", "F residuals|fields"),
    ("matrix", residual(lambda u, x: js.hessian(u)(x)), "pde", "scalar"),
    ("None", residual(lambda u, x: None), "pde|residual", "scalar|return"),
    ("text", residual(lambda u, x: "zero"), "pde|residual", "scalar|number"),
    ("complex", residual(lambda u, x: 1j * js.laplacian(u)(x)), "pde|residual|complex", "real"),
    ("integer", residual(lambda u, x: 3), "pde", r"u\(x\)"),
    ("ignores-u", residual(lambda u, x: x[0] ** 2), "pde", r"u\(x\)"),
    ("cancels-u", residual(lambda u, x: u(x) - u(x)), "pde", r"u\(x\)"),
    ("unevaluated", residual(lambda u, x: js.laplacian(u)), "pde|residual|field", r"\(x\)"),
    ("field-plus-number", residual(lambda u, x: js.laplacian(u) + 1.0), "field", "evaluate it"),
    ("operator-of-number", residual(lambda u, x: js.laplacian(u(x))), "operator|field", r"js.grad\(u\)\(x\)"),
    ("elsewhere", residual(lambda u, x: u(2.0 * x)), "field u|pde", r"\bx\b"),
    ("shifted", residual(lambda u, x: js.laplacian(u)(x) - u(x + 0.1)), "field u|pde", r"\bx\b"),
    ("at-the-origin", residual(lambda u, x: js.laplacian(u)(x) - u(jnp.zeros(1))), "field u|pde", r"\bx\b"),
    ("at-a-coordinate", residual(lambda u, x: u(x[0])), "field|shape", "pass the x"),
    ("at-a-batch", residual(lambda u, x: jax.vmap(u)(jnp.stack([x, x])).sum()), "field u", "one point"),
    ("divergence-of-scalar", residual(lambda u, x: js.divergence(u)(x)), r"\bv\b", r"grad\(u\)"),
    ("divergence-length", residual(lambda u, x: js.divergence(lambda y: jnp.ones(3) * u(y))(x)), r"\bv\b",
     "1 components"),
    ("partial-length", residual(lambda u, x: js.partial(u, (1, 1))(x)), "multi_index", "1 non-negative"),
    ("partial-negative", residual(lambda u, x: js.partial(u, (-1,))(x)), "multi_index", "non-negative"),
    ("one-argument", residual(lambda u: u), "pde", r"pde\(u, x"),
    ("three-arguments", residual(lambda u, x, p: u(x)), "pde", "params"),
    ("params-not-taken", residual(poisson, params={"k": 1.0}), "pde", "params"),
    ("coordinate-beyond", residual(lambda u, x: js.laplacian(u)(x) - x[1]), "x|pde", "1|bounds"),
    ("fields-unused", residual(lambda u, x: jnp.stack([js.laplacian(u[0])(x), u[0](x)]), fields=2), "pde.*field 1",
     "use it|lower"),
    ("too-few-equations", residual(lambda u, x: js.laplacian(u[0])(x) + u[1](x), fields=2), "pde", "2|F residuals"),
    ("field-beyond-in-a-system", residual(lambda u, x: jnp.stack([u[0](x), u[2](x)]), fields=2), "pde.*index 2",
     "bounds"),
    ("huge-operator", residual(lambda u, x: 1e300 * js.laplacian(u)(x) - 1.0), "pde.*1e.300", "divide the equation"),
    ("python-float", residual(lambda u, x: js.laplacian(u)(x) - float(x[0])), "pde", "float"),
    ("callback", residual(lambda u, x: js.laplacian(u)(x) - jax.pure_callback(
        np.sin, jax.ShapeDtypeStruct((), x.dtype), x[0])), "pde|primitive", "no Taylor expansion"),
    ("random-key", residual(lambda u, x: js.laplacian(u)(x) - jax.random.normal(jax.random.key(0), (3,))[0]),
     "pde.*random keys", "draw the numbers before"),
    ("random-key-in-a-condition", ends(left=js.dirichlet(lambda x: jax.random.normal(jax.random.PRNGKey(0), ()))),
     r"bcs\['left'\].value.*random keys", "draw the numbers before"),
    ("nan-source", residual(lambda u, x: js.laplacian(u)(x) - jnp.log(x[0] - 0.3)), "pde", "finite|NaN"),
    ("singular-source", residual(lambda u, x: js.laplacian(u)(x) - 1.0 / (x[0] - 0.5)), "pde", "finite|NaN"),
    ("nan-coefficient", residual(lambda u, x: jnp.sqrt(x[0] - 0.3) * js.laplacian(u)(x)), "pde", "finite|NaN"),
    ("zero-coefficient", residual(lambda u, x: 0.0 * js.laplacian(u)(x) + x[0]), "pde", r"u\(x\)"),
]

FLOW = js.Solution(np.zeros((25, 1)), SQUARE, Recipe("S", 2, None, "auto", 1), None, True, 1, {},
                   fitted=np.zeros((25, 1, 6)))  # fmt: skip
EVALUATION = [
    ("blend-text", evaluate(lambda sol: sol([[0.5]], blend="no")), "blend:", "True or False"),
    ("picture-field", evaluate(lambda sol: js.plot.solution(sol, field=1)), "field:", "one field 0"),
    ("picture-exact", evaluate(lambda sol: js.plot.solution(sol, exact=3.0)), "exact:", "function of one point"),
    ("picture-log", lambda: js.plot.values(LINE, np.ones(9), log="no"), "log:", "True or False"),
    ("picture-colorbar", lambda: js.plot.values(SQUARE, np.ones(25), colorbar="no"), "colorbar:", "True or False"),
    ("picture-levels", lambda: js.plot.values(SQUARE, np.ones(25), levels=10**400), "levels:", "such as 20"),
    ("picture-names", evaluate(lambda sol: js.plot.fields(sol, names=3)), "names:", "in a list"),
    ("picture-exact-fails", evaluate(lambda sol: js.plot.error(sol, lambda: 1.0)), "exact:", "one point x"),
    ("tuned", lambda: js.tune(js.Problem(poisson, ENDS), LINE, KERNEL, parameters=3), "parameters:", "'h', 'd', in a"),
    ("tuned-from", lambda: js.tune(js.Problem(poisson, ENDS), LINE, KERNEL, u0="a"), "u0:", "a function of x"),
    ("stages", lambda: js.continuation(lambda: None, LINE, [1.0, 2.0]), "problem:", "the parameter alone"),
    ("flat", evaluate(lambda s: s(np.zeros(3))), "points:", r"\(M, 1\)"),
    ("scalar", evaluate(lambda s: s(0.5)), "points:", r"\(M, 1\)"),
    ("dimension", evaluate(lambda s: s(np.zeros((3, 2)))), "points:", r"\(M, 1\)"),
    ("nan", evaluate(lambda s: s(np.array([[NAN]]))), "points:", "finite"),
    ("inf", evaluate(lambda s: s.grad(np.array([[INF]]))), "points:", "finite"),
    ("text", evaluate(lambda s: s([["a"]])), "points:", r"\(M, 1\)|number"),
    ("complex", evaluate(lambda s: s(np.array([[1j]]))), "points:", "real"),
    ("conductivity-text", lambda: FLOW.flux("left", "steel"), "conductivity:", "number or a function"),
    ("derivative-length", evaluate(lambda s: s.derivative([[0.5]], (1, 0))), "multi_index", "1 non-negative"),
    ("derivative-high", evaluate(lambda s: s.derivative([[0.5]], (3,))), "multi_index", "at most 2|sum"),
    ("derivative-negative", evaluate(lambda s: s.derivative([[0.5]], (-1,))), "multi_index", "non-negative"),
    ("multi_indices-dim", lambda: js.multi_indices(0, 2), "dim", "1|positive"),
    ("multi_indices-fraction", lambda: js.multi_indices(2, 1.5), "order|degree", "whole|integer"),
    *((f"multi_indices-dim-{k}", lambda d=d: js.multi_indices(d, 2), "dim:", "whole|axes")
      for k, d in enumerate(([1], NAN, 1e300, True, 10**400, np.ones(2)))),
    *((f"multi_indices-degree-{k}", lambda d=d: js.multi_indices(2, d), "degree:", "whole|lower")
      for k, d in enumerate(([1], NAN, 2.0, None, 10**400, np.ones(2)))),
    ("versions-to-a-name", lambda: js.show_versions("report.txt"), "file:", "open"),
    ("grad-of-number", lambda: js.grad(3.0), "operator", "function of the point"),
    ("laplacian-of-batch", lambda: js.laplacian(lambda x: x[0])(np.zeros((3, 2))), "x must", r"\(D,\)"),
]


def traced(function, at):
    return lambda: jax.grad(lambda v: jnp.sum(function(v)))(at)


def u_of(cloud=LINE, kernel=KERNEL):
    return js.solve(js.Problem(poisson, ENDS), cloud, kernel=kernel, solver="dense").u


TRACED = [
    ("h", traced(lambda h: u_of(kernel=KERNEL.replace(h=h)), 0.125), "stencils:.*h", r"js.stencils\(cloud"),
    ("d", traced(lambda d: u_of(kernel=KERNEL.replace(d=d)), 3.0), "stencils:.*d", r"js.stencils\(cloud"),
    ("points", traced(lambda x: u_of(LINE.replace(points=x)), LINE.points), "stencils:.*points", r"js.stencils\(cloud"),
    ("points-no-kernel", traced(lambda x: u_of(LINE.replace(points=x), None), LINE.points), "stencils:.*points",
     r"js.stencils\(cloud"),
    ("points-jit", lambda: jax.jit(lambda x: u_of(LINE.replace(points=x)))(LINE.points), "stencils:.*points",
     r"js.stencils\(cloud"),
    ("h-vmap", lambda: jax.vmap(lambda h: u_of(kernel=KERNEL.replace(h=h)))(np.array([0.125, 0.13])), "stencils:.*h",
     r"js.stencils\(cloud"),
]  # fmt: skip

TABLES = {
    "cloud": CLOUDS, "kernel": KERNELS, "stencils": STENCILS, "problem": PROBLEMS, "condition": CONDITIONS,
    "on-a-cloud": ON_A_CLOUD, "solve": SOLVE, "residual": RESIDUALS, "evaluation": EVALUATION, "traced": TRACED,
}  # fmt: skip
EVERY = [pytest.param(*entry[1:], id=f"{table}-{entry[0]}") for table, entries in TABLES.items() for entry in entries]


@pytest.mark.parametrize("call, argument, remedy", EVERY)
def test_the_message_names_the_argument_and_the_remedy(call, argument, remedy):
    with pytest.raises(ValueError) as caught:
        call()
    message = str(caught.value)
    assert re.search(argument, message, re.IGNORECASE | re.DOTALL), f"argument {argument!r} not named: {message}"
    assert re.search(remedy, message, re.IGNORECASE | re.DOTALL), f"remedy {remedy!r} not named: {message}"


def test_the_table_is_as_large_as_promised():
    assert len(EVERY) >= 200


# ------------------------------------------------------------------ solves that fail

FLAT = {"left": js.neumann(0.0), "right": js.neumann(0.0)}
SINGULAR = [
    ("incompatible-neumann", solve(bcs=FLAT), "incompatible|singular"),
    ("floating-part", solve(pde=lambda u, x: js.laplacian(u)(x) - 1.0, bcs={"left": js.free(), "right": js.free()}),
     "singular|condition"),
    ("outside-the-range", solve(pde=lambda u, x: js.laplacian(u)(x) - jnp.log(u(x)), u0=np.zeros(9)),
     "not finite at 7.*u0"),
    ("kernel-of-nan", solve(kernel=js.Kernel(lambda r: jnp.log(r - 10.0), 0.125, 3.0)),
     "moment systems|finite|profile"),
]  # fmt: skip


@pytest.mark.parametrize("call, words", [pytest.param(*e[1:], id=e[0]) for e in SINGULAR])
def test_a_singular_solve_raises(call, words):
    with pytest.raises((js.SolveError, ValueError), match=f"(?i){words}"):
        call()


def test_without_throw_a_failed_solve_says_so():
    sol = solve(bcs=FLAT, throw=False)()
    assert not sol.converged
    assert "not" in sol.diagnose().lower()


# ------------------------------------------------------------------ odd, but right

ODD = [
    ("integer-points", lambda: js.Cloud(np.arange(9)[:, None], {"interior": range(1, 8), "left": [0], "right": [8]})),
    ("list-points", lambda: js.Cloud(LINE.points.tolist(), {"interior": list(range(1, 8)), "left": [0], "right": [8]})),
    ("jax-points", lambda: js.Cloud(jnp.asarray(LINE.points), LINE.groups, jnp.asarray(LINE.normals))),
    ("fortran-order", lambda: js.Cloud(np.asfortranarray(LINE.points), LINE.groups)),
    ("read-only", lambda: js.Cloud(np.broadcast_to(LINE.points, LINE.points.shape), LINE.groups)),
    ("descending", lambda: js.Cloud(LINE.points[::-1], {"interior": np.arange(1, 8), "left": [8], "right": [0]})),
]


@pytest.mark.parametrize("make", [pytest.param(e[1], id=e[0]) for e in ODD])
def test_odd_but_sound_clouds_give_the_right_answer(make):
    """u'' = 1 with u = 0 and 1 at the ends of [0, L]: a parabola, exact at order 4 up to round-off."""
    made = make()
    x, length = made.points[:, 0], float(made.points.max())
    sol = js.solve(js.Problem(poisson, ENDS), made)
    assert np.abs(np.asarray(sol.u) - (x * (x - length) / 2 + x / length)).max() < 1e-12 * max(length**2, 1)


def test_a_cloud_keeps_its_own_copy():
    points = LINE.points.copy()
    made = js.Cloud(points, LINE.groups)
    points[:] = NAN
    assert np.isfinite(made.points).all()


# ------------------------------------------------------------------ residuals with no derivative, and other precisions

PARABOLA = lambda x: x * (x - 1.0) / 2.0 + x  # noqa: E731
STEPS = [
    ("round-of-x", lambda u, x: js.laplacian(u)(x) - 1.0 - 0.0 * x[0] - jnp.round(0.2 * x[0])),
    ("floor-of-x", lambda u, x: js.laplacian(u)(x) - 1.0 - jnp.floor(0.9 * x[0])),
    ("integer-of-x", lambda u, x: js.laplacian(u)(x) - 1.0 - (0.9 * x[0]).astype(int)),
    ("argmax", lambda u, x: js.laplacian(u)(x) - 1.0 - jnp.argmax(x)),
    ("round-of-u", lambda u, x: js.laplacian(u)(x) - 1.0 - jnp.round(0.2 * u(x))),
    ("integer-of-u", lambda u, x: js.laplacian(u)(x) - 1.0 - (0.9 * u(x)).astype(int)),
    ("sign-of-u", lambda u, x: js.laplacian(u)(x) - jnp.sign(u(x) + 1.0)),
    ("numpy-source", lambda u, x: js.laplacian(u)(x) - np.float32(1.0)),
]


@pytest.mark.parametrize("pde", [pytest.param(e[1], id=e[0]) for e in STEPS])
def test_a_residual_without_a_derivative_gives_the_right_answer(pde):
    """Each step is constant on the domain, so that u'' = 1, u(0) = 0, u(1) = 1."""
    sol = solve(pde=pde)()
    assert sol.converged and np.abs(sol.u - PARABOLA(LINE.points[:, 0])).max() < 1e-12


def test_only_a_step_of_u_does_not_depend_on_u():
    """Its derivative vanishes wherever there is one: nothing determines u."""
    with pytest.raises((ValueError, js.SolveError), match="(?s)not finite|depend|singular|determine"):
        solve(pde=lambda u, x: jnp.round(u(x)) - 1.0)()


@pytest.mark.parametrize("method", ["S", "III"])
def test_without_x64_the_answer_is_right_to_single_precision(method):
    with jax.enable_x64(False):
        sol = js.solve(js.Problem(poisson, ENDS), LINE, method=method, kernel=None if method == "S" else KERNEL)
        assert sol.converged and np.abs(np.asarray(sol.u) - PARABOLA(LINE.points[:, 0])).max() < 1e-4


def test_moment_systems_lost_to_float32_ask_for_float64():
    held = dict.fromkeys(("left", "right", "bottom", "top"), js.dirichlet(lambda x: x[0]))
    with jax.enable_x64(False):
        cloud = js.rectangle((0, 0), (1, 1), (13, 13), jitter=0.3)
        with pytest.raises(js.SolveError, match="do not determine.*enable float64 with"):
            js.solve(js.Problem(lambda u, x: js.laplacian(u)(x), held), cloud, order=11)


STACKED = {
    "values": lambda sol: sol([[0.3]]),
    "slopes": lambda sol: sol.grad([[0.3]]),
    "coefficients": lambda sol: sol.coefficients,
    "an estimate": lambda sol: sol.error_estimate(),
    "a flux": lambda sol: sol.flux("left"),
    "a diagnosis": lambda sol: sol.diagnose(),
    "flags": lambda sol: sol.flags,
    "a picture": lambda sol: js.plot.solution(sol),
    "a file": lambda sol: pickle.dumps(sol),
    "a table": lambda sol: js.files.to_pandas(sol),
}


@pytest.fixture(scope="module")
def stacked():
    bcs = {"left": js.dirichlet(0.0), "right": js.dirichlet(1.0)}
    problem = js.Problem(lambda u, x, s: js.laplacian(u)(x) - s, bcs, params=1.0)
    alone = lambda s: js.solve(problem.replace(params=s), js.interval(0.0, 1.0, 8))
    return alone, jax.vmap(alone)(np.array([1.0, 2.0]))


@pytest.mark.parametrize("asked", STACKED)
def test_a_stack_of_solutions_says_what_it_is(stacked, asked):
    pattern = "stack of 2 that came out of jax.vmap.*inside the mapped function, or take one"
    with pytest.raises(ValueError, match=pattern):
        STACKED[asked](stacked[1])


def test_one_of_a_stack_of_solutions_is_a_solution(stacked):
    """By the way the message names; round-off of two programs."""
    alone, several = stacked
    assert several.u.shape == (2, 8) and "u: 2x8" in repr(several)
    one, same = jax.tree.map(lambda x: x[1], several), alone(2.0)
    for ask in (lambda sol: sol.u, lambda sol: sol([[0.3]]), lambda sol: sol.error_estimate()):
        assert np.allclose(ask(one), ask(same), rtol=0, atol=1e-13)


def test_fields_of_a_system_left_out():
    """u(x)[1] of what is one field: the remedy is named."""
    pde = lambda u, x: [js.laplacian(u)(x)[0] - u(x)[1], js.laplacian(u)(x)[1]]
    with pytest.raises(ValueError, match=r"pde: .*fields=F"):
        js.solve(js.Problem(pde, {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}), js.interval(0.0, 1.0, 9))


@pytest.mark.parametrize(
    "call, words",
    [(lambda: js.solve(js.Problem(poisson, ENDS), LINE, oder=6), "oder: no argument of solve; did you mean 'order'"),
     (lambda: js.continuation(lambda k: js.Problem(poisson, ENDS), LINE, [1.0, 2.0], oder=6), "did you mean 'order'"),
     (lambda: js.Problem(poisson, bc=ENDS), "bc: no argument of Problem; did you mean 'bcs'"),
     (lambda: js.stencils(LINE, sise=5), "sise: .*it takes cloud, size, radius"),
     (lambda: js.SuperGaussian(d=3.0), "SuperGaussian: missing a required argument: 'h'; it takes h, d"),
     (lambda: js.dirichlet(1.0, 0, 3), "dirichlet: too many positional arguments; it takes value, field")],
)  # fmt: skip
def test_arguments_that_a_function_does_not_have(call, words):
    with pytest.raises(TypeError, match=words):
        call()


def test_the_users_own_wrong_call_is_left_as_it_is():
    with pytest.raises((TypeError, ValueError), match="theirs"):
        js.solve(js.Problem(lambda u, x: theirs(1, 2, 3), ENDS), LINE)


def theirs(a):
    return a
