"""A scene map as messages that are kept for those who come later."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.mapping.export import glb_of
from placegraph.indoor.mapping.paint import painted
from placegraph.ros.message import FrameIds, Message, colour, header, points, time
from placegraph.ros.objects import MARKERS, TRIANGLES, label, over
from placegraph.ros.pose import scale

if TYPE_CHECKING:
    from placegraph.indoor.map.scene import Scene
    from placegraph.ros.message import Fields


def map_messages(scene: Scene, stamp: float, frames: FrameIds | None = None) -> list[Message]:
    """The map, thrice: its mesh as markers (RViz), its names, and a `SceneUpdate` (Foxglove).

    - ``localization/map``: a `MarkerArray`, a list of triangles an object with colours by vertex.
    - ``localization/names``: a `MarkerArray` of what the objects are called.
    - ``localization/scene``: a `foxglove_msgs/SceneUpdate` with the map as GLB and its textures.

    Raises `OptionError` where the stamp [s] is none that ROS can say.
    """
    frames = frames or FrameIds()
    head = header(stamp, frames.map)
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
        Message("localization/map", MARKERS, stamp, {"markers": _meshes(scene, head)}, latched=True),
        Message("localization/names", MARKERS, stamp, {"markers": names}, latched=True),
        Message(
            "localization/scene", "foxglove_msgs/msg/SceneUpdate", stamp, {"entities": [entity]},
            latched=True,
        ),
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
