"""Python's garbage collector, held back where it would search in vain."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def uncollected() -> Iterator[None]:
    """Without the collector: for what makes many objects at once that are to stay.

    A program that JAX traces is a hundred thousand of them, and so is a large module. To look through them, and all
    else that JAX keeps, for garbage takes an eighth of a first solve.
    """
    on = gc.isenabled()
    if on:
        gc.disable()
    try:
        yield
    finally:
        if on:
            gc.enable()
