"""Properties of answers indoors: a room and its captures go elsewhere, and the answer goes along."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

import numpy as np

from placegraph.core.estimate import PoseEstimate, Status
from placegraph.core.geometry import Camera
from placegraph.indoor.build import build_scene
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture, open_capture
from placegraph_lab.campaign import rooms
from placegraph_lab.campaign.rooms import Motion
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.interior import Interior
from placegraph_lab.worlds.flat.walks import Walk, stroll, write_walk

DRAWING = """
[flat]
name = Room
height = 2.6
[drawing]
########====########
#SSS         pp  BB#
#SSS             BB#
#SSS  tt      1  BB#
#SSS  tt         BB#
#                  #
#LL  3             #
#LL       hhTTT  2 +
#         hhTTT    +
#CCCCCC     TTT    #
####################
[legend]
1 room: label=study walls=wallpaper palegoldenrod floor=parquet sienna
2 spot:
3 spot:
S sofa: look=fabric darkred trim=fabric firebrick
B shelf: label=bookcase height=2.1
t roundtable: label=side table height=0.45
T table: label=desk look=wood burlywood
h chair: faces=T look=plain teal trim=plain darkslategrey
C cabinet: label=sideboard height=0.8 look=wood peru
L lamp:
p picture:
"""
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
    drawing = Flat.parse(DRAWING)
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
    return apart(here, rooms.relisted(room.scene, rng).localize(walk))


def still(room: Room, rng: np.random.Generator) -> str:
    """The frames of a camera that stands still in another order change nothing."""
    frames = rooms.stood(room.walk(rng, still=True).frames)
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
