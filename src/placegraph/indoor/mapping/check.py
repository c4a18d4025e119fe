"""Checks of a scene map: what is wrong, how badly, and which option of `scene build` mends it.

Nothing here is needed to localize: a map may be odd and still serve. An ``error`` makes localizing
fail or lie, a ``warning`` makes it worse, a ``note`` is good to know.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from math import sqrt
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.likelihood.visibility import visibility
from placegraph.indoor.map.floor import (
    LEVEL,
    find_labelled_floors,
    is_floor,
    is_nameless,
    is_structural,
    split_label,
    weighted_quantiles,
)
from placegraph.indoor.map.free_space import DIRECTIONS
from placegraph.indoor.map.relations import MAX_RELATED_OBJECTS
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.options import PoseSearchOptions

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is odd about a map."""

    severity: Severity
    what: str
    """One sentence."""
    objects: Sequence[str] = ()
    """Ids of the objects it is about, at most 20; empty where it is about the whole map."""
    remedy: str = ""
    """Remedy: an option of `placegraph scene build`, or advice about the file."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain strings."""
        told = {**asdict(self), "objects": list(self.objects)}
        told["mend"] = told.pop("remedy")
        return told


_DOUBLES = 0.01  # Share of triangles that lie on another
_BARE = 0.2  # Share of the surface that is white and without texture


def _weld_corners(scene: Scene) -> NDArray[np.int64]:
    """Number the corners (T, 3) by place: vertices at one place are one, whatever their colour."""
    grain, _ = scene.mesh.steps()
    steps = np.rint(scene.mesh.vertices / np.float32(grain)).astype(np.int64)
    steps -= steps.min(axis=0)
    span = steps.max(axis=0) + 1
    keys = (steps[:, 0] * span[1] + steps[:, 1]) * span[2] + steps[:, 2]
    return np.unique(keys, return_inverse=True)[1][scene.mesh.triangles]


def _check_doubles(scene: Scene) -> Iterator[Finding]:
    corners = _weld_corners(scene)
    ordered = np.sort(corners, axis=1)
    first = ordered[:, 0] * (int(corners.max()) + 1) + ordered[:, 1]
    order = np.lexsort([ordered[:, 2], first])
    same = (np.diff(first[order]) == 0) & (np.diff(ordered[order, 2]) == 0)
    share = float(same.sum()) / len(corners)
    if share > _DOUBLES:
        rows = np.unique(scene.mesh.object_of[order[1:][same]])
        yield Finding(
            "warning" if share > 10 * _DOUBLES else "note",
            f"{share:.0%} of the triangles coincide with another one, so the mesh is duplicated.",
            [scene.graph.ids[i] for i in rows.tolist()],
            "Delete duplicate faces in the file; they take space and time, and their "
            "colours flicker.",
        )


def _check_colours(scene: Scene) -> Iterator[Finding]:
    mesh = scene.mesh
    if not scene.has_colours:
        white = (mesh.colours == 255).all() and all((t == 255).all() for t in mesh.textures)
        fault = "has no colours" if white else "has a single colour"
        yield Finding(
            "warning" if white else "note",
            f"The map {fault}, so images cannot be compared with it; only depth and labels can.",
            remedy=(
                "Export textures or vertex colours with the file"
                + ("." if white else ", if it has any.")
            ),
        )
        return
    blank = np.array([bool((t == 255).all()) for t in mesh.textures])
    bare = blank[mesh.texture_of] & (mesh.colours[mesh.triangles] == 255).all(axis=(1, 2))
    areas = np.linalg.norm(mesh.normals(), axis=1)
    share = float(areas[bare].sum() / max(float(areas.sum()), 1e-12))
    if share > _BARE:
        whole = np.bincount(mesh.object_of, areas, len(scene))
        white = np.bincount(mesh.object_of, areas * bare, len(scene))
        rows = np.flatnonzero(white > 0.9 * np.maximum(whole, 1e-12))
        yield Finding(
            "note",
            f"{share:.0%} of the surface is pure white without texture: its colour may be missing.",
            [scene.graph.ids[i] for i in rows.tolist()],
            "Export its materials with the file, if it is not white.",
        )


_GIANT = 0.8  # An object with this share of all surface that is no wall, floor or ceiling ..
_TWINS = 0.8
"""Boxes whose common part is this share of what they fill together are one object twice."""
_MANY_TRIANGLES = 1_000_000
_LARGE_FILE = 20e6  # [bytes]
_SLOW = 2.0  # Opening a map beyond this is slow [s]


def _check_giants(scene: Scene) -> Iterator[Finding]:
    areas = np.linalg.norm(scene.mesh.normals(), axis=1) / 2.0
    own = np.bincount(scene.mesh.object_of, areas, len(scene))
    largest = int(own.argmax())
    share = own[largest] / max(float(own.sum()), 1e-12)
    if share > _GIANT and not is_structural(scene.graph.labels)[largest]:
        severity: Severity = "warning" if len(scene) > 1 else "error"
        yield Finding(
            severity,
            f"{_describe_object(scene, largest)} is {share:.0%} of the surface, so the map lacks "
            "the separate objects that localization needs.",
            [scene.graph.ids[largest]],
            "Build from a file with one node, group or id per object (--object-property, "
            "--labels), or from the capture, which segments the mesh.",
        )


def _check_twins(scene: Scene) -> Iterator[Finding]:
    low, high = _bound_objects(scene)
    movable = np.flatnonzero(~is_structural(scene.graph.labels))
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
        yield Finding(
            "warning",
            f"{len(pairs)} pairs of objects fill the same space, such as {_describe_object(scene, a)} and "
            f"{_describe_object(scene, b)}.",
            [scene.graph.ids[i] for i in dict.fromkeys(i for pair in pairs for i in pair)],
            "Delete one of each pair in the file, or give both one id.",
        )


def _check_far_objects(scene: Scene) -> Iterator[Finding]:
    """Check for objects farther from all others than the map without them is wide."""
    low, high = _bound_objects(scene)
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
        yield Finding(
            "warning",
            f"{len(out)} object{('s lie' if len(out) > 1 else ' lies')} far from the rest, "
            f"{_describe_object(scene, int(out[0]))} by {reach[out[0]]:.0f} m.",
            [scene.graph.ids[i] for i in out.tolist()],
            "Delete or move it in the file; it enlarges the bounding box that is searched.",
        )


def _check_words(scene: Scene) -> Iterator[Finding]:
    graph = scene.graph
    bare = [i for i, label in enumerate(graph.labels) if is_nameless(label)]
    if len(bare) > 0.2 * len(scene):
        yield Finding(
            "warning" if len(bare) > 0.5 * len(scene) else "note",
            f"{len(bare)} of {len(scene)} objects have no meaningful label.",
            [graph.ids[i] for i in bare],
            "--labels FILE gives each object's id or name a label.",
        )
    names = Counter(name for name in graph.names if name)
    twice = {name for name, count in names.items() if count > 1}
    if twice:
        rows = [i for i, name in enumerate(graph.names) if name in twice]
        yield Finding(
            "note",
            f"{len(twice)} names are used by several objects, such as {min(twice)!r}.",
            [graph.ids[i] for i in rows],
            "Give each object its own name in the file; until then use ids.",
        )
    folded = Counter(id_.strip().casefold() for id_ in graph.ids)
    alike = [id_ for id_ in graph.ids if folded[id_.strip().casefold()] > 1]
    if alike:
        yield Finding(
            "warning",
            f"{len(alike)} ids differ only in case or spaces, such as {alike[0]!r}.",
            alike,
            "Rename them in the file, so that instance images and label tables can "
            "distinguish them.",
        )


def _check_relations(scene: Scene) -> Iterator[Finding]:
    if len(scene) > 1 and not scene.graph.relations:
        many = len(scene) > MAX_RELATED_OBJECTS
        yield Finding(
            "note",
            "No relation between objects is known"
            + (f": there are more than {MAX_RELATED_OBJECTS:,} of them." if many else "."),
            remedy="Cut the scene into fewer objects."
            if many
            else "Check --scale; no surface is near the cameras.",
        )


def _check_costs(scene: Scene, size: int | None, seconds: float | None) -> Iterator[Finding]:
    remedy = "--detail small, or tiny, makes it smaller; so do --error and --texel."
    if len(scene.mesh) > _MANY_TRIANGLES:
        yield Finding("warning", f"The map has {len(scene.mesh):,} triangles.", remedy=remedy)
    if size is not None and size > _LARGE_FILE:
        yield Finding("note", f"The file has {size / 1e6:.0f} MB.", remedy=remedy)
    if seconds is not None and seconds > _SLOW:
        yield Finding("note", f"Opening it took {seconds:.1f} s.", remedy=remedy)


def _bound_objects(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    found = scene.mesh.object_bounds(len(scene))
    return found[:, 0], found[:, 1]


def _describe_object(scene: Scene, row: int) -> str:
    graph = scene.graph
    return f"{graph.labels[row] or 'object'} {(graph.names[row] or graph.ids[row])!r}"


HEIGHTS = {
    "chair": 0.9, "armchair": 0.9, "table": 0.74, "desk": 0.75, "sofa": 0.85, "couch": 0.85,
    "door": 2.05, "toilet": 0.78, "refrigerator": 1.7, "fridge": 1.7, "wardrobe": 2.0,
    "counter": 0.9, "bathtub": 0.58, "stool": 0.55, "nightstand": 0.55, "wall": 2.6,
}  # fmt: skip
"""Usual heights of things that stand on the floor [m]."""
_KINDS = 3  # Kinds of things that have to agree how far a map's unit is off ..
_AGREE = 1.5  # ... within this factor: sizes of one kind differ by as much
_STANDS = 0.15  # A whole thing begins no higher above the floor than this share of its height
UNITS = (
    ("millimetres", 0.001), ("centimetres", 0.01), ("inches", 0.0254), ("feet", 0.3048),
    ("metres", 1.0), ("hundreds of metres", 100.0), ("kilometres", 1000.0),
)  # fmt: skip
"""Units of files, and metres in each."""
_LOW, _HIGH = 1.9, 7.0  # Height of rooms, halls and a second storey included [m]
_USUAL = 2.6
_TILTED, _VERY_TILTED = 1.0, 4.0
"""The floor's slope that is told, and the one that spoils poses [deg]: gravity is taken for known."""
_OFF = 0.1  # How far the floor may lie from a level surface [m]


def _check_units(scene: Scene) -> Iterator[Finding]:
    """Check that the unit is the metre, by heights of rooms and of objects of known label."""
    rooms = measure_room_height(scene)
    known = _compare_heights(scene)
    guess = known if known is not None else rooms / _USUAL
    off = (known is not None and not 0.5 < known < 2.0) or not _LOW < rooms < _HIGH
    if not off or guess <= 0:  # nothing above the floor is a floor elsewhere
        return
    unit, scale = min(UNITS, key=lambda u: abs(np.log(guess * u[1])))
    text = f"Rooms are {rooms:.3g} m high"
    if known is not None:
        text += f", and objects {known:.3g} times as high as usual"
    if scale != 1.0 and abs(np.log(guess * scale)) < 0.7:
        unsure = unit == "feet" and known is None  # or it is a hall
        severity: Severity = "warning" if unsure else "error"
        yield Finding(
            severity, f"{text}: the file seems to be in {unit}.", remedy=f"--scale {scale:g}"
        )
    else:
        yield Finding(
            "warning",
            f"{text}.",
            remedy="--scale N, metres in one unit of the file, if that is odd.",
        )


def _check_up_axis(scene: Scene) -> Iterator[Finding]:
    """Check that z is up: floors and ceilings face along it, and rooms are lower than wide."""
    areas, unit = _measure_faces(scene)
    named, standing = find_labelled_floors(scene.mesh, scene.graph.labels)
    words = [split_label(label)[-1:] for label in scene.graph.labels]
    level = named if named.any() else np.array([w == ["ceiling"] for w in words])
    labelled = level[scene.mesh.object_of]
    if areas[labelled].sum() > 0:
        shares = _sum_facing(areas[labelled], unit[labelled])
        severity: Severity = "error"
        sure, what = 2.0, "ceilings face"
        if named.any():
            what = "the floor is vertical; it faces"
    else:
        shares = _sum_facing(areas, unit)
        extents = np.ptp(scene.bounds, axis=0)
        if extents[2] < 1.3 * extents[int(shares[:2].argmax())]:
            return
        severity, sure, what = "warning", 1.3, "most surfaces face"
    best = int(shares.argmax())
    if best != 2 and shares[best] > sure * shares[2]:
        yield Finding(
            severity,
            f"The map seems to lie on its side: {what} along {'xy'[best]}.",
            remedy="--up y" if best == 1 else "Turn the file so that z points up.",
        )
    elif standing.any():
        many = int(standing.sum())
        yield Finding(
            "warning",
            f"The floor is vertical in {many} object{('s' if many > 1 else '')} with that "
            "label, so these were ignored when the map's floor was estimated.",
            [scene.graph.ids[i] for i in np.flatnonzero(standing)],
            "Correct their labels (--labels), or rotate the file so that z points up.",
        )


def _check_floors(scene: Scene) -> Iterator[Finding]:
    """Check that each merged scene's floor is level and where the map says."""
    areas, unit = _measure_faces(scene)
    heights = scene.mesh.vertices[scene.mesh.triangles][:, :, 2].mean(axis=1, dtype=np.float64)
    named = np.array([is_floor(label) for label in scene.graph.labels])[scene.mesh.object_of]
    level = np.abs(unit[:, 2]) > LEVEL
    for s, floor in enumerate(scene.floors.tolist()):
        own = level & (scene.scene_of[scene.mesh.object_of] == s)
        low, high = scene.scene_bounds[s]
        least = max(0.5, 0.03 * float(np.prod((high - low)[:2])))
        near = own & (np.abs(heights - floor) < _OFF)
        if areas[near].sum() < least:
            where = _find_largest_level(heights[own], areas[own], floor)
            yield Finding(
                "error" if where is None or abs(where - floor) > 0.3 else "warning",
                f"The floor height is {floor:.2f} m, but hardly any level surface lies there"
                + ("." if where is None else f"; the next large one is at {where:.2f} m."),
                remedy="--floor H" if where is None else f"--floor {where:.2f}",
            )
            continue
        below = own & named & (heights < floor - 3 * _OFF)
        if areas[below].sum() > areas[near].sum():
            where = float(np.average(heights[below], weights=areas[below]))
            yield Finding(
                "warning",
                f"More of the surface labelled floor lies at {where:.2f} m than at the "
                f"map's floor height, {floor:.2f} m.",
                remedy=f"--floor {where:.2f}, or cut the storeys apart.",
            )
        floor_like = near & named if (near & named).any() else near
        turned = unit[floor_like] * np.sign(unit[floor_like, 2:])
        # no wall is among them, but chamfers and clutter are: the middle, not the mean
        slope = [weighted_quantiles(turned[:, k], areas[floor_like], (0.5,))[0] for k in range(3)]
        tilt = float(np.degrees(np.arctan2(np.hypot(slope[0], slope[1]), slope[2])))
        if tilt > _TILTED:
            yield Finding(
                "error" if tilt > _VERY_TILTED else "warning",
                f"The floor slopes by {tilt:.1f} degrees, so -z is not the direction of "
                "gravity, which localization assumes.",
                remedy="Level the file (rotate the floor into the plane z = const), and build again.",
            )


def measure_room_height(scene: Scene) -> float:
    """Return the height from the floor below which all but a fiftieth of the surface lies [m]."""
    areas, _ = _measure_faces(scene)
    heights = scene.mesh.vertices[scene.mesh.triangles][:, :, 2].mean(axis=1, dtype=np.float64)
    (top,) = weighted_quantiles(heights, areas, (0.98,))
    return float(top - scene.floors.min())


def _compare_heights(scene: Scene) -> float | None:
    """Compare the heights of objects whose kind is in `HEIGHTS` with the usual ones, as a ratio.

    None where fewer than `_KINDS` kinds, or no more than half of them, agree: parts of things are
    lower than things, and labels may err.
    """
    kinds: dict[str, list[float]] = {}
    boxes = scene.mesh.object_bounds(len(scene)).astype(np.float64)
    for i, label in enumerate(scene.graph.labels):
        word = (split_label(label) or [""])[-1]
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


def _measure_faces(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return areas (T,) [m2] and unit normals (T, 3)."""
    doubled = scene.mesh.normals()
    lengths = np.linalg.norm(doubled, axis=1)
    return lengths / 2.0, doubled / np.maximum(lengths, 1e-12)[:, None]


def _sum_facing(areas: NDArray[np.float64], unit: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (3,) area that faces along each axis."""
    return np.array([areas[np.abs(unit[:, k]) > LEVEL].sum() for k in range(3)])


def _find_largest_level(
    heights: NDArray[np.float64], areas: NDArray[np.float64], floor: float
) -> float | None:
    """Return height of the largest level surface no more than 3 m off the floor that is said."""
    near = np.abs(heights - floor) < 3.0
    if not near.any():
        return None
    bins, inverse = np.unique(np.round(heights[near] / 0.1), return_inverse=True)
    best = int(np.bincount(inverse, areas[near]).argmax())
    return float(bins[best] * 0.1)


_PLACES = 24  # Places from which holes are looked for
_SKY, _OPEN = 0.03, 0.3  # Share of the rays from inside that leave the map: told, and much
_LEVEL_RAY = 0.2
"""Rays that rise or fall more steeply than this may pass over low walls, and under none."""
_BACK = 0.3  # Share of the rays from inside that meet the back of a triangle


def _check_places(scene: Scene, options: PoseSearchOptions | None) -> Iterator[Finding]:
    options = options or PoseSearchOptions()
    table = visibility(scene, options)
    heights = " to ".join(f"{h:g}" for h in sorted({min(options.heights), max(options.heights)}))
    over = float(scene.floors.min()) + min(options.heights) >= float(scene.bounds[1, 2])
    if not len(table) or over:
        rooms = measure_room_height(scene)
        yield Finding(
            "error",
            f"At camera heights of {heights} m above the floor ({scene.floors[0]:.2f} m) no "
            "place is free, so no particle can start and localization is impossible.",
            remedy=(
                "--floor H, if the floor lies elsewhere; --scale N, if the map is in another unit; or "
                f"`scene localize --height {max(0.3, min(0.6 * rooms, 1.0)):.1f}`."
            ),
        )
        return
    below = scene.caster.cast(table.positions, np.tile([0.0, 0.0, -1.0], (len(table), 1)))
    # inside: with a floor below, where there is one
    inside = (
        np.flatnonzero(below.triangle >= 0)
        if (below.triangle >= 0).any()
        else np.arange(len(table))
    )
    chosen = inside[np.linspace(0, len(inside) - 1, min(_PLACES, len(inside))).round().astype(int)]
    rays = _aim_around()
    origins = np.repeat(table.positions[chosen], len(rays), axis=0)
    hits = scene.caster.cast(origins, np.tile(rays, (len(chosen), 1)))
    missed = (hits.triangle < 0).reshape(len(chosen), -1)
    yield from _check_holes(missed, rays)
    yield from _check_normals(scene, hits.triangle, np.tile(rays, (len(chosen), 1)))


def _aim_around() -> NDArray[np.float32]:
    """Return directions (N, 3): those of the visibility, and as many up and down, to 50 degrees."""
    count = len(DIRECTIONS)
    z = np.linspace(0.77, 1.0, count // 2 + count % 2)
    turn = np.arange(len(z)) * 2.399963  # golden angle
    flat = np.sqrt(1.0 - z**2)
    up = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
    both = np.concatenate([up, (up * (1.0, 1.0, -1.0))[: count // 2]])
    return np.concatenate([DIRECTIONS, both.astype(np.float32)])


def _check_holes(missed: NDArray[np.bool_], rays: NDArray[np.float32]) -> Iterator[Finding]:
    share = float(missed.mean())
    if share <= _SKY:
        return
    up, down = rays[:, 2] > _LEVEL_RAY, rays[:, 2] < -_LEVEL_RAY
    parts = {"above": up, "below": down, "around": ~(up | down)}
    shares = {where: float(missed[:, which].mean()) for where, which in parts.items()}
    listed = ", ".join(f"{s:.0%} {where}" for where, s in shares.items() if s > _SKY)
    only_up = shares["above"] > _SKY and shares["below"] <= _SKY and shares["around"] <= _SKY
    yield Finding(
        "note" if only_up or share < _OPEN else "warning",
        f"From inside, {share:.0%} of all rays leave the map ({listed}): "
        + ("it has no ceiling." if only_up else "walls or floors have holes, or are missing."),
        remedy=(
            "Those rays cannot be compared. Export the file with ceiling and walls, or scan "
            "the missing parts."
        ),
    )


def _check_normals(
    scene: Scene, triangle: NDArray[np.int32], rays: NDArray[np.float32]
) -> Iterator[Finding]:
    hit = triangle >= 0
    rows = triangle[hit]
    back = np.einsum("nk,nk->n", scene.normals[rows], rays[hit]) > 0.05
    share = float(back.mean()) if len(back) else 0.0
    if share <= _BACK:
        return
    own = scene.mesh.object_of[rows]
    seen = np.bincount(own, minlength=len(scene))
    turned = np.bincount(own, back, len(scene))
    worst = np.argsort(-turned)[: int((turned > 0.5 * np.maximum(seen, 1)).sum())]
    yield Finding(
        "note",
        f"{share:.0%} of the surface visible from inside shows the back of triangles, so "
        "normals are flipped.",
        [scene.graph.ids[i] for i in worst.tolist() if turned[i] > 0.5 * seen[i]],
        "Placegraph renders both sides; recalculate the normals if other programs use the file.",
    )


_SURE = 0.9  # Probability from which on a candidate is the one
_FAR, _FARTHEST = 1.0, 3.0  # What may be left of what was fitted, on the whole and at worst [m]
_NO_HEIGHT = 50.0  # A height with a larger standard deviation is unknown [m]
_AGAIN = "Anchor it again with `placegraph scene anchor`"


def _check_anchors(scene: Scene) -> Iterator[Finding]:
    for name in scene.scenes:
        found = scene.anchors_of(name)
        if not found:
            continue
        of = f" of {name}" if len(scene.scenes) > 1 else ""
        best = found[0]
        if best.probability < _SURE:
            yield Finding(
                "warning",
                f"The position{of} on Earth is ambiguous: the best of {len(found)} "
                f"candidates has probability {best.probability:.0%}.",
                remedy=f"{_AGAIN} with point pairs, or keep only the correct candidate.",
            )
        left = sqrt(sum(r * r for r in best.residuals) / max(1, len(best.residuals)))
        worst = max(best.residuals, default=0.0)
        if left > _FAR or worst > _FARTHEST:
            yield Finding(
                "warning",
                f"The anchor{of} has residuals of {left:.1f} m on average and {worst:.1f} m "
                "at most.",
                remedy=f"{_AGAIN}; check the point pairs and the building.",
            )
        if not best.has_covariance:
            yield Finding(
                "note",
                f"The position{of} on Earth has no covariance, so GeoPoses look exact.",
                remedy="Give the anchor a covariance.",
            )
        elif best.covariance[2, 2] > _NO_HEIGHT**2:
            yield Finding(
                "note",
                f"The height{of} on Earth is unknown, so heights of GeoPoses are wrong.",
                remedy=f"{_AGAIN} and --height.",
            )


def check(
    scene: Scene,
    *,
    options: PoseSearchOptions | None = None,
    size: int | None = None,
    seconds: float | None = None,
) -> list[Finding]:
    """Find what is odd about a map, worst first; empty where nothing is.

    `scene`: the map; it is only read.
    `options`: localizing's options: at their camera heights places are looked for.
    `size`, `seconds`: of the map file [bytes], and what opening it took [s], where they are known.
    """
    found = chain(
        _check_units(scene), _check_up_axis(scene), _check_floors(scene),
        _check_places(scene, options), _check_doubles(scene),
        _check_colours(scene), _check_giants(scene), _check_twins(scene), _check_far_objects(scene),
        _check_words(scene), _check_relations(scene), _check_costs(scene, size, seconds),
        _check_anchors(scene),
    )  # fmt: skip
    named = [replace(f, objects=tuple(f.objects)[:20]) for f in found]
    return sorted(named, key=lambda f: SEVERITIES.index(f.severity))
