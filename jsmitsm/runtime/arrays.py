"""What numbers are called in signatures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import numpy as np
from numpy.typing import ArrayLike as NumpyArrayLike

# An array of numpy outside of JAX transforms, of JAX inside.
Array: TypeAlias = np.ndarray[Any, Any] | jax.Array
# What becomes one: numbers, nested lists of them, arrays of either kind.
ArrayLike: TypeAlias = NumpyArrayLike | jax.Array
# Given as it is, or as a function of the point (and of a problem's params, where it has them).
ValueOrFunction: TypeAlias = ArrayLike | Callable[..., Any]
