"""Sources of messages and frames: bags, growing recordings and folders, pipes."""

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
from placegraph_io.ros.containers import is_complete, open_bag
from placegraph_io.ros.stream import Fault, Packet, bag_packets, mcap_packets
from placegraph_io.ros.topics import CapturePlan, TopicChoice, plan_capture, read_topic_choice

T = TypeVar("T")
TICK = 0.02  # Longest wait before control returns to the caller [s]
_GAP = 5.0  # longer gaps of a recording are skipped [s]


class PlaybackClock:
    """Clock of a playback; all methods are thread-safe.

    `speed` is seconds of the recording per second, greater than 0 (else `OptionError`); infinite: no
    waiting. `clock` returns seconds.
    """

    def __init__(self, speed: float = 1.0, clock: Callable[[], float] = monotonic) -> None:
        self._changed = Condition()
        self._clock = clock
        self._from: tuple[float, float] | None = None
        self.paused = self.stopped = False
        self.now = 0.0
        """Current time of the recording [s]."""
        self.speed = 1.0
        self.set(speed=speed)

    def set(self, *, speed: float | None = None, paused: bool | None = None) -> None:
        """Change the speed, pause or resume."""
        if speed is not None and not speed > 0:
            raise OptionError(f"speed is {speed}; it must be greater than 0 (1 is real time).")
        with self._changed:
            self.speed = self.speed if speed is None else speed
            self.paused = self.paused if paused is None else paused
            self._from = None
            self._changed.notify_all()

    def stop(self) -> None:
        """End the playback."""
        with self._changed:
            self.stopped = True
            self._changed.notify_all()

    def wait_until(self, time: float) -> Iterator[None]:
        """Wait until a time [s] of the recording is due; yield every `TICK`."""
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
        """Yield each event when it is due, and None while waiting; events without a time at once."""
        for event in events:
            time = time_of(event)
            if time is not None:
                yield from self.wait_until(time)
            if self.stopped:
                return
            yield event


StreamEvent = Packet | Fault | Frame | None


STDIN = Path("stdin")  # Name of standard input in messages, and of its file `stdin.json`
_POLL = 0.2  # interval of polling [s]


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """Events in order, None after a timeout, with what is known about them."""

    path: Path
    events: Iterator[StreamEvent]
    plan: CapturePlan | None = None  # Topics that make frames, if known
    choice: TopicChoice | None = None
    frames: int | None = None  # Number of frames, if known
    span: tuple[float, float] | None = None  # First and last time [s], if known


class WaitPolicy:
    """Waits for more data until nothing arrived for some seconds, or `over` is set."""

    def __init__(self, seconds: float, pause: Callable[[float], object] | None = None) -> None:
        if not seconds >= 0:
            raise OptionError(f"wait is {seconds}; it must be 0 or more seconds.")
        self.over = Event()
        self._seconds, self._pause = seconds, pause or self.over.wait
        self._since = monotonic()

    def should_poll(self, *, came: bool) -> bool:
        """Return, after a pause, whether to poll again; `came`: data arrived now."""
        if came:
            self._since = monotonic()
        elif not self.over.is_set() and monotonic() - self._since < self._seconds:
            self._pause(_POLL)
        else:
            return False
        return not self.over.is_set()


def open_source(path: Path, policy: WaitPolicy, stdin: BinaryIO | None = None) -> Source:
    """Open a bag, a growing recording, a growing folder, or (``-``) a pipe as a source.

    A complete bag is read by its index. An MCAP without its end and a folder of images are followed
    until `policy` ends; standard input is an MCAP, read to its end. Raises `InputError` where the source
    is unknown or incomplete, `MissingExtraError` without `rosbags`.
    """
    if str(path) == "-":
        read = (stdin or sys.stdin.buffer).read
        return Source(STDIN, mcap_packets(read, STDIN.name), choice=read_topic_choice(STDIN, None))
    if not path.exists():
        raise InputError(f"{path} does not exist; give a bag, a folder of images, or - for a pipe.")
    if not is_bag(path):
        return Source(path, _follow_folder(path, policy if path.is_dir() else WaitPolicy(0.0)))
    if path.suffix.lower() == ".mcap" and not path.is_dir() and not is_complete(path):
        return Source(path, _follow_file(path, policy), choice=read_topic_choice(path, None))
    return bag_source(path)


def bag_source(path: Path) -> Source:
    """Open a bag as a source; `InputError` where it is none or incomplete."""
    if not is_bag(path):
        hint = " Give the bag before the map." if path.suffix in {".scene", ".library"} else ""
        raise InputError(
            f"{path} is not a bag; give an .mcap, .db3 or .bag file, or a folder of rosbag2.{hint}"
        )
    choice = read_topic_choice(path, None)
    plan = plan_capture(open_bag(path), choice)
    if plan.missing:
        raise InputError(next(iter(plan.missing.values())))
    assert plan.pose_reader is not None and plan.colour is not None  # noqa: S101, PT018  # nothing lacks
    used = [plan.colour.topic, plan.pose_reader.odometry, *plan.pose_reader.transform_topics]
    used += [plan.depth.topic if plan.depth is not None else None]
    topics = [topic for topic in used if topic is not None]
    first = min(float(t.times[0]) for t in topics) * 1e-9
    last = max(float(t.times[-1]) for t in topics) * 1e-9
    return Source(
        path, bag_packets(plan.bag, {t.name for t in topics}), plan, choice,
        len(plan.colour.topic), (first, last),
    )  # fmt: skip


def time_of(event: StreamEvent) -> float | None:
    """Return the time of an event [s], or None."""
    if isinstance(event, Frame):
        return event.stamp
    return event.time if isinstance(event, Packet) else None


def _follow_folder(path: Path, policy: WaitPolicy) -> Iterator[Frame | None]:
    """Yield the frames of a growing folder, which is opened again whenever it changes.

    Errors are raised at the end, since a row may be written before its image.
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
        more = policy.should_poll(came=came)
        yield None
    if error is not None:
        raise error


def _state(path: Path) -> int:
    """Return a hash of the files of a folder and its subfolders."""
    parts = [path] if path.is_file() else [path, *path.glob("*"), *path.glob("*/*")]
    facts = []
    for part in parts:
        try:
            status = part.stat()
        except OSError:
            continue  # gone since
        facts.append((str(part), status.st_mtime_ns, status.st_size))
    return hash(tuple(sorted(facts)))


def _follow_file(path: Path, policy: WaitPolicy) -> Iterator[Packet | Fault]:
    """Yield the messages of a growing MCAP."""
    with path.open("rb") as file:

        def read(count: int) -> bytes:
            data = b""
            while len(data) < count:
                part = file.read(count - len(data))
                data += part
                if not policy.should_poll(came=bool(part)):
                    break
            return data

        yield from mcap_packets(read, str(path))
