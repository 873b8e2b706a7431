"""The numbers of A. Karamanli, "Different implementation approaches of the strong form meshless
implementation of Taylor series method" (2015), Tables 1 to 5, and why some do not come out.

Every error is a relative L2 norm in percent; the paper cuts digits instead of rounding. None:
the paper prints no solution.
"""

from __future__ import annotations

NODES = (5, 20, 100)
GRIDS = ((5, 10), (9, 19), (17, 37))

# Tables 1 to 4 by the number of terms; one entry per number of nodes.
RODS: dict[int, dict[str, tuple[float | None, ...]]] = {
    3: {
        "I": (None, 1.4129277, 0.15680171),
        "II": (1.0455434, 0.0542322, 0.0020706),
        "III": (1.0455434, 0.0542322, 0.0020706),
        "SSPH": (1.0455434, 0.0542322, 0.0020706),
    },
    4: {
        "I": (None, 0.05299339, 0.0020771),
        "II": (1.0455434, 0.0542322, 0.0020706),
        "III": (1.0455434, 0.0542322, 0.0020706),
        "SSPH": (1.0455434, 0.0542322, 0.0020706),
    },
    5: {
        "I": (None, 0.0019065, 1.6e-6),
        "II": (4.5e-14, 1.2e-11, 2.3e-9),
        "III": (3.1e-14, 4.9e-13, 3.6e-12),
        "SSPH": (0.1258686, 0.0001205, 3.6e-8),
    },
    6: {
        "I": (None, 2.4e-13, 3.9e-12),
        "II": (7.9e-14, 1.4e-11, 3.6e-9),
        "III": (7.8e-14, 3.3e-13, 3.6e-12),
        "SSPH": (None, 1.3e-9, 2.6e-9),
    },
}

# The support radius is 2, but SSPH needs more neighbours for five and six terms.
SSPH_SUPPORT = {3: 2.0, 4: 2.0, 5: 4.0, 6: 5.0}

# Table 5, six terms; one entry per grid.
PLATE: dict[str, tuple[float | None, ...]] = {
    "I": (3.7853, 2.1886, 1.2718),
    "II": (3.2134, 1.6750, 0.9927),
    "III": (3.7313, 1.9813, 1.0541),
    "SSPH": (8.4205, 4.3004, 2.3956),
}

# Figures 10 to 12: the largest smoothing length, in spacings, that the paper calls stable.
STABLE: dict[int, dict[str, float]] = {
    171: {"I": 2.0, "II": 2.0, "III": 2.0, "SSPH": 1.8},
    629: {"II": 2.2, "III": 2.2, "SSPH": 2.0},
}

# An entry below this is round-off, of whichever size; one at most ROUND_OFF reproduces it.
TINY = 1e-8
ROUND_OFF = 4e-9
TOLERANCE = 0.005


def reproduced(paper: float | None, here: float | None) -> bool:
    """Whether this run gives the paper's entry, round-off for round-off, none for none."""
    if paper is None or here is None:
        return paper is here
    return here <= ROUND_OFF if paper < TINY else abs(here / paper - 1) <= TOLERANCE


_ROD_I = (
    "I: the rows of I as printed determine no constant, and the paper's entries up to 5 terms are the round-off of "
    "that singular system (none at 5 nodes); closed in two stages the method has an answer at every size."
)

WHY_RODS = {
    (3, "I"): _ROD_I,
    (4, "I"): _ROD_I,
    (5, "I"): _ROD_I,
    (6, "I"): "I: the paper has none at 5 nodes, where its system is singular; the closed method is exact there.",
    (6, "SSPH"): "SSPH: six terms ask for six nodes; five have no answer.",
}

WHY_PLATE = {
    "I": "I: for Laplace's equation the printed rows leave Shepard's average u_i = sum(W u) / sum(W), the paper's "
    "numbers; closed in two stages the derivatives count, and the error is lower at every grid.",
    "II": "II: how the paper sets the derivatives at the boundary is not said and cannot be told from its numbers; "
    "here they are recovered from the values. With all seven free coefficients every grid is below the paper.",
    "III": "III: within 0.2 percent everywhere; the paper's 171-node entry is 0.004 too large in I and in III alike.",
    "SSPH": "SSPH: 50 and 171 nodes agree to the digits printed, 629 does not at the stated settings: other settings "
    "there, or a misprint.",
}
