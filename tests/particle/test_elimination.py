"""What all particles share of a constant operator is rounded once."""

import numpy as np

from jsmitsm.particle.elimination import _inverted


def test_the_pseudo_inverse_of_a_wide_matrix_is_rounded_once():
    """Rows of unit length, condition about 1e3: one factorisation alone is off by 3e-14 of the largest."""
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(40, 70)) * np.exp(-rng.uniform(0, 8, 70))
    matrix /= np.linalg.norm(matrix, axis=1)[:, None]
    inverse = _inverted(matrix).astype(np.longdouble)
    for _ in range(2):  # Newton's iteration in long double
        inverse = inverse + inverse @ (np.eye(40) - matrix.astype(np.longdouble) @ inverse)
    assert np.abs(_inverted(matrix) - inverse).max() < 3e-16 * np.abs(inverse).max()
