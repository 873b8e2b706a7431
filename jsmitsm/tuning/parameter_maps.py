"""The parameters of a kernel as unbounded numbers, for a search that may step anywhere."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.particle.kernels import Kernel

Steps = dict[str, Any]
"""How far each tuned parameter is from its start: by name, an array or, for "params", a list of them."""


class ParameterMap:
    """Kernels as functions of z, all zero at the start: p = p0 exp(z) where p0 > 0, p0 + z elsewhere.

    groups : (N,) particles with the same number share one z of h, or None.
    """

    def __init__(self, kernel: Kernel, names: tuple[str, ...], groups: np.ndarray | None):
        self.start, self.names = kernel, names
        self.labels = None if groups is None else np.unique(groups, return_inverse=True)[1]
        if groups is not None:
            self.start = kernel.replace(h=np.broadcast_to(np.asarray(kernel.h, float), groups.shape))
        leaves, self.shape = jax.tree.flatten(kernel.params)
        self.moving = [np.asarray(x).dtype.kind == "f" for x in leaves]
        # A scalar h moves at a fixed support d h: the support has a lower bound, and the search slides along it.
        self.by_support = {"h", "d"} <= set(names) and not np.ndim(self.start.h)

    def zero(self) -> Steps:
        """The start."""
        z: Steps = {}
        for name in self.names:
            if name == "params":
                leaves = jax.tree.leaves(self.start.params)
                z[name] = [jnp.zeros(np.shape(x)) for x, m in zip(leaves, self.moving) if m]
            elif name == "h" and self.labels is not None:
                z[name] = jnp.zeros(self.labels.max() + 1)
            else:
                z[name] = jnp.zeros(np.shape(getattr(self.start, name)))
        return z

    def kernel(self, z: Steps) -> Kernel:
        """The kernel at z."""
        changes: dict[str, Any] = {}
        if "params" in z:
            changes["params"] = self._params(z["params"])
        if "h" in z:
            by = z["h"] if self.labels is None else z["h"][self.labels]
            changes["h"] = self.start.h * jnp.exp(by)
        if "d" in z:
            changes["d"] = self.start.d * jnp.exp(z["d"] - z["h"] if self.by_support else z["d"])
        return self.start.replace(**changes)

    def _params(self, moves: list[Any]) -> Any:
        moved, leaves = iter(moves), jax.tree.leaves(self.start.params)
        return jax.tree.unflatten(self.shape, [_moved(x, next(moved)) if m else x for x, m in zip(leaves, self.moving)])

    def kept_within(self, z: Steps, lowest: np.ndarray, highest: np.ndarray) -> Steps:
        """z with every support between ``lowest`` and ``highest``, (N,), as far as h and d can."""
        shared = ["d"] if self.by_support else [name for name in ("h", "d") if name in z]
        if not shared:
            return z
        kernel = self.kernel(z)
        support = np.broadcast_to(np.asarray(kernel.h) * np.asarray(kernel.d), lowest.shape)
        up, down = np.log(np.maximum(lowest / support, 1.0)), np.log(np.minimum(highest / support, 1.0))
        if "h" in z and np.ndim(kernel.h):
            return {**z, "h": z["h"] + _per_label(np.where(up > 0, up, down), self.labels)}
        shift = up.max() if up.max() > 0 else down.min()
        return {**z, **{name: z[name] + shift / len(shared) for name in shared}}


def _moved(x: Any, z: Any) -> Any:
    x = jnp.asarray(x)
    return jnp.where(x > 0, x * jnp.exp(z), x + z)


def _per_label(shift: np.ndarray, labels: np.ndarray | None) -> np.ndarray:
    """The largest upward shift of every group, or its largest downward one."""
    if labels is None:
        return shift
    up, down = np.zeros(labels.max() + 1), np.zeros(labels.max() + 1)
    np.maximum.at(up, labels, shift)
    np.minimum.at(down, labels, shift)
    return np.where(up > 0, up, down)
