"""Other discretisations of a Poisson problem on given particles, as their users would write them.

Each takes points (N, D), a mask of the held boundary particles, and numbers at all particles: the
conductivity and its gradient, the source, the boundary values; each returns the values. Sparse
systems go to SciPy's SuperLU. A package that is not installed is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, identity, kron
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree


@dataclass
class Posed:
    """div(k grad u) = f with u = g where ``held``, as numbers.

    functions : from places (M, D) to source, conductivity and solution there.
    slope : mask of the particles with du/dy = 0 instead of the equation.
    """

    points: np.ndarray
    held: np.ndarray
    source: np.ndarray
    values: np.ndarray  # of the solution; only those at held particles may be used
    conductivity: np.ndarray
    gradient: np.ndarray  # of the conductivity, (N, D)
    functions: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
    cells: np.ndarray | None = None  # simplices, for the finite elements
    lattice: tuple[int, ...] = ()
    slope: np.ndarray | None = None
    formula: Callable[[Any], Any] | None = None  # the source at one place, for JAX


def _finish(posed: Posed, rows: csc_matrix, right: np.ndarray) -> np.ndarray:
    """Rows of all particles that are not held, (M, N) in their order; held values eliminated."""
    free = np.flatnonzero(~posed.held)
    u = np.where(posed.held, posed.values, 0.0)
    u[free] = splu(rows[:, free].tocsc()).solve(right - rows @ u)
    return u


def rbf(order: int) -> Callable[[Posed], np.ndarray]:
    """RBF-FD: polyharmonic splines with polynomials (package treverhines-rbf)."""
    from rbf.pde.fd import weight_matrix

    def run(posed: Posed) -> np.ndarray:
        x, free = posed.points, np.flatnonzero(~posed.held)
        dim = x.shape[1]
        second = [[2 * (k == m) for k in range(dim)] for m in range(dim)]
        first = [[int(k == m) for k in range(dim)] for m in range(dim)]
        n = min(2 * math.comb(order + dim, dim), len(x))
        plain = not posed.gradient.any()
        options = {"n": n, "phi": f"phs{min(order + 1, 7) | 1}", "order": order}
        if plain:
            rows = weight_matrix(x[free], x, diffs=second, **options)
        else:
            coeffs = [posed.conductivity[free]] * dim + list(posed.gradient[free].T)
            rows = weight_matrix(x[free], x, diffs=second + first, coeffs=coeffs, **options)
        right = posed.source[free].copy()
        if posed.slope is not None:
            at, rows = np.flatnonzero(posed.slope[free]), rows.tolil()
            rows[at] = weight_matrix(x[free[at]], x, diffs=[[0, 1]], **options)
            right[at] = 0.0
        return _finish(posed, rows.tocsc(), right)

    return run


def gfdm(posed: Posed) -> np.ndarray:
    """Generalised finite differences: weighted least squares of degree 4 about each particle, 25 neighbours in 2D."""
    x, free = posed.points, np.flatnonzero(~posed.held)
    dim = x.shape[1]
    powers = [a for a in np.ndindex(*(5,) * dim) if 0 < sum(a) <= 4]
    size = {2: 25, 3: 60}[dim]
    away, near = cKDTree(x).query(x[free], k=size)
    length = away[:, -1:]
    offset = (x[near[:, 1:]] - x[free][:, None]) / length[..., None]
    weight = np.exp(-4 * (away[:, 1:] / length) ** 2)
    p = np.stack([np.prod(offset ** np.array(a), axis=2) for a in powers], axis=2) * weight[..., None]
    fit = np.linalg.pinv(p) * weight[:, None]  # coefficients from differences of values
    row = 0.0
    for m in range(dim):
        two = powers.index(tuple(2 * (k == m) for k in range(dim)))
        one = powers.index(tuple(int(k == m) for k in range(dim)))
        row = row + posed.conductivity[free, None] * 2 * fit[:, two] / length**2
        row = row + posed.gradient[free, m : m + 1] * fit[:, one] / length
    right = posed.source[free].copy()
    if posed.slope is not None:
        at = posed.slope[free]
        row[at] = (fit[:, powers.index((0, 1))] / length)[at]
        right[at] = 0.0
    weights = np.concatenate([-row.sum(axis=1, keepdims=True), row], axis=1)
    place = np.repeat(np.arange(len(free)), size)
    return _finish(posed, coo_matrix((weights.ravel(), (place, near.ravel())), (len(free), len(x))).tocsc(), right)


def elements(degree: int) -> Callable[[Posed], np.ndarray]:
    """Finite elements of degree 1 or 2 on the triangles between the particles (package scikit-fem)."""
    import skfem
    from skfem.helpers import dot, grad
    from skfem.models.poisson import laplace

    def run(posed: Posed) -> np.ndarray:
        assert posed.cells is not None
        mesh = skfem.MeshTri(posed.points.T.copy(), posed.cells.T.copy())
        basis = skfem.Basis(mesh, skfem.ElementTriP1() if degree == 1 else skfem.ElementTriP2())
        places = basis.doflocs.T
        source, conductivity, exact = posed.functions(places)
        if posed.gradient.any():
            k = basis.interpolate(conductivity)
            stiff = skfem.BilinearForm(lambda u, v, w: w.k * dot(grad(u), grad(v))).assemble(basis, k=k)
        else:
            stiff = laplace.assemble(basis)
        load = skfem.LinearForm(lambda v, w: -w.f * v).assemble(basis, f=basis.interpolate(source))
        held = basis.get_dofs().all()
        if posed.slope is not None:  # nothing to do for du/dy = 0 at the bottom, corners excepted
            x, y = places[held].T
            held = held[(y > 0) | (x == x.min()) | (x == x.max())]
        u = np.where(np.isin(np.arange(basis.N), held), exact, 0.0)
        free = np.setdiff1d(np.arange(basis.N), held)
        u[free] = splu(stiff[free][:, free].tocsc()).solve((load - stiff @ u)[free])
        return u[basis.nodal_dofs[0]]

    return run


def compact(posed: Posed) -> np.ndarray:
    """The compact fourth-order 9-point stencil on a lattice (Mehrstellenverfahren), du/dy = 0 at the bottom."""
    nx, ny = posed.lattice
    h = float(posed.points[:, 0].max() / (nx - 1))
    ordered = np.lexsort((posed.points[:, 0], posed.points[:, 1]))
    f, u = (v[ordered].reshape(ny, nx) for v in (posed.source, posed.values))

    def band(n: int, outer: float, middle: float) -> Any:
        return identity(n) * middle + coo_matrix(
            (np.full(2 * n - 2, outer), (np.r_[: n - 1, 1:n], np.r_[1:n, : n - 1])), (n, n)
        )

    inner = nx - 2
    same, other = band(inner, 4.0, -20.0), band(inner, 1.0, 4.0)  # the row itself, and those above and below
    up = coo_matrix((np.ones(ny - 2), (np.arange(ny - 2), np.arange(1, ny - 1))), (ny - 1, ny - 1))
    down = up.T.tolil()
    down[0, 1] = 0.0
    down = down.tocoo()
    ghost = coo_matrix(([1.0], ([0], [1])), (ny - 1, ny - 1))  # below the bottom row: mirrored
    a = (kron(identity(ny - 1), same) + kron(up + down + ghost, other)) / (6 * h * h)
    # f + h^2/12 laplacian(f), the second derivatives across the bottom by reflection.
    wide = np.concatenate([f[1:2], f])
    lap = (wide[:-2, 1:-1] + wide[2:, 1:-1] + wide[1:-1, :-2] + wide[1:-1, 2:] - 4 * wide[1:-1, 1:-1]) / h**2
    right = f[:-1, 1:-1] + h * h / 12 * lap
    edge = np.concatenate([u[1:2], u])  # held values at the sides and on top
    for col, at in ((0, 0), (-1, -1)):
        right[:, at] -= (edge[:-2, col] + 4 * edge[1:-1, col] + edge[2:, col]) / (6 * h * h)
    right[-1] -= (4 * u[-1, 1:-1]) / (6 * h * h)
    right[-1] -= (u[-1, :-2] + u[-1, 2:]) / (6 * h * h)
    right[-1, 0] += u[-1, 0] / (6 * h * h)  # the corner was counted with the side
    right[-1, -1] += u[-1, -1] / (6 * h * h)
    out = u.copy()
    out[:-1, 1:-1] = splu(a.tocsc()).solve(right.ravel()).reshape(ny - 1, inner)
    result = np.empty(nx * ny)
    result[ordered] = out.ravel()
    return result


def differences(accuracy: int) -> Callable[[Posed], np.ndarray]:
    """Central differences on a lattice, one-sided at the bottom where du/dy = 0 (package findiff)."""
    from findiff import PDE, BoundaryConditions, FinDiff

    def run(posed: Posed) -> np.ndarray:
        nx, ny = posed.lattice
        x, y = posed.points.max(axis=0) / (nx - 1, ny - 1)
        ordered = np.lexsort((posed.points[:, 1], posed.points[:, 0]))
        f, u = (v[ordered].reshape(nx, ny) for v in (posed.source, posed.values))
        given = BoundaryConditions((nx, ny))
        given[:, 0] = FinDiff(1, y, 1, acc=accuracy), 0.0
        given[:, -1] = given[0, :] = given[-1, :] = u
        laplacian = FinDiff(0, x, 2, acc=accuracy) + FinDiff(1, y, 2, acc=accuracy)
        result = np.empty(nx * ny)
        result[ordered] = PDE(laplacian, f, given).solve().ravel()
        return result

    return run


def dense(power: int, degree: int) -> Callable[[Posed], np.ndarray]:
    """Collocation by r^power and polynomials over all particles, dense, in JAX (package updes).

    Its solver compiles anew for every cloud object. The first call makes the cloud and compiles;
    later calls at the same particles, to 1e-9 spacings, assemble and solve only.
    """
    import matplotlib

    with matplotlib.rc_context():  # it sets a dark style
        import updes
    kept: dict[int, Any] = {}

    def kernel(x, centre):
        return updes.polyharmonic(x, centre, a=(power - 1) // 2)

    def operator(x, centre, rbf, monomial, k):
        slope = updes.nodal_gradient(x, centre, rbf, monomial)
        return k[0] * updes.nodal_laplacian(x, centre, rbf, monomial) + k[1] * slope[0] + k[2] * slope[1]

    def run(posed: Posed) -> np.ndarray:
        if len(posed.points) not in kept:
            kept[len(posed.points)] = (_updes_cloud(posed), lambda x, centres, rbf, fields: posed.formula(x))
        cloud, source = kept[len(posed.points)]
        place = np.array([cloud.renumbering_map[i] for i in range(cloud.N)])
        own = np.argsort(place)
        sides = {side: np.where(posed.held, posed.values, 0.0)[own[nodes]] for side, nodes in cloud.facet_nodes.items()}
        k = [v[own] for v in (posed.conductivity, *posed.gradient.T)]
        return np.asarray(updes.pde_solver_jit(operator, source, cloud, sides, kernel, degree, diff_args=k).vals)[place]

    return run


def _updes_cloud(posed: Posed) -> Any:
    """Its own clouds are unit squares and Gmsh files; this one has the given particles."""
    import jax.numpy as jnp
    import updes

    free = np.zeros(len(posed.held), bool) if posed.slope is None else posed.slope & ~posed.held
    masks = {"d": posed.held, "n": free} if free.any() else {"d": posed.held}
    cloud = updes.Cloud({kind: kind for kind in masks})
    cloud.N = len(posed.points)
    cloud.nodes = dict(enumerate(jnp.asarray(posed.points)))
    cloud.facet_nodes = {kind: np.flatnonzero(mask).tolist() for kind, mask in masks.items()}
    cloud.node_types = {i: next((kind for kind in masks if masks[kind][i]), "i") for i in range(cloud.N)}
    cloud.Ni, cloud.Nd, cloud.Nn = (list(cloud.node_types.values()).count(kind) for kind in "idn")
    cloud.outward_normals = {i: jnp.array([0.0, -1.0]) for i in cloud.facet_nodes.get("n", [])}
    cloud.define_local_supports()
    cloud.renumber_nodes()
    cloud.sorted_nodes = cloud.sort_dict_by_keys(cloud.nodes)
    cloud.sorted_local_supports = cloud.sort_dict_by_keys(cloud.local_supports)
    if cloud.outward_normals:
        cloud.sorted_outward_normals = cloud.sort_dict_by_keys(cloud.outward_normals)
    return cloud
