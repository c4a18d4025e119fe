"""From patches to objects: what stands on something is its own, what hangs together is one.

Patches that touch are joined, the strongest contact first, but for two cases. What meets a level
surface from above only (a vase on a table) is not of the table. And two parts that could both
stand alone, in a contact that is concave and thin for their size, stay two.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.mapping.segment.segment_kernels import connect

if TYPE_CHECKING:
    from placegraph.indoor.mapping.segment.patches import PatchGraph
    from placegraph.indoor.mapping.segment.segments import SegmentOptions


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]


_LEVEL = 0.9
_LOW = 0.2  # a surface that carries things is this far above the floor [m]
_RESTS = 0.7  # share of a contact that is concave where something only stands on a surface
_ALONE = 0.25  # area [m2] of what could stand alone, and
_WIDE = 0.3  # its second largest extent [m]: it is no post and no rail


def join_patches(patches: PatchGraph, floor: float | None, options: SegmentOptions) -> Ints:
    """Object (N,) of each patch: its lowest patch; those of the structure's planes stay alone."""
    free = patches.plane < 0
    ends, kept = patches.ends, free[patches.ends].all(axis=1)
    carried = _carried(patches, free, floor, options)
    kept &= ~carried
    return joined(patches, ends[kept], patches.lengths[kept], patches.concave[kept], options)


def _carried(patches: PatchGraph, free: Mask, floor: float | None, options: SegmentOptions) -> Mask:
    """Contacts (E,) of things with the level surfaces they stand on."""
    ends, lengths = patches.ends, patches.lengths
    base = patches.low[:, 2].min(initial=0.0) if floor is None else floor
    level = free & (patches.normals[:, 2] > _LEVEL) & (patches.low[:, 2] > base + _LOW)
    flat = level[ends].all(axis=1) & (patches.concave < 0.5)
    surface = connect(len(patches), ends[flat])
    wide = np.bincount(surface, patches.areas * level, len(patches))
    tops = level & (wide[surface] >= options.support)
    inner = free[ends].all(axis=1)
    apart = inner & ~tops[ends].any(axis=1)
    thing = connect(len(patches), ends[apart])
    meets = np.flatnonzero(inner & tops[ends[:, 0]] & ~tops[ends[:, 1]])
    key = surface[ends[meets, 0]] * (len(patches) + 1) + thing[ends[meets, 1]]
    _, row = np.unique(key, return_inverse=True)
    total = np.bincount(row, lengths[meets])
    over = np.bincount(row, (lengths * patches.concave)[meets])
    # what joins any surface from the side or from below is no thing on a surface
    part = np.zeros(len(patches), np.bool_)
    tied = over < _RESTS * total
    part[thing[ends[meets[tied[row]], 1]]] = True
    out = np.zeros(len(ends), np.bool_)
    rests = meets[~part[thing[ends[meets, 1]]]]
    pair = np.sort(ends, axis=1)
    code = pair[:, 0] * (len(patches) + 1) + pair[:, 1]
    out[np.isin(code, code[rests])] = True
    return out


@dataclass(slots=True)
class _Part:
    """Patches joined so far."""

    area: float
    low: Floats
    high: Floats
    contacts: dict[int, tuple[float, float]]
    """Length and concave length of contact with each other part [m]."""

    def alone(self) -> bool:
        """Whether it is large enough to be a thing by itself."""
        return self.area >= _ALONE and bool(np.partition(self.high - self.low, 1)[1] >= _WIDE)


def joined(
    patches: PatchGraph, ends: Ints, lengths: Floats, concave: Floats, options: SegmentOptions
) -> Ints:
    """Lowest patch (N,) of what each belongs to once contacts (E,) but the thin ones are closed."""
    parts = [
        _Part(float(a), low, high, {})
        for a, low, high in zip(patches.areas, patches.low, patches.high, strict=True)
    ]
    for (a, b), length, share in zip(
        ends.tolist(), lengths.tolist(), concave.tolist(), strict=True
    ):
        for one, two in ((a, b), (b, a)):  # both directions halve into one contact
            total, inward = parts[one].contacts.get(two, (0.0, 0.0))
            half = 0.5 * length
            parts[one].contacts[two] = (total + half, inward + half * share)
    root = np.arange(len(parts))
    queue = [
        (-_strength(parts, a, b), a, b)
        for a, part in enumerate(parts)
        for b in part.contacts
        if a < b
    ]
    heapq.heapify(queue)
    while queue:
        value, a, b = heapq.heappop(queue)
        if root[a] != a or root[b] != b or value != -_strength(parts, a, b):
            continue  # an older state of one of them
        if _thin(parts, a, b, options):
            continue
        root[b] = a
        for other in _merge(parts, a, b):
            low, high = min(a, other), max(a, other)
            heapq.heappush(queue, (-_strength(parts, low, high), low, high))
    for i in range(len(root)):
        root[i] = root[root[i]]  # roots are lower, so theirs are settled
    return root


def _strength(parts: list[_Part], a: int, b: int) -> float:
    """Length of a contact, the concave part of it at a third, over the size of the smaller part."""
    length, inward = parts[a].contacts[b]
    return (length - 0.67 * inward) / min(parts[a].area, parts[b].area) ** 0.5


def _thin(parts: list[_Part], a: int, b: int, options: SegmentOptions) -> bool:
    one, two = parts[a], parts[b]
    length, inward = one.contacts[b]
    if inward < 0.5 * length or not (one.alone() and two.alone()):
        return False
    return bool(length < options.thin * min(one.area, two.area) ** 0.5)


def _merge(parts: list[_Part], a: int, b: int) -> list[int]:
    """Put part b into part a; returns all that touch it now."""
    one, two = parts[a], parts[b]
    one.area += two.area
    one.low, one.high = np.minimum(one.low, two.low), np.maximum(one.high, two.high)
    del one.contacts[b]
    for other, (length, inward) in two.contacts.items():
        if other == a:
            continue
        total, before = one.contacts.get(other, (0.0, 0.0))
        one.contacts[other] = parts[other].contacts[a] = (total + length, before + inward)
        del parts[other].contacts[b]
    two.contacts = {}
    return list(one.contacts)


def settle(
    group: Ints, patches: PatchGraph, fixed: NDArray[np.bool_], options: SegmentOptions
) -> Ints:
    """Groups (N,) of patches, those that are too small put into what they touch most.

    A group is named by one of its patches; those whose patch is `fixed` (N,) stay. So does what
    touches nothing.
    """
    areas = np.bincount(group, patches.areas, len(patches))
    contacts = _touched(group, patches)
    root = np.arange(len(patches))
    queue = [(float(areas[g]), int(g)) for g in np.unique(group) if not fixed[g]]
    heapq.heapify(queue)
    while queue:
        area, g = heapq.heappop(queue)
        if area >= options.least:
            break
        if root[g] != g or area != areas[g] or not contacts[g]:
            continue
        to = max(contacts[g].items(), key=lambda item: (item[1], -item[0]))[0]
        root[g] = to
        areas[to] += area
        for other, length in contacts[g].items():
            del contacts[other][g]
            if other != to:
                contacts[to][other] = contacts[to].get(other, 0.0) + length
                contacts[other][to] = contacts[other].get(to, 0.0) + length
        contacts[g] = {}
        if not fixed[to]:
            heapq.heappush(queue, (float(areas[to]), to))
    while (root != root[root]).any():
        root = root[root]
    return root[group]


def _touched(group: Ints, patches: PatchGraph) -> list[dict[int, float]]:
    """Length of contact [m] of each group with others."""
    contacts: list[dict[int, float]] = [{} for _ in range(len(patches))]
    ends = group[patches.ends].tolist()
    for (a, b), length in zip(ends, patches.lengths.tolist(), strict=True):
        if a != b:
            for one, two in ((a, b), (b, a)):
                contacts[one][two] = contacts[one].get(two, 0.0) + 0.5 * length
    return contacts
