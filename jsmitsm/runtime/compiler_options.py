"""Options of XLA's compiler for CPUs: those that this version of it has."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import jax

# Up to this version of JAX every option that the package sets was seen to exist.
_TRIED = (0, 10)


def on_cpu(options: Mapping[str, Any]) -> dict[str, Any]:
    """What of ``options`` can be given to the compiler: nothing unless JAX computes on a CPU."""
    if jax.default_backend() != "cpu":
        return {}
    if jax.__version_info__[:2] <= _TRIED:
        return dict(options)
    return {name: value for name, value in options.items() if _exists(name, value)}


@cache
def _exists(name: str, value: Any) -> bool:
    """Whether the compiler takes an option; it refuses those it does not know, and there is no list of them."""
    try:
        jax.jit(lambda: 0, compiler_options={name: value}).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
