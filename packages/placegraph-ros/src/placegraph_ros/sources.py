"""Sources of messages and frames: bags, recordings that go on, pipes and folders that fill."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from threading import Condition, Event
from time import monotonic
from typing import BinaryIO, TypeVar

from placegraph.errors import InputError, OptionError
from placegraph.io.capture.capture import open_capture
from placegraph.io.capture.frame import Frame
from placegraph_io.ros.capture import is_bag
from placegraph_io.ros.containers import is_whole, open_bag
from placegraph_io.ros.stream import Fault, Packet, mcap_packets, packets_of
from placegraph_io.ros.topics import Plan, TopicChoice, plan_of, read_topic_choice

T = TypeVar("T")
TICK = 0.02
"""Longest wait [s] before somebody may look whether there is news."""
_GAP = 5.0  # without anything: it is not waited for [s]


class PlaybackClock:
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

    def wait_until(self, time: float) -> Iterator[None]:
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

    def play(self, events: Iterable[T], time_of: Callable[[T], float | None]) -> Iterator[T | None]:
        """Yield each event when it is due, and None while it is waited for; those of no time at once."""
        for event in events:
            time = time_of(event)
            if time is not None:
                yield from self.wait_until(time)
            if self.stopped:
                return
            yield event


StreamEvent = Packet | Fault | Frame | None


STDIN = Path("stdin")
"""What standard input is called in messages; `stdin.json` says what it does not."""
_LOOK = 0.2  # seconds between two looks at what may have grown


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """What happens, in order; None: nothing has, for a while."""

    path: Path
    events: Iterator[StreamEvent]
    plan: Plan | None = None
    """What frames are made of, where it is known before."""
    choice: TopicChoice | None = None
    frames: int | None = None
    """How many there are, where it is known."""
    span: tuple[float, float] | None = None
    """First and last time [s], where they are known."""


class WaitPolicy:
    """Waits for more, until nothing has come for some seconds, or `over` is set.

    `pause` waits so many seconds, or less.
    """

    def __init__(self, seconds: float, pause: Callable[[float], object] | None = None) -> None:
        if not seconds >= 0:
            raise OptionError(f"wait is {seconds}; it is seconds, 0 or more.")
        self.over = Event()
        self._seconds, self._pause = seconds, pause or self.over.wait
        self._since = monotonic()

    def more(self, *, came: bool) -> bool:
        """Return whether to look again, after a while; `came`: there was something now."""
        if came:
            self._since = monotonic()
        elif not self.over.is_set() and monotonic() - self._since < self._seconds:
            self._pause(_LOOK)
        else:
            return False
        return not self.over.is_set()


def open_source(path: Path, policy: WaitPolicy, stdin: BinaryIO | None = None) -> Source:
    """What happens in a bag, in a recording that goes on, in a folder that fills, or (``-``) in a pipe.

    A bag that is whole is read by its index. An MCAP without its end is read as it grows, and a folder
    of images as it fills, until `policy` ends; standard input is an MCAP, read until it ends.

    Raises
    ------
    InputError
        It is nothing of that, or lacks what frames are made of; later, where nothing usable came.
    MissingExtraError
        `rosbags` is not installed.

    """
    if str(path) == "-":
        read = (stdin or sys.stdin.buffer).read
        return Source(STDIN, mcap_packets(read, STDIN.name), choice=read_topic_choice(STDIN, None))
    if not path.exists():
        raise InputError(f"{path} does not exist; name a bag, a folder of images, or - for a pipe.")
    if not is_bag(path):
        return Source(path, _follow_folder(path, policy if path.is_dir() else WaitPolicy(0.0)))
    if path.suffix.lower() == ".mcap" and not path.is_dir() and not is_whole(path):
        return Source(path, _follow_file(path, policy), choice=read_topic_choice(path, None))
    return bag_source(path)


def bag_source(path: Path) -> Source:
    """Return a bag that is whole, or as far as it goes.

    Raises `InputError` where it is none, or lacks what frames are made of.
    """
    if not is_bag(path):
        raise InputError(f"{path} is no bag: .mcap, .db3, .bag, or a folder of rosbag2.")
    choice = read_topic_choice(path, None)
    plan = plan_of(open_bag(path), choice)
    if plan.lacks:
        raise InputError(next(iter(plan.lacks.values())))
    assert plan.pose_reader is not None and plan.colour is not None  # noqa: S101, PT018  # nothing lacks
    used = [plan.colour.topic, plan.pose_reader.odometry, *plan.pose_reader.moves]
    used += [plan.depth.topic if plan.depth is not None else None]
    topics = [topic for topic in used if topic is not None]
    first = min(float(t.times[0]) for t in topics) * 1e-9
    last = max(float(t.times[-1]) for t in topics) * 1e-9
    return Source(
        path, packets_of(plan.bag, {t.name for t in topics}), plan, choice,
        len(plan.colour.topic), (first, last),
    )  # fmt: skip


def time_of(event: StreamEvent) -> float | None:
    """Return when something happened [s]; None: at no time of its own."""
    if isinstance(event, Frame):
        return event.stamp
    return event.time if isinstance(event, Packet) else None


def _follow_folder(path: Path, policy: WaitPolicy) -> Iterator[Frame | None]:
    """Yield the frames of a folder, and those that come into it: it is opened again whenever it has changed.

    While it cannot be read it is waited for, as a row may come before its image.
    """
    last, seen = -float("inf"), -1
    error: InputError | None = None
    more = True
    while more:
        state, came = _state(path), False
        if state != seen:
            seen, error = state, None
            try:
                frames = [f for f in open_capture(path) if f.stamp > last]
            except InputError as now:
                frames, error = [], now
            for frame in frames:
                yield frame
                last, came = frame.stamp, True
        more = policy.more(came=came)
        yield None
    if error is not None:
        raise error


def _state(path: Path) -> int:
    """Return a number that differs where files of a folder, or of folders in it, have."""
    parts = [path] if path.is_file() else [path, *path.glob("*"), *path.glob("*/*")]
    facts = []
    for part in parts:
        try:
            said = part.stat()
        except OSError:
            continue  # gone since
        facts.append((str(part), said.st_mtime_ns, said.st_size))
    return hash(tuple(sorted(facts)))


def _follow_file(path: Path, policy: WaitPolicy) -> Iterator[Packet | Fault]:
    """Yield the messages of an MCAP that is being written."""
    with path.open("rb") as file:

        def read(count: int) -> bytes:
            data = b""
            while len(data) < count:
                part = file.read(count - len(data))
                data += part
                if not policy.more(came=bool(part)):
                    break
            return data

        yield from mcap_packets(read, str(path))
