"""What changed in a scene map, on its plan: what moved with arrows, what came, and what went."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.view.draw.canvas import Disc, Frame, Item, Mark, Stroke, Text
from placegraph.view.draw.lettering import Taken
from placegraph.view.draw.painter import paint_picture
from placegraph.view.draw.sheet import Sheet
from placegraph.view.scene.plan_drawing import measures, names
from placegraph.view.scene.plan_layout import FOOT, Layout
from placegraph.view.scene.room_painter import paint_room
from placegraph.view.scene.room_plan import RoomPlan
from placegraph.view.scene.room_style import plain_words

if TYPE_CHECKING:
    from placegraph.indoor.mapping.change.changes import Change, SceneDiff
    from placegraph.indoor.scene_map import SceneMap

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

    Parameters
    ----------
    scene
        The earlier map.
    diff
        From it to a later look.
    width
        Of the picture [px].

    Raises
    ------
    OptionError
        The width is no width of a picture.

    """
    plan = RoomPlan(scene)
    layout = Layout.of(plan.bounds, [], width=width)
    sheet = Sheet(layout.width, layout.height)
    frame = Frame.around(plan.bounds, *layout.large)
    rows = {id_: i for i, id_ in enumerate(scene.graph.ids)}
    marked = {rows[c.id]: COLOR[c.kind] for c in diff if c.id in rows and c.kind != "appeared"}
    marks = [mark for change in reversed(diff.changes) for mark in marks_of(plan, change, rows)]
    items: list[Item] = [
        paint_room(plan, frame),
        *names(plan, frame, Taken(), marked),
        *marks,
    ]
    sheet.paste(paint_picture(items, frame, reduce=False), layout.large_corner)
    counts = {kind: len(diff.of(kind)) for kind in ("moved", "appeared", "vanished", "relabelled")}
    said = ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
    sheet.text((14, 22), said or "nothing changed", 14, "ink", room=sheet.width - 28)
    after = f"{diff.before or scene.scenes[0]} and {diff.after or 'a later look'}"
    words = f"{after}: {len(diff.same)} the same, {len(diff.unseen)} unseen"
    sheet.text((14, 47), words, 13, "soft-ink", room=sheet.width - 28)
    end, x, y = measures(sheet, frame), 14.0, sheet.height - FOOT / 2
    for kind, count in counts.items():
        draw = partial(sheet.key_line, color=COLOR[kind], dashed=kind == "vanished")
        if count and x + 110.0 < end:
            x = draw((x, y), words=kind)
    return sheet.save(path)


def marks_of(plan: RoomPlan, change: Change, rows: dict[str, int]) -> list[Mark]:
    """One change as marks on the plan."""
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
    words = plain_words(change.new_label or change.label)
    label = Text(middle, words, 12.0, color, shift=(0.0, 14.0))
    if change.kind == "relabelled":
        return [Stroke(ring, color, 1.6), label]
    return [Stroke(ring, color, 2.0, fill=0.25), Disc(middle, 3.0, color), label]


def _rectangle(low: Floats, high: Floats) -> Floats:
    """Closed ring (5, 2) around a box seen from above [m]."""
    (west, south), (east, north) = low[:2], high[:2]
    return np.array([[west, south], [east, south], [east, north], [west, north], [west, south]])


def _arrow(start: Floats, end: Floats, color: str) -> list[Mark]:
    """Arrow between points (2,) [m]."""
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
