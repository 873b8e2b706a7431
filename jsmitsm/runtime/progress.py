"""One progress bar for what takes long, where someone is watching.

Shown after the first seconds, on a terminal or in a notebook, if tqdm is installed; never in
pipes or under pytest. Off for a block with ``js.no_progress``, for a process with the
environment variable ``TQDM_DISABLE=1``.

There is one bar at a time: what opens a bar inside of another's becomes a stage that the outer one
names, "solve, local fits 40%", and "compiling (first call)" while that is what takes the time. What is left of the
whole call is told where its parts are known, else what is left of the stage: of what has begun by the time that it
took so far, of what has not by its share. A clock ticks beside it, also while one long call (a factorisation, a
compilation) reports nothing.

tqdm draws. rich would bring the clock (ten lines here), but takes 0.15 s to import, and ipywidgets in notebooks.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from jsmitsm.runtime.errors import refuse_no_switch

# Seconds before a bar appears: what is done by then needs none. Then between two ticks of its clock,
# and the shortest time between two movements.
DELAY, TICK, PAUSE = 1.5, 0.5, 0.1
# A stage that has lasted so many seconds tells how many are left.
LASTING = 2.0
# What reports nothing moves a bar by the clock alone, no further than this.
NEARLY = 0.95
COMPILING = "compiling (first call)"
_COMPILERS = ("jax/_src/compiler.py", "jax/_src/interpreters/mlir.py")
# The parts of a call in their order: a word in the name of each stage, and its share of the time, about.
Parts = tuple[tuple[str, float], ...]
SOLVE: Parts = (("local fits", 2.0), ("unknowns", 1.0))
PENCIL: Parts = (("local fits", 1.0), ("source fits", 1.0))


class _Nothing:
    """Stands in where no bar is wanted."""

    def update(self, n: int = 1) -> None: ...

    def note(self, text: str) -> None: ...

    def reach(self, part: float) -> None: ...

    def stage(self, what: str, total: int | None) -> _Nothing:
        return self

    def close(self) -> None: ...


class _Bar:
    """A tqdm bar with a clock that ticks by itself."""

    def __init__(self, what: str, total: int | None, parts: Parts = ()):
        tqdm = _bars()
        form = None if total else "{desc} [{elapsed}{postfix}]"
        if parts:
            form = "{desc} [{elapsed}<{remaining}{postfix}] {percentage:.0f}% {bar:12}"
        self.what, self.total, self._parts, self._begun = what, total, parts, 0
        self._bar = tqdm(total=1.0 if parts else total, desc=what, delay=DELAY, mininterval=PAUSE, miniters=0,
                         leave=False, bar_format=form, smoothing=0.0 if parts else 0.3)  # fmt: skip
        self._lock, self._done = threading.Lock(), threading.Event()
        self._said, self._noted, self._caller = "", "", threading.get_ident()
        self._foretold = 0.0  # seconds of the whole call
        self._clock = threading.Thread(target=self._tick, name=f"clock of {what}", daemon=True)
        self._clock.start()

    def _tick(self) -> None:
        while not self._done.wait(TICK):
            self._compiles(in_compiler(self._caller))

    def _compiles(self, busy: bool) -> None:
        """Tell that a program is compiled, for as long as one is."""
        with self._lock:
            if self.total:
                self._bar.set_postfix_str(COMPILING if busy else self._noted, refresh=False)
            else:
                self._describe(COMPILING if busy and COMPILING not in self._said else "")
            if self._foretold:
                self._bar.n = max(self._bar.n, min(self.elapsed() / self._foretold, NEARLY))
            self._bar.update(0)

    def _describe(self, more: str = "") -> None:
        words = ", ".join(filter(None, (self.what, self._said, more)))
        self._bar.set_description_str(words, refresh=False)

    def update(self, n: int = 1) -> None:
        with self._lock:
            self._bar.update(n)

    def note(self, text: str) -> None:
        """A few words or numbers at the end of the bar."""
        with self._lock:
            self._noted = text
            self._bar.set_postfix_str(text, refresh=False)

    def say(self, text: str) -> None:
        with self._lock:
            self._said = text
            self._describe()
            self._bar.update(0)

    def reach(self, part: float) -> None:
        """Say which part of the time of the whole call is over."""
        with self._lock:
            self._foretold = self.elapsed() / part if part > 0.0 else 0.0
            self._bar.n = min(part, 1.0)

    def elapsed(self) -> float:
        return float(self._bar.format_dict["elapsed"])

    def stage(self, what: str, total: int | None) -> Any:
        if self.total:
            return _Counted(self)
        place = next((k for k, (name, _) in enumerate(self._parts) if k >= self._begun and name in what), None)
        if place is None:
            return _Stage(self, what, total)
        self._begun = place + 1
        cuts = [sum(share for _, share in self._parts[:k]) for k in (place, place + 1, None)]
        return _Stage(self, what, total, (cuts[0] / cuts[2], cuts[1] / cuts[2]))

    def close(self) -> None:
        self._done.set()
        self._clock.join()
        self._bar.close()


class _Stage:
    """What goes on inside of a bar, in its words."""

    def __init__(self, outer: Any, what: str, total: int | None, share: tuple[float, float] | None = None):
        self.outer, self.what, self.total, self.done, self.share = outer, what, total, 0, share
        self.start = time.monotonic()
        self.update(0)

    def update(self, n: int = 1) -> None:
        self.done += n
        if self.share:
            first, last = self.share
            part = self.done / self.total if self.total else 0.0
            gone, here = self.outer.elapsed(), time.monotonic() - self.start
            # Until the end of this stage it is as long as its part says, then as long as shares say.
            self.outer.reach(last * gone / (gone + here * (1.0 / part - 1.0)) if part and gone else first)
        self.say("")

    def note(self, text: str) -> None: ...

    def reach(self, part: float) -> None: ...

    def say(self, text: str) -> None:
        at = f" {self.done / self.total:.0%}" if self.total else f" {self.done}" if self.done else ""
        gone = time.monotonic() - self.start
        if self.total and not self.share and 0 < self.done < self.total and gone > LASTING:
            at += f", {gone * (self.total / self.done - 1):.0f} s left"
        self.outer.say(self.what + at + (f", {text}" if text else ""))

    def stage(self, what: str, total: int | None) -> _Stage:
        return _Stage(self, what, total)

    def close(self) -> None:
        if self.share:
            self.outer.reach(self.share[1])
        self.outer.say("")


class _Counted(_Nothing):
    """What goes on inside of a bar that fills up, which tells enough: only that something compiles is told."""

    def __init__(self, outer: Any):
        self.outer = outer

    def say(self, text: str) -> None:
        if text == COMPILING:
            self.outer.note(text)


_NOTHING = _Nothing()
# What is shown now; None where nothing long has begun.
_shown: ContextVar[Any] = ContextVar("shown", default=None)


@contextmanager
def no_progress() -> Iterator[None]:
    """No progress bars inside this block.

    Returns
    -------
    context manager
        For a ``with`` statement.

    Examples
    --------
    >>> import jsmitsm as js
    >>> with js.no_progress():
    ...     pass  # js.solve(...), js.tune(...)
    """
    token = _shown.set(_NOTHING)
    try:
        yield
    finally:
        _shown.reset(token)


@contextmanager
def bar(what: str, total: int | None = None, wanted: bool = True, parts: Parts = ()) -> Iterator[Any]:
    """A bar, a stage of the one that is shown, or nothing that looks like one.

    It has ``update(n)``, ``note(text)`` and, with ``parts``, ``reach(part of the whole)``. Also a decorator:
    ``@bar("what the function does")``. parts: the stages to come, by which the rest of the call is estimated.
    """
    refuse_no_switch("progress", wanted)
    outer = _shown.get()
    if not wanted or (outer is None and not watched()):
        made: Any = _NOTHING
    else:
        made = _Bar(what, total, parts) if outer is None else outer.stage(what, total)
    token = _shown.set(made)
    try:
        yield made
    finally:
        _shown.reset(token)
        made.close()


@contextmanager
def first_call() -> Iterator[None]:
    """While a program runs for the first time: the bar says that it is compiled."""
    say = getattr(_shown.get(), "say", lambda text: None)
    say(COMPILING)
    try:
        yield
    finally:
        say("")


def in_compiler(thread: int) -> bool:
    """Whether a thread is in JAX's compiler now, or writes down a program for it, whoever called for that."""
    frame = sys._current_frames().get(thread)
    while frame is not None:
        if frame.f_code.co_filename.replace("\\", "/").endswith(_COMPILERS):
            return True
        frame = frame.f_back
    return False


def watched() -> bool:
    """Whether a bar would be seen."""
    if "PYTEST_CURRENT_TEST" in os.environ or os.environ.get("TQDM_DISABLE", "0") != "0":
        return False
    if threading.current_thread() is not threading.main_thread():
        return False  # several at once would draw over one another
    # A notebook's stderr says that it is no terminal.
    return (sys.stderr.isatty() or _in_notebook()) and _bars() is not None


def _in_notebook() -> bool:
    return type(sys.stderr).__module__.startswith("ipykernel")


def _bars() -> Any:
    """tqdm's class of text bars, or None where it is not installed."""
    try:
        from tqdm import tqdm
    except ImportError:
        return None
    return tqdm


def shown() -> bool:
    """Whether a bar is there now that would tell of stages."""
    return isinstance(_shown.get(), (_Bar, _Stage))


def each(what: str, one: Callable[[Any], Any], classes: Sequence[Any], mapped: Callable = map) -> list[Any]:
    """``one`` of every class, under a bar that counts their particles; ``mapped`` goes through them like map."""
    made = []
    with bar(what, sum(len(cls.ids) for cls in classes)) as shown:
        for result, cls in zip(mapped(one, classes), classes):
            made.append(result)
            shown.update(len(cls.ids))
    return made
