"""Nodes of Spark-DSG's JSON: their names, attributes and rooms."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

Json = dict[str, Any]
_LOGGED = ("dsg_with_mesh.json", "dsg.json")
"""What Hydra saves in `backend/` of its log folder when it ends."""


def logged(path: Path) -> Path:
    """The graph in a folder that Hydra logged to, with its mesh if there is one; else the path itself."""
    try:
        if path.is_dir():
            tried = (path / part / name for name in _LOGGED for part in ("backend", ""))
            return next((file for file in tried if file.is_file()), path)
    except (OSError, ValueError):
        pass
    return path


def rooms_of(content: Json, layer: int, top: int) -> dict[int, str]:
    """Name of the room of each object (`layer`) that lies in one (`top`), itself or by its place."""
    level = {int(n["id"]): int(n["layer"]) for n in content["nodes"]}
    parent: dict[int, int] = {}
    for edge in content.get("edges") or []:
        ends = sorted((int(edge["source"]), int(edge["target"])), key=lambda i: level.get(i, 0))
        if level.get(ends[0], 0) < level.get(ends[1], 0):
            parent.setdefault(ends[0], ends[1])
    title = {
        int(n["id"]): str(n["attributes"].get("name") or symbol(int(n["id"])))
        for n in content["nodes"]
        if int(n["layer"]) == top
    }
    rooms = {}
    for number in (i for i, at in level.items() if at == layer):
        above = parent.get(number)
        while above is not None and level[above] < top:
            above = parent.get(above)
        if above in title:
            rooms[number] = title[above]
    return rooms


def symbol(number: int) -> str:
    """Name of a node by its number: O3 of an object, R0 of a room."""
    return f"{chr(number >> 56)}{number & (1 << 56) - 1}" if 0 < number >> 56 < 128 else str(number)


def object_of(value: object) -> Json:
    """The JSON object that a value is, or an empty one."""
    return value if isinstance(value, dict) else {}


def plain(attributes: Json) -> dict[str, str]:
    """Attributes as text, those that are lists or objects left out."""
    return {
        str(k): v if isinstance(v, str) else json.dumps(v)
        for k, v in attributes.items()
        if isinstance(v, str | int | float)
    }
