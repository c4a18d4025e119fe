"""Keys of a terminal while something plays: pause, speed, end."""

from __future__ import annotations

import os
import select
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
