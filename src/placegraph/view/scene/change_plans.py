"""Plans of a scene map on Earth, and of changes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.geo import Anchor, no_anchor_error
from placegraph.core.geometry import Floats
from placegraph.view.draw.canvas import Bounds, Disc, Frame, Item, Mark, Stroke, Text
from placegraph.view.draw.lettering import OccupiedPlaces
from placegraph.view.draw.painter import Sheet, paint_picture
from placegraph.view.scene.plan import (
    FOOT,
    HEAD,
    Layout,
    draw_measures,
    draw_scale_bar,
    place_names,
)
from placegraph.view.scene.room_plan import MARGIN, RoomPlan, name_of, paint_room

if TYPE_CHECKING:
    from placegraph.indoor.mapping.change.changes import Change, SceneDiff
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.world.outlines import Footprint

FAR = 150.0
"""Candidates farther from the best are told, not drawn [m]."""
MAX_LINES = 5
"""Candidates that are told at most."""
BUILDING, FAINT, ENTRANCE = "ink", "soft-ink", "for"
"""Colours."""


def draw_anchors(scene: SceneMap, path: str | Path, footprints: Sequence[Footprint] = ()) -> Path:
    """Draw a map of one scene where it stands, as a PNG with north at the top.

    The best candidate of its anchor is drawn in full, the walls of the others faintly, each with its
    number at the map's origin; footprints with their entrances around them.

    Raises `GeoPoseError`: the map stands nowhere.
    """
    if not scene.anchors:
        raise no_anchor_error(scene.source)
    best = scene.anchors[0]
    plan = RoomPlan(_turn_east(scene, best))
    origin = {k: _to_east_north(best, a, np.zeros(2)) for k, a in enumerate(scene.anchors, 1)}
    near = [k for k, at in origin.items() if k > 1 and np.linalg.norm(at) < FAR]
    marks = [mark for building in footprints for mark in _building(best, building)]
    for k in near:
        marks += _walls(scene, best, scene.anchors[k - 1])
    for k in reversed([1, *near] if near else []):
        marks.append(Disc(origin[k], 8.0, "mode" if k == 1 else FAINT, text=str(k)))
    bounds = _extend_bounds(plan.bounds, marks)
    layout = Layout.of(bounds, [], width=1200)
    frame = Frame.around(bounds, *layout.large)
    sheet = Sheet(layout.width, layout.height)
    room: list[Item] = [paint_room(plan, frame), *place_names(plan, frame, OccupiedPlaces())]
    sheet.paste(paint_picture([*room, *marks], frame, reduce=False), (0, HEAD))
    _draw_candidates(sheet, scene.anchors)
    sheet.north((layout.width - 26.0, HEAD + 28.0))
    x, y = 14.0, sheet.height - FOOT / 2
    for wanted, color, words in (
        (footprints, BUILDING, "building"), (near, FAINT, "other candidates"),
    ):  # fmt: skip
        if wanted:
            x = sheet.key_line((x, y), color=color, words=words)
    if any(len(building.entrances) for building in footprints):
        sheet.key_disc((x, y), color=ENTRANCE, words="entrance")
    draw_scale_bar(sheet, frame, sheet.width - 26.0)
    return sheet.save(path)


def _turn_east(scene: SceneMap, anchor: Anchor) -> SceneMap:
    """Return the map with its x axis to the east."""
    mesh = replace(
        scene.mesh, vertices=scene.mesh.vertices @ anchor.enu_from_map[:3, :3].T.astype(np.float32)
    )
    boxes = mesh.object_bounds(len(scene))
    graph = replace(scene.graph, positions=boxes.mean(axis=1), extents=boxes[:, 1] - boxes[:, 0])
    return replace(scene, mesh=mesh, graph=graph, anchors=())


def _to_east_north(best: Anchor, anchor: Anchor, points: Floats) -> Floats:
    """Convert points (..., 2) [m] of a map by an anchor to east and north (..., 2) of the best one."""
    flat = np.concatenate([points, np.zeros((*points.shape[:-1], 1))], axis=-1)
    there: Floats = replace(best, heading=0.0).to_map(anchor.to_earth(flat))[..., :2]
    return there


def _building(best: Anchor, building: Footprint) -> Iterator[Stroke | Disc]:
    for ring in building.rings:
        yield Stroke(_to_east_north(best, building.base, ring), BUILDING, 3.0, fill=0.05)
    for at in _to_east_north(best, building.base, building.entrances):
        yield Disc(at, 6.0, ENTRANCE)


def _walls(scene: SceneMap, best: Anchor, anchor: Anchor) -> Iterator[Stroke | Disc]:
    segments = [cut for paint, cut in RoomPlan(scene).cuts.items() if paint != "curtain"]
    for pair in _to_east_north(best, anchor, np.concatenate(segments)) if segments else ():
        yield Stroke(pair, FAINT, 1.0)


def _extend_bounds(bounds: Bounds, marks: Iterable[Stroke | Disc]) -> Bounds:
    """Extend bounds to hold all marks."""
    drawn = [mark.points if isinstance(mark, Stroke) else [mark.at] for mark in marks]
    corners = np.concatenate([np.reshape(bounds, (2, 2)), *drawn])
    west, south = (corners.min(axis=0) - MARGIN).tolist()
    east, north = (corners.max(axis=0) + MARGIN).tolist()
    return west, south, east, north


def _draw_candidates(sheet: Sheet, anchors: Sequence[Anchor]) -> None:
    """Draw the position of the best candidate and the probability of each."""
    best = anchors[0]
    where = " ".join(x for x in (best.building, best.osm and f"({best.osm})") if x)
    level = f"level {best.level}" if best.level else ""
    place = f"{best.latitude:.6f}, {best.longitude:.6f}"
    said = ", ".join(x for x in (where, level, place) if x)
    sheet.text((14, 22), said, 14, "ink", room=sheet.width - 28)
    spread = ""
    if best.has_covariance:
        east, north, _, turn = np.sqrt(np.diag(best.covariance))
        spread = f" ±{np.hypot(east, north) / np.sqrt(2):.1f} m, ±{degrees(turn):.1f}°"
    chances = "     ".join(
        f"{k}: {a.probability:.0%}, heading {round(degrees(a.heading)) % 360}°"
        for k, a in enumerate(anchors[:MAX_LINES], 1)
    )
    more = f"     and {len(anchors) - MAX_LINES} more" if len(anchors) > MAX_LINES else ""
    sheet.text(
        (14, 47), f"by {best.method or 'hand'}{spread}     {chances}{more}", 13, "soft-ink",
        room=sheet.width - 28,
    )  # fmt: skip


COLOR = {"moved": "transit", "appeared": "leisure", "vanished": "mode", "relabelled": "amber"}
"""Colours of changes."""
_HEAD = 0.25, 0.5
"""Length of an arrow's head, at most and as a share of the arrow [m], [1]."""


def write_diff(
    scene: SceneMap,
    diff: SceneDiff,
    path: str | Path,
    *,
    width: int = 1200,
) -> Path:
    """Draw what changed on the plan of the earlier map, or the first of merged ones, as a PNG.

    What moved is outlined where it was (dashed) and is now, with an arrow; what appeared is green,
    what vanished red.

    Raises `OptionError`: the width is no width of a picture.

    `scene`: the earlier map.
    `diff`: from it to a later look.
    `width`: of the picture [px].
    """
    plan = RoomPlan(scene)
    layout = Layout.of(plan.bounds, [], width=width)
    sheet = Sheet(layout.width, layout.height)
    frame = Frame.around(plan.bounds, *layout.large)
    rows = {id_: i for i, id_ in enumerate(scene.graph.ids)}
    marked = {rows[c.id]: COLOR[c.kind] for c in diff if c.id in rows and c.kind != "appeared"}
    marks = [mark for change in reversed(diff.changes) for mark in change_marks(plan, change, rows)]
    items: list[Item] = [
        paint_room(plan, frame),
        *place_names(plan, frame, OccupiedPlaces(), marked),
        *marks,
    ]
    sheet.paste(paint_picture(items, frame, reduce=False), layout.large_corner)
    counts = {kind: len(diff.of(kind)) for kind in ("moved", "appeared", "vanished", "relabelled")}
    said = ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
    sheet.text((14, 22), said or "nothing changed", 14, "ink", room=sheet.width - 28)
    after = f"{diff.before or scene.scenes[0]} and {diff.after or 'a later look'}"
    words = f"{after}: {len(diff.same)} the same, {len(diff.unseen)} unseen"
    sheet.text((14, 47), words, 13, "soft-ink", room=sheet.width - 28)
    end, x, y = draw_measures(sheet, frame), 14.0, sheet.height - FOOT / 2
    for kind, count in counts.items():
        draw = partial(sheet.key_line, color=COLOR[kind], dashed=kind == "vanished")
        if count and x + 110.0 < end:
            x = draw((x, y), words=kind)
    return sheet.save(path)


def change_marks(plan: RoomPlan, change: Change, rows: dict[str, int]) -> list[Mark]:
    """Return one change as marks on the plan."""
    color, before = COLOR[change.kind], rows.get(change.id, -1)
    if change.kind == "moved" and before >= 0 and change.after_from_before is not None:
        motion = change.after_from_before
        low, high = plan.boxes[before]
        ring = _rectangle(low, high)
        corners = np.column_stack([ring, np.full(len(ring), (low[2] + high[2]) / 2)])
        there = (corners @ motion[:3, :3].T + motion[:3, 3])[:, :2]
        return [
            Stroke(ring, color, 1.4, (4.0, 3.0)),
            Stroke(there, color, 2.0, fill=0.15),
            *_arrow(ring[:4].mean(axis=0), there[:4].mean(axis=0), color),
        ]
    if change.box is None:
        return []
    ring = _rectangle(*change.box)
    middle = ring[:4].mean(axis=0)
    if change.kind == "vanished":
        cross = [ring[[0, 2]], ring[[1, 3]]]
        return [
            Stroke(ring, color, 2.0, (4.0, 3.0), fill=0.15),
            *(Stroke(line, color, 1.2) for line in cross),
        ]
    words = name_of(change.new_label or change.label)
    label = Text(middle, words, 12.0, color, shift=(0.0, 14.0))
    if change.kind == "relabelled":
        return [Stroke(ring, color, 1.6), label]
    return [Stroke(ring, color, 2.0, fill=0.25), Disc(middle, 3.0, color), label]


def _rectangle(low: Floats, high: Floats) -> Floats:
    """Return a closed ring (5, 2) around a box seen from above [m]."""
    (west, south), (east, north) = low[:2], high[:2]
    return np.array([[west, south], [east, south], [east, north], [west, north], [west, south]])


def _arrow(start: Floats, end: Floats, color: str) -> list[Mark]:
    """Return an arrow between points (2,) [m]."""
    way = end - start
    length = float(np.hypot(*way))
    if length < 1e-6:
        return []
    along = way / length
    across = np.array([-along[1], along[0]])
    head = min(_HEAD[0], _HEAD[1] * length)
    wings = np.stack(
        [end - head * (along + 0.5 * across), end, end - head * (along - 0.5 * across)]
    )
    line = np.stack([start, end])
    halo_first = (("paper", 4.5), (color, 2.4))
    return [Stroke(part, name, width) for name, width in halo_first for part in (line, wings)]
