"""Runs under JAX transforms."""

from __future__ import annotations

from typing import Any

from jsmitsm.evolution.evolution import Evolution
from jsmitsm.evolution.run import Run


def differentiable(run: Run, steps: int, parts: Any) -> Evolution:
    """The Evolution of a run with traced values."""
    raise NotImplementedError
