"""Objects that agreed with a pose, and those that did not, as markers in green and red."""

from __future__ import annotations

import numpy as np

from placegraph.core.estimate import Evidence, PoseEstimate
from placegraph.core.geometry import Floats
from placegraph.indoor.map.scene import Scene
from placegraph_ros.message import Fields, FrameIds, Message, colour, header, points, xyz
from placegraph_ros.pose import scale

MARKERS = "visualization_msgs/msg/MarkerArray"
CUBE, LINES, TEXT, TRIANGLES = 1, 5, 9, 11
"""Types of markers."""
CLEAR = 3
"""Action: what stood there before is gone."""
COLOURS = {"for": (0.1, 0.75, 0.2), "against": (0.9, 0.1, 0.1)}
_ALPHA = 0.35
_TALL, _THICK = 0.12, 0.01  # of letters and lines [m]


def objects_message(
    estimate: PoseEstimate, stamp: float, frames: FrameIds | None = None
) -> list[Message]:
    """`MarkerArray` of the boxes of objects that spoke for the best mode, and against it.

    A line leads from the camera to each. None where the estimate does not know its map.
    """
    frames = frames or FrameIds()
    scene = estimate.map
    if not isinstance(scene, Scene):
        return []
    head = header(stamp, frames.map)
    markers: list[Fields] = [{"header": head, "action": CLEAR}]
    rows = {name: row for row, name in enumerate(scene.graph.ids)}
    for verdict, rgb in COLOURS.items():
        said = [
            (rows[ref.id], evidence)
            for evidence in estimate.evidence
            for ref in evidence.objects
            if evidence.verdict == verdict and ref.id in rows
        ]
        for row, evidence in said:
            markers += _box(scene, row, evidence, head)
        if said and estimate.best is not None:
            places = scene.graph.positions[[row for row, _ in said]]
            ends = np.stack(
                [np.broadcast_to(estimate.best.map_from_camera[:3, 3], places.shape), places],
                axis=1,
            )
            markers.append({
                "header": head, "ns": f"{verdict}/lines", "type": LINES,
                "pose": {"orientation": {"w": 1.0}}, "scale": {"x": _THICK}, "color": colour(rgb),
                "points": points(ends.reshape(-1, 3)),
            })  # fmt: skip
    return [Message("localization/objects", MARKERS, stamp, {"markers": markers})]


def _box(scene: Scene, row: int, evidence: Evidence, head: Fields) -> list[Fields]:
    """A box and what it is called, of an object."""
    graph = scene.graph
    center, size = graph.positions[row], np.maximum(extent(scene, row), _THICK)
    rgb = COLOURS[evidence.verdict]
    words = f"{graph.names[row] or graph.labels[row]} {evidence.weight:+.1f}"
    return [
        {
            "header": head, "ns": evidence.verdict, "id": row, "type": CUBE, "scale": xyz(size),
            "pose": {"position": xyz(center), "orientation": {"w": 1.0}},
            "color": colour(rgb, _ALPHA),
        },
        label(words, row, over(scene, row), head, rgb, ns=f"{evidence.verdict}/names"),
    ]  # fmt: skip


def extent(scene: Scene, row: int) -> Floats:
    """Size (3,) of the box around an object [m]."""
    extents = scene.graph.extents
    return np.zeros(3) if extents is None else extents[row]


def over(scene: Scene, row: int) -> Floats:
    """Place (3,) above an object, where its name stands [m]."""
    up = np.array([0.0, 0.0, 0.5 * extent(scene, row)[2] + _TALL])
    return np.asarray(scene.graph.positions[row] + up)


def label(
    words: str,
    row: int,
    place: Floats,
    head: Fields,
    rgb: tuple[float, float, float],
    *,
    ns: str,
) -> Fields:
    """A marker of letters that face who looks, at a place (3,)."""
    return {
        "header": head, "ns": ns, "id": row, "type": TEXT, "scale": scale(_TALL),
        "pose": {"position": xyz(place), "orientation": {"w": 1.0}},
        "color": colour(rgb), "text": words,
    }  # fmt: skip
