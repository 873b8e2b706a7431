"""What of a problem concerns the particles of one process: arrays cut to them, held particles numbered anew."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from jsmitsm.equation.bcs import Condition
from jsmitsm.equation.problem import Problem
from jsmitsm.parallel.distributed import Slab
from jsmitsm.particle.kernels import Kernel


def local_kernel(kernel: Kernel, slab: Slab) -> Kernel:
    """The kernel with the smoothing lengths of the local particles, where it has one for each."""
    if np.ndim(kernel.h) == 0:
        return kernel
    if np.shape(kernel.h) != (slab.count,):
        raise ValueError(f"kernel: h has shape {np.shape(kernel.h)}, expected a scalar or ({slab.count},)")
    return kernel.at(slab.number)


def local_problem(problem: Problem, slab: Slab) -> Problem:
    """The problem with arrays over a group cut to its local particles, and held particles numbered here."""
    bcs: dict[str, Any] = {}
    for name, conditions in problem.bcs.items():
        places, size = np.zeros(0, int), 0
        if name in slab.names:
            k = slab.names.index(name)
            places, size = slab.place[slab.group == k], slab.sizes[k]
        cut = [_local_condition(c, f"bcs[{name!r}]", places, size, slab, problem.fields) for c in conditions]
        if any(c is not None for c in cut):
            bcs[name] = [c for c in cut if c is not None]
    return problem.replace(bcs=bcs)


def _local_condition(
    c: Condition, where: str, places: np.ndarray, size: int, slab: Slab, fields: int
) -> Condition | None:
    if c.kind in ("periodic", "interface"):
        raise ValueError(f"{where}: js.{c.kind} is not made for several processes; use js.solve")
    parts = dict(c.parts)
    if c.kind == "fix":
        wanted = np.array(c.indices)
        if wanted.max() >= slab.count:
            raise ValueError(f"{where}: particle {wanted.max()} does not exist; the cloud has {slab.count}")
        at = np.minimum(np.searchsorted(slab.number, wanted), len(slab) - 1)
        places, size = np.flatnonzero(slab.number[at] == wanted), len(wanted)
        if not len(places):
            return None
        parts["indices"] = tuple(int(i) for i in at[places])
    for name in c.numbers:
        shape = np.shape(parts[name])
        one_a_field = c.field is None and fields > 1 and shape == (fields,)
        if shape and not one_a_field:
            if shape[0] != size:
                raise ValueError(f"{where}.{name}: shape {shape} for a group of {size} particles")
            value = parts[name]
            parts[name] = (value if isinstance(value, jax.Array) else np.asarray(value))[places]
    out = Condition(c.kind, c.field, **parts)
    out.numbers = c.numbers
    return out
