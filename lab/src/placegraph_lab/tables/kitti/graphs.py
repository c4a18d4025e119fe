"""KITTI360Pose as graphs: cells as scene graphs (Eq. 5-8), hints as query graphs (Eq. 3-4).

Two readings of the hints. *Paper*: the observer is left out, and the described things are related to
each other by Eq. 6 from where they really stand; the texts do not say that. *Honest*: what the texts
do say, "The pose is north of a gray pole", as a statement about the speaker; no position is used.
"""

from __future__ import annotations

from math import pi
from typing import Literal

import numpy as np

from placegraph.core.graph import SceneGraph
from placegraph.outdoor.language.description import (
    LISTENER,
    SPEAKER,
    Description,
    Mention,
    Relation,
    Sense,
    Statement,
)
from placegraph_lab.datasets.kitti360pose import DIRECTIONS, Hints, Kitti360Pose, Objects
from placegraph_lab.tables.outdoor.nearby import DIRECTIONS as WINDS
from placegraph_lab.tables.outdoor.nearby import relations

Reading = Literal["honest", "paper"]  # what the query graph of a pose is made of

EDGE_DISTANCE = 15.0
"""Objects nearer than this are joined by an edge [m]: as far as a pose's own objects may be."""
BEARINGS = {"north": 0.0, "east": 0.5 * pi, "south": pi, "west": 1.5 * pi}

OSM = {
    "building": "building=yes", "pole": "power=pole", "traffic light": "highway=traffic_signals",
    "traffic sign": "traffic_sign=yes", "garage": "building=garage", "stop": "highway=bus_stop",
    "smallpole": "barrier=bollard", "lamp": "highway=street_lamp",
    "trash bin": "amenity=waste_basket", "vending machine": "amenity=vending_machine",
    "box": "man_made=street_cabinet", "road": "highway=residential",
    "sidewalk": "footway=sidewalk", "parking": "amenity=parking", "wall": "barrier=wall",
    "fence": "barrier=fence", "guard rail": "barrier=guard_rail", "bridge": "man_made=bridge",
    "tunnel": "tunnel=yes", "vegetation": "natural=scrub", "terrain": "landuse=grass",
}  # fmt: skip
"""Tags for the labels, for a network that learned from OpenStreetMap."""


class Names:
    """Names of objects in graphs, on both sides alike.

    `coloured`: "gray pole" instead of "pole"; `osm`: tags (`OSM`) instead of the data's labels;
    they have no colours.
    """

    def __init__(self, data: Kitti360Pose, *, coloured: bool = False, osm: bool = False) -> None:
        self.data, self.coloured, self.osm = data, coloured, osm

    def of(self, table: Objects | Hints, row: int) -> str:
        """Name of an object or of what a hint is about."""
        label = self.data.labels[table.labels[row]]
        if self.osm:
            return (self.data.tags or OSM).get(label, label)
        return (
            f"{self.data.colours[table.colours[row]]} {label}".strip() if self.coloured else label
        )


def scene_graph(
    data: Kitti360Pose,
    cell: int,
    *,
    names: Names | None = None,
    edge_distance: float = EDGE_DISTANCE,
) -> SceneGraph:
    """Scene graph of a cell (row): objects at their centres, relations of Eq. 6 between near ones."""
    names = names or Names(data)
    span = data.cells.objects(cell)
    rows = range(span.start, span.stop)
    at = data.objects.centers[span, :2]
    delta = at[:, None] - at[None]
    apart = np.hypot(delta[..., 0], delta[..., 1])
    sources, targets = np.nonzero((apart > 0.0) & (apart <= edge_distance))
    winds = relations(delta[sources, targets])
    return SceneGraph(
        ids=tuple(f"{data.cells.ids[cell]}/{k}" for k in range(len(rows))),
        labels=tuple(names.of(data.objects, row) for row in rows),
        positions=at,
        sources=sources,
        targets=targets,
        relations=tuple(WINDS[w] for w in winds),
    )


def text_of(data: Kitti360Pose, pose: int) -> str:
    h, span = data.hints, data.poses.hints(pose)
    return " ".join(
        f"The pose is {DIRECTIONS[h.directions[i]]} of a {_name_of_hint(data, i)}."
        for i in range(span.start, span.stop)
    )


def description_of(
    data: Kitti360Pose,
    pose: int,
    *,
    reading: Reading = "honest",
    names: Names | None = None,
    edge_distance: float = EDGE_DISTANCE,
) -> Description:
    """Query graph of a pose (row), without a parser."""
    names = names or Names(data)
    span = data.poses.hints(pose)
    rows = range(span.start, span.stop)
    mentions = [Mention(SPEAKER, "I"), Mention(LISTENER, "you")]
    for node, i in enumerate(rows, 2):
        senses = (Sense(names.of(data.hints, i), 1.0),)
        mentions.append(Mention(node, f"a {_name_of_hint(data, i)}", senses, definite=False))
    if reading == "honest":
        told = [_from_speaker(data, i, node) for node, i in enumerate(rows, 2)]
    else:
        told = _between(data, rows, edge_distance)
    return Description(text_of(data, pose), tuple(mentions), tuple(told))


def _name_of_hint(data: Kitti360Pose, hint: int) -> str:
    h = data.hints
    return f"{data.colours[h.colours[hint]]} {data.labels[h.labels[hint]]}".strip()


def _from_speaker(data: Kitti360Pose, hint: int, node: int) -> Statement:
    direction = DIRECTIONS[data.hints.directions[hint]]
    text = f"The pose is {direction} of a {_name_of_hint(data, hint)}"
    if direction not in BEARINGS:  # on top of it
        return Statement(Relation.SAME, SPEAKER, node, text=text)
    return Statement(Relation.DIRECTION, SPEAKER, node, bearing=BEARINGS[direction], text=text)


def _between(data: Kitti360Pose, rows: range, edge_distance: float) -> list[Statement]:
    """Eq. 6 between the described things; offsets lead from a thing's centre to the pose."""
    told = []
    for a, i in enumerate(rows):
        for b, j in enumerate(rows):
            delta = data.hints.offsets[j] - data.hints.offsets[i]
            if a < b and 0.0 < np.hypot(*delta) <= edge_distance:
                wind = WINDS[int(relations(delta))]
                text = (
                    f"The {_name_of_hint(data, i)} is on the {wind} of the {_name_of_hint(data, j)}"
                )
                told.append(
                    Statement(Relation.DIRECTION, a + 2, b + 2, bearing=BEARINGS[wind], text=text)
                )
    return told
