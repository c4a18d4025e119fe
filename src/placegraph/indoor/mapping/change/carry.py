"""What things take along, or find anew, when they move: the names of rooms, relations that last."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.map.relation_words import BIGGER, PART, canonical
from placegraph.indoor.map.relations import SAME_ROOM
from placegraph.indoor.map.rooms import rooms_of, with_rooms
from placegraph.indoor.map.structure import structure

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from placegraph.geometry import Floats
    from placegraph.indoor.map.mesh import Mesh

_COMPARED = frozenset({
    "messier", "cleaner", "fuller", "emptier", "brighter", "darker", "more", "less", "older",
    "newer", "heavier", "lighter", "softer", "harder",
})  # fmt: skip
"""First words of what 3DSSG compares, but for where things are: "higher than" is left out."""


def lasting(relation: str) -> bool:
    """Whether a relation says nothing of place, so that it holds wherever the two things are."""
    name = canonical(relation)[0]
    if name in {BIGGER, PART}:
        return True
    words = name.split()
    return bool(words) and name != SAME_ROOM and (words[0] == "same" or words[0] in _COMPARED)


def rooms_now(
    mesh: Mesh,
    labels: Sequence[str],
    floor: float,
    attributes: Sequence[Mapping[str, str]],
    stirred: NDArray[np.bool_],
) -> tuple[NDArray[np.int32], list[dict[str, str]]]:
    """Rooms (N,) and attributes that name them, as `with_rooms` does, after some things changed.

    What did not change keeps the name of its room; what did, (N,) `stirred`, takes that of most
    things in the room where it is now, or of the nearest thing where it is in no room that is found.
    Where no attribute names a room, rooms are found.
    """
    if not any(a.get("room") for a in attributes):
        return with_rooms(mesh, labels, floor, attributes)
    told = [dict(a) for a in attributes]
    if stirred.any():
        now = rooms_of(mesh, labels, floor).room_of
        boxes = mesh.object_bounds(len(labels))
        told_by = ~stirred & ~structure(labels)
        for row in np.flatnonzero(stirred).tolist():
            among = told_by & (now == now[row]) if now[row] >= 0 else _nearest(boxes, row, told_by)
            name = _most([told[i].get("room", "") for i in np.flatnonzero(among).tolist()])
            told[row].pop("room", None)
            told[row] |= {"room": name} if name else {}
    return with_rooms(mesh, labels, floor, told)


def _nearest(boxes: Floats, row: int, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(N,) which of the chosen things is nearest to one, by their boxes (N, 2, 3) [m]."""
    apart = np.maximum(boxes[:, 0] - boxes[row, 1], boxes[row, 0] - boxes[:, 1])
    gap = np.where(chosen, np.linalg.norm(np.maximum(apart, 0.0), axis=1), np.inf)
    return chosen & (np.arange(len(boxes)) == gap.argmin())


def _most(names: Sequence[str]) -> str:
    """The name that most things have, the first of several; things without one have no say."""
    given = sorted({name for name in names if name})
    return max(given, key=names.count, default="")
