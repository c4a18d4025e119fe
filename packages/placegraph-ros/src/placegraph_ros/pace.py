"""A recording at the pace at which it was recorded, or another, with pauses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from threading import Condition
from time import monotonic
from typing import TypeVar

from placegraph.errors import OptionError

T = TypeVar("T")
TICK = 0.02
"""Longest wait [s] before somebody may look whether there is news."""
_GAP = 5.0  # without anything: it is not waited for [s]


class Pace:
    """When what was recorded is due. All methods may be called from any thread.

    Parameters
    ----------
    speed
        Seconds of the recording in one second, above 0; infinite: nothing is waited for.
    clock
        Tells seconds.

    Raises
    ------
    OptionError
        The speed is not above 0.

    """

    def __init__(self, speed: float = 1.0, clock: Callable[[], float] = monotonic) -> None:
        self._changed = Condition()
        self._clock = clock
        self._from: tuple[float, float] | None = None
        self.paused = self.stopped = False
        self.now = 0.0
        """Time of the recording that was come to [s]."""
        self.speed = 1.0
        self.set(speed=speed)

    def set(self, *, speed: float | None = None, paused: bool | None = None) -> None:
        """Go on faster or slower, pause, or go on."""
        if speed is not None and not speed > 0:
            raise OptionError(f"speed is {speed}; it is above 0: 1 is as it was recorded.")
        with self._changed:
            self.speed = self.speed if speed is None else speed
            self.paused = self.paused if paused is None else paused
            self._from = None
            self._changed.notify_all()

    def stop(self) -> None:
        """End it."""
        with self._changed:
            self.stopped = True
            self._changed.notify_all()

    def waited(self, time: float) -> Iterator[None]:
        """Wait until a time [s] of the recording is due, with a pause for news every `TICK`."""
        with self._changed:
            if self._from is not None:
                gone = time - self.now
                if not 0.0 <= gone <= _GAP:
                    self._from = None
        while not self.stopped:
            with self._changed:
                if self._from is None and not self.paused:
                    self._from = self._clock(), time
                left = TICK
                if self._from is not None and not self.paused:
                    since, first = self._from
                    left = since + (time - first) / self.speed - self._clock()
                    if left <= 0:
                        break
                self._changed.wait(min(left, TICK))
            yield None
        self.now = time

    def paced(
        self, events: Iterable[T], time_of: Callable[[T], float | None]
    ) -> Iterator[T | None]:
        """Each event when it is due, and None while it is waited for; those of no time at once."""
        for event in events:
            time = time_of(event)
            if time is not None:
                yield from self.waited(time)
            if self.stopped:
                return
            yield event
