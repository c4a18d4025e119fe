"""Checks of a scene map's objects: giants, twins, strays, labels, relations; and what it costs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.map.relations import MOST_OBJECTS
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.map.structure import nameless, structure
from placegraph.indoor.mapping.check.finding import Found, Severity

_GIANT = 0.8
"""An object with this share of all surface that is no wall, floor or ceiling ..."""
_TWINS = 0.8
"""Boxes whose common part is this share of what they fill together are one object twice."""
_MANY_TRIANGLES = 1_000_000
_LARGE_FILE = 20e6
"""[bytes]"""
_SLOW = 2.0
"""Opening a map beyond this is slow [s]."""


def giant(scene: Scene) -> Iterator[Found]:
    """Whether one object is nearly all of the surface."""
    areas = np.linalg.norm(scene.mesh.normals(), axis=1) / 2.0
    own = np.bincount(scene.mesh.object_of, areas, len(scene))
    largest = int(own.argmax())
    share = own[largest] / max(float(own.sum()), 1e-12)
    if share > _GIANT and not structure(scene.graph.labels)[largest]:
        severity: Severity = "warning" if len(scene) > 1 else "error"
        yield (
            severity,
            (
                f"{_name(scene, largest)} holds {share:.0%} of all surface: the map knows no objects "
                "apart, and objects are what it localizes by."
            ),
            [scene.graph.ids[largest]],
            (
                "Build from a file with one node, group or id an object (--object-property, --labels), "
                "or from the capture, which cuts the mesh into objects."
            ),
        )


def twins(scene: Scene) -> Iterator[Found]:
    """Whether objects fill the same space."""
    low, high = _boxes(scene)
    movable = np.flatnonzero(~structure(scene.graph.labels))
    if not 1 < len(movable) <= 5000:
        return
    low, high = low[movable] - 5e-3, high[movable] + 5e-3
    volume = np.prod(high - low, axis=1)
    pairs: list[tuple[int, int]] = []
    order = np.argsort(low[:, 0], kind="stable")
    for at, i in enumerate(order.tolist()):
        later = order[at + 1 :]
        later = later[: int(np.searchsorted(low[later, 0], high[i, 0]))]
        sides = np.minimum(high[i], high[later]) - np.maximum(low[i], low[later])
        common = np.prod(np.maximum(sides, 0.0), axis=1)
        twin = common > _TWINS * (volume[i] + volume[later] - common)
        pairs += [(int(movable[i]), int(movable[j])) for j in later[twin]]
    if pairs:
        a, b = pairs[0]
        yield (
            "warning",
            (
                f"{len(pairs)} pairs of objects fill the same space, such as {_name(scene, a)} and "
                f"{_name(scene, b)}."
            ),
            [scene.graph.ids[i] for i in dict.fromkeys(i for pair in pairs for i in pair)],
            "Delete one of each pair in the file, or give both one id.",
        )


def far(scene: Scene) -> Iterator[Found]:
    """Objects that lie apart from all others by more than the map without them is wide."""
    low, high = _boxes(scene)
    if len(scene) < 3:
        return
    middle = np.median((low + high) / 2, axis=0)
    reach = np.maximum(np.maximum(low - middle, middle - high), 0.0).max(axis=1)
    order = np.argsort(reach, kind="stable")
    sorted_reach = np.maximum(reach[order], 1.0)
    jump = np.flatnonzero(sorted_reach[1:] > 3.0 * sorted_reach[:-1])
    jump = jump[jump + 1 > 0.9 * len(order) - 1]
    if jump.size:
        out = order[jump[0] + 1 :]
        yield (
            "warning",
            (
                f"{len(out)} object{'s lie' if len(out) > 1 else ' lies'} far off from the rest, "
                f"{_name(scene, int(out[0]))} by {reach[out[0]]:.0f} m."
            ),
            [scene.graph.ids[i] for i in out.tolist()],
            "Delete or move it in the file: the map's box is searched, and grows with it.",
        )


def words(scene: Scene) -> Iterator[Found]:
    """Whether labels, names and ids say what is what."""
    graph = scene.graph
    bare = [i for i, label in enumerate(graph.labels) if nameless(label)]
    if len(bare) > 0.2 * len(scene):
        yield (
            "warning" if len(bare) > 0.5 * len(scene) else "note",
            f"{len(bare)} of {len(scene)} objects have no label that says what they are.",
            [graph.ids[i] for i in bare],
            "--labels FILE gives each object's id or name a label.",
        )
    names = Counter(name for name in graph.names if name)
    twice = {name for name, count in names.items() if count > 1}
    if twice:
        rows = [i for i, name in enumerate(graph.names) if name in twice]
        yield (
            "note",
            f"{len(twice)} names stand for several objects, such as {min(twice)!r}.",
            [graph.ids[i] for i in rows],
            "Give each object its own name in the file; ids tell them apart meanwhile.",
        )
    folded = Counter(id_.strip().casefold() for id_ in graph.ids)
    alike = [id_ for id_ in graph.ids if folded[id_.strip().casefold()] > 1]
    if alike:
        yield (
            "warning",
            f"{len(alike)} ids differ in case or blanks alone, such as {alike[0]!r}.",
            alike,
            "Rename them in the file: instance images and tables of labels mix them up.",
        )


def relations(scene: Scene) -> Iterator[Found]:
    """Whether anything is known of how objects stand to each other."""
    if len(scene) > 1 and not scene.graph.relations:
        many = len(scene) > MOST_OBJECTS
        yield (
            "note",
            "No relation between objects is known"
            + (f": there are more than {MOST_OBJECTS:,} of them." if many else "."),
            [],
            "Cut the scene into fewer objects." if many else "Check --scale: nothing is near.",
        )


def costs(scene: Scene, size: int | None, seconds: float | None) -> Iterator[Found]:
    """Whether it is large, or slow to open."""
    mend = "--detail small, or tiny, makes it smaller; so do --error and --texel."
    if len(scene.mesh) > _MANY_TRIANGLES:
        yield "warning", f"The map has {len(scene.mesh):,} triangles.", [], mend
    if size is not None and size > _LARGE_FILE:
        yield "note", f"The file has {size / 1e6:.0f} MB.", [], mend
    if seconds is not None and seconds > _SLOW:
        yield "note", f"Opening it took {seconds:.1f} s.", [], mend


def _boxes(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower and upper corners (N, 3) of the objects' boxes [m]."""
    found = scene.mesh.object_bounds(len(scene))
    return found[:, 0], found[:, 1]


def _name(scene: Scene, row: int) -> str:
    graph = scene.graph
    return f"{graph.labels[row] or 'object'} {(graph.names[row] or graph.ids[row])!r}"
