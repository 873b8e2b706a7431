"""Long calls that Ctrl-C ends."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any


def interruptible(call: Callable[[], Any]) -> Any:
    """``call()``, left at once where Ctrl-C is pressed during a long stretch in C.

    Python handles signals between its own instructions only, in the main thread. So another thread
    does the work while the main one waits; after an interrupt it ends by itself, and nobody looks at
    what it made.
    """
    if threading.current_thread() is not threading.main_thread():
        return call()
    made: list[Any] = []
    failed: list[BaseException] = []

    def work() -> None:
        try:
            made.append(call())
        except BaseException as error:  # raised again below
            failed.append(error)

    worker = threading.Thread(target=work, daemon=True)
    worker.start()
    while worker.is_alive():
        worker.join(0.2)  # without a limit Windows would not see the signal
    if failed:
        raise failed[0]
    return made[0]
