"""What the local systems are made of: the numbers of a class of particles, and what they look up of the whole cloud."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.discretization.coefficients import Numbers
from jsmitsm.discretization.layout import Class, Discretization
from jsmitsm.discretization.supports import default_kernel
from jsmitsm.particle import batches
from jsmitsm.particle.batches import Operands
from jsmitsm.particle.elimination import Elimination, Scheme, as_matrix, eliminate, eliminate_on_host
from jsmitsm.particle.kernels import Kernel
from jsmitsm.particle.moments import COMMON
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.runtime.whole_program import in_one_program

# Bytes of an array that takes longer to copy than to be sent apart.
_LARGE = 1 << 20
# Particles that each elimination must serve.
_WORTH = 50


class Around(NamedTuple):
    """What particles look up of the whole cloud, padded once for all pieces: (M, ...) with periodic images."""

    points: Any
    kernel: Kernel | None
    data: Any


def around(disc: Discretization, nums: Numbers) -> Around:
    """What the particles of all classes look up."""
    given = disc.points, disc.kernel, disc.images.extend_values(nums.data)
    return Around(*sent(batches.in_cloud_size(given, len(disc.points))))


def sent(tree: Any) -> Any:
    """Large arrays sent to the device once, not again with every piece."""
    large = lambda x: isinstance(x, np.ndarray) and x.nbytes > _LARGE  # noqa: E731
    return jax.tree.map(lambda x: jax.device_put(x) if large(x) else x, tree)


def operands(disc: Discretization, nums: Numbers, cls: Class, shared: Elimination | None, data: Any) -> Operands:
    """What the particles of a class need; the particle axis first."""
    ids, jac, lengths = cls.ids, nums.jac, None
    if jac.shape[-1] > 1:
        jac = particles_first(jac, np.searchsorted(nums.ids, ids), len(ids))
    elif shared is not None:
        jac = np.zeros((1, 1, 1, 1))
    else:
        some = _eliminations(disc, nums, cls)
        if some is None:
            jac = particles_first(jac, None, 1)
        else:
            shared, lengths, jac = some
    return Operands(jac, own_conditions(nums, cls), data, shared, lengths)


def own_conditions(nums: Numbers, cls: Class) -> Any:
    """The conditions of the particles of a class, (n, n_own, S_own)."""
    if not cls.scheme.n_own:
        return np.zeros((len(cls.ids), 0, len(cls.scheme.own)))
    return _first_columns(nums.own, np.searchsorted(nums.own_ids, cls.ids), cls.scheme.n_own)


def _eliminations(disc: Discretization, nums: Numbers, cls: Class) -> tuple[Elimination, np.ndarray, np.ndarray] | None:
    """A constant operator of terms of several orders (laplacian(u) + k^2 u): one elimination for each of a few lengths.

    Returns the eliminations (B, ...), their lengths (B,) and each particle's number (n,); None where that does not pay,
    and where something is traced.
    """
    points, near, kernel = disc.points, cls.neighbours, disc.kernel
    if not disc.traced.constant or cls.scheme.method != "S" or is_traced(points, near, kernel, nums.jac):
        return None
    if isinstance(nums.jac, jax.Array):
        return None
    own = default_kernel(points, cls.ids, near, cls.scheme.decay) if kernel is None else kernel.at(cls.ids)
    length = np.broadcast_to(np.asarray(own.length), cls.ids.shape)
    if not (length > 0).all():
        return None
    steps, place = np.unique(np.rint(np.log(length) / np.log(COMMON)).astype(int), return_inverse=True)
    if len(cls.ids) < _WORTH * len(steps):
        return None
    disc.lengths = max(disc.lengths, len(steps))
    # One program for any number of lengths up to the next power of two.
    steps = np.concatenate([steps, np.full(max(4, 1 << (len(steps) - 1).bit_length()) - len(steps), steps[-1])])
    lengths = COMMON**steps
    made = [eliminate_on_host(cls.scheme, nums.jac[..., 0], float(x)) for x in lengths]
    return Elimination(*(np.stack(part) for part in zip(*made))), lengths, place


def shared_elimination(disc: Discretization, nums: Numbers) -> Elimination | None:
    """One elimination for all particles, where the operator allows it."""
    if not (disc.traced.constant and disc.rec.scale_free):
        return None
    if is_traced(nums.jac) or isinstance(nums.jac, jax.Array):
        return _eliminate(disc.scheme, jnp.asarray(nums.jac[..., 0]))
    return eliminate_on_host(disc.scheme, nums.jac[..., 0])


@partial(in_one_program, static=("scheme",))
@partial(jax.jit, static_argnames="scheme")  # its many small operations one by one take longer than a hundred solves
def _eliminate(scheme: Scheme, jac: Any) -> Elimination:
    made = eliminate(scheme, jac, 1.0)
    return made._replace(particular=as_matrix(made.particular))


def right_sides(disc: Discretization, nums: Numbers, cls: Class) -> tuple[Any, Any]:
    """The recursion's right-hand side (n, rows) and the own conditions' values (n, n_own)."""
    n, source = len(cls.ids), nums.source
    here = np.searchsorted(nums.ids, cls.ids) if source.shape[1] > 1 else None
    source = particles_first(source, here, n)
    if not cls.scheme.n_own:
        return source, np.zeros((n, 0))
    return source, _first_columns(nums.given, np.searchsorted(nums.own_ids, cls.ids), cls.scheme.n_own)


@partial(in_one_program, static=("n",))
def particles_first(values: Any, here: np.ndarray | None, n: int) -> Any:
    """The n particles ``here`` of an array with the particle axis last, that axis first; None: one serves all."""
    xp = jnp if is_traced(values) else np
    values = xp.asarray(values)
    chosen = xp.broadcast_to(values, (*values.shape[:-1], n)) if here is None else values[..., here]
    return xp.moveaxis(chosen, -1, 0)


@partial(in_one_program, static=("count",))
def _first_columns(values: Any, here: np.ndarray, count: int) -> Any:
    return values[here, :count]
