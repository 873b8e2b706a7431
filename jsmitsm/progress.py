"""One progress bar for what takes long, where someone is watching.

Shown after the first seconds, on a terminal or in a notebook, if tqdm is installed; never in
pipes or under pytest. Off for a block with :func:`no_progress`, for a process with the
environment variable ``TQDM_DISABLE=1``.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.boundary import is_traced

# Seconds before a bar appears: what is done by then needs none.
DELAY = 1.5
# At most so many particles between two movements of the bar.
PIECE = 8192

# Also set while a bar is shown, so that a solve inside a search opens no second one.
_silent: ContextVar[bool] = ContextVar("silent", default=False)


class _NoBar:
    """Stands in where no bar is wanted."""

    def update(self, n: int = 1) -> None: ...

    def set_postfix_str(self, text: str, refresh: bool = True) -> None: ...


@contextmanager
def no_progress() -> Iterator[None]:
    """No progress bars inside this block.

    Examples
    --------
    >>> import jsmitsm as js
    >>> with js.no_progress():
    ...     pass  # js.solve(...), js.tune(...)
    """
    token = _silent.set(True)
    try:
        yield
    finally:
        _silent.reset(token)


@contextmanager
def bar(what: str, total: int | None = None, wanted: bool = True) -> Iterator[Any]:
    """A bar, or what looks like one; no other opens inside."""
    made = _opened(what, total) if wanted else None
    with no_progress():
        try:
            yield _NoBar() if made is None else made
        finally:
            if made is not None:
                made.close()


def _opened(what: str, total: int | None) -> Any:
    if not watched():
        return None
    from tqdm import tqdm

    return tqdm(total=total, desc=what, delay=DELAY, leave=False)


def watched() -> bool:
    """Whether a bar would be seen."""
    if _silent.get() or "PYTEST_CURRENT_TEST" in os.environ or os.environ.get("TQDM_DISABLE", "0") != "0":
        return False
    # A notebook's stderr says that it is no terminal.
    if not (sys.stderr.isatty() or type(sys.stderr).__module__.startswith("ipykernel")):
        return False
    try:
        import tqdm  # noqa: F401
    except ImportError:
        return False
    return True


def in_pieces(what: str, one: Callable[[Any], Any], cls: Any, *context: Any) -> Any:
    """``one(cls)`` for a class of particles: at once, or piece by piece with a bar where one is watched.

    The results are pytrees with the particle axis first; nothing is cut up where ``context`` is traced.
    """
    n = len(cls.ids)
    if n <= 2 * PIECE or not watched() or is_traced(context, cls.neighbours, jnp.asarray(np.zeros(()))):
        return one(cls)
    made = []
    step = -(-n // -(-n // PIECE))  # pieces of one size: one program serves all
    with bar(what, n) as shown:
        for start in range(0, n, step):
            some = slice(start, start + step)
            made.append(one(replace(cls, ids=cls.ids[some], neighbours=cls.neighbours[some])))
            shown.update(len(cls.ids[some]))
    return jax.tree.map(lambda *x: np.concatenate(x), *made)
