"""Several devices of one process: each takes an equal part of the particles, and all know the whole cloud."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

# Rows that are worth a device of their own, and the name of the axis along which they are shared.
WORTH = 4096
_AXIS = "particles"


def of_rows(count: int) -> Mesh | None:
    """All devices of JAX's default kind, where so many rows are worth more than one; None where the user chose one."""
    if jax.config.jax_default_device is not None or count < 2 * WORTH:  # type: ignore[attr-defined]
        return None
    found = jax.local_devices()
    some = min(len(found), count // WORTH)
    return Mesh(np.array(found[:some]), (_AXIS,)) if some > 1 else None


def side_by_side(function: Any, scheme: Any, arguments: dict[str, Any], by_row: dict[str, Any], mesh: Mesh) -> Any:
    """``function(scheme, **arguments)`` on all devices at once, without a word between them.

    by_row: a tree like the arguments, True for those with a row for each row of every result, as many as the devices
    share evenly; the others are on every device.
    """
    leaves, tree = jax.tree.flatten(arguments)
    return _program(function, scheme, tree, tuple(jax.tree.leaves(by_row)), mesh)(*leaves)


@lru_cache(maxsize=256)
def _program(function: Any, scheme: Any, tree: Any, by_row: tuple[bool, ...], mesh: Mesh) -> Any:
    def run(*leaves: Any) -> Any:
        return function(scheme, **jax.tree.unflatten(tree, leaves))

    parts = tuple(PartitionSpec(_AXIS) if shared else PartitionSpec() for shared in by_row)
    # Unchecked: what the devices share is replicated by construction, and the loops inside start from constants.
    return jax.jit(jax.shard_map(run, mesh=mesh, in_specs=parts, out_specs=PartitionSpec(_AXIS), check_vma=False))
