"""Work shared among the cores: one JAX program runs on one core, so pieces of a cloud run side by side.

The threads are those of concurrent.futures; ``Executor.map`` takes as long (57 ms against 62 ms for 16 pieces), but
would compile a program once on each core, under JAX's settings for new threads, and waits for itself where calls
nest.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from functools import lru_cache
from typing import Any

import jax

from jsmitsm.runtime.progress import first_call


def cores() -> int:
    """The cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


# Programs that have run, so that no two threads compile one of them; a forgotten one only runs a first piece alone.
_ready: set[Any] = set()
_MOST = 1024


def side_by_side(function: Callable[[Any], Any], items: Sequence[Any], program: Callable[[Any], Any]) -> Iterator[Any]:
    """``function`` of every item, in their order, on all cores: this thread works too.

    program: of an item, what tells the compiled program behind it from others; until that has run once, an item of it
    runs alone.
    """
    config: Any = jax.config
    if config.jax_disable_jit or config.jax_debug_nans or config.jax_debug_infs:
        yield from map(function, items)  # who looks for a fault wants it here
        return
    made = {}
    for k, item in enumerate(items):
        key = program(item)
        if key not in _ready:
            with first_call():
                made[k] = function(item)
            if len(_ready) >= _MOST:
                _ready.clear()
            _ready.add(key)
    left = [k for k in range(len(items)) if k not in made]
    helping = _begun(_as_here(function), {k: items[k] for k in left[1:]})
    # This thread begins with the first that is left, and goes on with those that no other has begun.
    mine = (k for k in left if k not in helping or helping[k].cancel())
    try:
        for k in range(len(items)):
            while k not in made:
                next_one = None if k in helping and helping[k].done() else next(mine, None)
                if next_one is not None:
                    made[next_one] = function(items[next_one])
                else:
                    made[k] = helping[k].result()
            yield made.pop(k)
    finally:
        for task in helping.values():
            task.cancel()


def _begun(function: Callable[[Any], Any], items: dict[Any, Any]) -> dict[Any, Future[Any]]:
    """The items handed to the other cores; none where there are no others, nor where Python is ending."""
    others = cores() - 1
    try:
        return {k: _helpers(others).submit(copy_context().run, function, x) for k, x in items.items()} if others else {}
    except RuntimeError:
        return {}


@lru_cache(maxsize=1)
def _helpers(count: int) -> ThreadPoolExecutor:
    """Threads that stay: starting them takes as long as the rows of several hundred particles."""
    return ThreadPoolExecutor(count, "jsmitsm")


if hasattr(os, "register_at_fork"):  # a fork has none of its parent's threads
    os.register_at_fork(after_in_child=_helpers.cache_clear)


def _as_here(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """The function under the precision and the device of this thread, which JAX sets for each thread apart."""
    config: Any = jax.config
    wide, device = config.jax_enable_x64, config.jax_default_device

    def there(item: Any) -> Any:
        with jax.enable_x64(wide), jax.default_device(device):
            return function(item)

    return there
