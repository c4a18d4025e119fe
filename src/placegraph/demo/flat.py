"""The demo's rooms: a flat with a film, changes and a library of homes, and the town with insides."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import PoseEstimate
from placegraph.core.geo import Anchor
from placegraph.core.geometry import vector_from_rotation
from placegraph.demo.town import FLAT, TOWN, TOWNS, print_evidence
from placegraph.io.capture.capture import Capture

if TYPE_CHECKING:
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.world import World


ROOMS = ("a kitchen with two sinks", "a bedroom with a bookcase, and a plant next to the sofa")


def locate_in_flat(world: Path, out: Path, report: Callable[[str], None]) -> list[str]:
    """Build the flat, localize a film of a walk through it, say what changed, find it among homes.

    Returns the commands that do the same.
    """
    from placegraph.indoor.build import build_scene
    from placegraph.io.capture.capture import open_capture
    from placegraph.io.capture.tum import read_tum
    from placegraph.view import draw_scene

    glb, file, walk = world / f"{FLAT}.glb", out / f"{FLAT}.scene", world / "walk"
    scene = build_scene(glb, file)
    draw_scene(scene, out / f"{FLAT}.png")
    report(f"\nBuilt {scene} from a flat drawn in ASCII.")
    capture = open_capture(walk)
    report(
        f"Rendered {capture}. Since the map was made, an armchair was moved and a chair was "
        "removed."
    )
    truth = read_tum(walk / "trajectory.tum").poses
    estimate = _film(scene, capture, truth, out, report)
    newer = _changes(scene, capture, estimate, out, report)
    _library(world, out, capture, report)
    library = out / "homes.library"
    return [
        f"scene build {glb} -o {file}",
        f"scene localize {file} {walk}",
        f"scene diff {file} {walk} -o {out / 'changes.json'}",
        f"scene update {file} {out / 'changes.json'} -o {newer}",
        f"library build {file} {world / 'home*.scene'} -o {library}",
        f"library search {library} {walk}",
        f'library search {library} "{ROOMS[0]}"',
    ]


def _film(
    scene: SceneMap,
    capture: Capture,
    truth: NDArray[np.float64],
    out: Path,
    report: Callable[[str], None],
) -> PoseEstimate:
    """Localize the film, draw it, and say how far off it is; truth: (T, 4, 4)."""
    from placegraph.indoor.options import FilterOptions
    from placegraph.view import write_overlay, write_plan, write_plan_animation

    estimate = scene.localize(capture, options=FilterOptions(record=True), seed=0)
    write_plan(
        scene, estimate, out / "walk.png", truth=truth, camera=capture.camera, capture=capture
    )
    write_plan_animation(scene, estimate, out / "walk.gif", truth=truth, camera=capture.camera)
    write_overlay(scene, estimate, capture, out / "overlay.png")
    _say_pose(estimate, report)
    _say_truth(estimate, truth, report)
    return estimate


def _changes(
    scene: SceneMap,
    capture: Capture,
    estimate: PoseEstimate,
    out: Path,
    report: Callable[[str], None],
) -> Path:
    """Say what the film shows to have changed, and write the map that has taken it over."""
    from placegraph.view.scene.change_plans import write_diff

    found = scene.diff(capture, estimate)
    report("Changes since the map was made, detected from the walk:")
    for change in found.changes:
        report(
            f"  {change.kind} {change.name or change.label}, {change.confidence:.0%} sure: {change.reason}"
        )
    write_diff(scene, found, out / "changes.png")
    newer, path = scene.updated(found), out / f"{FLAT}_now.scene"
    newer.save(path)
    report(f"The changes were applied to {path}: {len(newer)} objects instead of {len(scene)}.")
    return path


def _library(world: Path, out: Path, capture: Capture, report: Callable[[str], None]) -> None:
    """Find the flat among others, by the film and by a sentence."""
    from placegraph.indoor.library import SceneLibrary

    library = SceneLibrary()
    library.add(FLAT, out / f"{FLAT}.scene")
    for path in sorted(world.glob("home*.scene")):
        library.add(path.stem, path)
    library.save(out / "homes.library")
    size = (out / "homes.library").stat().st_size
    report(f"\n{library} in {size / 1000:.0f} kB: in which scene was the capture recorded?")
    found = library.search(capture)
    report(f"  {found.status.name}: {found.reason}")
    for text in ROOMS:
        told = library.search(text)
        report(f"  “{text}”: {told.status.name}: {told.reason}")


def _say_pose(estimate: PoseEstimate, report: Callable[[str], None]) -> None:
    """Print the pose of the last frame, its evidence, and the result of the refinement."""
    report(f"{estimate.status.name}: {estimate.reason}")
    for mode in estimate.modes[:3]:
        report(f"  {_pose(mode.pose)}  {mode.probability:.0%}")
    print_evidence(estimate, report)
    if estimate.refinement is not None:
        report(f"  {estimate.refinement.reason}")


def _say_truth(
    estimate: PoseEstimate, truth: NDArray[np.float64], report: Callable[[str], None]
) -> None:
    """Print the errors of all frames before and after the refinement; truth: (T, 4, 4)."""
    refinement = estimate.refinement
    if refinement is None:
        report(f"  off by {_errors(estimate.trajectory, truth)}")
        return
    report("Errors of all frames, median and maximum, against the drawn ground truth:")
    report(f"  coarse   {_errors(refinement.coarse_trajectory, truth)}")
    report(f"  refined  {_errors(estimate.trajectory, truth)}")


def _errors(poses: NDArray[np.float64], truth: NDArray[np.float64]) -> str:
    """Describe the median and the largest error of poses (T, 4, 4)."""
    way = 100.0 * np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1)
    between = np.swapaxes(poses[:, :3, :3], 1, 2) @ truth[:, :3, :3]
    turn = np.degrees(np.linalg.norm(vector_from_rotation(between), axis=1))
    return (
        f"{np.median(way):4.1f} cm and {np.median(turn):.2f}°, "
        f"{way.max():4.1f} cm and {turn.max():.2f}°"
    )


def _pose(pose: NDArray[np.float64]) -> str:
    x, y, z, yaw = pose.tolist()
    return f"x {x:.2f} m, y {y:.2f} m, z {z:.2f} m, yaw {np.degrees(yaw):.1f}°"


TWIN_FLAT = f"{FLAT}_twin"
"""A flat as the first, in another house."""
SCENE_PLACES = {
    FLAT: (TOWN, "Hotel Hansa", "2", 0.0),
    TWIN_FLAT: (TOWN, "Bücherhalle", "1", np.pi),
    "home1": (TOWN, "Die Kajüte", "0", np.pi),
    "home2": (TOWN, "Stadtbibliothek", "2", 0.0),
    "home3": (TOWNS[1], "Stadtbücherei", "1", np.pi / 2),
    "home4": (TOWN, "Zum Anker", "0", 0.0),
}
"""Town, building, level and heading [rad] of each scene; buildings are tagged as insides need it."""
STOREY = 3.2
"""Height of a storey [m]."""
PRECISION = np.diag([0.5, 0.5, 0.5, 0.02]) ** 2
WINDOW = "I am in the library on Lange Straße, by the window"
QUESTIONS = (
    (WINDOW, False),
    ("I am in the dining room of Zum Anker", False),
    (None, True),
    (WINDOW, True),
    ("I am in the hotel", True),
)
"""Text, and whether three frames are shown."""


def locate_in_world(world: Path, out: Path, report: Callable[[str], None]) -> list[str]:
    """Place rooms in the buildings of two towns, and ask for place, room and pose at once.

    Returns the commands that do the same.
    """
    from placegraph.indoor.library import SceneLibrary
    from placegraph.io.capture.capture import open_capture
    from placegraph.outdoor.city import build_city
    from placegraph.world import open_world

    for town in TOWNS:
        build_city(world / f"{town}.osm", world / f"{town}.city")
    write_scenes(world, out / f"{FLAT}.scene")
    library = SceneLibrary()
    for name in SCENE_PLACES:
        library.add(name, world / f"{name}.scene")
    library.save(world / "homes.library")
    opened = open_world(world)
    report(f"\n{opened} in {world}: the rooms lie in buildings, and two flats are identical.")
    frames = open_capture(world / "window")
    for text, shown in QUESTIONS:
        _ask(opened, text, frames if shown else None, report)
    return [
        f'locate {world} "{WINDOW}"',
        f'locate {world} "{WINDOW}" --capture {world / "window"}',
    ]


def write_scenes(world: Path, flat: Path) -> None:
    """Write the flat, its twin and the homes into a folder, each where it stands on Earth."""
    from placegraph.indoor.scene_map import SceneMap

    for name, (town, building, level, heading) in SCENE_PLACES.items():
        scene = SceneMap.open(flat if name in (FLAT, TWIN_FLAT) else world / f"{name}.scene")
        placed = place_in_building(scene, world / f"{town}.osm", building, level, heading)
        placed.save(world / f"{name}.scene")


def place_in_building(
    scene: SceneMap, town: Path, building: str, level: str, heading: float
) -> SceneMap:
    """Return the scene with an anchor in the middle of a building of a town, found by name."""
    from placegraph.world.outlines import find_footprints

    outline = find_footprints(town, building)[0]
    ring = outline.rings[0]
    middle = np.append((ring.min(axis=0) + ring.max(axis=0)) / 2.0, 0.0)
    longitude, latitude, _ = outline.base.to_earth(middle).tolist()
    there = Anchor(
        longitude, latitude, STOREY * float(level), heading, PRECISION, building=building,
        osm=outline.osm, level=level, method="pose",
    )  # fmt: skip
    return scene.anchored(there.shift_origin(scene.bounds.mean(axis=0) * (1.0, 1.0, 0.0)))


def _ask(
    world: World, text: str | None, frames: Capture | None, report: Callable[[str], None]
) -> None:
    """Ask with a text, with frames or with both, and say what was found."""
    estimate = world.locate(text, frames)
    asked = [f"“{text}”"] * (text is not None) + ["three frames"] * (frames is not None)
    report(f"  {' and '.join(asked)}\n    {estimate.status.name}: {estimate.reason}")
    if estimate.best is not None and estimate.best.earth is not None:
        earth = estimate.best.earth
        report(
            f"    {earth.latitude:.6f}, {earth.longitude:.6f}, {earth.height:.1f} m, level {earth.level}"
        )
