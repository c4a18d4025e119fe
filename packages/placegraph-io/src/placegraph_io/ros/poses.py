"""Poses of a bag's camera: the tree of transforms between frames, odometry, and stamps of images."""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from struct import unpack_from
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import cross_matrix, rotation_from_quaternion
from placegraph.errors import InputError
from placegraph.io.capture.up import upright
from placegraph_io.ros.containers import Bag, Topic, read_messages
from placegraph_io.ros.decode import HEAD, decode, frame_name, header_stamp, read_stamps

if TYPE_CHECKING:
    from placegraph_io.ros.topics import ImageTopic, TopicChoice

MAX_GAP = 0.5  # Longest gap between samples of a transform that is interpolated [s]
EXTRAPOLATION = (
    0.05  # Time before the first and after the last sample for which a transform holds [s]
)
_FIXED_TOLERANCE = 1e-9
_UNIT_TOLERANCE = 1e-2  # quaternions are written with few digits

Samples = dict[tuple[str, str], list[NDArray[np.float64]]]
"""By parent and child: rows (N, 8) of stamp [s], x, y, z [m], qx, qy, qz, qw."""


def is_static(topic: str) -> bool:
    """Return whether a topic's transforms never change."""
    return topic.endswith("tf_static")


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """Samples of one transform, parent_from_child."""

    stamps: NDArray[np.float64]  # (N,) strictly ascending [s]
    position: NDArray[np.float64]  # (N, 3) [m]
    xyzw: NDArray[np.float64]  # (N, 4) of unit length
    fixed: bool  # Whether it never changes

    @classmethod
    def from_samples(
        cls, stamps: NDArray[np.float64], values: NDArray[np.float64], *, static: bool
    ) -> Edge:
        """Return the edge of unordered samples: stamps (N,) [s], x y z qx qy qz qw (N, 7)."""
        stamps, first = np.unique(stamps[::-1], return_index=True)  # the last of equal stamps
        values = values[::-1][first]
        xyzw = values[:, 3:] / np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
        flip = np.cumprod(np.where((xyzw[1:] * xyzw[:-1]).sum(axis=1) < 0, -1.0, 1.0))
        xyzw[1:] *= flip[:, None]
        same = bool((np.ptp(np.c_[values[:, :3], xyzw], axis=0) <= _FIXED_TOLERANCE).all())
        return cls(stamps, values[:, :3], xyzw, static or same)

    def extend(self, newer: Edge, since: float) -> Edge:
        """Return the edge of the samples after `since` [s] and of newer ones."""
        first = int(np.searchsorted(self.stamps, since, "right"))
        same = 1.0 if (self.xyzw[-1] * newer.xyzw[0]).sum() >= 0 else -1.0
        stamps = np.concatenate([self.stamps[first:], newer.stamps])
        position = np.concatenate([self.position[first:], newer.position])
        xyzw = np.concatenate([self.xyzw[first:], same * newer.xyzw])
        if newer.stamps[0] > self.stamps[-1]:
            return Edge(stamps, position, xyzw, fixed=False)
        return replace(Edge.from_samples(stamps, np.c_[position, xyzw], static=False), fixed=False)

    def at(self, stamps: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return parent_from_child (T, 4, 4) at stamps (T,); NaN where it is not known."""
        poses = np.tile(np.eye(4), (len(stamps), 1, 1))
        if self.fixed:
            poses[:, :3, :3] = rotation_from_quaternion(self.xyzw[-1])
            poses[:, :3, 3] = self.position[-1]
            return poses
        if len(self.stamps) == 1:
            poses[:] = replace(self, fixed=True).at(stamps)
            poses[np.abs(stamps - self.stamps[0]) > EXTRAPOLATION] = np.nan
            return poses
        after = np.clip(np.searchsorted(self.stamps, stamps), 1, len(self.stamps) - 1)
        before = after - 1
        gap = self.stamps[after] - self.stamps[before]
        part = np.clip((stamps - self.stamps[before]) / gap, 0.0, 1.0)[:, None]
        poses[:, :3, 3] = self.position[before] * (1 - part) + self.position[after] * part
        # normalized linear interpolation: samples are close to each other
        xyzw = self.xyzw[before] * (1 - part) + self.xyzw[after] * part
        poses[:, :3, :3] = rotation_from_quaternion(xyzw)
        outside = np.maximum(self.stamps[0] - stamps, stamps - self.stamps[-1])
        on = np.minimum(np.abs(stamps - self.stamps[before]), np.abs(stamps - self.stamps[after]))
        unknown = (outside > EXTRAPOLATION) | (
            (gap > MAX_GAP) & (outside < 0) & (on > EXTRAPOLATION)
        )
        poses[unknown] = np.nan
        return poses


@dataclass(slots=True, eq=False)
class TransformTree:
    """Frames and the edges between them; a child that has two parents keeps both."""

    edges: dict[tuple[str, str], Edge] = field(default_factory=dict)  # By parent and child
    invalid: int = 0  # Number of invalid samples: not finite, or without a unit quaternion

    def add(self, samples: Samples, *, static: bool = False) -> None:
        """Add samples in the order of their recording."""
        for key, held in samples.items():
            table = np.concatenate(held)
            with np.errstate(over="ignore", invalid="ignore"):
                length = np.linalg.norm(table[:, 4:], axis=1)
                good = np.isfinite(table).all(axis=1) & (np.abs(length - 1.0) < _UNIT_TOLERANCE)
            good &= key[0] != key[1]
            self.invalid += int((~good).sum())
            if good.any():
                self.edges[key] = Edge.from_samples(table[good, 0], table[good, 1:], static=static)

    def extend(self, key: tuple[str, str], rows: NDArray[np.float64], keep: float) -> None:
        """Add newer samples (N, 8) of a stream's transform, and drop those older than `keep` [s].

        The transform may change at any time. Where stamps go back by more than `MAX_GAP`, the clock
        was set back, and older samples are dropped.
        """
        edge = self.edges.pop(key, None)
        self.add({key: [rows]})
        newer = self.edges.get(key)
        if newer is None:
            if edge is not None:
                self.edges[key] = edge
            return
        newer = replace(newer, fixed=False)
        if edge is not None and newer.stamps[0] > edge.stamps[-1] - MAX_GAP:
            newer = edge.extend(newer, newer.stamps[-1] - keep)
        self.edges[key] = newer

    @property
    def names(self) -> list[str]:
        """Names of all frames."""
        return sorted({name for edge in self.edges for name in edge})

    def parents(self) -> dict[str, list[str]]:
        """Return the parents of each child."""
        out: dict[str, list[str]] = defaultdict(list)
        for parent, child in self.edges:
            out[child].append(parent)
        return dict(out)

    def ancestors(self, frame: str) -> dict[str, bool]:
        """Return the ancestors of a frame, nearest first, and whether the frame moves in them."""
        parents = self.parents()
        out: dict[str, bool] = {}
        todo = deque([(frame, False)])
        while todo:
            child, moves = todo.popleft()
            for parent in parents.get(child, []):
                if parent not in out and parent != frame:
                    out[parent] = moves or not self.edges[parent, child].fixed
                    todo.append((parent, out[parent]))
        return out

    def find_path(self, target: str, source: str) -> list[tuple[str, str]] | None:
        """Return the pairs of frames on the shortest path from target to source; None where there is none."""
        near: dict[str, list[str]] = defaultdict(list)
        for parent, child in self.edges:
            near[parent].append(child)
            near[child].append(parent)
        came: dict[str, str] = {target: ""}
        todo = deque([target])
        while todo and source not in came:
            here = todo.popleft()
            for there in near[here]:
                if there not in came:
                    came[there] = here
                    todo.append(there)
        if source not in came:
            return None
        steps = []
        while source != target:
            steps.append((came[source], source))
            source = came[source]
        return steps[::-1]

    def lookup(
        self, target: str, source: str, stamps: NDArray[np.float64]
    ) -> NDArray[np.float64] | None:
        """Return target_from_source (T, 4, 4) at stamps (T,), NaN in gaps; None without a path."""
        steps = self.find_path(target, source)
        if steps is None:
            return None
        out = np.tile(np.eye(4), (len(stamps), 1, 1))
        for near, far in steps:
            down = (near, far) in self.edges
            edge = self.edges[(near, far) if down else (far, near)].at(stamps)
            out = out @ (edge if down else inverse(edge))
        return out


def inverse(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverses (T, 4, 4) of rigid transforms."""
    out = np.tile(np.eye(4), (len(poses), 1, 1))
    out[:, :3, :3] = poses[:, :3, :3].swapaxes(1, 2)
    out[:, :3, 3] = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    return out


TransformRows = dict[tuple[str, str], list[NDArray[np.float64]]]
"""By parent and child: rows (N, 9) of time of recording and stamp [s], x, y, z [m], qx, qy, qz, qw."""
_NUMBERS = 56  # bytes of a transform's numbers, at the end
_STAMP = 8  # offset of the stamp of the first transform, in ROS 1 and ROS 2


def read_transforms(
    data: list[bytes], topic: Topic, path: Path, window: tuple[int, int] | None
) -> TransformRows:
    """Return the transforms of a topic's messages, recorded within a window [ns] (None: always).

    Messages of one transform between the same frames differ only in stamp and numbers: the first is
    decoded, and only stamp and numbers of the others are read.
    """
    groups: dict[bytes | int, list[tuple[int, bytes]]] = defaultdict(list)
    ros1 = topic.encoding == "ros1"
    head = b"\1\0\0\0" if ros1 else b"\0\1\0\0\1\0\0\0"  # one transform, little-endian
    for row, (time, raw) in enumerate(zip(topic.times.tolist(), data, strict=True)):
        if window is None or window[0] < time < window[1]:
            is_single = raw.startswith(head) and len(raw) >= _STAMP + 8 + _NUMBERS
            groups[raw[_STAMP + 8 : -_NUMBERS] if is_single else row].append((time, raw))
    out: TransformRows = defaultdict(list)
    for group in groups.values():
        where = f"{path}, {topic.name}"
        for t in decode(group[0][1], where, topic.type, topic.encoding).transforms:
            rows = np.empty((len(group), 9))
            rows[:, 0] = np.array([time for time, _ in group]) * 1e-9
            rows[0, 1:] = (
                header_stamp(t.header),
                *pose_numbers(t.transform.translation, t.transform.rotation),
            )
            raws = [raw for _, raw in group[1:]]
            form = "<II" if ros1 else "<iI"
            rows[1:, 1] = [
                s + n * 1e-9 for s, n in (unpack_from(form, raw, _STAMP) for raw in raws)
            ]
            numbers = b"".join(raw[-_NUMBERS:] for raw in raws)
            rows[1:, 2:] = np.frombuffer(numbers, "<f8").reshape(-1, 7)
            out[frame_name(t.header.frame_id), frame_name(t.child_frame_id)].append(rows)
    return dict(out)


def select_samples(tables: Iterable[TransformRows], *, recorded: bool) -> Samples:
    """Return the samples of all tables, with their stamps or their times of recording."""
    out: Samples = defaultdict(list)
    for table in tables:
        for key, rows in table.items():
            out[key] += [np.delete(r, 1 if recorded else 0, axis=1) for r in rows]
    return out


def pose_numbers(move: Any, turn: Any) -> tuple[float, ...]:  # noqa: ANN401  # rosbags'
    """Return x, y, z, qx, qy, qz, qw of a position and a quaternion."""
    return move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w


class OdometryCovariance(NamedTuple):
    """Covariance that odometry reports, and the position that it belongs to."""

    covariance: NDArray[np.float64]
    """(6, 6) of x, y, z [m] and a rotation about its frame's axes [rad]; unchecked."""
    position: NDArray[np.float64]  # (3,) [m]

    @classmethod
    def from_message(cls, message: Any) -> Self:  # noqa: ANN401  # rosbags'
        """Read a `geometry_msgs/PoseWithCovariance`."""
        at = message.pose.position
        covariance = np.array(message.covariance, np.float64).reshape(6, 6)
        return cls(covariance, np.array([at.x, at.y, at.z]))

    def at(
        self, odometry_from_camera: NDArray[np.float64], upright_from_odometry: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of a camera on the robot, in upright axes; both are (4, 4)."""
        jacobian = np.eye(6)
        jacobian[:3, 3:] = -cross_matrix(odometry_from_camera[:3, 3] - self.position)
        jacobian = np.kron(np.eye(2), upright_from_odometry[:3, :3]) @ jacobian
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(jacobian @ self.covariance @ jacobian.T)


CLOCK_JUMP = 0.5  # Stamps that go back by more [s] mean that the clock was set back
_IMU_SAMPLES = 1000  # whose mean is gravity to a tenth of a degree
_LEVEL_TOLERANCE = np.radians(3.0)  # between an IMU and level odometry
TRANSFORM_TYPES = "tf2_msgs/TFMessage", "tf/tfMessage"
MAP_FRAMES = ("map", "world")  # Frames of localization, SLAM or motion capture, not of odometry


@dataclass(eq=False)
class PoseReader:
    """Reader of the stamps of images, of the tree of frames and of the camera's poses."""

    bag: Bag
    choice: TopicChoice
    colour: ImageTopic
    depth: ImageTopic | None
    stamps: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    """Stamps (N,) of the colour images [s]."""
    depth_stamps: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    rows: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    """Rows of the colour images that are used."""
    tree: TransformTree = field(default_factory=TransformTree)
    frame: str = ""  # Frame of the poses
    odometry: Topic | None = None  # None where transforms hold the poses
    imu: Topic | None = None
    transform_topics: list[Topic] = field(default_factory=list)  # Topics of transforms
    recorded: bool = False  # Whether times of recording replace stamps, since clocks differ
    upright_from_frame: NDArray[np.float64] = field(
        default_factory=lambda: np.eye(3)
    )  # (3, 3), by the IMU
    notes: list[str] = field(default_factory=list)
    left_out: Counter[str] = field(default_factory=Counter)

    def poses(self) -> NDArray[np.float64]:
        """Return frame_from_camera (T, 4, 4) of the images of `rows`, z up; NaN where unknown."""
        found = self.tree.lookup(self.frame, self.colour.frame, self.stamps[self.rows])
        assert found is not None  # noqa: S101  # `read` has found a way
        found[:, :3] = self.upright_from_frame @ found[:, :3]
        return found

    def read(self) -> None:
        """Read stamps, transforms and accelerations in one pass; `InputError`: no path to the camera."""
        self.imu = _imu(self.bag, self.choice)
        self.transform_topics = self.bag.of_type(*TRANSFORM_TYPES)
        shown = [v.topic for v in (self.colour, self.depth) if v is not None]
        wanted: list[tuple[Topic, NDArray[np.intp] | None, int | None]]
        wanted = [(t, None, HEAD) for t in shown] + [(t, None, None) for t in self.transform_topics]
        if self.imu is not None:
            some = np.unique(np.linspace(0, len(self.imu) - 1, _IMU_SAMPLES).astype(np.intp))
            wanted.append((self.imu, some, None))
        read = read_messages(wanted)
        self.stamps = read_stamps(read[0], self.colour.topic)
        if self.depth is not None:
            self.depth_stamps = read_stamps(read[1], self.depth.topic)
        window = self._one_run()
        tables = [
            (t, read_transforms(data, t, self.bag.path, None if is_static(t.name) else window))
            for t, data in zip(self.transform_topics, read[len(shown) :], strict=False)
        ]
        self._build_tree(tables)
        self._choose(window)
        if not self._clocks_agree():
            self._build_tree(tables, recorded=True)
            self._by_recording()
        self._note_choices()
        if self.imu is not None:
            self._level(self.imu, read[-1])

    def _one_run(self) -> tuple[int, int]:
        """Return the window [ns] of the longest run in which the clock does not go back."""
        times = self.colour.topic.times
        cuts = np.flatnonzero(np.diff(self.stamps) < -CLOCK_JUMP) + 1
        edges = [0, *cuts.tolist(), len(times)]
        longest = int(np.argmax(np.diff(edges)))
        first, last = edges[longest], edges[longest + 1]
        self.rows = np.arange(first, last)
        if len(cuts):
            self.left_out["the clock jumped back"] += len(times) - len(self.rows)
            self.notes.append(
                f"The clock of {self.colour.topic.name} jumps back {len(cuts)} times; only the longest "
                "run between jumps is used."
            )
        begin = -1 if first == 0 else int(times[first - 1])
        return begin, (1 << 62 if last == len(times) else int(times[last]))

    def _build_tree(
        self, tables: list[tuple[Topic, TransformRows]], *, recorded: bool = False
    ) -> None:
        """Build the tree by stamps or times of recording; keep the edges of odometry."""
        odometry = self.tree.edges if self.odometry is not None else {}
        self.tree = TransformTree()
        for static in (True, False):
            rows = [table for topic, table in tables if is_static(topic.name) is static]
            self.tree.add(select_samples(rows, recorded=recorded), static=static)
        self.tree.add(self.choice.transforms, static=True)
        self.tree.edges = odometry | self.tree.edges

    def _choose(self, window: tuple[int, int]) -> None:
        """Choose the frame of the poses; read odometry where transforms have none."""
        choice, bag = self.choice, self.bag
        above = self.tree.ancestors(self.colour.frame)
        moving = [f for f, moves in above.items() if moves or f in MAP_FRAMES]
        odom = next((f for f in above if "odom" in f.rpartition("/")[2]), "")
        asked = odom if choice.frame is None else choice.frame
        if choice.odometry is None and asked in above:
            self.frame = asked
            return
        topics = bag.of_type("nav_msgs/Odometry")
        if choice.odometry is not None:
            topics = [t for t in topics if t.name == choice.odometry]
            if not topics:
                raise InputError(
                    f"{bag.path}: {choice.odometry} has no nav_msgs/Odometry messages."
                )
        lost = []
        for topic in sorted(topics, key=len, reverse=True):
            parent, child = self._odometry(topic, window)
            wanted = choice.frame or parent
            joined = self.tree.find_path(child, self.colour.frame) and wanted in self.tree.names
            if joined or child == self.colour.frame:
                self.odometry, self.frame = topic, wanted
                return
            lost.append(f"{topic.name} moves {child!r}, which no transform connects to the camera")
        if not moving or choice.frame is not None or choice.odometry is not None:
            raise self._no_path_error(lost)
        own = [f for f in moving if f not in MAP_FRAMES and "base" not in f]
        self.frame = own[-1] if own else moving[-1]  # the outermost: in inner ones, joints move

    def _odometry(self, topic: Topic, window: tuple[int, int]) -> tuple[str, str]:
        """Add the edge of odometry; return the names of its frames."""
        where = f"{self.bag.path}, {topic.name}"
        rows = np.flatnonzero((topic.times > window[0]) & (topic.times < window[1]))
        samples: dict[tuple[str, str], list[tuple[float, ...]]] = defaultdict(list)
        for raw in read_messages([(topic, rows, None)])[0]:
            message = decode(raw, where, topic.type, topic.encoding)
            names = frame_name(message.header.frame_id), frame_name(message.child_frame_id)
            at, turn = message.pose.pose.position, message.pose.pose.orientation
            samples[names].append((header_stamp(message.header), *pose_numbers(at, turn)))
        parent, child = next(iter(samples), ("", ""))
        if not (parent and child):
            raise InputError(
                f"{where}: header.frame_id or child_frame_id is empty; set them where it is published, or "
                "choose another topic as odometry."
            )
        self.tree.add({(parent, child): [np.array(samples[parent, child])]})
        return parent, child

    def _no_path_error(self, lost: list[str]) -> InputError:
        path, names = self.bag.path, self.tree.names
        wanted = repr(self.choice.frame) if self.choice.frame else "a fixed frame"
        known = f"frames are {', '.join(names[:12])}" if names else "there are no transforms"
        return InputError(
            f"{path}: no transform leads from the camera's frame {self.colour.frame!r} to "
            f"{wanted}; {'; '.join([known, *lost])}. Record /tf, /tf_static or "
            f'nav_msgs/Odometry, add the missing ones as "transforms" in {path}.json, or '
            "give `poses`, a trajectory in TUM's format."
        )

    def _clocks_agree(self) -> bool:
        """Return whether images and the moving transforms they need share a clock."""
        steps = self.tree.find_path(self.frame, self.colour.frame) or []
        edges = [self.tree.edges.get(s) or self.tree.edges[s[::-1]] for s in steps]
        first, last = self.stamps[self.rows].min(), self.stamps[self.rows].max()
        return all(e.fixed or (e.stamps[0] <= last and e.stamps[-1] >= first) for e in edges)

    def _by_recording(self) -> None:
        """Use the times of recording as stamps."""
        self.recorded = True
        self.stamps = (self.colour.topic.times * 1e-9).astype(np.float64)
        if self.depth is not None:
            self.depth_stamps = (self.depth.topic.times * 1e-9).astype(np.float64)
        self.notes.append(
            "The stamps of images and transforms are from different clocks, so the times of "
            "recording replace both."
        )

    def _note_choices(self) -> None:
        by = self.odometry.name if self.odometry is not None else "/tf"
        self.notes.append(f"Poses: {self.colour.frame} in {self.frame}, from {by}.")
        if self.frame in MAP_FRAMES and self.choice.frame is None:
            self.notes.append(
                f"{self.frame} is a frame of localization or SLAM, not of odometry, but the "
                "bag has no other."
            )
        for child, parents in self.tree.parents().items():
            if len(parents) > 1:
                self.notes.append(
                    f"{child} has several parents ({', '.join(sorted(parents))}); the shortest "
                    f'path to {self.frame} is used. Choose another with "frame" in '
                    f"{self.bag.path}.json."
                )
        if self.tree.invalid:
            self.notes.append(
                f"{self.tree.invalid} transforms with NaN or without a unit quaternion are ignored."
            )

    def _level(self, imu: Topic, data: list[bytes]) -> None:
        """Level the poses' frame where the IMU measures a tilt."""
        where = f"{self.bag.path}, {imu.name}"
        samples = [decode(raw, where, imu.type, imu.encoding) for raw in data]
        frame = frame_name(samples[0].header.frame_id)
        turns = self.tree.lookup(
            self.frame, frame, np.array([header_stamp(m.header) for m in samples])
        )
        felt = np.array([[getattr(m.linear_acceleration, a) for a in "xyz"] for m in samples])
        up: NDArray[np.float64] = np.zeros(3)
        if turns is not None and float(samples[0].linear_acceleration_covariance[0]) != -1.0:
            ups = np.einsum("nij,nj->ni", turns[:, :3, :3], felt.astype(np.float64))
            up += ups[np.isfinite(ups).all(axis=1)].sum(axis=0)
        length = float(np.linalg.norm(up))
        if not (np.isfinite(length) and length > 0):
            self.notes.append(
                f"{imu.name} is not used, because no transform connects {frame!r}, or it measures "
                "no acceleration."
            )
            return
        angle = float(np.arccos(np.clip(up[2] / length, -1.0, 1.0)))
        if angle > _LEVEL_TOLERANCE:
            self.upright_from_frame = upright(up / length, np.eye(3)[0])
            self.notes.append(
                f"{self.frame} is tilted by {np.degrees(angle):.1f} degrees according to {imu.name}; it is "
                "levelled."
            )


def _imu(bag: Bag, choice: TopicChoice) -> Topic | None:
    topics = bag.of_type("sensor_msgs/Imu") if choice.with_imu else []
    if choice.imu is not None:
        topics = [t for t in topics if t.name == choice.imu]
        if not topics:
            raise InputError(f"{bag.path}: {choice.imu} has no sensor_msgs/Imu messages.")
    return max(topics, key=len, default=None)
