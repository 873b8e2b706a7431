"""Runge-Kutta schemes as data: their coefficients, and nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np


@dataclass(frozen=True, eq=False)
class Sampling:
    """Where in a step data are looked at, and what the stages take of them.

    nodes (m,), the first 0, the last 1. stages: which of them the implicit stages are. blend (s, m): boundary data of
    the stages, those that the scheme itself would make of the data's rates: with the exact ones at a stage's own time
    its error would not fit them, and cost the order of the scheme near the boundary.
    """

    nodes: np.ndarray
    stages: np.ndarray
    blend: np.ndarray


def _sampling(matrix: np.ndarray, at: np.ndarray, nodes: np.ndarray, consistent: bool = True) -> Sampling:
    """matrix (s, r): the implicit stages from the rates at the nodes ``at`` (r,)."""
    powers = np.arange(len(nodes))
    rates = (powers * at[:, None] ** np.maximum(powers - 1, 0)) @ np.linalg.inv(nodes[:, None] ** powers)
    stages = np.array([int(np.argmin(abs(nodes - c))) for c in at[len(at) - len(matrix) :]])
    exact = np.eye(len(nodes))[stages]
    blend = matrix @ rates + np.eye(len(nodes))[0] if consistent else exact
    blend[-1] = exact[-1]
    return Sampling(nodes, stages, blend)


@dataclass(frozen=True, eq=False)
class Additive:
    """A scheme with an explicit first stage, one implicit coefficient, and an explicit companion.

    The last stage is the end of a step for the implicit half alone: the companion is not stiffly accurate. implicit,
    explicit (s, s); nodes (s,); weights (s,), of both halves; embedded (s,) or None, of one order less.
    """

    name: str
    order: int
    implicit: np.ndarray
    explicit: np.ndarray
    nodes: np.ndarray
    weights: np.ndarray
    embedded: np.ndarray | None

    def sampling(self, consistent: bool) -> Sampling:
        return _sampling(self.implicit[1:], self.nodes, self.nodes, consistent and self.stages > 2)

    @property
    def gamma(self) -> float:
        """The coefficient of every implicit stage."""
        return float(self.implicit[-1, -1])

    @property
    def stages(self) -> int:
        return len(self.nodes)

    @property
    def closing(self) -> np.ndarray:
        """What the end of a step takes of the explicit half (s,) beyond the last stage."""
        return self.weights - self.explicit[-1]


def _kencarp4() -> Additive:
    """ARK4(3)6L[2]SA of Kennedy and Carpenter, Appl. Numer. Math. 44 (2003) 139-181."""
    c = np.array([0, 1 / 2, 83 / 250, 31 / 50, 17 / 20, 1])
    b = np.array([82889 / 524892, 0, 15625 / 83664, 69875 / 102672, -2260 / 8211, 1 / 4])
    embedded = [4586570599 / 29645900160, 0, 178811875 / 945068544, 814220225 / 1159782912, -3700637 / 11593932,
                61727 / 225920]  # fmt: skip
    a, e = np.zeros((6, 6)), np.zeros((6, 6))
    np.fill_diagonal(a[1:, 1:], 1 / 4)
    a[1, 0] = 1 / 4
    a[2, :2] = 8611 / 62500, -1743 / 31250
    a[3, :3] = 5012029 / 34652500, -2922 / 441, 174375 / 388108
    a[4, :4] = 15267082809 / 155376265600, -71443401 / 120774400, 730878875 / 902184768, 2285395 / 8070912
    a[5] = b
    e[1, 0] = 1 / 2
    e[2, :2] = 13861 / 62500, 6889 / 62500
    e[3, :3] = -116923316275 / 2393684061468, -2731218467317 / 15368042101831, 9408046702089 / 11113171139209
    e[4, :4] = (-451086348788 / 2902428689909, -2682348792572 / 7519795681897, 12662868775082 / 11960479115383,
                3355817975965 / 11060851509271)  # fmt: skip
    e[5, :5] = (647845179188 / 3216320057751, 73281519250 / 8382639484533, 552539513391 / 3454668386233,
                3354512671639 / 8306763924573, 4040 / 17871)  # fmt: skip
    for k in range(1, 6):  # one coefficient of each row follows from its node, to the last digit
        at = 1 if k > 1 else 0
        a[k, at] += c[k] - a[k].sum()
        e[k, 0] += c[k] - e[k].sum()
    return Additive("KenCarp4", 4, a, e, c, b, np.array(embedded))


KENCARP4 = _kencarp4()
EULER = Additive(
    "backward Euler", 1, np.array([[0.0, 0.0], [0.0, 1.0]]), np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([0.0, 1.0]),
    np.array([0.0, 1.0]), None,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Radau:
    """Radau IIA of three stages and order 5, decoupled by the eigenvectors of the inverse of its matrix.

    inverse = vectors diag(values) vectors^-1, the first eigenvalue real, the others conjugate. lagrange, slopes (3, 3):
    values and rates, at ``places`` of a step, of the polynomial through its start (zero) and its stages; left (3, 3):
    from what that leaves over there the coefficients of 1, t, t^2 of q in (t - c_1)(t - c_2)(t - c_3) q.
    """

    matrix: np.ndarray
    nodes: np.ndarray
    values: np.ndarray
    vectors: np.ndarray
    back: np.ndarray
    places: np.ndarray
    lagrange: np.ndarray
    slopes: np.ndarray
    left: np.ndarray

    def sampling(self, consistent: bool) -> Sampling:
        if consistent:
            return _sampling(self.matrix, self.nodes, self._denser)
        return _sampling(self.matrix, self.nodes, np.concatenate([[0.0], self.nodes]), False)

    @cache  # noqa: B019 (there is one Radau)
    def between(self, consistent: bool) -> Sampling:
        """At the last two places, with the boundary data of the polynomial through those of the stages."""
        s = _sampling(self.matrix, self.nodes, self._denser, consistent)
        start = np.multiply.outer(1.0 - self.lagrange[1:].sum(axis=1), np.eye(len(s.nodes))[0])
        return Sampling(s.nodes, np.array([2, 4]), self.lagrange[1:] @ s.blend + start)

    @property
    def _denser(self) -> np.ndarray:
        a, b, c = self.nodes
        return np.array([0.0, a, (a + b) / 2, b, (b + c) / 2, c])


def _radau() -> Radau:
    r = np.sqrt(6.0)
    a = np.array([
        [(88 - 7 * r) / 360, (296 - 169 * r) / 1800, (-2 + 3 * r) / 225],
        [(296 + 169 * r) / 1800, (88 + 7 * r) / 360, (-2 - 3 * r) / 225],
        [(16 - r) / 36, (16 + r) / 36, 1 / 9],
    ])  # fmt: skip
    values, vectors = np.linalg.eig(np.linalg.inv(a))
    order = np.argsort(np.abs(values.imag) + (values.imag < 0))  # real, then the one above the axis, then below
    values, vectors = values[order], vectors[:, order]
    nodes = np.array([(4 - r) / 10, (4 + r) / 10, 1.0])
    places, k = np.array([0.0, nodes[:2].mean(), nodes[1:].mean()]), np.arange(1, 4)
    back = np.linalg.inv(nodes[:, None] ** k)
    lagrange, slopes = places[:, None] ** k @ back, (k * places[:, None] ** (k - 1)) @ back
    left = np.linalg.inv(places[:, None] ** (k - 1)) / np.prod(places[:, None] - nodes, axis=1)
    return Radau(a, nodes, values, vectors, np.linalg.inv(vectors), places, lagrange, slopes, left)


RADAU = _radau()
