"""Checks of a scene map's space: units, up axis, floor."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.map.floor import LEVEL, is_floor, label_words, labelled_floors, quantiles
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.check.finding import Found, Severity

HEIGHTS = {
    "chair": 0.9, "armchair": 0.9, "table": 0.74, "desk": 0.75, "sofa": 0.85, "couch": 0.85,
    "door": 2.05, "toilet": 0.78, "refrigerator": 1.7, "fridge": 1.7, "wardrobe": 2.0,
    "counter": 0.9, "bathtub": 0.58, "stool": 0.55, "nightstand": 0.55, "wall": 2.6,
}  # fmt: skip
"""Usual heights of things that stand on the floor [m]."""
_KINDS = 3
"""Kinds of things that have to agree how far a map's unit is off ..."""
_AGREE = 1.5
"""... within this factor: sizes of one kind differ by as much."""
_STANDS = 0.15
"""A whole thing begins no higher above the floor than this share of its height."""
UNITS = (
    ("millimetres", 0.001), ("centimetres", 0.01), ("inches", 0.0254), ("feet", 0.3048),
    ("metres", 1.0), ("hundreds of metres", 100.0), ("kilometres", 1000.0),
)  # fmt: skip
"""Units of files, and metres in each."""
_LOW, _HIGH = 1.9, 7.0
"""Height of rooms, halls and a second storey included [m]."""
_USUAL = 2.6
_TILTED, _VERY_TILTED = 1.0, 4.0
"""The floor's slope that is told, and the one that spoils poses [deg]: gravity is taken for known."""
_OFF = 0.1
"""How far the floor may lie from a level surface [m]."""


def units(scene: Scene) -> Iterator[Found]:
    """Is it in metres? By the height of rooms, and of things whose label is known."""
    rooms = height_of_rooms(scene)
    known = _known_ratio(scene)
    guess = known if known is not None else rooms / _USUAL
    off = (known is not None and not 0.5 < known < 2.0) or not _LOW < rooms < _HIGH
    if not off or guess <= 0:  # nothing above the floor is a floor elsewhere
        return
    unit, scale = min(UNITS, key=lambda u: abs(np.log(guess * u[1])))
    said = f"Rooms are {rooms:.3g} m high"
    if known is not None:
        said += f", and things {known:.3g} times as high as such things are"
    if scale != 1.0 and abs(np.log(guess * scale)) < 0.7:
        unsure = unit == "feet" and known is None  # or it is a hall
        severity: Severity = "warning" if unsure else "error"
        yield severity, f"{said}: the file looks to be in {unit}.", [], f"--scale {scale:g}"
    else:
        yield (
            "warning",
            f"{said}.",
            [],
            "--scale N, metres in one unit of the file, if that is odd.",
        )


def up_axis(scene: Scene) -> Iterator[Found]:
    """Is z up? Floors and ceilings face along it, and rooms are lower than they are wide."""
    areas, unit = _normals(scene)
    named, standing = labelled_floors(scene.mesh, scene.graph.labels)
    words = [label_words(label)[-1:] for label in scene.graph.labels]
    level = named if named.any() else np.array([w == ["ceiling"] for w in words])
    labelled = level[scene.mesh.object_of]
    if areas[labelled].sum() > 0:
        shares = _facing(areas[labelled], unit[labelled])
        severity: Severity = "error"
        sure, what = 2.0, "ceilings face"
        if named.any():
            what = "the floor stands upright, it faces"
    else:
        shares = _facing(areas, unit)
        extents = np.ptp(scene.bounds, axis=0)
        if extents[2] < 1.3 * extents[int(shares[:2].argmax())]:
            return
        severity, sure, what = "warning", 1.3, "most surfaces face"
    best = int(shares.argmax())
    if best != 2 and shares[best] > sure * shares[2]:
        yield (
            severity,
            f"The map looks to lie on its side: {what} along {'xy'[best]}.",
            [],
            "--up y" if best == 1 else "Turn the file so that z points up.",
        )
    elif standing.any():
        many = int(standing.sum())
        yield (
            "warning",
            (
                f"The floor stands upright in {many} object{'s' if many > 1 else ''} labelled so: the "
                "map's floor was found without."
            ),
            [scene.graph.ids[i] for i in np.flatnonzero(standing)],
            "Label them for what they are (--labels), or turn the file so that z points up.",
        )


def floors(scene: Scene) -> Iterator[Found]:
    """Is the floor where the map says, and level? For each merged scene."""
    areas, unit = _normals(scene)
    heights = scene.mesh.vertices[scene.mesh.triangles][:, :, 2].mean(axis=1, dtype=np.float64)
    named = np.array([is_floor(label) for label in scene.graph.labels])[scene.mesh.object_of]
    level = np.abs(unit[:, 2]) > LEVEL
    for s, floor in enumerate(scene.floors.tolist()):
        own = level & (scene.scene_of[scene.mesh.object_of] == s)
        low, high = scene.scene_bounds[s]
        least = max(0.5, 0.03 * float(np.prod((high - low)[:2])))
        near = own & (np.abs(heights - floor) < _OFF)
        if areas[near].sum() < least:
            where = _largest_level(heights[own], areas[own], floor)
            yield (
                "error" if where is None or abs(where - floor) > 0.3 else "warning",
                f"The floor is said to be at {floor:.2f} m, but hardly any level surface lies there"
                + ("." if where is None else f"; the next large one is at {where:.2f} m."),
                [],
                "--floor H" if where is None else f"--floor {where:.2f}",
            )
            continue
        below = own & named & (heights < floor - 3 * _OFF)
        if areas[below].sum() > areas[near].sum():
            where = float(np.average(heights[below], weights=areas[below]))
            yield (
                "warning",
                (
                    f"More of what is labelled floor lies at {where:.2f} m than at the map's floor, "
                    f"{floor:.2f} m."
                ),
                [],
                f"--floor {where:.2f}, or cut the storeys apart.",
            )
        floor_like = near & named if (near & named).any() else near
        turned = unit[floor_like] * np.sign(unit[floor_like, 2:])
        # no wall is among them, but chamfers and clutter are: the middle, not the mean
        slope = [quantiles(turned[:, k], areas[floor_like], (0.5,))[0] for k in range(3)]
        tilt = float(np.degrees(np.arctan2(np.hypot(slope[0], slope[1]), slope[2])))
        if tilt > _TILTED:
            yield (
                "error" if tilt > _VERY_TILTED else "warning",
                (
                    f"The floor slopes by {tilt:.1f} degrees: gravity is not -z of the map, and poses "
                    "are found with gravity taken for known."
                ),
                [],
                "Level the file (rotate the floor into the plane z = const), and build again.",
            )


def height_of_rooms(scene: Scene) -> float:
    """From the floor to where all but a fiftieth of the surface lies below [m]."""
    areas, _ = _normals(scene)
    heights = scene.mesh.vertices[scene.mesh.triangles][:, :, 2].mean(axis=1, dtype=np.float64)
    (top,) = quantiles(heights, areas, (0.98,))
    return float(top - scene.floors.min())


def _known_ratio(scene: Scene) -> float | None:
    """How many times as high as usual things are whose kind is in `HEIGHTS`.

    None where fewer than `_KINDS` kinds, or no more than half of them, agree: parts of things are
    lower than things, and labels may err.
    """
    kinds: dict[str, list[float]] = {}
    boxes = scene.mesh.object_bounds(len(scene)).astype(np.float64)
    for i, label in enumerate(scene.graph.labels):
        word = (label_words(label) or [""])[-1]
        low, high = boxes[i, :, 2]
        off = abs(low - scene.floors[scene.scene_of[i]])
        if word in HEIGHTS and high > low and off < _STANDS * (high - low):
            kinds.setdefault(word, []).append(float(high - low) / HEIGHTS[word])
    ratios = np.array([float(np.median(values)) for values in kinds.values()])
    if len(ratios) < _KINDS:
        return None
    middle = float(np.median(ratios))
    agree = int((np.abs(np.log(ratios / middle)) < np.log(_AGREE)).sum())
    return middle if agree >= max(_KINDS, len(ratios) // 2 + 1) else None


def _normals(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Areas (T,) [m2] and unit normals (T, 3)."""
    doubled = scene.mesh.normals()
    lengths = np.linalg.norm(doubled, axis=1)
    return lengths / 2.0, doubled / np.maximum(lengths, 1e-12)[:, None]


def _facing(areas: NDArray[np.float64], unit: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) area that faces along each axis."""
    return np.array([areas[np.abs(unit[:, k]) > LEVEL].sum() for k in range(3)])


def _largest_level(
    heights: NDArray[np.float64], areas: NDArray[np.float64], floor: float
) -> float | None:
    """Height of the largest level surface no more than 3 m off the floor that is said."""
    near = np.abs(heights - floor) < 3.0
    if not near.any():
        return None
    bins, inverse = np.unique(np.round(heights[near] / 0.1), return_inverse=True)
    best = int(np.bincount(inverse, areas[near]).argmax())
    return float(bins[best] * 0.1)
