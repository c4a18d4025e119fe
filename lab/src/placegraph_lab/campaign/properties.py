"""Rooms turned, mirrored, carried elsewhere or relisted, and captures of them that go along."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import PoseEstimate, Status
from placegraph.core.geometry import Camera
from placegraph.errors import PlacegraphError
from placegraph.indoor.build import build_scene
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture, open_capture
from placegraph.io.capture.frame import Frame
from placegraph_lab.campaign.platforms import PROCESSES
from placegraph_lab.campaign.row import Effort, Row
from placegraph_lab.campaign.town_properties import TOWNS
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.interior import Interior
from placegraph_lab.worlds.flat.walks import Walk, stroll, write_walk

_FLIP = np.diag([-1.0, 1.0, 1.0, 1.0])  # of what is seen in a mirror: right is left


@dataclass(frozen=True, eq=False)
class Motion:
    """Where a room goes: mirrored west to east before, turned about its up, shifted."""

    yaw: float  # [rad]
    shift: NDArray[np.float64]  # (3,) [m]
    mirrored: bool = False

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(4, 4) of points."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        out = np.eye(4)
        out[:2, :2] = [[c, -s], [s, c]]
        out[:3, 3] = self.shift
        return out @ _FLIP if self.mirrored else out

    def pose(self, map_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """A pose (4, 4) in the room, as it is where the room has gone."""
        out = self.matrix @ map_from_camera
        return out @ _FLIP if self.mirrored else out

    def scene(self, scene: SceneMap) -> SceneMap:
        """The room where it has gone."""
        mesh, matrix = scene.mesh, self.matrix
        vertices = (mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)
        triangles = mesh.triangles[:, [0, 2, 1]] if self.mirrored else mesh.triangles
        return _made(scene, replace(mesh, vertices=vertices, triangles=triangles), self.shift[2])

    def capture(self, frames: Sequence[Frame]) -> Capture:
        """What a camera records that went along."""
        return Capture.from_frames([_in_mirror(f) if self.mirrored else f for f in frames])


def stood(frames: Sequence[Frame]) -> list[Frame]:
    """Frames of a camera that stood still, as its odometry tells."""
    return [_again(f, odometry=frames[0].odometry, gravity=frames[0].gravity) for f in frames]


def _again(frame: Frame, **change: Any) -> Frame:  # noqa: ANN401  # of `Frame.from_arrays`
    given: dict[str, Any] = {
        "depth": frame.depth(), "depth_camera": frame.depth_camera, "labels": frame.labels(),
        "label_camera": frame.label_camera, "label_kind": frame.label_kind or "labels",
        "label_names": frame.label_names, "odometry": frame.odometry, "gravity": frame.gravity,
        "stamp": frame.stamp, "index": frame.index,
    } | change  # fmt: skip
    rgb, camera = given.pop("rgb", None), given.pop("camera", frame.camera)
    return Frame.from_arrays(frame.rgb() if rgb is None else rgb, camera, **given)


def _in_mirror(frame: Frame) -> Frame:
    depth, labels = frame.depth(), frame.labels()
    return _again(
        frame,
        rgb=_flipped(frame.rgb()), camera=_seen(frame.camera),
        depth=None if depth is None else _flipped(depth),
        depth_camera=None if frame.depth_camera is None else _seen(frame.depth_camera),
        labels=None if labels is None else _flipped(labels),
        label_camera=None if frame.label_camera is None else _seen(frame.label_camera),
        odometry=_FLIP @ frame.odometry @ _FLIP, gravity=_FLIP[:3, :3] @ frame.gravity,
    )  # fmt: skip


def _flipped(image: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(image[:, ::-1])


def _seen(camera: Camera) -> Camera:
    return replace(camera, cx=camera.width - camera.cx)


def _made(
    scene: SceneMap, mesh: Mesh, rise: float, order: NDArray[np.int64] | None = None
) -> SceneMap:
    graph, rows = scene.graph, np.arange(len(scene)) if order is None else order
    return SceneMap.create(
        mesh, [graph.ids[i] for i in rows], [graph.labels[i] for i in rows],
        floor=float(scene.floors[0] + rise), names=[graph.names[i] for i in rows],
        encoded=scene.encoded,
    )  # fmt: skip


_CAMERA = Camera(160, 90, 115.0, 115.0, 80.0, 45.0)
_FRAMES = 5
_FAR, _TURNED = 0.1, np.deg2rad(2.0)
"""So much two answers to one question may differ [m, rad]: what a room leaves open of a height."""


@dataclass(frozen=True, eq=False)
class Room:
    """A furnished room, its map, and room for walks."""

    drawing: Flat
    interior: Interior
    scene: SceneMap
    folder: Path

    def walk(self, rng: np.random.Generator, *, still: bool = False) -> Capture:
        """Frames of a new walk, or of a camera that stands where one ends."""
        way = stroll(self.drawing, rng, frames=_FRAMES)
        if still:
            there = np.repeat(way.map_from_camera[-1:], _FRAMES, axis=0)
            way = Walk(way.stamps, there)
        folder = next(f for k in count() if not (f := self.folder / f"walk{k}").exists())
        write_walk(self.interior, way, folder, rng, camera=_CAMERA)
        return open_capture(folder)


def furnished(folder: Path) -> Room:
    """The room, made in a folder."""
    drawing = Flat.load("study")
    interior = drawing.furnish(np.random.default_rng(1))
    interior.write_glb(folder / "room.glb")
    built = build_scene(folder / "room.glb", folder / "room.scene", detail="full")
    # as it comes from the hands of those that move it: the same columns, and no more
    return Room(drawing, interior, Motion(0.0, np.zeros(3)).scene(built), folder)


def moved(room: Room, rng: np.random.Generator) -> str:
    """A room turned, shifted or mirrored, its camera with it: the pose goes along."""
    walk = room.walk(rng)
    motion = Motion(
        rng.uniform(-np.pi, np.pi), rng.uniform(-200.0, 200.0, 3), mirrored=bool(rng.integers(2))
    )
    here = room.scene.localize(walk)
    there = motion.scene(room.scene).localize(motion.capture(walk.frames))
    return apart(here, there, motion)


def relisted(room: Room, rng: np.random.Generator) -> str:
    """The objects of a map in another order change nothing."""
    walk = room.walk(rng)
    here = room.scene.localize(walk)
    order = rng.permutation(len(room.scene))
    place = np.argsort(order).astype(np.int32)
    mesh = replace(room.scene.mesh, object_of=place[room.scene.mesh.object_of])
    return apart(here, _made(room.scene, mesh, 0.0, order).localize(walk))


def still(room: Room, rng: np.random.Generator) -> str:
    """The frames of a camera that stands still in another order change nothing."""
    frames = stood(room.walk(rng, still=True).frames)
    order = rng.permutation(len(frames))
    mixed = [
        replace(frames[i], stamp=f.stamp, index=f.index) for i, f in zip(order, frames, strict=True)
    ]
    here, there = (room.scene.localize(Capture.from_frames(f)) for f in (frames, mixed))
    return apart(here, there)


def apart(here: PoseEstimate, there: PoseEstimate, motion: Motion | None = None) -> str:
    """How two answers differ, in words, where they differ by more than they may.

    Two that are `OK` lie together. One alone may be `OK`: its sureness lay at the border.
    """
    if Status.OK not in (here.status, there.status):
        return ""
    if here.best is None or there.best is None:
        return f"{here.status} became {there.status} without a pose"
    pose = here.best.map_from_camera
    delta = (
        np.linalg.inv(pose if motion is None else motion.pose(pose)) @ there.best.map_from_camera
    )
    far, turned = (
        float(np.linalg.norm(delta[:3, 3])),
        (float(np.arccos(np.clip((np.trace(delta[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))),
    )
    if (far > _FAR or turned > _TURNED) and here.status is there.status:
        return f"{far:.3f} m and {np.rad2deg(turned):.2f} degrees apart, both OK"
    return ""


ROOMS = (furnished, 3.0, {
    "a room moved, turned or mirrored moves the pose": moved,
    "objects of a room in another order": relisted,
    "frames of a still camera in another order": still,
})  # fmt: skip


PART = "properties"


@dataclass(frozen=True)
class Property:
    """A property, and how it is tried once."""

    name: str
    world: Callable[[Path], Any]  # makes what its trials are about, in a folder
    trial: Callable[[Any, np.random.Generator], str]  # in words how it is broken; empty: it holds
    share: float = 1.0  # of the time, against the others


_WORLDS: tuple[tuple[Callable[[Path], Any], float, dict[str, Callable[..., str]]], ...] = (
    TOWNS,
    ROOMS,
    PROCESSES,
)
PROPERTIES = tuple(
    Property(name, world, trial, share)
    for world, share, trials in _WORLDS
    for name, trial in trials.items()
)


def rows(effort: Effort) -> Iterator[Row]:
    """One row a property; each is tried once at least."""
    worlds: dict[object, object] = {}
    whole = sum(p.share for p in PROPERTIES)
    for number, known in enumerate(PROPERTIES):
        if known.world not in worlds:
            folder = effort.folder / f"world{len(worlds)}"
            folder.mkdir(parents=True)
            worlds[known.world] = known.world(folder)
        yield tried(
            known, worlds[known.world], (effort.seed, number), effort.seconds * known.share / whole,
            effort.say,
        )  # fmt: skip


def tried(
    known: Property,
    world: object,
    seed: tuple[int, int],
    seconds: float,
    say: Callable[[str], None] = lambda _: None,
) -> Row:
    """Try a property for so long; trial k draws from ``default_rng((*seed, k))``."""
    found = {"accepted": 0, "untyped": 0}
    start, k = monotonic(), 0
    while not k or monotonic() - start < seconds:
        rng = np.random.default_rng((*seed, k))
        try:
            broken = known.trial(world, rng)
        except PlacegraphError as error:
            broken = f"{type(error).__name__}: {error}"
        found["untyped" if broken else "accepted"] += 1
        if broken:
            say(f"{known.name}, seed {(*seed, k)}: {broken}")
        k += 1
    return Row.counted(PART, known.name, found, seed[0], monotonic() - start)
