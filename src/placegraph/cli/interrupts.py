"""Ctrl-C: the first ends a command in good order, the second in any case."""

from __future__ import annotations

import os
import signal
import sys
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator

INTERRUPTED = 130
"""Exit code of what a second Ctrl-C ends: 128 and the number of SIGINT, as shells count."""
GRACE = 5.0
"""Time [s] that is left after the second to leave no lock and no half of a file."""
_AGAIN = 0.05
"""After this [s] an interruption is raised again that fell where Python ignores exceptions."""


@contextmanager
def interruptible() -> Iterator[None]:
    """See to it that a SIGINT within is never lost.

    Python ignores a `KeyboardInterrupt` that it raises in a destructor or in what C calls back, of
    which loading libraries and compiling have many: it is then raised again. And nothing is raised
    in a kernel or a library that takes long; there a second SIGINT ends the process after a while.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    read, write = os.pipe()
    os.set_blocking(write, False)
    before = signal.signal(signal.SIGALRM, signal.default_int_handler), sys.unraisablehook
    sys.unraisablehook = _raise_again
    woken = signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    over = threading.Event()
    threading.Thread(target=_watch, args=(read, over), daemon=True).start()
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.set_wakeup_fd(woken)
        signal.signal(signal.SIGALRM, before[0])
        sys.unraisablehook = before[1]
        over.set()
        os.close(write)  # ends the thread


def _raise_again(ignored: Any) -> None:  # noqa: ANN401  # sys.UnraisableHookArgs
    if issubclass(ignored.exc_type, KeyboardInterrupt):
        signal.setitimer(signal.ITIMER_REAL, _AGAIN)
    else:
        sys.__unraisablehook__(ignored)


def _watch(read: int, over: threading.Event) -> None:
    """End the process by the second SIGINT, whatever its main thread does."""
    seen = 0
    while numbers := os.read(read, 64):
        seen += numbers.count(signal.SIGINT)
        if seen > 1 and not over.wait(GRACE):
            os._exit(INTERRUPTED)
    os.close(read)
