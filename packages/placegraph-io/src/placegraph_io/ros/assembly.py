"""Frames and moves out of the messages of a stream, by what was found to make them of.

Nothing waits for ever: a frame comes as soon as its depth and its transforms have come, and is left
out, and counted, where they do not come.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.io.capture.frame import Frame
from placegraph.io.capture.frame_files import (
    LazyImages,
    posed_frame,
    quarter_turn,
    upright_turns,
)
from placegraph.io.capture.posed import SAME_MOMENT
from placegraph_io.ros.capture import Source, metres_of, picture, unit_of
from placegraph_io.ros.decode import decode, frame_of, stamp_of
from placegraph_io.ros.moves import Spread, numbers_of
from placegraph_io.ros.packets import Packet, is_static
from placegraph_io.ros.plan import Plan
from placegraph_io.ros.poses import BACK
from placegraph_io.ros.transforms import Edge, Tree

PATIENCE = 0.5
"""A frame waits so long for its depth and its transforms [s]."""
SILENT = 1.0
"""Where no depth came for so long [s], colours go on alone."""
_KEEP = 5.0  # of transforms [s]
_WAITING, _DEPTHS = 30, 30
_BASES = ("base_link", "base_footprint")


class Move(NamedTuple):
    """Where odometry has the camera."""

    stamp: float
    odometry_from_camera: NDArray[np.float64]
    """(4, 4) [m]"""
    covariance: NDArray[np.float64] | None
    """(6, 6) of it as odometry itself says, in its frame: x, y, z [m], and a turn about the axes [rad];
    it may hold anything. None: transforms tell where it is."""


class Assembly:
    """Makes frames of messages, and moves, of which the first comes before the first frame.

    `left_out` counts what could not be used, by reason, `jumps` how often the clock was set back:
    what came before is then of another time.
    """

    def __init__(self, plan: Plan) -> None:
        assert plan.placing is not None and plan.colour is not None  # noqa: S101, PT018  # nothing lacks
        self.plan = plan
        self.path = plan.bag.path
        self.left_out: Counter[str] = Counter()
        self.jumps = 0
        self.odometry, self.camera = plan.placing.frame, plan.colour.frame
        """Names of frames."""
        self.base = self._base(plan.placing.tree)
        self._colour = plan.colour.topic
        self._depth = plan.depth.topic if plan.depth is not None else None
        self._told = plan.placing.odometry
        self._edges = self._wanted(plan.placing.tree)
        self._lean = np.eye(4)
        self._lean[:3, :3] = plan.placing.lean
        self._turns: int | None = None
        self._mount: NDArray[np.float64] | None = None
        self._spread: Spread | None = None
        self._tree = Tree()
        self._tree.add(plan.wishes.transforms, static=True)
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
        assert self.plan.placing is not None  # noqa: S101
        parts = (self._colour, self._depth, self._told, *self.plan.placing.moves)
        return frozenset(topic.name for topic in parts if topic is not None)

    def take(self, packet: Packet) -> Iterator[Frame | Move]:
        """Take in a message; `InputError` where it cannot be read, and nothing is changed."""
        if packet.topic == self._colour.name:
            self._see(packet)
        elif self._depth is not None and packet.topic == self._depth.name:
            self._depths.append((self._stamp(packet), packet))
        elif packet.topic in self.topics:
            self._carry(packet)
            yield from self._move()
        yield from self._ready(packet.time)

    def rest(self) -> Iterator[Frame | Move]:
        """The frames that wait for what will not come any more: the stream has ended."""
        yield from self._ready(np.inf)

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

    # --------------------------------------------------------------------------------- images

    def _stamp(self, packet: Packet) -> float:
        assert self.plan.placing is not None  # noqa: S101
        return packet.time if self.plan.placing.recorded else packet.stamp

    def _see(self, packet: Packet) -> None:
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

    def _ready(self, now: float) -> Iterator[Frame | Move]:
        """Frames all of whose parts have come, or will not come any more."""
        while self._waiting:
            stamp, packet = self._waiting[0]
            over = now - packet.time > PATIENCE
            if not (over or (self._depth_is_settled(stamp) and self._covered() >= stamp)):
                return
            self._waiting.popleft()
            frame = self._frame(stamp, packet)
            if frame is not None:
                yield from self._move()
                yield frame

    def _depth_is_settled(self, stamp: float) -> bool:
        """Whether the depth of a moment has come, or a later one, or none comes any more."""
        if self._depth is None or (self._depths and self._depths[-1][0] < stamp - SILENT):
            return True
        return any(s > stamp - SAME_MOMENT for s, _ in self._depths)

    def _frame(self, stamp: float, packet: Packet) -> Frame | None:
        placing, camera = self.plan.placing, self.plan.camera
        assert placing is not None and camera is not None  # noqa: S101, PT018
        found = self._tree.between(placing.frame, self.camera, np.array([stamp]))
        if found is None or np.isnan(found).any():
            self.left_out[f"no transform from {self.camera} to {placing.frame}"] += 1
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
        """What reads the depth of a message; None, and counted: its camera's place is not known."""
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
            self.plan.wishes.depth_scale, self.plan.registration, moved,
        )  # fmt: skip

    # ----------------------------------------------------------------------------- transforms

    def _wanted(self, tree: Tree) -> frozenset[tuple[str, str]]:
        """Parents and children of the transforms that lead from odometry to cameras and base."""
        depth = self.plan.depth
        ends = [self.odometry, self.base, *([] if depth is None else [depth.frame])]
        steps = [step for end in ends for step in tree.path(end, self.camera) or ()]
        return frozenset(step if step in tree.edges else step[::-1] for step in steps)

    def _base(self, tree: Tree) -> str:
        """The robot's base: by its name, else what odometry carries."""
        steps = tree.path(self.odometry, self.camera) or []
        named = [b for b in _BASES if b in tree.names and tree.path(b, self.camera) is not None]
        moves = [far for near, far in steps if not _edge(tree, near, far).fixed]
        return next(iter((*named, *moves)), self.camera)

    def _carry(self, packet: Packet) -> None:
        """Take in transforms or odometry."""
        rows = self._rows(packet)
        for key in self._edges & rows.keys():
            table = np.array(rows[key])
            if is_static(packet.topic):
                self._tree.add({key: [table]}, static=True)
            else:
                self._tree.extend(key, table, _KEEP)

    def _move(self) -> Iterator[Move]:
        """Where odometry has the camera by now, if it has told anything new."""
        newest = self._covered()
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
            yield Move(newest, pose, spread)

    def _rows(self, packet: Packet) -> dict[tuple[str, str], list[tuple[float, ...]]]:
        """Stamps and numbers of transforms by parent and child."""
        said = decode(packet.data, f"{self.path}, {packet.topic}", packet.type, packet.encoding)
        assert self.plan.placing is not None  # noqa: S101
        by_recording = self.plan.placing.recorded
        out: dict[tuple[str, str], list[tuple[float, ...]]] = {}
        if self._told is not None and packet.topic == self._told.name:
            at = said.pose.pose
            if frame_of(said.header.frame_id) == self.odometry:
                self._spread = Spread.of(said.pose)
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

    def _covered(self) -> float:
        """Stamp up to which all transforms from odometry to the camera are known [s]."""
        path = self._tree.path(self.odometry, self.camera)
        if path is None:
            return -np.inf
        edges = [_edge(self._tree, near, far) for near, far in path]
        return min((float(e.stamps[-1]) for e in edges if not e.fixed), default=np.inf)

    def _turned(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pose of the camera as the frames' images are turned."""
        out = pose.copy()
        out[:3, :3] = pose[:3, :3] @ quarter_turn(self._turns or 0).T
        return out


def _edge(tree: Tree, near: str, far: str) -> Edge:
    return tree.edges.get((near, far)) or tree.edges[far, near]
