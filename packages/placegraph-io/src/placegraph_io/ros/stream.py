"""Frames of a stream of messages: a live recording, a pipe, or a bag in the order of its recording.

`StreamDiscovery` chooses the topics, `FrameAssembly` assembles frames. A frame is ready when its depth and
transforms have arrived; after a timeout it is left out and counted. `mcap_packets` reads an MCAP that is
still being written.
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

from placegraph.core.geometry import Camera
from placegraph.errors import InputError, PlacegraphError
from placegraph.io.capture.frame import Frame, LazyImages, posed_frame, quarter_turn, upright_turns
from placegraph.io.capture.posed import SAME_MOMENT
from placegraph_io.ros.capture import MessageSource, depth_unit, read_colour, read_depth
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
from placegraph_io.ros.decode import decode, frame_name, header_stamp
from placegraph_io.ros.poses import (
    CLOCK_JUMP,
    TRANSFORM_TYPES,
    Edge,
    OdometryCovariance,
    TransformTree,
    is_static,
    pose_numbers,
)
from placegraph_io.ros.topics import IMAGES, CameraReader, CapturePlan, TopicChoice, plan_capture
from placegraph_io.storage import LARGEST_MESSAGE, CompressedBytes


class Packet(NamedTuple):
    """One message with its time of arrival."""

    topic: str
    type: str  # As ROS 2 names it: `sensor_msgs/msg/Image`
    time: float  # Time of recording or arrival [s]
    data: bytes
    encoding: str = "cdr"  # `cdr` (ROS 2) or `ros1`

    @property
    def stamp(self) -> float:
        """Stamp of the header [s]; where 0, the time of arrival; `InputError` without a header."""
        at, form = (4, "<II") if self.encoding == "ros1" else (4, "<iI")
        if self.encoding == "cdr" and self.data[1:2] in {b"\x00", b"\x02"}:
            form = ">iI"
        try:
            seconds, nanos = unpack_from(form, self.data, at)
        except struct_error as error:
            raise InputError(f"{self.topic}: a message has no header; record again.") from error
        return float(seconds + nanos * 1e-9) or self.time

    def message(self, path: Path) -> Message:
        """Return the packet as a message of a bag of this name."""
        return Message(MemoryStore(path, (self.data,)), 0)


class Fault(NamedTuple):
    """A message that cannot be read."""

    topic: str
    reason: str  # Reason, a sentence


@dataclass(frozen=True, slots=True)
class MemoryStore:
    """Messages in memory, a `containers.MessageStore`."""

    path: Path  # Name of the stream in error messages
    data: Sequence[bytes]

    def read(self, offset: int, most: int | None = None) -> bytes:
        """Read a message; the offset is its number."""
        return self.data[offset][:most]


def bag_packets(bag: Bag, topics: Collection[str]) -> Iterator[Packet | Fault]:
    """Yield messages of topics in the order of their recording, `tf_static` before all others."""
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


LISTEN = 1.0  # Time before the first choice of topics, and between two attempts [s]
_IMAGES, _OTHERS = 16, 2000  # messages of a topic that are stored until then
OTHERS = ("sensor_msgs/CameraInfo", "nav_msgs/Odometry", "sensor_msgs/Imu")
WANTED = frozenset((*IMAGES, *TRANSFORM_TYPES, *OTHERS))
"""Types of the messages that are used, such as `sensor_msgs/Image`."""


class StreamDiscovery:
    """Chooses the topics of a stream that make frames.

    `path` names the stream in error messages, which refer to a file PATH.json; `choice` are the user's
    topics.
    """

    def __init__(self, path: Path, choice: TopicChoice) -> None:
        self.path, self.choice = path, choice
        self.missing: tuple[str, ...] = ()
        """Sentences about what is still missing."""
        self._stored: dict[tuple[str, str, str], deque[Packet]] = {}
        self._next: float | None = None

    def take(self, packet: Packet) -> CapturePlan | None:
        """Add a message; return the plan as soon as it is complete."""
        if packet.type.replace("/msg/", "/") not in WANTED:
            return None
        key = packet.topic, packet.type, packet.encoding
        if key not in self._stored:
            short = packet.type.replace("/msg/", "/")
            self._stored[key] = deque(maxlen=_IMAGES if short in IMAGES else _OTHERS)
        self._stored[key].append(packet)
        if (
            self._next is None or packet.time < self._next - LISTEN
        ):  # the first, or the clock was set
            self._next = packet.time + LISTEN
        return self.find_plan() if packet.time >= self._next else None

    def find_plan(self) -> CapturePlan | None:
        """Return the plan of the messages so far, or None; `missing` says what it lacks."""
        held = [packet for packets in self._stored.values() for packet in packets]
        if not held:
            self.missing = (f"{self.path}: no camera message has arrived yet.",)
            return None
        self._next = max(packet.time for packet in held) + LISTEN
        try:
            plan = plan_capture(self._bag(), self.choice)
        except PlacegraphError as error:
            self.missing = (str(error),)
            return None
        self.missing = tuple(plan.missing.values())
        return None if plan.missing else plan

    def packets(self) -> list[Packet]:
        """Return the stored messages, static transforms first."""
        held = [packet for packets in self._stored.values() for packet in packets]
        return sorted(held, key=lambda p: (not is_static(p.topic), p.time))

    def _bag(self) -> Bag:
        """Return the stored messages as a bag."""
        topics: dict[str, Topic] = {}
        for (name, kind, encoding), packets in self._stored.items():
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


LONGEST_WAIT = 0.5  # Longest time that a frame waits for depth and transforms [s]
SILENT = 1.0  # Time without depth after which frames have none [s]
_HISTORY = 5.0  # of transforms [s]
_WAITING, _DEPTHS = 30, 30
_BASES = ("base_link", "base_footprint")


class OdometryPose(NamedTuple):
    """Pose of the camera by odometry."""

    stamp: float
    odometry_from_camera: NDArray[np.float64]  # (4, 4) [m]
    covariance: NDArray[np.float64] | None
    """(6, 6) as odometry reports it, in its frame: x, y, z [m] and rotation about the axes [rad];
    unchecked. None where transforms hold the pose."""


class FrameAssembly:
    """Assembles frames and odometry poses from messages; the first pose precedes the first frame.

    `left_out` counts unusable messages by reason, `jumps` how often the clock was set back.
    """

    def __init__(self, plan: CapturePlan) -> None:
        assert plan.pose_reader is not None and plan.colour is not None  # noqa: S101, PT018  # nothing lacks
        self.plan = plan
        self.path = plan.bag.path
        self.left_out: Counter[str] = Counter()
        self.jumps = 0
        self.odometry, self.camera = plan.pose_reader.frame, plan.colour.frame
        """Names of coordinate frames."""
        self.base = self._base(plan.pose_reader.tree)
        self._colour = plan.colour.topic
        self._depth = plan.depth.topic if plan.depth is not None else None
        depth_reader = plan.depth_camera_reader if plan.registration is None else None
        self._readers = {r.topic.name: r for r in (plan.camera_reader, depth_reader) if r}
        self._cameras: dict[str, deque[tuple[float, Camera]]] = {
            name: deque(maxlen=_DEPTHS) for name in self._readers
        }
        self._odometry_topic = plan.pose_reader.odometry
        self._edges = self._needed_edges(plan.pose_reader.tree)
        self._upright = np.eye(4)
        self._upright[:3, :3] = plan.pose_reader.upright_from_frame
        self._turns: int | None = None
        self._mount: NDArray[np.float64] | None = None
        self._odometry_covariance: OdometryCovariance | None = None
        self._tree = TransformTree()
        self._tree.add(plan.choice.transforms, static=True)
        self._waiting: deque[tuple[float, Packet]] = deque()
        self._depths: deque[tuple[float, Packet]] = deque(maxlen=_DEPTHS)
        self._last, self._last_pose, self._count = -np.inf, -np.inf, 0

    @property
    def newest(self) -> float:
        """Stamp of the newest image [s]; minus infinity before the first."""
        return self._last

    @property
    def oldest_waiting(self) -> float:
        """Stamp of the oldest image that waits for depth or transforms [s]; infinite: none waits."""
        return self._waiting[0][0] if self._waiting else np.inf

    @property
    def topics(self) -> frozenset[str]:
        """Names of the topics that make frames."""
        assert self.plan.pose_reader is not None  # noqa: S101
        parts = (
            self._colour,
            self._depth,
            self._odometry_topic,
            *self.plan.pose_reader.transform_topics,
            *(reader.topic for reader in self._readers.values()),
        )
        return frozenset(topic.name for topic in parts if topic is not None)

    def take(self, packet: Packet) -> Iterator[Frame | OdometryPose]:
        """Add a message; `InputError`, without a change, where it cannot be read."""
        if packet.topic == self._colour.name:
            self._take_image(packet)
        elif self._depth is not None and packet.topic == self._depth.name:
            self._depths.append((self._stamp(packet), packet))
        elif packet.topic in self._readers:
            camera = self._readers[packet.topic].read(packet.data)
            self._cameras[packet.topic].append((self._stamp(packet), camera))
        elif packet.topic in self.topics:
            self._take_transforms(packet)
            yield from self._move()
        yield from self._ready_frames(packet.time)

    def finish(self) -> Iterator[Frame | OdometryPose]:
        """Yield the waiting frames at the end of the stream."""
        yield from self._ready_frames(np.inf)

    def base_from_camera(self) -> NDArray[np.float64] | None:
        """Return base_from_camera (4, 4) at present; None where no transform connects them."""
        if self._mount is None:
            stamp = np.array([self._last_pose if np.isfinite(self._last_pose) else 0.0])
            found = self._tree.lookup(self.base, self.camera, stamp)
            if found is None or np.isnan(found).any():
                return None
            steps = self._tree.find_path(self.base, self.camera) or []
            if not all(_edge(self._tree, near, far).fixed for near, far in steps):
                return self._turn_pose(found[0])
            self._mount = found[0]
        return self._turn_pose(self._mount)

    def _stamp(self, packet: Packet) -> float:
        assert self.plan.pose_reader is not None  # noqa: S101
        return packet.time if self.plan.pose_reader.recorded else packet.stamp

    def _take_image(self, packet: Packet) -> None:
        stamp = self._stamp(packet)
        if stamp < self._last - CLOCK_JUMP:
            self.jumps += 1
            self._forget(stamp + CLOCK_JUMP)
        elif stamp <= self._last:
            self.left_out["a repeated or late stamp"] += 1
            return
        self._last = stamp
        self._waiting.append((stamp, packet))
        if len(self._waiting) > _WAITING:
            self._waiting.popleft()
            self.left_out["its transforms came too late"] += 1

    def _forget(self, after: float) -> None:
        """Drop what is later than a time [s], after the clock was set back."""
        for _ in range(len(self._waiting)):
            self._waiting.popleft()
            self.left_out["the clock jumped back"] += 1
        for held in [d for d in self._depths if d[0] > after]:
            self._depths.remove(held)
        edges = self._tree.edges.items()
        self._tree.edges = {k: e for k, e in edges if e.fixed or e.stamps[-1] <= after}
        self._last_pose = -np.inf

    def _ready_frames(self, now: float) -> Iterator[Frame | OdometryPose]:
        """Yield the frames that are complete or timed out."""
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
        """Return whether the depth of a moment, or later depth, has arrived, or depth has ended."""
        if self._depth is None or (self._depths and self._depths[-1][0] < stamp - SILENT):
            return True
        return any(s > stamp - SAME_MOMENT for s, _ in self._depths)

    def _frame(self, stamp: float, packet: Packet) -> Frame | None:
        pose_reader = self.plan.pose_reader
        camera = self._camera(stamp, self.plan.camera, self.plan.camera_reader)
        assert pose_reader is not None and camera is not None  # noqa: S101, PT018
        found = self._tree.lookup(pose_reader.frame, self.camera, np.array([stamp]))
        if found is None or np.isnan(found).any():
            self.left_out[f"no transform from {self.camera} to {pose_reader.frame}"] += 1
            return None
        pose = self._upright @ found[0]
        nearest = min(self._depths, key=lambda held: abs(held[0] - stamp), default=None)
        metres = None
        if nearest is not None and abs(nearest[0] - stamp) <= SAME_MOMENT:
            metres = self._metres(stamp, nearest[1])
            if metres is None:
                return None
        elif nearest is not None and self._depths[-1][0] > stamp - SILENT:
            self.left_out[f"no depth within {SAME_MOMENT * 1000:.0f} ms"] += 1
            return None
        colour = partial(
            read_colour, packet.message(self.path), MessageSource.from_topic(self._colour), camera
        )
        if self._turns is None:
            self._turns = upright_turns(-pose[2, :3])
        self._count += 1
        return posed_frame(
            self._count - 1, stamp, pose, camera, LazyImages(colour, metres, unit=depth_unit(self.plan)),
            depth_camera=None if metres is None else
            self._camera(stamp, self.plan.depth_camera, self.plan.depth_camera_reader),
            turns=self._turns,
        )  # fmt: skip

    def _camera(
        self, stamp: float, camera: Camera | None, reader: CameraReader | None
    ) -> Camera | None:
        """Return the camera of the CameraInfo nearest to a moment; the given one without any."""
        held = self._cameras.get(reader.topic.name) if reader else None
        return min(held, key=lambda h: abs(h[0] - stamp))[1] if held else camera

    def _metres(self, stamp: float, packet: Packet) -> partial[NDArray[np.float32]] | None:
        """Return the function that reads a depth image; None, and counted, without its transform."""
        depth, moved = self.plan.depth, None
        assert depth is not None  # noqa: S101
        if self.plan.registration is not None:
            found = self._tree.lookup(self.camera, depth.frame, np.array([stamp]))
            if found is None or np.isnan(found).any():
                self.left_out[f"no transform from {depth.frame} to {self.camera}"] += 1
                return None
            moved = found[0]
        return partial(
            read_depth, packet.message(self.path), MessageSource.from_topic(depth.topic), depth.size,
            self.plan.choice.depth_scale, self.plan.registration, moved,
        )  # fmt: skip

    def _needed_edges(self, tree: TransformTree) -> frozenset[tuple[str, str]]:
        """Return the edges from odometry to the cameras and the base."""
        depth = self.plan.depth
        ends = [self.odometry, self.base, *([] if depth is None else [depth.frame])]
        steps = [step for end in ends for step in tree.find_path(end, self.camera) or ()]
        return frozenset(step if step in tree.edges else step[::-1] for step in steps)

    def _base(self, tree: TransformTree) -> str:
        """Return the robot's base frame: by name, else odometry's child."""
        steps = tree.find_path(self.odometry, self.camera) or []
        named = [
            b for b in _BASES if b in tree.names and tree.find_path(b, self.camera) is not None
        ]
        moves = [far for near, far in steps if not _edge(tree, near, far).fixed]
        return next(iter((*named, *moves)), self.camera)

    def _take_transforms(self, packet: Packet) -> None:
        """Add transforms or odometry."""
        rows = self._read_rows(packet)
        for key in self._edges & rows.keys():
            table = np.array(rows[key])
            if is_static(packet.topic):
                self._tree.add({key: [table]}, static=True)
            else:
                self._tree.extend(key, table, _HISTORY)

    def _move(self) -> Iterator[OdometryPose]:
        """Yield the newest pose by odometry, if it is new."""
        newest = self._known_until()
        is_old = self._last_pose - CLOCK_JUMP < newest <= self._last_pose
        if self._turns is None or not np.isfinite(newest) or is_old:
            return
        found = self._tree.lookup(self.odometry, self.camera, np.array([newest]))
        if found is not None and not np.isnan(found).any():
            self._last_pose = newest
            pose = self._upright @ self._turn_pose(found[0])
            covariance = self._odometry_covariance and self._odometry_covariance.at(
                found[0], self._upright
            )
            yield OdometryPose(newest, pose, covariance)

    def _read_rows(self, packet: Packet) -> dict[tuple[str, str], list[tuple[float, ...]]]:
        """Return the stamps and numbers of transforms by parent and child."""
        message = decode(packet.data, f"{self.path}, {packet.topic}", packet.type, packet.encoding)
        assert self.plan.pose_reader is not None  # noqa: S101
        by_recording = self.plan.pose_reader.recorded
        out: dict[tuple[str, str], list[tuple[float, ...]]] = {}
        if self._odometry_topic is not None and packet.topic == self._odometry_topic.name:
            at = message.pose.pose
            if frame_name(message.header.frame_id) == self.odometry:
                self._odometry_covariance = OdometryCovariance.from_message(message.pose)
            held = [(message.header, message.child_frame_id, at.position, at.orientation)]
        else:
            held = [
                (t.header, t.child_frame_id, t.transform.translation, t.transform.rotation)
                for t in message.transforms
            ]
        for header, child, place, turn in held:
            stamp = packet.time if by_recording else header_stamp(header)
            key = frame_name(header.frame_id), frame_name(child)
            out.setdefault(key, []).append((stamp, *pose_numbers(place, turn)))
        return out

    def _known_until(self) -> float:
        """Return the last stamp at which the path from odometry to the camera is known [s]."""
        path = self._tree.find_path(self.odometry, self.camera)
        if path is None:
            return -np.inf
        edges = [_edge(self._tree, near, far) for near, far in path]
        return min((float(e.stamps[-1]) for e in edges if not e.fixed), default=np.inf)

    def _turn_pose(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """Rotate a camera pose as the frames' images are rotated."""
        out = pose.copy()
        out[:3, :3] = pose[:3, :3] @ quarter_turn(self._turns or 0).T
        return out


def _edge(tree: TransformTree, near: str, far: str) -> Edge:
    return tree.edges.get((near, far)) or tree.edges[far, near]


_FOOTER, _DATA_END = 2, 15


def mcap_packets(read: Callable[[int], bytes], name: str) -> Iterator[Packet | Fault]:
    """Yield the messages of a stream of bytes up to its end, also where it is truncated.

    `read` returns the given number of bytes, fewer at the end of the stream; `name` is the name of the
    stream in messages. Raises `InputError` where the stream does not begin as an MCAP.
    """
    if read(len(MAGIC)) != MAGIC:
        raise InputError(
            f"{name} does not begin like an MCAP stream. Send an .mcap from its beginning; give "
            "other bags as files."
        )
    channels = Channels()
    while len(head := read(9)) == 9:
        op, length = unpack_from("<BQ", head)
        if op in {_FOOTER, _DATA_END}:
            return
        if length > LARGEST_MESSAGE:
            yield Fault("", f"{name} is damaged: a record has {length:,} bytes; reading ends here.")
            return
        data = read(length)
        whole = len(data) == length
        try:
            yield from _packets_of_record(channels, op, data, name) if whole or op == CHUNK else ()
        except (MissingIndexError, InputError, struct.error) as error:
            if whole:
                reason = str(error) or "it is truncated"
                yield Fault("", f"{name}, a chunk: {reason}; reading continues after it.")
        if not whole:
            break
    yield Fault("", f"{name} has no end, so it was truncated; it is read as far as possible.")


def _packets_of_record(channels: Channels, op: int, data: bytes, name: str) -> Iterator[Packet]:
    """Yield the messages of a record."""
    if op == CHUNK:
        _, _, size, _, letters = unpack_from("<QQQII", data)
        packing = data[32 : 32 + letters].decode("ascii", "replace")
        content = data[32 + letters + 8 :]
        if packing:
            content = CompressedBytes(content, packing, f"{name}, a chunk").read(0, size)
        for inner, at, length in records(content):
            yield from _packets_of_record(channels, inner, content[at : at + length], name)
    elif op == MESSAGE:
        number, _, time = unpack_from("<HIQ", data)
        channel = channels.channels.get(number)
        if channel is not None and channel.encoding in {"cdr", "ros1"}:
            kind = ros2_type(channel.type)
            yield Packet(channel.topic, kind, time * 1e-9, data[22:], channel.encoding)
    else:
        channels.add_record(op, data)
