"""The stencils of a part of a cloud, which stand in the classes of its particles and nowhere beside them."""

from __future__ import annotations

from typing import Any

import numpy as np

from jsmitsm.cloud.neighbours import Stencils


class InClasses(Stencils):
    """Stencils (N, w), put together where they are asked for: of the particles of the classes from these.

    Beside a matrix every list of neighbours is seen: in 3D one is a third as large as the matrix itself.
    """

    _shape: tuple[int, int]
    _others: tuple[np.ndarray, np.ndarray]
    _classes: list[Any]

    def __init__(self, found: Stencils, classes: list[Any]):
        near = np.asarray(found.indices)
        others = np.ones(len(near), bool)
        for cls in classes:
            others[cls.ids] = False
        shape = len(near), max([near.shape[1], *(cls.neighbours.shape[1] for cls in classes)])
        ids = np.flatnonzero(others)
        for name, value in {"radius": found.radius, "_shape": shape, "_others": (ids, near[ids]),
                            "_classes": classes}.items():  # fmt: skip
            object.__setattr__(self, name, value)

    @property
    def indices(self) -> np.ndarray:  # type: ignore[override]
        """The padded array, -1 for none."""
        out = np.full(self._shape, -1, np.int32)
        for ids, near in [self._others, *((cls.ids, cls.neighbours) for cls in self._classes)]:
            out[ids, : near.shape[1]] = near
        return out
