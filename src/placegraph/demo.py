"""The demo: a town and a flat that ship with placegraph, and someone lost in each of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.geometry import vector_from_rotation
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.town.town import Town

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from typing import Any

    from numpy.typing import NDArray

    from placegraph.estimate import Estimate, PoseEstimate
    from placegraph.formats.capture.capture import Capture
    from placegraph.outdoor.city import CityMap

TOWN = "hafenstadt"
SENTENCES = {
    "clear": "I'm on Lange Straße. A bakery is north of me, a tram stop is south of me, "
    "and the church is to the southeast.",
    "ambiguous": "I am standing on a square. There is a fountain north of me and a café to my east.",
    "impossible": "A lighthouse is north of me and a zoo is to the south.",
}
ON_THE_WAY = (
    SENTENCES["ambiguous"],
    "I walked about 100 metres south.",
    "There is a library to my east.",
)
"""Said one after the other: the way tells the two squares apart."""
FLAT = "altbau"
WAY = "41"
"""Rooms that the camera comes through."""
FRAMES = 18
HOMES = 4
"""Drawn homes that stand beside the flat in a library."""
ROOMS = ("a kitchen with two sinks", "a bedroom with a bookcase, and a plant next to the sofa")


def run_demo(out: Path, say: Callable[[str], None]) -> None:
    """Locate sentences and a way in the town, a film in the flat; leave maps and pictures in `out`."""
    _town(out, say)
    _flat(out, say)
    pages = ("clear.html", "ambiguous.html", "walk.png", "walk.gif", "overlay.png", "changes.png")
    say(f"\nLook at {', '.join(f'{out}/{page}' for page in pages)}.")


def _town(out: Path, say: Callable[[str], None]) -> None:
    """Build the town and locate what was said in it."""
    from placegraph.outdoor.map.build import build_city
    from placegraph.view import draw_city, write_page, write_picture

    osm = Town.load(TOWN).write_osm(out / f"{TOWN}.osm")
    city = build_city(osm, out / f"{TOWN}.city")
    draw_city(city, out / f"{TOWN}.png")
    say(f"Built {city} from a town drawn in ASCII.")
    for name, text in SENTENCES.items():
        estimate = city.locate(text)
        question = estimate.next_question(city) if estimate.status.name == "AMBIGUOUS" else None
        write_page(
            city,
            estimate,
            out / f"{name}.html",
            title=text,
            question=question.text if question else None,
        )
        write_picture(city, estimate, out / f"{name}.png")
        say(f"\n“{text}”\n{estimate.status.name}: {estimate.reason}")
        for mode in estimate.modes[:3]:
            say(f"  {mode.latitude:.5f}, {mode.longitude:.5f}  {mode.probability:.0%}")
        _say_evidence(estimate, say)
        if question:
            say(f"  To be sure: {question.text}")
    _way(city, say)


def _way(city: CityMap, say: Callable[[str], None]) -> None:
    """Follow somebody who could be at either of two places, until their way tells which."""
    tracker = city.track()
    say("\nSomebody speaks, walks on, and speaks again:")
    for text in ON_THE_WAY:
        estimate = tracker.tell(text)
        say(f"  “{text}”\n    {estimate.status.name}: {estimate.reason}")
    for mode in tracker.estimate.modes[:1]:
        say(f"    {mode.latitude:.5f}, {mode.longitude:.5f}  {mode.probability:.0%}")


def _flat(out: Path, say: Callable[[str], None]) -> None:
    """Build the flat, film a walk through it after something changed, and localize the film."""
    from placegraph.formats.capture.capture import open_capture
    from placegraph.indoor.build import build_scene
    from placegraph.indoor.options import FilterOptions
    from placegraph.view import draw_scene, write_overlay, write_plan, write_plan_animation
    from placegraph.view.scene.diff_plan import write_diff
    from placegraph_lab.worlds.flat.walks import stroll, write_walk

    drawing, rng = Flat.load(FLAT), np.random.default_rng(0)
    interior = drawing.furnish(rng)
    scene = build_scene(interior.write_glb(out / f"{FLAT}.glb"), out / f"{FLAT}.scene")
    draw_scene(scene, out / f"{FLAT}.png")
    say(f"\nBuilt {scene} from a flat drawn in ASCII.")

    now = interior.moved("armchair", (0.5, -0.2), 0.6).without("chair 1")
    walk = stroll(drawing, rng, frames=FRAMES, through=WAY, speed=1.1)
    capture = open_capture(write_walk(now, walk, out / "walk", rng))
    say(f"Rendered {capture}; since the map was made, an armchair was moved and a chair is gone.")
    estimate = scene.localize(capture, options=FilterOptions(record=True), seed=0)
    truth = walk.map_from_camera
    write_plan(scene, estimate, out / "walk.png", truth=truth, camera=capture.camera)
    write_plan_animation(scene, estimate, out / "walk.gif", truth=truth, camera=capture.camera)
    write_overlay(scene, estimate, capture, out / "overlay.png")
    _say_pose(estimate, say)
    _say_truth(estimate, truth, say)
    found = scene.diff(capture, estimate)
    say("What changed since the map was made, as the walk shows it:")
    for change in found.changes:
        say(
            f"  {change.kind} {change.name or change.label}, {change.confidence:.0%} sure: {change.reason}"
        )
    write_diff(scene, found, out / "changes.png")
    newer = scene.updated(found)
    newer.save(out / f"{FLAT}_now.scene")
    say(
        f"{out / f'{FLAT}_now.scene'} has taken it over: {len(newer)} objects instead of {len(scene)}."
    )
    _library(capture, out, say)


def _library(capture: Capture, out: Path, say: Callable[[str], None]) -> None:
    """Find the flat among others, by the film and by a sentence."""
    from placegraph.indoor.library import SceneLibrary
    from placegraph_lab.worlds.home.home import home, scene_of

    library = SceneLibrary()
    library.add(FLAT, out / f"{FLAT}.scene")
    for i in range(HOMES):
        rng = np.random.default_rng(i)
        path = out / f"home{i + 1}.scene"
        scene_of(home(rng).furnish(rng)).save(path)
        library.add(path.stem, path)
    library.save(out / "homes.library")
    size = (out / "homes.library").stat().st_size
    say(f"\n{library} in {size / 1000:.0f} kB: which of them was the film taken in?")
    found = library.search(capture)
    say(f"  {found.status.name}: {found.reason}")
    for text in ROOMS:
        told = library.search(text)
        say(f"  “{text}”: {told.status.name}: {told.reason}")


def _say_pose(estimate: PoseEstimate, say: Callable[[str], None]) -> None:
    """Where the last frame was taken, why, and what became of the refinement."""
    say(f"{estimate.status.name}: {estimate.reason}")
    for mode in estimate.modes[:3]:
        say(f"  {_pose(mode.pose)}  {mode.probability:.0%}")
    _say_evidence(estimate, say)
    if estimate.refinement is not None:
        say(f"  {estimate.refinement.reason}")


def _say_truth(
    estimate: PoseEstimate, truth: NDArray[np.float64], say: Callable[[str], None]
) -> None:
    """How far all frames were off before the refinement and after it; truth: (T, 4, 4)."""
    refinement = estimate.refinement
    if refinement is None:
        say(f"  off by {_errors(estimate.trajectory, truth)}")
        return
    say("Errors of all frames, median and largest (the truth is known because we drew it):")
    say(f"  coarse   {_errors(refinement.coarse_trajectory, truth)}")
    say(f"  refined  {_errors(estimate.trajectory, truth)}")


def _errors(poses: NDArray[np.float64], truth: NDArray[np.float64]) -> str:
    """Median and largest error of poses (T, 4, 4) in words."""
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


def _say_evidence(estimate: Estimate[Any], say: Callable[[str], None]) -> None:
    for e in estimate.evidence:
        things = ", ".join(o.name or o.label for o in e.objects)
        say(f"    {e.verdict:7} {e.statement}  [{things or e.note}]")
