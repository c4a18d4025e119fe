"""Objects of a scene map that stands on Earth, as GeoJSON."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from placegraph.core.features import areas, collection, feature
from placegraph.core.geo import unplaced
from placegraph.indoor.map.scene import Scene

_RING = np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)])


def features(scene: Scene) -> dict[str, Any]:
    """FeatureCollection of a map's objects: `SceneMap.to_geojson` says more."""
    return collection(_objects(scene))


def _objects(scene: Scene) -> Iterator[dict[str, Any]]:
    graph, mesh = scene.graph, scene.mesh
    boxes = mesh.object_bounds(len(graph))
    for row, (low, high) in enumerate(boxes):
        name = scene.scenes[scene.scene_of[row]]
        anchors = scene.anchors_of(name)
        if not anchors:
            raise unplaced(name)
        corners = np.where(_RING, high[:2], low[:2])
        there = anchors[0].to_earth(np.column_stack([corners, np.full(len(_RING), low[2])]))
        said = {
            "id": graph.ids[row], "label": graph.labels[row], "name": graph.names[row],
            "room": scene.attributes[row].get("room", ""), "scene": name,
            "level": anchors[0].level, "building": anchors[0].building,
            "height": round(float(there[0, 2]), 3), "tall": round(float(high[2] - low[2]), 3),
        }  # fmt: skip
        yield feature(areas([there[:, :2]]), said)
