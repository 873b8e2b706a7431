"""The solution of a complex problem: two real fields inside, one complex one outside."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.solution.regions.solution import RegionsSolution
from jsmitsm.solution.solution import Solution


@jax.tree_util.register_pytree_node_class
class ComplexSolution(Solution):
    """A solution whose values, derivatives and integrals are complex; its estimate is that of the modulus."""

    @classmethod
    def of(cls, real: Solution) -> ComplexSolution:
        """The complex solution made of one with the two parts of every field."""
        new = object.__new__(cls)
        new.__dict__.update(real.__dict__)
        return new

    def _joined(self, values: Any) -> Any:
        """Complex values of the parts, which lie along the second axis; one field has no axis of its own."""
        count = self._recipe.fields // 2
        xp: Any = np if isinstance(values, np.ndarray) else jnp
        values = values[:, :count] + 1j * values[:, count:]
        return xp.asarray(values)[:, 0] if count == 1 else xp.asarray(values)

    @property
    def u(self) -> Any:
        if jnp.ndim(self._values) > 2:  # a stack out of jax.vmap
            count = self._recipe.fields // 2
            whole = self._values[..., :count] + 1j * self._values[..., count:]
            return whole[..., 0] if count == 1 else whole
        return self._joined(self._values)

    @property
    def coefficients(self) -> Any:
        whole = self._joined(self._taylor)
        return whole if self._recipe.fields == 2 else jnp.swapaxes(whole, 1, 2)

    def derivative(self, points: Any, multi_index: Any, *, blend: bool = False, outside: str = "nan") -> Any:
        return self._joined(super().derivative(points, multi_index, blend=blend, outside=outside))

    def error_estimate(self) -> Any:
        error = super().error_estimate()
        count = self._recipe.fields // 2
        xp: Any = np if isinstance(error, np.ndarray) else jnp
        size = xp.hypot(error[:, :count], error[:, count:])
        return size[:, 0] if count == 1 else size

    def __repr__(self) -> str:
        return f"{super().__repr__()[:-1]}, complex)"


@jax.tree_util.register_pytree_node_class
class ComplexRegionsSolution(ComplexSolution, RegionsSolution):
    """The same in several regions."""

    derivative = RegionsSolution.derivative  # type: ignore[assignment]

    def region(self, name: str) -> ComplexSolution:
        """The solution of one region, on its own cloud with outward normals."""
        return ComplexSolution.of(super().region(name))


def complex_solution(real: Solution) -> ComplexSolution:
    """The complex solution, in one region or several, made of a real one with the two parts of every field."""
    return (ComplexRegionsSolution if isinstance(real, RegionsSolution) else ComplexSolution).of(real)
