"""Table `world_locate`: recall of building, room and pose by a sentence, three frames and a fix.

A quarter of houses with addresses is drawn, and in each a home. Somebody in a room says address, room
and two things (one number in ten is the next house's), and films three frames with depth.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.estimate import Status
from placegraph.core.geo import Anchor
from placegraph.core.geometry import Camera, LocalPlane, vector_from_rotation
from placegraph.indoor.map.floor import is_structural, split_label
from placegraph.indoor.map.rooms import find_room_name
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture
from placegraph.outdoor.city import build_city
from placegraph.world import World
from placegraph_lab.tables.runner import Quick, Run, Seed, markdown, table
from placegraph_lab.worlds.home.home import home, scene_of
from placegraph_lab.worlds.home.visit import record, visit

PLANE = LocalPlane(9.99, 53.55)
CAMERA = Camera(96, 72, 70.0, 70.0, 48.0, 36.0)
NUMBERS, PLOT, STREET = 20, 25.0, 60.0
"""Houses of a street; metres from house to house, and from street to street."""
NAMES = (
    "Ahornweg", "Birkenallee", "Eschenstraße", "Fliederweg", "Gerberstraße", "Holzmarkt",
    "Kastanienallee", "Lindenstraße", "Mühlenweg", "Nelkenweg", "Obstgasse", "Pappelallee",
)  # fmt: skip
FRAMES, WITHIN, TURN = 3, 0.25, np.radians(5.0)
GPS = 15.0  # standard deviation of a fix [m]
ROWS = {
    f"{what}{', fix' if fix else ''}": ("text" in what, "frames" in what, fix)
    for fix in (False, True)
    for what in ("text", "frames", "text and frames")
}


@dataclass(frozen=True, eq=False)
class Visit:
    """Somebody in a room of a house."""

    scene: str
    room: str
    text: str
    frames: Capture
    pose: NDArray[np.float64]  # (4, 4) map_from_camera of the last frame
    near: tuple[float, float]


def quarter(count: int, folder: Path, seed: int) -> tuple[World, list[Visit]]:
    """A world of so many houses, and a visit to each."""
    spots = [
        (NAMES[i // NUMBERS], 1 + i % NUMBERS, (PLOT * (i % NUMBERS), STREET * (i // NUMBERS)))
        for i in range(count)
    ]
    city = build_city(_osm(spots, folder / "quarter.osm"), folder / "quarter.city")
    scenes: dict[str, SceneMap] = {}
    visits = []
    for i, (street, number, spot) in enumerate(spots):
        rng = np.random.default_rng((seed, i))
        flat = home(rng)
        interior = flat.furnish(rng)
        longitude, latitude = PLANE.to_lonlat(spot)
        there = Anchor(longitude, latitude, 0.0, 0.0, np.diag([1.0, 1, 1, 0.01]), level="0")
        scene = scene_of(interior, name=f"house{i}")
        scene = scene.anchored(there.shift_origin(scene.bounds.mean(axis=0) * (1, 1, 0)))
        scenes[f"house{i}"] = scene
        walk = visit(flat, interior, rng, frames=FRAMES)
        film = record(interior, walk, rng, camera=CAMERA, depth=True, labels=None)
        pose = walk.map_from_camera[-1]
        room = find_room_name(scene, pose[:3, 3])
        fix = PLANE.to_lonlat(np.array(spot) + rng.normal(0.0, GPS, 2))
        text = _describe(scene, room, street, number, rng)
        visits.append(Visit(f"house{i}", room, text, film, pose, (float(fix[0]), float(fix[1]))))
    return World({"quarter": city}, scenes), visits


def _describe(scene: SceneMap, room: str, street: str, number: int, rng: Generator) -> str:
    labels = np.array(scene.graph.labels)
    here = np.array([a.get("room") == room for a in scene.attributes]) & ~is_structural(
        scene.graph.labels
    )
    things = rng.permutation(np.unique(labels[here]))[:2]
    told = " and ".join(f"a {' '.join(split_label(str(thing)))}" for thing in things)
    number += int(rng.random() < 0.1)
    where = f"I am in the {room} at {street} {number}." if room else f"I am at {street} {number}."
    return f"{where} There is {told}." if told else where


def _osm(spots: Sequence[tuple[str, int, tuple[float, float]]], path: Path) -> Path:
    nodes: list[str] = []
    ways: list[str] = []

    def way(corners: Sequence[tuple[float, float]], tags: dict[str, str], *, closed: bool) -> None:
        first = len(nodes) + 1
        for corner in corners:
            lon, lat = PLANE.to_lonlat(corner)
            nodes.append(
                f'<node id="{len(nodes) + 1}" version="1" lon="{lon:.7f}" lat="{lat:.7f}"/>'
            )
        refs = [*range(first, len(nodes) + 1), *([first] if closed else [])]
        inner = "".join(f'<nd ref="{r}"/>' for r in refs)
        inner += "".join(f"<tag k={quoteattr(k)} v={quoteattr(v)}/>" for k, v in tags.items())
        ways.append(f'<way id="{len(ways) + 1}" version="1">{inner}</way>')

    for street in dict.fromkeys(s for s, _, _ in spots):
        own = [at for s, _, at in spots if s == street]
        ends = [(own[0][0] - 20.0, own[0][1] - 18.0), (own[-1][0] + 20.0, own[-1][1] - 18.0)]
        way(ends, {"highway": "residential", "name": street}, closed=False)
    for street, number, (x, y) in spots:
        box = [(x - 6, y - 5), (x + 6, y - 5), (x + 6, y + 5), (x - 6, y + 5)]
        tags = {"building": "yes", "addr:street": street, "addr:housenumber": str(number)}
        way(box, tags, closed=True)
    text = "\n".join(['<osm version="0.6">', *nodes, *ways, "</osm>"])
    path.write_text(text, encoding="utf-8")
    return path


def ask(world: World, visit_: Visit, row: str, seed: int) -> dict[str, Any]:
    """Locate a visit in a world by what a row of the table knows of it."""
    text, frames, fix = ROWS[row]
    start = perf_counter()
    estimate = world.locate(
        visit_.text if text else None, visit_.frames if frames else None,
        near=visit_.near if fix else None, radius=1.1774 * GPS, seed=seed,
    )  # fmt: skip
    seconds = perf_counter() - start
    best = estimate.best
    building = best is not None and best.scene == visit_.scene
    room = building and best is not None and best.room == visit_.room
    pose = False
    if building and best is not None and best.pose is not None:
        off = np.linalg.inv(visit_.pose) @ best.pose.scene_from_camera
        turn = float(np.linalg.norm(vector_from_rotation(off[:3, :3])))
        pose = bool(np.linalg.norm(off[:3, 3]) < WITHIN and turn < TURN)
    ok = estimate.status is Status.OK
    right = pose if frames else room
    return {
        "row": row, "scene": visit_.scene, "building": building, "room": room, "pose": pose,
        "ok": ok, "false_ok": ok and not right, "seconds": seconds,
    }  # fmt: skip


def report(answers: Sequence[dict[str, Any]]) -> str:
    rows = []
    for row in ROWS:
        own = [a for a in answers if a["row"] == row]
        shares = [
            f"{np.mean([a[key] for a in own]):.0%}" for key in ("building", "room", "pose", "ok")
        ]
        wrong = sum(a["false_ok"] for a in own)
        rows.append([row, *shares, str(wrong), f"{np.median([a['seconds'] for a in own]):.2f}"])
    header = ["known", "building", "room", "pose", "OK", "wrong OK", "s a query"]
    return markdown(header, rows)


@table()
def world_locate(
    run: Run,
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """Recall of building, room and pose in a quarter, by sentence, film and fix."""
    buildings = 6 if quick else 200
    with tempfile.TemporaryDirectory() as folder:
        world, visits = quarter(buildings, Path(folder), seed)
        world.library  # noqa: B018  # made when first asked for: its time is no query's
        cases = [(visit, row) for row in ROWS for visit in visits]
        asked = [ask(world, visit, row, seed) for visit, row in run.track(cases, "asking")]
    print(f"{buildings} buildings, a visit to each\n\n{report(asked)}")
    run.save({"rows": asked})
