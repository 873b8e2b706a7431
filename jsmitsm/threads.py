"""Work shared among the cores: one JAX program runs on one core, so pieces of a cloud run side by side."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from typing import Any

import jax


def cores() -> int:
    """The cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


# Programs that have run, so that no two threads compile one of them; a forgotten one only runs a first piece alone.
_ready: set[Any] = set()
_MOST = 1024


def side_by_side(function: Callable[[Any], Any], items: Sequence[Any], program: Any) -> Iterator[Any]:
    """``function`` of every item, in their order, on all cores.

    program: what tells the compiled program behind the function from others; until it has run once, the first item
    runs alone.
    """
    alone = 0 if program in _ready else 1
    yield from map(function, items[:alone])
    if len(_ready) >= _MOST:
        _ready.clear()
    _ready.add(program)
    threads = min(cores(), len(items) - alone)
    if threads < 2:
        yield from map(function, items[alone:])
        return
    there = _as_here(function)
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(lambda pair: pair[0].run(there, pair[1]), [(copy_context(), x) for x in items[alone:]])


def _as_here(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """The function under the precision and the device of this thread, which JAX sets for each thread apart."""
    config: Any = jax.config
    wide, device = config.jax_enable_x64, config.jax_default_device

    def there(item: Any) -> Any:
        with jax.enable_x64(wide), jax.default_device(device):
            return function(item)

    return there
