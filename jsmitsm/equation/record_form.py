"""What is static of a record, comparable: records that pass through JAX are pytrees, and trees are compared."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


class Form:
    """What is static of a record: all but the arrays ``moving`` of its constants. Equal where the same is computed."""

    def __init__(self, traced: Any, moving: tuple[int, ...]):
        self.traced, self.moving = traced, moving

    @cached_property
    def _key(self) -> Any:
        t = self.traced
        fixed = tuple(None if c is None else (c.dtype.str, c.shape, c.tobytes()) for c in map(_host, t._record.consts))
        return t._fingerprint, fixed, self.moving, t.dim, t.fields, t.slots, t._n_extras, t._params_tree

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Form) and self._key == other._key)

    def __hash__(self) -> int:
        return hash(self._key)


def _host(const: Any) -> Any:
    return None if const is None else np.asarray(const)


def is_fixed(const: Any) -> bool:
    """Whether a constant is part of what is computed: integers and truth values that are not traced."""
    return not isinstance(const, jax.core.Tracer) and not jnp.issubdtype(const.dtype, jnp.inexact)
