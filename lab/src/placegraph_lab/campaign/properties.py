"""Metamorphic properties: of rooms here, of towns in `town_properties`, of processes in `platforms`."""

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
    """Motion of a room: mirrored west to east, turned about its vertical axis, shifted."""

    yaw: float  # [rad]
    shift: NDArray[np.float64]  # (3,) [m]
    mirrored: bool = False

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(4, 4) new_from_old for points."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        out = np.eye(4)
        out[:2, :2] = [[c, -s], [s, c]]
        out[:3, 3] = self.shift
        return out @ _FLIP if self.mirrored else out

    def pose(self, map_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a pose (4, 4) in the moved room."""
        out = self.matrix @ map_from_camera
        return out @ _FLIP if self.mirrored else out

    def scene(self, scene: SceneMap) -> SceneMap:
        """Return the moved scene map."""
        mesh, matrix = scene.mesh, self.matrix
        vertices = (mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)
        triangles = mesh.triangles[:, [0, 2, 1]] if self.mirrored else mesh.triangles
        return _make_scene(
            scene, replace(mesh, vertices=vertices, triangles=triangles), self.shift[2]
        )

    def capture(self, frames: Sequence[Frame]) -> Capture:
        """Return the capture of a camera that moved with the room."""
        return Capture.from_frames([_mirror_frame(f) if self.mirrored else f for f in frames])


def hold_still(frames: Sequence[Frame]) -> list[Frame]:
    """Return frames whose odometry says that the camera stands still."""
    return [
        _change_frame(f, odometry=frames[0].odometry, gravity=frames[0].gravity) for f in frames
    ]


def _change_frame(frame: Frame, **change: Any) -> Frame:  # noqa: ANN401  # of `Frame.from_arrays`
    given: dict[str, Any] = {
        "depth": frame.depth(), "depth_camera": frame.depth_camera, "labels": frame.labels(),
        "label_camera": frame.label_camera, "label_kind": frame.label_kind or "labels",
        "label_names": frame.label_names, "odometry": frame.odometry, "gravity": frame.gravity,
        "stamp": frame.stamp, "index": frame.index,
    } | change  # fmt: skip
    rgb, camera = given.pop("rgb", None), given.pop("camera", frame.camera)
    return Frame.from_arrays(frame.rgb() if rgb is None else rgb, camera, **given)


def _mirror_frame(frame: Frame) -> Frame:
    depth, labels = frame.depth(), frame.labels()
    return _change_frame(
        frame,
        rgb=_flip(frame.rgb()), camera=_mirror_camera(frame.camera),
        depth=None if depth is None else _flip(depth),
        depth_camera=None if frame.depth_camera is None else _mirror_camera(frame.depth_camera),
        labels=None if labels is None else _flip(labels),
        label_camera=None if frame.label_camera is None else _mirror_camera(frame.label_camera),
        odometry=_FLIP @ frame.odometry @ _FLIP, gravity=_FLIP[:3, :3] @ frame.gravity,
    )  # fmt: skip


def _flip(image: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(image[:, ::-1])


def _mirror_camera(camera: Camera) -> Camera:
    return replace(camera, cx=camera.width - camera.cx)


def _make_scene(
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
_FAR, _TURNED = 0.1, np.deg2rad(2.0)  # Allowed difference of two answers [m, rad]


@dataclass(frozen=True, eq=False)
class Room:
    """A furnished room, its map, and a folder for walks."""

    drawing: Flat
    interior: Interior
    scene: SceneMap
    folder: Path

    def walk(self, rng: np.random.Generator, *, still: bool = False) -> Capture:
        """Record a new walk, or a camera that stands at the end of one."""
        way = stroll(self.drawing, rng, frames=_FRAMES)
        if still:
            there = np.repeat(way.map_from_camera[-1:], _FRAMES, axis=0)
            way = Walk(way.stamps, there)
        folder = next(f for k in count() if not (f := self.folder / f"walk{k}").exists())
        write_walk(self.interior, way, folder, rng, camera=_CAMERA)
        return open_capture(folder)


def furnish_room(folder: Path) -> Room:
    """Furnish the room and build its map in a folder."""
    drawing = Flat.load("study")
    interior = drawing.furnish(np.random.default_rng(1))
    interior.write_glb(folder / "room.glb")
    built = build_scene(folder / "room.glb", folder / "room.scene", detail="full")
    # a null motion: so that moved maps have the same columns
    return Room(drawing, interior, Motion(0.0, np.zeros(3)).scene(built), folder)


def move_room(room: Room, rng: np.random.Generator) -> str:
    """Move or mirror a room and its camera: the pose moves along."""
    walk = room.walk(rng)
    motion = Motion(
        rng.uniform(-np.pi, np.pi), rng.uniform(-200.0, 200.0, 3), mirrored=bool(rng.integers(2))
    )
    here = room.scene.localize(walk)
    there = motion.scene(room.scene).localize(motion.capture(walk.frames))
    return compare_estimates(here, there, motion)


def reorder_objects(room: Room, rng: np.random.Generator) -> str:
    """Reorder the objects of a map: the pose stays."""
    walk = room.walk(rng)
    here = room.scene.localize(walk)
    order = rng.permutation(len(room.scene))
    place = np.argsort(order).astype(np.int32)
    mesh = replace(room.scene.mesh, object_of=place[room.scene.mesh.object_of])
    return compare_estimates(here, _make_scene(room.scene, mesh, 0.0, order).localize(walk))


def reorder_frames(room: Room, rng: np.random.Generator) -> str:
    """Reorder the frames of a standing camera: the pose stays."""
    frames = hold_still(room.walk(rng, still=True).frames)
    order = rng.permutation(len(frames))
    mixed = [
        replace(frames[i], stamp=f.stamp, index=f.index) for i, f in zip(order, frames, strict=True)
    ]
    here, there = (room.scene.localize(Capture.from_frames(f)) for f in (frames, mixed))
    return compare_estimates(here, there)


def compare_estimates(here: PoseEstimate, there: PoseEstimate, motion: Motion | None = None) -> str:
    """Describe how two estimates differ; empty where the difference is allowed.

    Two `OK` poses must agree. One alone may be `OK`: its confidence lay at the threshold.
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


ROOMS = (furnish_room, 3.0, {
    "a room moved, turned or mirrored moves the pose": move_room,
    "objects of a room in another order": reorder_objects,
    "frames of a still camera in another order": reorder_frames,
})  # fmt: skip


PART = "properties"


@dataclass(frozen=True)
class Property:
    """A property and its trial."""

    name: str
    world: Callable[[Path], Any]  # makes the subject of its trials in a folder
    trial: Callable[[Any, np.random.Generator], str]  # describes a violation; empty: it holds
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
    """Yield a row for each property; each is tried at least once."""
    worlds: dict[object, object] = {}
    whole = sum(p.share for p in PROPERTIES)
    for number, tested in enumerate(PROPERTIES):
        if tested.world not in worlds:
            folder = effort.folder / f"world{len(worlds)}"
            folder.mkdir(parents=True)
            worlds[tested.world] = tested.world(folder)
        yield try_property(
            tested, worlds[tested.world], (effort.seed, number), effort.seconds * tested.share / whole,
            effort.report,
        )  # fmt: skip


def try_property(
    tested: Property,
    world: object,
    seed: tuple[int, int],
    seconds: float,
    report: Callable[[str], None] = lambda _: None,
) -> Row:
    """Try a property for `seconds`; trial k draws from ``default_rng((*seed, k))``."""
    found = {"accepted": 0, "untyped": 0}
    start, k = monotonic(), 0
    while not k or monotonic() - start < seconds:
        rng = np.random.default_rng((*seed, k))
        try:
            broken = tested.trial(world, rng)
        except PlacegraphError as error:
            broken = f"{type(error).__name__}: {error}"
        found["untyped" if broken else "accepted"] += 1
        if broken:
            report(f"{tested.name}, seed {(*seed, k)}: {broken}")
        k += 1
    return Row.from_counts(PART, tested.name, found, seed[0], monotonic() - start)
