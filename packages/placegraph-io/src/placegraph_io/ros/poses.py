"""When the images of a bag were taken, and where their camera was: stamps, transforms, odometry."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError
from placegraph.io.capture.level import upright
from placegraph_io.ros.decode import HEAD, decode, frame_of, stamp_of, stamps
from placegraph_io.ros.files.bag import Bag
from placegraph_io.ros.files.storage import Topic, read_all
from placegraph_io.ros.moves import Moves, numbers_of, samples_of, transforms
from placegraph_io.ros.packets import is_static
from placegraph_io.ros.transforms import Tree
from placegraph_io.ros.views import View

if TYPE_CHECKING:
    from placegraph_io.ros.plan import Wishes

BACK = 0.5
"""Stamps that go back by more [s] are of another run of the clock."""
_SAMPLES = 1000  # of an Imu: their mean is gravity to a tenth of a degree
_LEANS = np.radians(3.0)  # between an Imu and an odometry that means to be level
TRANSFORM_TYPES = "tf2_msgs/TFMessage", "tf/tfMessage"
OF_OTHERS = ("map", "world")
"""Frames in which a localization, SLAM or a motion capture tells poses, and no odometry."""


@dataclass(eq=False)
class Placing:
    """Stamps of the images, the tree of frames, and the frame in which poses are told."""

    bag: Bag
    wishes: Wishes
    colour: View
    depth: View | None
    stamps: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    """(N,) of colour images [s]."""
    depth_stamps: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    rows: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    """Of the colour images of the run that is used."""
    tree: Tree = field(default_factory=Tree)
    frame: str = ""
    """In which poses are told."""
    odometry: Topic | None = None
    """None: transforms tell the poses."""
    imu: Topic | None = None
    moves: list[Topic] = field(default_factory=list)
    """Topics of transforms."""
    recorded: bool = False
    """Whether times of recording stand for stamps, which are of different clocks."""
    lean: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    """(3, 3) upright_from_frame, by the Imu."""
    notes: list[str] = field(default_factory=list)
    left_out: Counter[str] = field(default_factory=Counter)

    def poses(self) -> NDArray[np.float64]:
        """frame_from_camera (T, 4, 4) of the images of `rows`, frame z up; NaN where it is not known."""
        found = self.tree.between(self.frame, self.colour.frame, self.stamps[self.rows])
        assert found is not None  # noqa: S101  # `read` has found a way
        found[:, :3] = self.lean @ found[:, :3]
        return found

    def read(self) -> None:
        """Read stamps, transforms and accelerations, in one pass over the file.

        Raises `InputError` where no transform leads to the camera; stamps are known then.
        """
        self.imu = _imu(self.bag, self.wishes)
        self.moves = self.bag.of_type(*TRANSFORM_TYPES)
        shown = [v.topic for v in (self.colour, self.depth) if v is not None]
        wanted: list[tuple[Topic, NDArray[np.intp] | None, int | None]]
        wanted = [(t, None, HEAD) for t in shown] + [(t, None, None) for t in self.moves]
        if self.imu is not None:
            some = np.unique(np.linspace(0, len(self.imu) - 1, _SAMPLES).astype(np.intp))
            wanted.append((self.imu, some, None))
        read = read_all(wanted)
        self.stamps = stamps(read[0], self.colour.topic)
        if self.depth is not None:
            self.depth_stamps = stamps(read[1], self.depth.topic)
        window = self._one_run()
        held = [
            (t, transforms(data, t, self.bag.path, None if is_static(t.name) else window))
            for t, data in zip(self.moves, read[len(shown) :], strict=False)
        ]
        self._grow(held)
        self._choose(window)
        if not self._overlap():
            self._grow(held, recorded=True)
            self._by_recording()
        self._tell()
        if self.imu is not None:
            self._level(self.imu, read[-1])

    def _one_run(self) -> tuple[int, int]:
        """Times of recording [ns] about the longest run in which the clock does not go back."""
        times = self.colour.topic.times
        cuts = np.flatnonzero(np.diff(self.stamps) < -BACK) + 1
        edges = [0, *cuts.tolist(), len(times)]
        longest = int(np.argmax(np.diff(edges)))
        first, last = edges[longest], edges[longest + 1]
        self.rows = np.arange(first, last)
        if len(cuts):
            self.left_out["the clock jumped back"] += len(times) - len(self.rows)
            self.notes.append(
                f"The clock of {self.colour.topic.name} jumps back ({len(cuts)} times); the longest "
                "run between is used."
            )
        begin = -1 if first == 0 else int(times[first - 1])
        return begin, (1 << 62 if last == len(times) else int(times[last]))

    def _grow(self, held: list[tuple[Topic, Moves]], *, recorded: bool = False) -> None:
        """Make the tree, by stamps or times of recording, and keep what odometry told."""
        told = self.tree.edges if self.odometry is not None else {}
        self.tree = Tree()
        for static in (True, False):
            rows = [moves for topic, moves in held if is_static(topic.name) is static]
            self.tree.add(samples_of(rows, recorded=recorded), static=static)
        self.tree.add(self.wishes.transforms, static=True)
        self.tree.edges = told | self.tree.edges

    def _choose(self, window: tuple[int, int]) -> None:
        """Choose the frame in which poses are told; odometry is read where transforms have none."""
        wishes, bag = self.wishes, self.bag
        above = self.tree.above(self.colour.frame)
        moving = [f for f, moves in above.items() if moves or f in OF_OTHERS]
        odom = next((f for f in above if "odom" in f.rpartition("/")[2]), "")
        asked = odom if wishes.frame is None else wishes.frame
        if wishes.odometry is None and asked in above:
            self.frame = asked
            return
        topics = bag.of_type("nav_msgs/Odometry")
        if wishes.odometry is not None:
            topics = [t for t in topics if t.name == wishes.odometry]
            if not topics:
                raise InputError(
                    f"{bag.path}: {wishes.odometry} is no nav_msgs/Odometry with messages."
                )
        lost = []
        for topic in sorted(topics, key=len, reverse=True):
            parent, child = self._odometry(topic, window)
            wanted = wishes.frame or parent
            if self.tree.path(child, self.colour.frame) and wanted in self.tree.names:
                self.odometry, self.frame = topic, wanted
                return
            if child == self.colour.frame:
                self.odometry, self.frame = topic, wanted
                return
            lost.append(
                f"{topic.name} tells of {child!r}, which no transform joins with the camera"
            )
        if not moving or wishes.frame is not None or wishes.odometry is not None:
            raise self._nowhere(lost)
        own = [f for f in moving if f not in OF_OTHERS and "base" not in f]
        self.frame = own[-1] if own else moving[-1]  # the outermost: in inner ones, joints move

    def _odometry(self, topic: Topic, window: tuple[int, int]) -> tuple[str, str]:
        """Make an edge of odometry; the names of its frames."""
        where = f"{self.bag.path}, {topic.name}"
        rows = np.flatnonzero((topic.times > window[0]) & (topic.times < window[1]))
        samples: dict[tuple[str, str], list[tuple[float, ...]]] = defaultdict(list)
        for raw in read_all([(topic, rows, None)])[0]:
            said = decode(raw, where, topic.type, topic.encoding)
            names = frame_of(said.header.frame_id), frame_of(said.child_frame_id)
            at, turn = said.pose.pose.position, said.pose.pose.orientation
            samples[names].append((stamp_of(said.header), *numbers_of(at, turn)))
        parent, child = next(iter(samples), ("", ""))
        if not (parent and child):
            raise InputError(
                f"{where}: header.frame_id or child_frame_id is empty, so nobody knows what moves; set "
                "them where it is published, or name another topic as odometry."
            )
        self.tree.add({(parent, child): [np.array(samples[parent, child])]})
        return parent, child

    def _nowhere(self, lost: list[str]) -> InputError:
        path, names = self.bag.path, self.tree.names
        wanted = repr(self.wishes.frame) if self.wishes.frame else "a frame in which it moves"
        known = f"frames are {', '.join(names[:12])}" if names else "there are no transforms"
        return InputError(
            f"{path}: no transform leads from the camera's frame {self.colour.frame!r} to {wanted}; "
            f"{'; '.join([known, *lost])}. Record /tf, /tf_static or nav_msgs/Odometry, write what "
            f'lacks as "transforms" in {path}.json, or give `poses`, a trajectory in TUM\'s format.'
        )

    def _overlap(self) -> bool:
        """Whether images and the moving transforms they need share a clock."""
        steps = self.tree.path(self.frame, self.colour.frame) or []
        edges = [self.tree.edges.get(s) or self.tree.edges[s[::-1]] for s in steps]
        first, last = self.stamps[self.rows].min(), self.stamps[self.rows].max()
        return all(e.fixed or (e.stamps[0] <= last and e.stamps[-1] >= first) for e in edges)

    def _by_recording(self) -> None:
        """Take the times of recording for stamps."""
        self.recorded = True
        self.stamps = (self.colour.topic.times * 1e-9).astype(np.float64)
        if self.depth is not None:
            self.depth_stamps = (self.depth.topic.times * 1e-9).astype(np.float64)
        self.notes.append(
            "Images and transforms bear stamps of different clocks; the times of recording stand for "
            "both."
        )

    def _tell(self) -> None:
        by = self.odometry.name if self.odometry is not None else "/tf"
        self.notes.append(f"Poses are those of {self.colour.frame} in {self.frame}, by {by}.")
        if self.frame in OF_OTHERS and self.wishes.frame is None:
            self.notes.append(
                f"{self.frame} is a frame in which a localization or SLAM tells poses, no odometry; the "
                "bag has no other."
            )
        for child, parents in self.tree.parents().items():
            if len(parents) > 1:
                self.notes.append(
                    f"{child} has several parents ({', '.join(sorted(parents))}); the shortest way to "
                    f'{self.frame} was taken. "frame" in {self.bag.path}.json chooses another.'
                )
        if self.tree.broken:
            self.notes.append(
                f"{self.tree.broken} transforms held NaN or no quaternion of unit length; left out."
            )

    def _level(self, imu: Topic, data: list[bytes]) -> None:
        """Stand the poses' frame upright, where the Imu's accelerations say that it leans."""
        where = f"{self.bag.path}, {imu.name}"
        said = [decode(raw, where, imu.type, imu.encoding) for raw in data]
        frame = frame_of(said[0].header.frame_id)
        turns = self.tree.between(self.frame, frame, np.array([stamp_of(m.header) for m in said]))
        felt = np.array([[getattr(m.linear_acceleration, a) for a in "xyz"] for m in said])
        up: NDArray[np.float64] = np.zeros(3)
        if turns is not None and float(said[0].linear_acceleration_covariance[0]) != -1.0:
            ups = np.einsum("nij,nj->ni", turns[:, :3, :3], felt.astype(np.float64))
            up += ups[np.isfinite(ups).all(axis=1)].sum(axis=0)
        length = float(np.linalg.norm(up))
        if not (np.isfinite(length) and length > 0):
            self.notes.append(
                f"{imu.name} is not used: no transform joins {frame!r}, or it feels no acceleration."
            )
            return
        angle = float(np.arccos(np.clip(up[2] / length, -1.0, 1.0)))
        if angle > _LEANS:
            self.lean = upright(up / length, np.eye(3)[0])
            self.notes.append(
                f"{self.frame} leans by {np.degrees(angle):.1f} degrees, says {imu.name}; it is stood "
                "upright."
            )


def _imu(bag: Bag, wishes: Wishes) -> Topic | None:
    topics = bag.of_type("sensor_msgs/Imu") if wishes.with_imu else []
    if wishes.imu is not None:
        topics = [t for t in topics if t.name == wishes.imu]
        if not topics:
            raise InputError(f"{bag.path}: {wishes.imu} is no sensor_msgs/Imu with messages.")
    return max(topics, key=len, default=None)
