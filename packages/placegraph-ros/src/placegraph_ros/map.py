"""A scene map as messages that are kept for those who come later."""

from __future__ import annotations

import numpy as np

from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.export import glb_of, painted
from placegraph_ros.message import Fields, FrameIds, Message, colour, header, points, time, xyz
from placegraph_ros.objects import CUBE, MARKERS, TRIANGLES, extent, label, over
from placegraph_ros.pose import scale

MOST = 200_000
"""Triangles, 120 bytes each, that markers show."""


def map_messages(scene: Scene, stamp: float, frames: FrameIds | None = None) -> list[Message]:
    """The map, thrice: its mesh as markers (RViz), its names, and a `SceneUpdate` (Foxglove).

    - ``localization/map``: a `MarkerArray`, a list of triangles an object with colours by vertex; of
      more than `MOST` triangles the objects' boxes.
    - ``localization/names``: a `MarkerArray` of what the objects are called.
    - ``localization/scene``: a `foxglove_msgs/SceneUpdate` with the map as GLB and its textures.

    Raises `OptionError` where the stamp [s] is none that ROS can say.
    """
    frames = frames or FrameIds()
    head = header(stamp, frames.map)
    shown = (_meshes if len(scene.mesh) <= MOST else _boxes)(scene, head)
    names = [_name(scene, row, head) for row in range(len(scene))]
    model = {
        "pose": {"orientation": {"w": 1.0}}, "scale": scale(1.0),
        "media_type": "model/gltf-binary", "data": np.frombuffer(glb_of(scene), np.uint8),
    }  # fmt: skip
    entity = {
        "timestamp": time(stamp), "frame_id": frames.map, "id": "map", "frame_locked": True,
        "metadata": [{"key": "source", "value": scene.source}], "models": [model],
    }  # fmt: skip
    return [
        Message("localization/map", MARKERS, stamp, {"markers": shown}, latched=True),
        Message("localization/names", MARKERS, stamp, {"markers": names}, latched=True),
        Message(
            "localization/scene", "foxglove_msgs/msg/SceneUpdate", stamp, {"entities": [entity]},
            latched=True,
        ),
    ]  # fmt: skip


def _boxes(scene: Scene, head: Fields) -> list[Fields]:
    graph = scene.graph
    return [
        {
            "header": head, "ns": graph.labels[row], "id": row, "type": CUBE, "frame_locked": True,
            "pose": {"position": xyz(graph.positions[row]), "orientation": {"w": 1.0}},
            "scale": xyz(extent(scene, row)), "color": colour((0.6, 0.6, 0.6), 0.3),
        }
        for row in range(len(scene))
    ]  # fmt: skip


def _meshes(scene: Scene, head: Fields) -> list[Fields]:
    model = painted(scene)
    order = np.argsort(model.thing_of, kind="stable")
    ends = np.cumsum(np.bincount(model.thing_of, minlength=len(scene)))[:-1]
    found = []
    for row, triangles in enumerate(np.split(model.triangles[order], ends)):
        corners = triangles.ravel()
        shades = model.colours[corners] / 255.0
        found.append({
            "header": head, "ns": scene.graph.labels[row], "id": row, "type": TRIANGLES,
            "pose": {"orientation": {"w": 1.0}}, "scale": scale(1.0), "frame_locked": True,
            "color": colour((1.0, 1.0, 1.0)),
            "points": points(model.vertices[corners]),
            "colors": [colour((r, g, b)) for r, g, b in shades.tolist()],
        })  # fmt: skip
    return found


def _name(scene: Scene, row: int, head: Fields) -> Fields:
    graph = scene.graph
    words = graph.names[row] or graph.labels[row]
    return label(words, row, over(scene, row), head, (1.0, 1.0, 1.0), ns=graph.labels[row])
