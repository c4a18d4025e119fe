"""Where encoders are judged patch by patch: the house, both halves of the office, drawn homes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.indoor.build import build_scene
from placegraph.indoor.mapping.from_capture import FromCapture
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture, Frame, open_capture
from placegraph_lab.tables.indoor.maps import place
from placegraph_lab.tables.indoor.windows import HALVES, true_poses
from placegraph_lab.worlds.home.home import home, record, scene_of, visit

HOMES = 8
WALK = 15
"""Frames of a walk through a home."""
_FIRST_HOME = 7_000  # seeds of homes from here on


@dataclass(frozen=True, eq=False)
class Place:
    """A map, frames whose poses are known, and images of the map itself."""

    kind: str
    """`house`, `office` or `homes`."""
    name: str
    scene: SceneMap
    frames: tuple[Frame, ...]
    map_from_camera: Floats
    """(T, 4, 4) of the frames."""
    captures: tuple[Capture, ...]
    """Of the map, for encoders that need some; other frames, their odometry being map_from_camera."""


def places(data: Path, cache: Path, every: int = 1, homes: int = HOMES) -> Iterator[Place]:
    """All places, one after the other; of the frames of recordings every `every`-th.

    `data`: folder with the house and the office; `cache`: where maps are kept.
    """
    yield house(data, cache, every)
    for half in HALVES:
        yield office(data, cache, half, every)
    for number in range(homes):
        yield drawn_home(number)


def house(data: Path, cache: Path, every: int = 1) -> Place:
    """The house; its first sequence shows the map, the others are asked about."""
    path = place(cache, "house_default")
    if not path.exists():
        build_scene(data / "house/map/house.glb", path)
    folders = sorted((data / "house").glob("seq[0-9]*"))
    asked = [(open_capture(f)[::every], true_poses(f)[::every]) for f in folders[1:]]
    return Place(
        kind="house",
        name="house",
        scene=SceneMap.open(path),
        frames=tuple(frame for capture, _ in asked for frame in capture),
        map_from_camera=np.concatenate([poses for _, poses in asked]),
        captures=(posed(open_capture(folders[0]), true_poses(folders[0])),),
    )


def office(data: Path, cache: Path, half: str, every: int = 1) -> Place:
    """The office: one half of its frames makes the map, cut into objects; the other is asked."""
    (low, high), (first, last) = HALVES[half]
    path = place(cache, f"office_objects_{low}_{high}")
    if not path.exists():
        build_scene(data / "office", path, capture=FromCapture(frames=slice(low, high)))
    capture, truth = open_capture(data / "office"), true_poses(data / "office")
    rows = slice(first, last, every)
    return Place(
        kind="office",
        name=f"office, {half}",
        scene=SceneMap.open(path),
        frames=capture[rows].frames,
        map_from_camera=truth[rows],
        captures=(posed(capture[low:high:3], truth[low:high:3]),),
    )


def drawn_home(number: int) -> Place:
    """A procedural home with objects' labels; two walks in different light."""
    rng = np.random.default_rng(_FIRST_HOME + number)
    flat = home(rng)
    interior = flat.furnish(rng)
    scene = scene_of(interior)
    walks = [visit(flat, interior, rng, frames=WALK) for _ in range(2)]
    asked, shown = (
        record(interior, walk, rng, daylight=float(rng.uniform(0.1, 0.9))) for walk in walks
    )
    return Place(
        kind="homes",
        name=f"home {number}",
        scene=scene,
        frames=asked.frames,
        map_from_camera=walks[0].map_from_camera,
        captures=(posed(shown, walks[1].map_from_camera),),
    )


def posed(capture: Capture, map_from_camera: Floats) -> Capture:
    """Capture whose odometry is map_from_camera (T, 4, 4): images of the map itself."""
    return replace(
        capture,
        frames=tuple(
            replace(frame, odometry=pose)
            for frame, pose in zip(capture, map_from_camera, strict=True)
        ),
    )
