"""Keys of a terminal while something plays: pause, speed, end; and Ctrl-C."""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from placegraph.ros.pace import Pace
    from placegraph.ros.sources import Patience

_FASTEST, _SLOWEST = 64.0, 1 / 64


@contextmanager
def ending(pace: Pace, patience: Patience) -> Iterator[None]:
    """The first Ctrl-C ends what plays as `q` does, between two messages: what is written of it is whole.

    The second is a `KeyboardInterrupt`, wherever it falls.
    """
    before = signal.getsignal(signal.SIGINT)
    main = threading.current_thread() is threading.main_thread()
    if not main or before is signal.SIG_IGN:  # a shell has started it in the background
        yield
        return

    def interrupted(*_: object) -> None:
        signal.signal(signal.SIGINT, before)
        # whoever was interrupted may hold the locks that this needs
        threading.Thread(target=pressed, args=("q", pace, patience)).start()

    signal.signal(signal.SIGINT, interrupted)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def keys(pace: Pace, patience: Patience) -> Iterator[None]:
    """Space pauses, + and - change the speed by two, q ends; without a terminal, nothing does."""
    if not (sys.stdin.isatty() and threading.current_thread() is threading.main_thread()):
        yield
        return
    import termios
    import tty

    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)
    read, write = os.pipe()

    def listen() -> None:
        while read not in select.select([terminal, read], [], [])[0]:
            pressed(os.read(terminal, 1).decode("ascii", "replace"), pace, patience)

    listener = threading.Thread(target=listen, daemon=True)
    tty.setcbreak(terminal)
    try:
        listener.start()
        yield
    finally:
        os.write(write, b".")
        listener.join()
        os.close(read)
        os.close(write)
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def pressed(key: str, pace: Pace, patience: Patience) -> None:
    """Do what a key stands for."""
    if key == " ":
        pace.set(paused=not pace.paused)
    elif key in "+=":
        pace.set(speed=min(pace.speed * 2.0, _FASTEST))
    elif key in "-_":
        pace.set(speed=max(pace.speed / 2.0, _SLOWEST))
    elif key in "qQ":
        patience.over.set()
        pace.stop()
