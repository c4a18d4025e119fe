"""Floors, storeys, and parts of the building by their labels."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.scene import Scene

LEVEL = 0.9  # A triangle is level where its normal's z is at least this, 26 degrees from upright
_BIN = 0.05  # [m] of the histogram of heights
_LOW = 0.25  # of the scene's height: where a floor without a label is looked for
_LOW_METRES = 0.4  # or this far above its lowest surfaces [m]
_SHARE = 0.05  # of the footprint that a floor without a label has to cover
_LEAST = 0.5  # and this much in any case [m2]

_ROOM = 2.0  # between the floors of two storeys, at least [m]
_ABOVE = 1.5  # a storey has surfaces so far above its floor [m]: else it is a roof
_STOREY_SHARE, _STOREY_LEAST = 0.15, 4.0  # of the footprint, and [m2], that its floor covers

_LYING = 0.25  # of the area of what is labelled floor is level, else it stands upright

_FLOORS = {"floor", "floors", "ground"}


def split_label(label: str) -> list[str]:
    """Return words of a label in lower case: "HouseWall", "house_wall" and "house wall" are two words."""
    return [w.lower() for w in re.findall(r"[A-Z]?[^\W\d_A-Z]+|[A-Z]+(?![^\W\d_A-Z])", label)]


def singular_forms(word: str) -> list[str]:
    """Return a word and the words that it may be the plural of."""
    endings = {"ves": ("f", "fe"), "ies": ("y",), "es": ("",), "s": ("",)}
    found = [word]
    for ending, singular in endings.items():
        if word.endswith(ending) and not (ending == "s" and word.endswith("ss")):
            found += [word[: -len(ending)] + end for end in singular]
    return found


def is_floor(label: str) -> bool:
    """Return whether a label says that the object is a floor: its last word does."""
    words = split_label(label)
    return bool(words) and words[-1] in _FLOORS


def find_floor_height(mesh: Mesh, labels: Sequence[str]) -> float | None:
    """Return height of the floor [m, map], or None where the mesh shows none.

    Objects labelled as floor that lie level come first, with what looks up where that is about half
    of them or more. Without one, it is the largest surface that looks up among the lowest quarter of the
    scene, if it covers a twentieth of the footprint; where nothing there looks up (a mesh turned
    inside out), what looks down counts.
    """
    normals = mesh.normals()
    areas = np.linalg.norm(normals, axis=1) / 2.0
    heights = mesh.vertices[:, 2][mesh.triangles].mean(axis=1, dtype=np.float64)
    upward = normals[:, 2] / np.maximum(2.0 * areas, 1e-300)
    floors, standing = find_labelled_floors(mesh, labels)
    labelled = (np.abs(upward) > LEVEL) & (floors & ~standing)[mesh.object_of]
    whole = float(areas[labelled].sum())
    if whole > 0:
        top = labelled & (upward > 0)  # of a slab; half of its area looks down
        if areas[top].sum() >= 0.4 * whole:
            labelled = top
        return _level(heights[labelled], areas[labelled])[0]
    low, high = weighted_quantiles(heights, areas, (0.02, 0.98))
    near = heights <= low + max(_LOW * (high - low), _LOW_METRES)
    box = mesh.bounds()
    footprint = float(np.prod((box[1] - box[0])[:2]))
    for side in (upward, -upward):
        level = near & (side > LEVEL)
        if not level.any():
            continue
        height, area = _level(heights[level], areas[level])
        if area >= max(_LEAST, _SHARE * footprint):
            return height
    return None


def find_storeys(scene: Scene, part: int) -> list[float]:
    """Return heights of the floors of a merged scene (row `part`) [m, map], lowest first.

    The first is the scene's own. Above it a storey begins where a level surface that looks up is as
    wide as a room, with walls above it and a room's height below.
    """
    return scene.compute_once(("storeys", part), lambda s: _search_storeys(s, part))


def find_storey(scene: Scene, point: ArrayLike) -> tuple[int, float]:
    """Return storey, from 0 on, in which a point (3,) x, y, z [m] lies, and the height of its floor [m]."""
    x, y, z = np.asarray(point, np.float64).tolist()
    floors = find_storeys(scene, scene.scene_at((x, y)))
    storey = sum(floor <= z for floor in floors[1:])
    return storey, floors[storey]


def _search_storeys(scene: Scene, part: int) -> list[float]:
    found = [float(scene.floors[part])]
    normals = scene.mesh.normals()
    own = scene.scene_of[scene.mesh.object_of] == part
    areas = np.linalg.norm(normals, axis=1) / 2.0
    heights = scene.mesh.vertices[:, 2][scene.mesh.triangles].mean(axis=1, dtype=np.float64)
    (top,) = weighted_quantiles(heights[own], areas[own], (0.98,))
    box = scene.scene_bounds[part, :, :2]
    wide = max(_STOREY_LEAST, _STOREY_SHARE * float(np.prod(box[1] - box[0])))
    level = own & (normals[:, 2] > LEVEL * 2.0 * areas)
    while True:
        higher = level & (heights > found[-1] + _ROOM) & (heights < top - _ABOVE)
        if not higher.any():
            return found
        bins = ((heights[higher] - found[-1]) / _BIN).astype(np.int64)
        # those that hold anything, and their neighbours: heights may be any, and bins are not
        filled = np.unique(bins[:, None] + (-1, 0, 1))
        held = np.bincount(np.searchsorted(filled, bins), areas[higher], len(filled))
        area = np.convolve(held, np.ones(3), "same")
        enough = np.flatnonzero(area >= wide)
        if not len(enough):
            return found
        # the widest of the first storey's height: noise of a scan begins below it
        near = np.flatnonzero((filled - filled[enough[0]]).clip(-1) // round(0.5 / _BIN) == 0)
        best = filled[near[area[near].argmax()]]
        around = np.abs(bins - best) <= 1
        (height,) = weighted_quantiles(heights[higher][around], areas[higher][around], (0.5,))
        found.append(height)


def find_labelled_floors(
    mesh: Mesh, labels: Sequence[str]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return (N,) objects that are labelled floor, and (N,) those of them that stand upright.

    These show hardly any level area: the map lies on its side, or the label errs.
    """
    normals = mesh.normals()
    areas = np.linalg.norm(normals, axis=1)
    level = np.abs(normals[:, 2]) > LEVEL * areas
    floors = np.array([is_floor(label) for label in labels], np.bool_)
    whole, lying = (np.bincount(mesh.object_of, a, len(labels)) for a in (areas, areas * level))
    return floors, floors & (lying < _LYING * whole)


def _level(heights: NDArray[np.float64], areas: NDArray[np.float64]) -> tuple[float, float]:
    """Return height and area of the largest level: the area-weighted median of what lies near its bin."""
    bins, inverse = np.unique(np.floor(heights / _BIN).astype(np.int64), return_inverse=True)
    alone = np.bincount(inverse, areas)
    around = alone.copy()  # with the neighbouring bins: noise and tilt of a scan
    close = np.flatnonzero(np.diff(bins) == 1)
    around[close] += alone[close + 1]
    around[close + 1] += alone[close]
    best = int(np.argmax(around))
    own = np.abs(inverse - best) <= 1
    own &= np.abs(bins[inverse] - bins[best]) <= 1
    (height,) = weighted_quantiles(heights[own], areas[own], (0.5,))
    return height, float(around[best])


def weighted_quantiles(
    values: NDArray[np.float64], weights: NDArray[np.float64], shares: tuple[float, ...]
) -> list[float]:
    """Return values below which these shares of the weights lie."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    rows = np.searchsorted(total, np.array(shares) * total[-1])
    return [float(v) for v in values[order[np.minimum(rows, len(order) - 1)]]]


STRUCTURE_WORDS = frozenset({
    "wall", "walls", "floor", "floors", "ground", "ceiling", "roof", "pillar", "column", "beam",
    "stairs", "staircase", "window", "windows", "doorframe", "windowsill",
})  # fmt: skip
"""Last words of labels of what is built in."""
NAMELESS = frozenset({
    "object", "objects", "unknown", "unlabelled", "unlabeled", "thing", "none", "mesh", "scan",
    "scene", "structure", "other",
})  # fmt: skip
"""Words of labels that name nothing."""


def is_structural(labels: Sequence[str]) -> NDArray[np.bool_]:
    """Return (N,) whether an object is part of the building, by its label's last word."""
    words = map(split_label, labels)
    return np.array([bool(w) and w[-1] in STRUCTURE_WORDS for w in words], np.bool_)


def is_nameless(label: str) -> bool:
    """Return whether a label says nothing of what an object is: "", "unknown", "object"."""
    return not set(split_label(label)) - NAMELESS


def labels_agree(one: str, other: str) -> bool:
    """Return whether two labels may be of one object: they are the same, or one names nothing."""
    return one.casefold() == other.casefold() or is_nameless(one) or is_nameless(other)
