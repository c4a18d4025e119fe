"""Frames of a stream of messages: a recording that goes on, a pipe, or a bag in the order of its recording.

`StreamDiscovery` listens until it is known what frames are made of, `FrameAssembly` makes them. Nothing
waits for ever: a frame comes as soon as its depth and its transforms have come, and is left out, and
counted, where they do not come. `mcap_packets` reads an MCAP that is still being written.
"""

from __future__ import annotations

import struct
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from struct import error as struct_error
from struct import unpack_from
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError, PlacegraphError
from placegraph.io.capture.frame import Frame, LazyImages, posed_frame, quarter_turn, upright_turns
from placegraph.io.capture.posed import SAME_MOMENT
from placegraph_io.ros.capture import Source, metres_of, picture, unit_of
from placegraph_io.ros.containers import (
    CHUNK,
    MAGIC,
    MESSAGE,
    Bag,
    Channels,
    Message,
    MissingIndexError,
    Topic,
    records,
    ros2_type,
)
from placegraph_io.ros.decode import decode, frame_of, stamp_of
from placegraph_io.ros.poses import (
    BACK,
    TRANSFORM_TYPES,
    Edge,
    OdometryCovariance,
    Tree,
    is_static,
    numbers_of,
)
from placegraph_io.ros.topics import IMAGES, Plan, TopicChoice, plan_of
from placegraph_io.storage import LARGEST_MESSAGE, CompressedBytes


class Packet(NamedTuple):
    """One message, and when it came."""

    topic: str
    type: str
    """As ROS 2 names it: `sensor_msgs/msg/Image`."""
    time: float
    """When it was recorded, or received [s]."""
    data: bytes
    encoding: str = "cdr"
    """`cdr` (ROS 2) or `ros1`."""

    @property
    def stamp(self) -> float:
        """Stamp of its header [s]; where unset (0), the time at which it came; `InputError`: it has none."""
        at, form = (4, "<II") if self.encoding == "ros1" else (4, "<iI")
        if self.encoding == "cdr" and self.data[1:2] in {b"\x00", b"\x02"}:
            form = ">iI"
        try:
            seconds, nanos = unpack_from(form, self.data, at)
        except struct_error as error:
            raise InputError(f"{self.topic}: a message has no header; record again.") from error
        return float(seconds + nanos * 1e-9) or self.time

    def message(self, path: Path) -> Message:
        """Return the same as a message of a bag of this name."""
        return Message(MemoryStore(path, (self.data,)), 0)


class Fault(NamedTuple):
    """A message that could not be read."""

    topic: str
    reason: str
    """A sentence."""


@dataclass(frozen=True, slots=True)
class MemoryStore:
    """Messages in memory, as what messages of a bag lie in (`storage.MessageStore`)."""

    path: Path
    """What they are called in messages."""
    data: Sequence[bytes]

    def read(self, offset: int, most: int | None = None) -> bytes:
        """As `storage.MessageStore.read`; the offset counts messages."""
        return self.data[offset][:most]


def packets_of(bag: Bag, topics: Collection[str]) -> Iterator[Packet | Fault]:
    """Messages of some topics of a bag in the order of their recording, `tf_static` before all others.

    As for those who subscribe to it: transforms that never change are told to whoever comes.
    """
    chosen = [bag.topics[name] for name in sorted(topics) if name in bag.topics]
    times = np.concatenate([t.times for t in chosen] or [np.zeros(0, np.int64)])
    which = np.repeat(np.arange(len(chosen)), [len(t) for t in chosen])
    rows = np.concatenate([np.arange(len(t)) for t in chosen] or [np.zeros(0, np.intp)])
    moving = np.array([not is_static(t.name) for t in chosen], bool)[which]
    for i in np.lexsort((times, moving)).tolist():
        topic = chosen[which[i]]
        try:
            data = topic[int(rows[i])].read()
        except InputError as error:
            yield Fault(topic.name, str(error))
            continue
        yield Packet(topic.name, topic.type, float(times[i]) * 1e-9, data, topic.encoding)


LISTEN = 1.0
"""Seconds of a stream that are heard before something is chosen, and between two tries."""
_IMAGES, _OTHERS = 16, 2000  # messages of a topic that are kept until then
OTHERS = ("sensor_msgs/CameraInfo", "nav_msgs/Odometry", "sensor_msgs/Imu")
WANTED = frozenset((*IMAGES, *TRANSFORM_TYPES, *OTHERS))
"""Types of messages that are listened to, such as `sensor_msgs/Image`."""


class StreamDiscovery:
    """Listens to a stream until it is known what frames are made of.

    Parameters
    ----------
    path
        What the stream is called in messages; a file of this name with ``.json`` behind it is where
        they say that what is missing can be written.
    choice
        What the user says of it.

    """

    def __init__(self, path: Path, choice: TopicChoice) -> None:
        self.path, self.choice = path, choice
        self.lacks: tuple[str, ...] = ()
        """Sentences on what is missing still."""
        self._heard: dict[tuple[str, str, str], deque[Packet]] = {}
        self._next: float | None = None

    def take(self, packet: Packet) -> Plan | None:
        """Take in a message; what frames are made of, as soon as that is known."""
        if packet.type.replace("/msg/", "/") not in WANTED:
            return None
        key = packet.topic, packet.type, packet.encoding
        if key not in self._heard:
            short = packet.type.replace("/msg/", "/")
            self._heard[key] = deque(maxlen=_IMAGES if short in IMAGES else _OTHERS)
        self._heard[key].append(packet)
        if (
            self._next is None or packet.time < self._next - LISTEN
        ):  # the first, or the clock was set
            self._next = packet.time + LISTEN
        return self.find_plan() if packet.time >= self._next else None

    def find_plan(self) -> Plan | None:
        """What frames are made of by what was heard, or None, and what is missing is told in `lacks`."""
        held = [packet for packets in self._heard.values() for packet in packets]
        if not held:
            self.lacks = (f"{self.path}: no message of a camera has come yet.",)
            return None
        self._next = max(packet.time for packet in held) + LISTEN
        try:
            plan = plan_of(self._bag(), self.choice)
        except PlacegraphError as error:
            self.lacks = (str(error),)
            return None
        self.lacks = tuple(plan.lacks.values())
        return None if plan.lacks else plan

    def packets(self) -> list[Packet]:
        """Return the messages that were heard, transforms that never change first, then in order."""
        held = [packet for packets in self._heard.values() for packet in packets]
        return sorted(held, key=lambda p: (not is_static(p.topic), p.time))

    def _bag(self) -> Bag:
        """Return what was heard, as a bag."""
        topics: dict[str, Topic] = {}
        for (name, kind, encoding), packets in self._heard.items():
            times = np.array([p.time for p in packets])
            order = np.argsort(times, kind="stable")
            if name in topics and len(topics[name]) >= len(packets):
                continue  # of types that share a name, the most frequent
            topics[name] = Topic(
                name=name, type=kind, encoding=encoding,
                times=np.rint(times[order] * 1e9).astype(np.int64),
                places=(MemoryStore(self.path, [p.data for p in packets]),),
                which=np.zeros(len(packets), np.int64), offsets=order.astype(np.int64),
            )  # fmt: skip
        return Bag(self.path, dict(sorted(topics.items())), ())


LONGEST_WAIT = 0.5
"""A frame waits so long for its depth and its transforms [s]."""
SILENT = 1.0
"""Where no depth came for so long [s], colours go on alone."""
_KEEP = 5.0  # of transforms [s]
_WAITING, _DEPTHS = 30, 30
_BASES = ("base_link", "base_footprint")


class OdometryPose(NamedTuple):
    """Where odometry has the camera."""

    stamp: float
    odometry_from_camera: NDArray[np.float64]
    """(4, 4) [m]"""
    covariance: NDArray[np.float64] | None
    """(6, 6) of it as odometry itself says, in its frame: x, y, z [m], and a turn about the axes [rad];
    it may hold anything. None: transforms tell where it is."""


class FrameAssembly:
    """Makes frames of messages, and moves, of which the first comes before the first frame.

    `left_out` counts what could not be used, by reason, `jumps` how often the clock was set back:
    what came before is then of another time.
    """

    def __init__(self, plan: Plan) -> None:
        assert plan.pose_reader is not None and plan.colour is not None  # noqa: S101, PT018  # nothing lacks
        self.plan = plan
        self.path = plan.bag.path
        self.left_out: Counter[str] = Counter()
        self.jumps = 0
        self.odometry, self.camera = plan.pose_reader.frame, plan.colour.frame
        """Names of frames."""
        self.base = self._base(plan.pose_reader.tree)
        self._colour = plan.colour.topic
        self._depth = plan.depth.topic if plan.depth is not None else None
        self._told = plan.pose_reader.odometry
        self._edges = self._wanted(plan.pose_reader.tree)
        self._lean = np.eye(4)
        self._lean[:3, :3] = plan.pose_reader.lean
        self._turns: int | None = None
        self._mount: NDArray[np.float64] | None = None
        self._spread: OdometryCovariance | None = None
        self._tree = Tree()
        self._tree.add(plan.choice.transforms, static=True)
        self._waiting: deque[tuple[float, Packet]] = deque()
        self._depths: deque[tuple[float, Packet]] = deque(maxlen=_DEPTHS)
        self._last, self._moved, self._count = -np.inf, -np.inf, 0

    @property
    def newest(self) -> float:
        """Stamp of the newest image [s]; minus infinity before the first."""
        return self._last

    @property
    def topics(self) -> frozenset[str]:
        """Names of the topics that frames are made of."""
        assert self.plan.pose_reader is not None  # noqa: S101
        parts = (self._colour, self._depth, self._told, *self.plan.pose_reader.moves)
        return frozenset(topic.name for topic in parts if topic is not None)

    def take(self, packet: Packet) -> Iterator[Frame | OdometryPose]:
        """Take in a message; `InputError` where it cannot be read, and nothing is changed."""
        if packet.topic == self._colour.name:
            self._take_image(packet)
        elif self._depth is not None and packet.topic == self._depth.name:
            self._depths.append((self._stamp(packet), packet))
        elif packet.topic in self.topics:
            self._take_transforms(packet)
            yield from self._move()
        yield from self._ready_frames(packet.time)

    def finish(self) -> Iterator[Frame | OdometryPose]:
        """Yield the frames that wait for what will not come any more: the stream has ended."""
        yield from self._ready_frames(np.inf)

    def base_from_camera(self) -> NDArray[np.float64] | None:
        """(4, 4) of the robot's base and the frames' camera as they are now; None: nothing joins them."""
        if self._mount is None:
            stamp = np.array([self._moved if np.isfinite(self._moved) else 0.0])
            found = self._tree.between(self.base, self.camera, stamp)
            if found is None or np.isnan(found).any():
                return None
            steps = self._tree.path(self.base, self.camera) or []
            if not all(_edge(self._tree, near, far).fixed for near, far in steps):
                return self._turned(found[0])
            self._mount = found[0]
        return self._turned(self._mount)

    def _stamp(self, packet: Packet) -> float:
        assert self.plan.pose_reader is not None  # noqa: S101
        return packet.time if self.plan.pose_reader.recorded else packet.stamp

    def _take_image(self, packet: Packet) -> None:
        stamp = self._stamp(packet)
        if stamp < self._last - BACK:
            self.jumps += 1
            self._forget(stamp + BACK)
        elif stamp <= self._last:
            self.left_out["its stamp twice, or late"] += 1
            return
        self._last = stamp
        self._waiting.append((stamp, packet))
        if len(self._waiting) > _WAITING:
            self._waiting.popleft()
            self.left_out["its transforms came too late"] += 1

    def _forget(self, after: float) -> None:
        """Forget what is of a later time [s]: the clock was set back."""
        for _ in range(len(self._waiting)):
            self._waiting.popleft()
            self.left_out["the clock jumped back"] += 1
        for held in [d for d in self._depths if d[0] > after]:
            self._depths.remove(held)
        edges = self._tree.edges.items()
        self._tree.edges = {k: e for k, e in edges if e.fixed or e.stamps[-1] <= after}
        self._moved = -np.inf

    def _ready_frames(self, now: float) -> Iterator[Frame | OdometryPose]:
        """Yield the frames all of whose parts have come, or will not come any more."""
        while self._waiting:
            stamp, packet = self._waiting[0]
            over = now - packet.time > LONGEST_WAIT
            if not (over or (self._depth_is_settled(stamp) and self._known_until() >= stamp)):
                return
            self._waiting.popleft()
            frame = self._frame(stamp, packet)
            if frame is not None:
                yield from self._move()
                yield frame

    def _depth_is_settled(self, stamp: float) -> bool:
        """Return whether the depth of a moment has come, or a later one, or none comes any more."""
        if self._depth is None or (self._depths and self._depths[-1][0] < stamp - SILENT):
            return True
        return any(s > stamp - SAME_MOMENT for s, _ in self._depths)

    def _frame(self, stamp: float, packet: Packet) -> Frame | None:
        pose_reader, camera = self.plan.pose_reader, self.plan.camera
        assert pose_reader is not None and camera is not None  # noqa: S101, PT018
        found = self._tree.between(pose_reader.frame, self.camera, np.array([stamp]))
        if found is None or np.isnan(found).any():
            self.left_out[f"no transform from {self.camera} to {pose_reader.frame}"] += 1
            return None
        pose = self._lean @ found[0]
        nearest = min(self._depths, key=lambda held: abs(held[0] - stamp), default=None)
        metres = None
        if nearest is not None and abs(nearest[0] - stamp) <= SAME_MOMENT:
            metres = self._metres(stamp, nearest[1])
            if metres is None:
                return None
        elif nearest is not None and self._depths[-1][0] > stamp - SILENT:
            self.left_out[f"no depth within {SAME_MOMENT * 1000:.0f} ms"] += 1
            return None
        colour = partial(picture, packet.message(self.path), Source.of(self._colour), camera)
        if self._turns is None:
            self._turns = upright_turns(-pose[2, :3])
        self._count += 1
        return posed_frame(
            self._count - 1, stamp, pose, camera, LazyImages(colour, metres, unit=unit_of(self.plan)),
            depth_camera=None if metres is None else self.plan.depth_camera, turns=self._turns,
        )  # fmt: skip

    def _metres(self, stamp: float, packet: Packet) -> partial[NDArray[np.float32]] | None:
        """Return what reads the depth of a message; None, and counted: its camera's place is not known."""
        depth, moved = self.plan.depth, None
        assert depth is not None  # noqa: S101
        if self.plan.registration is not None:
            found = self._tree.between(self.camera, depth.frame, np.array([stamp]))
            if found is None or np.isnan(found).any():
                self.left_out[f"no transform from {depth.frame} to {self.camera}"] += 1
                return None
            moved = found[0]
        return partial(
            metres_of, packet.message(self.path), Source.of(depth.topic), depth.size,
            self.plan.choice.depth_scale, self.plan.registration, moved,
        )  # fmt: skip

    def _wanted(self, tree: Tree) -> frozenset[tuple[str, str]]:
        """Return the parents and children of the transforms that lead from odometry to cameras and base."""
        depth = self.plan.depth
        ends = [self.odometry, self.base, *([] if depth is None else [depth.frame])]
        steps = [step for end in ends for step in tree.path(end, self.camera) or ()]
        return frozenset(step if step in tree.edges else step[::-1] for step in steps)

    def _base(self, tree: Tree) -> str:
        """Return the robot's base: by its name, else what odometry carries."""
        steps = tree.path(self.odometry, self.camera) or []
        named = [b for b in _BASES if b in tree.names and tree.path(b, self.camera) is not None]
        moves = [far for near, far in steps if not _edge(tree, near, far).fixed]
        return next(iter((*named, *moves)), self.camera)

    def _take_transforms(self, packet: Packet) -> None:
        """Take in transforms or odometry."""
        rows = self._rows(packet)
        for key in self._edges & rows.keys():
            table = np.array(rows[key])
            if is_static(packet.topic):
                self._tree.add({key: [table]}, static=True)
            else:
                self._tree.extend(key, table, _KEEP)

    def _move(self) -> Iterator[OdometryPose]:
        """Yield where odometry has the camera by now, if it has told anything new."""
        newest = self._known_until()
        if (
            self._turns is None
            or not np.isfinite(newest)
            or self._moved - BACK < newest <= self._moved
        ):
            return
        found = self._tree.between(self.odometry, self.camera, np.array([newest]))
        if found is not None and not np.isnan(found).any():
            self._moved = newest
            pose = self._lean @ self._turned(found[0])
            spread = self._spread and self._spread.at(found[0], self._lean)
            yield OdometryPose(newest, pose, spread)

    def _rows(self, packet: Packet) -> dict[tuple[str, str], list[tuple[float, ...]]]:
        """Return the stamps and numbers of transforms by parent and child."""
        said = decode(packet.data, f"{self.path}, {packet.topic}", packet.type, packet.encoding)
        assert self.plan.pose_reader is not None  # noqa: S101
        by_recording = self.plan.pose_reader.recorded
        out: dict[tuple[str, str], list[tuple[float, ...]]] = {}
        if self._told is not None and packet.topic == self._told.name:
            at = said.pose.pose
            if frame_of(said.header.frame_id) == self.odometry:
                self._spread = OdometryCovariance.of(said.pose)
            held = [(said.header, said.child_frame_id, at.position, at.orientation)]
        else:
            held = [
                (t.header, t.child_frame_id, t.transform.translation, t.transform.rotation)
                for t in said.transforms
            ]
        for header, child, place, turn in held:
            stamp = packet.time if by_recording else stamp_of(header)
            key = frame_of(header.frame_id), frame_of(child)
            out.setdefault(key, []).append((stamp, *numbers_of(place, turn)))
        return out

    def _known_until(self) -> float:
        """Return the stamp up to which all transforms from odometry to the camera are known [s]."""
        path = self._tree.path(self.odometry, self.camera)
        if path is None:
            return -np.inf
        edges = [_edge(self._tree, near, far) for near, far in path]
        return min((float(e.stamps[-1]) for e in edges if not e.fixed), default=np.inf)

    def _turned(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pose of the camera as the frames' images are turned."""
        out = pose.copy()
        out[:3, :3] = pose[:3, :3] @ quarter_turn(self._turns or 0).T
        return out


def _edge(tree: Tree, near: str, far: str) -> Edge:
    return tree.edges.get((near, far)) or tree.edges[far, near]


_FOOTER, _DATA_END = 2, 15


def mcap_packets(read: Callable[[int], bytes], name: str) -> Iterator[Packet | Fault]:
    """Yield the messages of a stream of bytes, up to its end, or as far as it goes where it is cut off.

    Parameters
    ----------
    read
        Returns so many bytes, waiting for them; fewer where the stream ends.
    name
        What it is called in messages.

    Raises
    ------
    InputError
        It does not begin as an MCAP.

    """
    if read(len(MAGIC)) != MAGIC:
        raise InputError(
            f"{name} is no MCAP stream: it does not begin as one. Send the bytes of an .mcap from its "
            "beginning; other bags are named as files."
        )
    known = Channels()
    while len(head := read(9)) == 9:
        op, length = unpack_from("<BQ", head)
        if op in {_FOOTER, _DATA_END}:
            return
        if length > LARGEST_MESSAGE:
            yield Fault("", f"{name} is damaged: a record of {length:,} bytes; it ends here.")
            return
        data = read(length)
        whole = len(data) == length
        try:
            yield from _packets_of_record(known, op, data, name) if whole or op == CHUNK else ()
        except (MissingIndexError, InputError, struct.error) as error:
            if whole:
                said = str(error) or "it is cut off"
                yield Fault("", f"{name}, a chunk: {said}; what follows is read.")
        if not whole:
            break
    yield Fault("", f"{name} was cut off, for it has no end; it is read as far as it goes.")


def _packets_of_record(known: Channels, op: int, data: bytes, name: str) -> Iterator[Packet]:
    """Yield the messages of a record."""
    if op == CHUNK:
        _, _, size, _, letters = unpack_from("<QQQII", data)
        packing = data[32 : 32 + letters].decode("ascii", "replace")
        content = data[32 + letters + 8 :]
        if packing:
            content = CompressedBytes(content, packing, f"{name}, a chunk").read(0, size)
        for inner, at, length in records(content):
            yield from _packets_of_record(known, inner, content[at : at + length], name)
    elif op == MESSAGE:
        number, _, time = unpack_from("<HIQ", data)
        channel = known.channels.get(number)
        if channel is not None and channel.encoding in {"cdr", "ros1"}:
            kind = ros2_type(channel.type)
            yield Packet(channel.topic, kind, time * 1e-9, data[22:], channel.encoding)
    else:
        known.add_record(op, data)
