"""The plan of a scene as a page draws it: a picture to lay on a map, and what stands where."""

from __future__ import annotations

from io import BytesIO
from math import ceil
from typing import TYPE_CHECKING, Any

from placegraph.errors import OptionError
from placegraph.indoor.map.floor import is_floor
from placegraph.view.draw.canvas import Frame
from placegraph.view.draw.painter import paint_picture
from placegraph.view.scene.room_plan import NAMED, RoomPlan, name_of, paint_room

if TYPE_CHECKING:
    from placegraph.indoor.scene_map import SceneMap

FINE = 48.0
"""Scale of the picture [px/m], where that is not too large."""
MAX_PIXELS = 2048
"""Width and height of the picture at most [px]."""


def open_plan(scene: SceneMap, name: str = "") -> RoomPlan:
    """Return the plan of a map's scene by name, else of its first; `OptionError` where it is unknown."""
    if name and name not in scene.scenes:
        known = ", ".join(scene.scenes[:5])
        raise OptionError(f"scene: the map has no {name[:80]!r}; it has {known}.")
    return RoomPlan(scene, scene.scenes.index(name) if name else 0)


def describe_plan(plan: RoomPlan) -> dict[str, Any]:
    """Describe a plan for a page: bounds and objects in the map's x and y [m].

    A thing has its id, label, name to be written (empty: none), box (low x, low y, high x, high y),
    whether it is a room, and how it is drawn (`RoomPlan.role`).
    """
    scene = plan.scene
    return {
        "kind": "scene",
        "scene": scene.scenes[plan.which],
        "bounds": [round(value, 3) for value in plan.bounds],
        "floor": plan.floor,
        "anchors": [a.to_dict() for a in scene.anchors_of(scene.scenes[plan.which])],
        "things": [_describe_object(plan, row) for row in plan.rows if plan.role(row) != "ceiling"],
    }


def _describe_object(plan: RoomPlan, row: int) -> dict[str, Any]:
    graph = plan.scene.graph
    label, room = graph.labels[row], plan.scene.attributes[row].get("room", "")
    low, high = plan.boxes[row, :, :2].round(3).tolist()
    is_room = is_floor(label) and bool(room) and not room.isdecimal()
    large = (high[0] - low[0]) * (high[1] - low[1]) >= NAMED
    named = plan.role(row) == "thing" and large and not plan.hangs(row)
    return {
        "id": graph.ids[row],
        "label": label,
        "name": room if is_room else name_of(label) if named else "",
        "box": [*low, *high],
        "room": is_room,
        "role": plan.role(row),
    }


def draw_png(plan: RoomPlan, *, dark: bool = False) -> bytes:
    """Return a PNG of exactly the plan's bounds."""
    west, south, east, north = plan.bounds
    scale = min(FINE, MAX_PIXELS / max(east - west, north - south))
    size = (max(1, ceil(scale * length)) for length in (east - west, north - south))
    frame = Frame(((west + east) / 2, (south + north) / 2), scale, *size)
    painted = paint_picture([paint_room(plan, frame, dark=dark)], frame, dark=dark)
    file = BytesIO()
    painted.save(file, "PNG", compress_level=6)
    return file.getvalue()
