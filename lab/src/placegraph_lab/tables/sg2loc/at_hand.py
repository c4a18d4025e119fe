"""Sets that this project has: the house, the office, freiburg1_rpy, and homes that are drawn."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from placegraph.core.geometry import Camera, Floats
from placegraph.indoor.build import build_scene
from placegraph.indoor.mapping.from_capture import FromCapture
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture, open_capture
from placegraph_lab.tables.indoor import maps as indoor_maps
from placegraph_lab.tables.indoor.maps import place
from placegraph_lab.tables.indoor.windows import HALVES, OFFICE_STRIDE, is_changed, true_poses
from placegraph_lab.tables.retrieval.retrieval_walks import RENDERING
from placegraph_lab.tables.runner import fingerprint
from placegraph_lab.tables.sg2loc.sets import Set, Walk, kept
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.interior import Interior
from placegraph_lab.worlds.flat.walks import write_walk
from placegraph_lab.worlds.home.home import STYLES, changed, home, scene_of, visit

FIRST, HOMES, WALKED = 2000, 10, 4
"""Seed of the first home, homes there are, and homes that are walked through; no other table, and no
training, draws of these seeds."""
FRAMES = 100
CAMERA = Camera(320, 240, 230.0, 230.0, 160.0, 120.0)
RPY = {"second half in the first": (0, 52, 104), "first half in the second": (52, 0, 52)}
"""Of freiburg1_rpy: the first of 52 frames that make the map; the frames that are asked about."""


def of_house(data: Path, cache: Path) -> Set:
    """The rendered house, of which methods were developed: eight walks, four after changes."""
    walks = [
        Walk(path.name, "house", partial(_recorded, path), is_changed(path / "changes.json"))
        for path in sorted((data / "house").glob("seq[0-9]*"))
    ]
    scene = kept(lambda _: indoor_maps.house(data, cache))
    return Set("house", tuple(walks), scene, {"house": "house"}, 5.0, own_ids=True)


def of_office(data: Path, cache: Path) -> Set:
    """The real office, of which methods were developed: each half asked in a map of the other."""
    walks = [
        Walk(half, half, partial(_recorded, data / "office", slice(*asked, OFFICE_STRIDE)))
        for half, (_, asked) in HALVES.items()
    ]
    folder = data / "office"
    spans = {half: slice(*made) for half, (made, _) in HALVES.items()}
    rooms = dict.fromkeys(spans, "office")
    return Set("office", tuple(walks), _halves(folder, cache, spans), rooms, 5.0)


def of_freiburg(data: Path, cache: Path) -> Set:
    """A real sequence, nearly all turning, of which nothing was developed: halves as of the office."""
    folder = data / "freiburg1_rpy"
    walks = [
        Walk(half, half, partial(_recorded, folder, slice(first, last)))
        for half, (_, first, last) in RPY.items()
    ]
    spans = {half: slice(low, low + 52) for half, (low, *_) in RPY.items()}
    scene = _halves(folder, cache, spans, floor=0.0)  # which one half does not show
    return Set("freiburg1_rpy", tuple(walks), scene, dict.fromkeys(spans, "desk"), 30 / 7)


def _halves(
    folder: Path, cache: Path, spans: dict[str, slice], floor: float | None = None
) -> Callable[[str], SceneMap]:
    """Maps of parts of a capture, cut into objects, as users make them."""

    def scene(half: str) -> SceneMap:
        span = spans[half]
        path = place(cache, f"{folder.name}_objects_{span.start}_{span.stop}")
        if not path.exists():
            build_scene(folder, path, capture=FromCapture(frames=span), floor=floor)
        return SceneMap.open(path)

    return kept(scene)


def of_homes(cache: Path, walked: int = WALKED, frames: int = FRAMES) -> Set:
    """Drawn homes of which nothing was developed: walks as they were, and months later."""
    styles = list(STYLES)
    drawn: dict[str, tuple[Flat, Interior]] = {}
    for i, seed in enumerate(range(FIRST, FIRST + HOMES)):
        rng = np.random.default_rng(seed)
        flat = home(rng, style=styles[i % len(styles)])
        drawn[f"home {seed}"] = flat, flat.furnish(rng)
    folder = cache / f"sg2loc_homes_{fingerprint(RENDERING)}"

    def walk(name: str, *, later: bool) -> tuple[Capture, Floats]:
        path = folder / f"{name.replace(' ', '_')}_{later:d}_{frames}"
        if not (path / "gravity.txt").exists():  # which is written last
            flat, interior = drawn[name]
            rng = np.random.default_rng([int(name.split()[1]), 1 + later])
            now = changed(interior, rng) if later else interior
            way = visit(flat, now, rng, frames=frames)
            write_walk(now, way, path, rng, camera=CAMERA, labels="labels", daylight=rng.uniform())
        return _recorded(path)

    walks = [
        Walk(f"{name}{' later' * later}", name, partial(walk, name, later=later), later)
        for name in list(drawn)[:walked]
        for later in (False, True)
    ]
    scene = kept(lambda name: scene_of(drawn[name][1], name=name))
    return Set("homes", tuple(walks), scene, {name: name for name in drawn}, 5.0, frames=frames)


def _recorded(path: Path, rows: slice = slice(None)) -> tuple[Capture, Floats]:
    """Frames of a capture's folder, and the truth that lies there, or is its odometry."""
    capture = open_capture(path)
    truth = true_poses(path) if (path / "trajectory.tum").exists() else capture.odometry
    return capture[rows], truth[rows]
