"""A map's object as evidence names it, with its place on Earth where the map has one."""

from __future__ import annotations

from placegraph.core.evidence import ObjectRef
from placegraph.indoor.map.scene import Scene


def ref(scene: Scene, row: int) -> ObjectRef:
    """Object in this row; its place is that of the likeliest anchor."""
    graph = scene.graph
    anchors = scene.anchors_of(scene.scenes[scene.scene_of[row]])
    place = anchors[0].to_earth(graph.positions[row])[:2].tolist() if anchors else ()
    name = graph.names[row] if graph.names else ""
    return ObjectRef(graph.ids[row], graph.labels[row], name, *place)
