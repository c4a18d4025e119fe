"""Drawn homes in drawn buildings, and how well their maps find their place there, by walls and by fixes."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geo import Anchor
from placegraph.core.geometry import Camera, Floats, wrap_angle
from placegraph.errors import PlacegraphError
from placegraph.indoor.mapping.outlines import trace_cells
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame
from placegraph.world import AnchorFit, fit_building, fit_capture
from placegraph_lab.tables.runner import Quick, Run, Seed, markdown, table
from placegraph_lab.tables.statistics import reliability
from placegraph_lab.worlds.flat.flat import DOOR, OUTSIDE, Flat
from placegraph_lab.worlds.flat.interior import Interior
from placegraph_lab.worlds.home.home import home, scene_of, visit

DRAWN, CORNER = 0.5, 0.2
"""Standard deviations of a whole footprint and of each of its corners [m]: pictures from above, a hand."""
THICK = (2, 4)  # cells that outer walls are thick
BESIDE = (40, 80)  # cells of building beside a home that is a part of it
GPS, WRONG, FAR, FIXES = 5.0, 0.1, (30.0, 100.0), 60
"""Standard deviation of a fix [m], share of reflections, how far off they are [m], fixes of a capture."""
WANDERS = 0.9  # correlation of a fix's error with that of the fix before, where errors wander
AROUND = 5.0  # from the walls, of those who walk around a house [m]
RIGHT, TURN = 1.8, np.radians(15.0)  # A candidate is right within these
BUILDINGS = {
    f"{shape}, {part}{', entrance' if entrance else ''}": (shape, part, entrance)
    for shape in ("rectangle", "other shape")
    for part in ("whole house", "part of it")
    for entrance in (False, True)
}
WALKS = {
    "fixes indoors": (False, False, False),
    "fixes around the house": (True, False, False),
    "fixes around, errors wander": (True, True, False),
    "fixes around, errors wander, and walls": (True, True, True),
}


@dataclass(frozen=True, eq=False)
class House:
    """A home in a building."""

    flat: Flat
    interior: Interior
    scene: SceneMap
    stands: Anchor
    outline: Floats  # (n, 2) outline of the home's outer walls [m, map]
    part: Floats | None
    """The same of a building that the home is a part of; None: no side of it is free of windows."""
    doors: Floats  # (E, 2) middles of outer doors [m, map]

    @property
    def shape(self) -> str:
        return "rectangle" if len(self.outline) == 5 else "other shape"


def house(seed: int, number: int) -> House:
    """House of a number; the same every time."""
    rng = np.random.default_rng((seed, number))
    flat = home(rng)
    interior = flat.furnish(rng)
    stands = Anchor(
        rng.uniform(-180, 180), rng.uniform(-70, 70), rng.uniform(0, 500), rng.uniform(0, 7)
    )
    inside = (flat.room_of >= 0)[::-1].T
    cell = flat.metres[0]
    pad, thick = max(BESIDE) + 2 * THICK[1], int(rng.integers(THICK[0], THICK[1] + 1))
    grown = _grown(np.pad(inside, pad), thick + 1)
    origin = np.full(2, -pad * cell)
    outline = trace_cells(grown, origin, cell)[0]
    openings = [flat.corner(*(np.mean(sorted(b.cells), axis=0) + 0.5)) for b in flat.openings]
    kinds = [b.symbol.kind for b in flat.openings]
    outer = [
        at for at, blot in zip(openings, flat.openings, strict=True) if _outer(flat, blot.cells)
    ]
    doors = [a for a, k in zip(openings, kinds, strict=True) if k == DOOR]
    part = _extended(grown, origin, cell, outer, rng)
    return House(
        flat, interior, scene_of(interior, name=f"home{number}"), stands, outline,
        part, np.reshape(doors, (-1, 2)),
    )  # fmt: skip


def _outer(flat: Flat, cells: frozenset[tuple[int, int]]) -> bool:
    near = [(r + i, c + j) for r, c in cells for i in (-1, 0, 1) for j in (-1, 0, 1)]
    rows, columns = flat.room_of.shape
    return any(
        not (0 <= r < rows and 0 <= c < columns) or flat.room_of[r, c] == OUTSIDE for r, c in near
    )


def _grown(mask: NDArray[np.bool_], cells: int) -> NDArray[np.bool_]:
    for axis in (0, 1):
        steps = [np.roll(mask, k, axis) for k in range(-cells, cells + 1)]
        mask = np.logical_or.reduce(steps)
    return mask


def _extended(
    mask: NDArray[np.bool_], origin: Floats, cell: float, openings: Sequence[Any], rng: Generator
) -> Floats | None:
    x, y = np.nonzero(mask)
    low, high = np.array([x.min(), y.min()]), np.array([x.max(), y.max()]) + 1
    ends = origin + low * cell, origin + high * cell
    width = int(rng.integers(*BESIDE))
    for side in rng.permutation(4).tolist():
        axis, above = side % 2, side // 2
        edge = ends[above][axis]
        if any(abs(at[axis] - edge) < 1.5 for at in openings):
            continue
        larger = mask.copy()
        box = [slice(low[0], high[0]), slice(low[1], high[1])]
        inner = 8  # cells, so that a jagged side is closed
        box[axis] = (
            slice(high[axis] - inner, high[axis] + width)
            if above
            else slice(low[axis] - width, low[axis] + inner)
        )
        larger[tuple(box)] = True
        return trace_cells(larger, origin, cell)[0]
    return None


def extract(home: House, ring: Floats, path: Path, rng: Generator, *, entrance: bool) -> Path:
    """File of a building as somebody drew it."""
    off = rng.normal(0.0, DRAWN, 2)
    corners = ring[:-1] + rng.normal(0.0, CORNER, (len(ring) - 1, 2)) + off
    points = np.vstack([corners, *([home.doors + off] if entrance else [])])
    places = home.stands.to_earth(np.column_stack([points, np.zeros(len(points))]))
    nodes = "".join(
        f'<node id="{k + 1}" lon="{lon:.9f}" lat="{lat:.9f}">'
        + ('<tag k="entrance" v="yes"/>' if k >= len(corners) else "")
        + "</node>"
        for k, (lon, lat, _) in enumerate(places.tolist())
    )
    refs = "".join(f'<nd ref="{k % len(corners) + 1}"/>' for k in range(len(corners) + 1))
    said = '<tag k="building" v="yes"/><tag k="name" v="House"/>'
    path.write_text(f'<osm version="0.6">{nodes}<way id="1">{refs}{said}</way></osm>')
    return path


def film(
    home: House, folder: Path, rng: Generator, *, around: bool, wanders: bool
) -> tuple[SceneMap, Capture]:
    """Capture with fixes, and the map that was made of it."""
    at = visit(home.flat, home.interior, rng, frames=FIXES).map_from_camera[:, :3, 3]
    if around:
        low, high = home.outline.min(axis=0) - AROUND, home.outline.max(axis=0) + AROUND
        turn = np.linspace(0, 2 * np.pi, FIXES) + rng.uniform(0, 7)
        way = (low + high) / 2 + np.stack([np.cos(turn), np.sin(turn)], axis=1) * (high - low) / 2
        at = np.column_stack([way, np.full(FIXES, 1.6)])
    off = rng.normal(0.0, GPS, (FIXES, 2))
    for k in range(1, FIXES if wanders else 1):
        off[k] = WANDERS * off[k - 1] + np.sqrt(1 - WANDERS**2) * off[k]
    wrong = np.flatnonzero(rng.random(FIXES) < WRONG)
    turn, far = rng.uniform(0, 7, len(wrong)), rng.uniform(*FAR, len(wrong))
    off[wrong] = np.stack([np.cos(turn), np.sin(turn)], axis=1) * far[:, None]
    places = home.stands.to_earth(at + np.column_stack([off, rng.normal(0, 1.5 * GPS, FIXES)]))
    rows = [
        f"{k} {lon:.9f} {lat:.9f} {h:.2f} {1.515 * GPS}" for k, (lon, lat, h) in enumerate(places)
    ]
    (folder / "fixes.txt").write_text("\n".join(rows))
    image, camera = np.zeros((12, 16, 3), np.uint8), Camera(16, 12, 12.0, 12.0, 8.0, 6.0)
    frames = []
    for k, point in enumerate(at):
        pose = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
        pose[:3, 3] = point
        frames.append(Frame.from_arrays(image, camera, odometry=pose, stamp=k, index=k))
    capture = replace(Capture.from_frames(frames), path=folder)
    return replace(home.scene, viewpoints=np.round(at[::5], 2)), capture


def ask(home: House, row: str, folder: Path, seed: int) -> dict[str, Any] | None:
    """Answer to a row of the table; None where the row is not of this house."""
    rng = np.random.default_rng((seed, list({**BUILDINGS, **WALKS}).index(row)))
    begun = process_time()
    try:
        if row in BUILDINGS:
            shape, part, entrance = BUILDINGS[row]
            ring = home.outline if part == "whole house" else home.part
            if home.shape != shape or ring is None:
                return None
            file = extract(home, ring, folder / "a.osm", rng, entrance=entrance)
            begun = process_time()
            found = fit_building(home.scene, file, "House")
        else:
            around, wanders, walls = WALKS[row]
            scene, capture = film(home, folder, rng, around=around, wanders=wanders)
            file = extract(home, home.outline, folder / "a.osm", rng, entrance=False)
            begun = process_time()
            found = fit_capture(scene, capture)
            if walls:
                found = fit_building(home.scene, file, "House", prior=found.anchors[0])
    except PlacegraphError as error:
        return {"row": row, "refused": str(error)}
    return {"row": row, "seconds": process_time() - begun} | score_candidates(home, found)


def score_candidates(home: House, fit: AnchorFit) -> dict[str, Any]:
    middle = home.scene.bounds.mean(axis=0) * (1, 1, 0)
    rows = np.ix_([0, 1, 3], [0, 1, 3])
    true, candidates = home.stands.shift_origin(-middle), []
    for anchor in fit.anchors:
        here = anchor.shift_origin(-middle)
        at = true.enu_from_map[:3, :3] @ true.to_map((here.longitude, here.latitude, true.height))
        off = np.array([*at[:2], float(wrap_angle(here.heading - true.heading))])
        told = {
            "probability": anchor.probability, "metres": np.hypot(*off[:2]),
            "degrees": np.degrees(abs(off[2])),
            "chi2": off @ np.linalg.solve(here.covariance[rows], off),
        }  # fmt: skip
        candidates.append({name: round(float(value), 3) for name, value in told.items()})
    return {"candidates": candidates}


def right(candidate: dict[str, Any]) -> bool:
    return bool(candidate["metres"] < RIGHT and np.radians(candidate["degrees"]) < TURN)


def report(answers: Sequence[dict[str, Any]]) -> str:
    lines, sure, true = [], [], []
    for row in (*BUILDINGS, *WALKS):
        own = [a for a in answers if a["row"] == row]
        kept = [a["candidates"] for a in own if "candidates" in a]
        if not kept:
            continue
        choice = (
            row in BUILDINGS or WALKS[row][2]
        )  # fixes alone have one candidate, however far off
        good = [next((c for c in found if right(c) or not choice), None) for found in kept]
        held = [c for c in good if c is not None]
        first = [right(found[0]) for found in kept]
        if not held:
            continue
        if row in BUILDINGS:
            sure += [found[0]["probability"] for found in kept]
            true += first
        metres, turns = ([c[key] for c in held] for key in ("metres", "degrees"))
        lines.append([
            row, str(len(own)), f"{1 - len(kept) / len(own):.0%}",
            *([
                f"{np.mean([len(found) for found in kept]):.1f}", f"{np.mean(first):.0%}",
                f"{np.mean([found[0]['probability'] for found in kept]):.0%}",
                f"{len(held) / len(kept):.0%}",
            ] if choice else ["–"] * 4), f"{np.median(metres):.1f} m", f"{np.quantile(metres, 0.9):.1f} m",
            f"{np.median(turns):.1f}°", f"{np.quantile(turns, 0.9):.1f}°",
            f"{np.mean([c['chi2'] < 7.815 for c in held]):.0%}",
        ])  # fmt: skip
    header = [
        "known", "maps", "refused", "candidates", "right first", "said", "right among", "off", "90 %",
        "turned", "90 %", "held",
    ]  # fmt: skip
    text = markdown(header, lines)
    if len(sure) >= 10:
        bins = reliability(sure, true, 5)
        text += f"\n\nCalibration error {bins.error:.2f} ({bins.floor:.2f} by luck)"
    return text


@table()
def scene_anchor(
    run: Run,
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """Anchors fitted to walls, entrances and fixes: right orientation, errors [m, degrees]."""
    asked = []
    with tempfile.TemporaryDirectory() as folder:
        for number in run.track(range(6 if quick else 200), "fitting"):
            drawn = house(seed, number)
            answers = (ask(drawn, row, Path(folder), number) for row in (*BUILDINGS, *WALKS))
            asked += [a | {"house": number} for a in answers if a is not None]
    print(report(asked))
    run.save({"rows": asked})
