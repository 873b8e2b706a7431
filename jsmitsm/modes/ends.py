"""What corners and changes of conditions make of eigenvalues where modes are singular there and no order sees it."""

from __future__ import annotations

import numpy as np

from jsmitsm.modes.question import Question
from jsmitsm.modes.spectrum import Pairs
from jsmitsm.particle.polynomials import monomials_on_host
from jsmitsm.solution.look.edges import singular
from jsmitsm.solution.look.reach import ENDED
from jsmitsm.solution.solution import Solution

# The error is so many times what misses add up to by way of the left vector. Measured on changes of conditions within a
# side and on corners of elastic bodies: by 1.0 it would be 0.1 to 0.4 times the error.
_TIMES = 2.5
# Neighbours within so many spacings tell what a polynomial is to reach; those so many times as far away as most of a
# row are images of others.
_NEAR, _IMAGE = 1.6, 4.0


def at_ends(question: Question, found: Pairs, k: int, sol: Solution) -> float:
    """By how much value k may be off for what polynomials leave of their neighbours beside singular ends.

    sol: the mode between the particles. A value that is predicted from its neighbours, as row i of A does it, misses

        d_i = sqrt(sum_j (A_ij (p_i(x_j) - v_j))^2),

    and of these the left vector y makes sum_i |y_i| d_i / y^T C v of the value.
    """
    disc = question.pencil.layout.disc
    points, fields = np.asarray(disc.cloud.points, float), disc.rec.fields
    values = np.asarray(sol.u, float).reshape(len(points), fields)
    fitted = np.asarray(sol.coefficients, float).reshape(len(points), -1, fields)
    a = question.pencil.A.host.tocoo()
    i, own, j, field = a.row // fields, a.row % fields, a.col // fields, a.col % fields
    offset = points[j] - points[i]
    far = np.linalg.norm(offset, axis=1)
    count = np.maximum(np.bincount(i[i != j], minlength=len(points)), 1)
    mean = np.bincount(i, far, len(points)) / count
    keep = (i != j) & (far < _IMAGE * np.minimum(mean, np.median(mean))[i])
    i, own, j, field, far, weight, offset = (x[keep] for x in (i, own, j, field, far, a.data, offset))
    terms = monomials_on_host(offset.T, sol.order + sol.depth)[: fitted.shape[1]]
    left = np.abs(np.einsum("nk,kn->n", fitted[i, :, field], terms) - values[j, field])
    nearest = np.full(len(points), np.inf)
    np.minimum.at(nearest, i, far)
    close = far < _NEAR * nearest[i]
    most, change = np.zeros(values.shape), np.zeros(values.shape)
    np.maximum.at(most, (i[close], field[close]), left[close])
    # All of the row: next to a crest the nearest hardly change.
    np.maximum.at(change, (i, field), np.abs(values[j, field] - values[i, field]))
    beside = singular(disc, most) & (most > ENDED * change)
    if not beside.any():
        return 0.0
    defects = np.zeros(values.shape)
    np.add.at(defects, (i, own), (weight * left) ** 2)
    y, v = np.abs(found.left[:, found.cluster == found.cluster[k]]).max(axis=1), values.ravel()[question.pencil.free]
    dual = found.left[:, k] @ (question.inert.host @ v)
    return float(_TIMES * y @ (np.sqrt(defects) * beside).ravel()[question.pencil.free] / abs(dual))
