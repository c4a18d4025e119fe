"""From labelled faces to objects: connected regions of one label, split where geometry splits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.mapping.segment.faces import Faces, Samples
from placegraph.indoor.mapping.segment.geometry import ROUNDS, Cut, adopted
from placegraph.indoor.mapping.segment.objects import joined, settle
from placegraph.indoor.mapping.segment.patches import PatchGraph, describe, step_weights
from placegraph.indoor.mapping.segment.segment_kernels import connect
from placegraph.indoor.mapping.segment.votes import NOTHING, Votes, label_faces

if TYPE_CHECKING:
    from placegraph.indoor.mapping.segment.segments import SegmentOptions


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


_FRAGMENT = 0.15  # area of what may be a broken-off part of a thing [m2] ...
_NEARBY = 0.2  # ... and how far from it [m]
_MAJOR = 0.5  # of a thing's area, from which on its label is that of all of it
_SPILT = 0.5  # of the area of a thing: what its label spills over onto wall and floor is less
_MAIN = 0.5  # of its area lies on planes of one kind, or
_SOME, _VAST = 0.3, 4.0  # so much, and so many m2: walls have niches, and no cupboard is as large
_PART = 0.35  # of a plane that what is the plane covers; pictures and rugs cover less ...
_LARGE = 8.0  # ... and none is as large as this [m2]: a floor of many rooms has many parts


@dataclass(frozen=True, slots=True, eq=False)
class Named:
    """Groups (F,) of faces, and what is known of each group."""

    groups: Ints
    labels: dict[int, str]
    ids: dict[int, int]


def cut_by_labels(faces: Faces, cut: Cut, votes: Votes, options: SegmentOptions) -> Named:
    """Objects by votes; what they leave open is as `cut` has it."""
    normals, lab = faces.smoothed(ROUNDS)
    outward = cut.structure.outward
    steps = step_weights(faces, normals, lab, outward, options)
    label = label_faces(faces, votes, cut.patches.of_face, steps)
    thing = cut.groups[cut.patches.of_face]
    plane = cut.patches.plane[thing]
    label = _completed(faces, label, thing, plane, len(votes.words))
    piece = _pieces(faces, label, thing)
    pieces = describe(faces, normals, piece, np.full(len(faces), -1, np.int64), outward, options)
    first = np.unique(piece, return_index=True)[1]
    upright = np.array([word == "wall" for word in (*cut.structure.labels, "wall")])
    level = (plane[first] >= 0) & ~upright[plane[first]]
    spilt = _spilt(pieces, label[first], plane[first], level, options)
    label = np.where(spilt[piece], NOTHING, label)
    group = _grouped(pieces, label[first], thing[first], plane[first], votes.kind, options)
    group, meant = cover(
        group, pieces, label[first], plane[first], votes.words, cut.structure.labels, options
    )
    fixed = (label[first] == NOTHING) & (plane[first] >= 0)
    if votes.kind == "labels":
        group = _gathered(faces, piece, pieces, label[first], group)
    group = settle(group, pieces, fixed, options)
    group = adopted(group, pieces, fixed, faces, options.least)
    return _named(group, label[first], plane[first], votes, cut, piece, meant)


def _completed(faces: Faces, label: Ints, thing: Ints, plane: Ints, count: int) -> Ints:
    """Labels (F,): where most of a thing bears one, what of it bears none bears it too."""
    table = np.bincount(thing * count + label, faces.areas, (int(thing.max()) + 1) * count)
    table = table.reshape(-1, count)
    whole = table.sum(axis=1)
    table[:, NOTHING] = 0.0
    best = np.where(table.max(axis=1) >= _MAJOR * whole, np.argmax(table, axis=1), NOTHING)
    open_ = (label == NOTHING) & (plane < 0)
    out: Ints = np.where(open_, best[thing], label)
    return out


def _pieces(faces: Faces, label: Ints, thing: Ints) -> Ints:
    """Connected faces (F,) of one label and one thing, numbered from 0."""
    a, b = faces.pairs.T
    same = (label[a] == label[b]) & (thing[a] == thing[b])
    return np.unique(connect(len(faces), faces.pairs[same]), return_inverse=True)[1]


def _spilt(
    pieces: PatchGraph, label: Ints, plane: Ints, level: NDArray[np.bool_], options: SegmentOptions
) -> NDArray[np.bool_]:
    """Pieces (N,) of floor or wall whose label is of a larger thing they touch, or that are small.

    Outlines in label images are rough: what stands before a wall is painted on it in part. `level`
    (N,) are pieces of the floor or a ceiling, where the stains are larger, and pictures none.
    """
    a, b = pieces.ends.T
    beside = (label[a] == label[b]) & (plane[a] >= 0) & (plane[b] < 0) & (label[a] != NOTHING)
    beside &= pieces.areas[a] < _SPILT * pieces.areas[b]
    out = (plane >= 0) & (pieces.areas < np.where(level, options.carpet, options.mark))
    out[a[beside]] = True
    return out


def _grouped(
    pieces: PatchGraph, label: Ints, thing: Ints, plane: Ints, kind: str, options: SegmentOptions
) -> Ints:
    """Group (N,) of each piece, named by its lowest."""
    if kind == "instances":
        key = np.where(label == NOTHING, -1 - thing, label)
        _, first, row = np.unique(key, return_index=True, return_inverse=True)
        return first[row]
    a, b = pieces.ends.T
    same = (label[a] == label[b]) & (label[a] != NOTHING)
    same &= (plane[a] == plane[b]) | (plane[a] < 0) | (plane[b] < 0)  # walls stay apart
    group = joined(pieces, pieces.ends[same], pieces.lengths[same], pieces.concave[same], options)
    open_ = np.flatnonzero(label == NOTHING)
    _, first, row = np.unique(thing[open_], return_index=True, return_inverse=True)
    group[open_] = open_[first[row]]
    return group


def _gathered(faces: Faces, piece: Ints, pieces: PatchGraph, label: Ints, group: Ints) -> Ints:
    """Groups (N,), the fragments among them put into what bears their label close by."""
    areas = np.bincount(group, pieces.areas, len(pieces))
    named = np.flatnonzero(label[piece] != NOTHING)
    spread = Samples.of(faces, named, 0.5 * _NEARBY)
    rows = group[piece[spread.face[spread.touching(group[piece], _NEARBY)]]]
    a, b = rows.T
    better = (label[a] == label[b]) & (areas[a] < _FRAGMENT)
    better &= (areas[b] > areas[a]) | ((areas[b] == areas[a]) & (b < a))  # never in a circle
    to = np.arange(len(pieces))
    for one in np.unique(a[better]).tolist():
        near = np.unique(b[better & (a == one)])
        to[one] = near[np.argmax(areas[near])]
    while (to != to[to]).any():
        to = to[to]
    out: Ints = to[group]
    return out


def _named(
    group: Ints,
    label: Ints,
    plane: Ints,
    votes: Votes,
    cut: Cut,
    piece: Ints,
    meant: dict[int, str],
) -> Named:
    words: dict[int, str] = {}
    ids: dict[int, int] = {}
    for g in np.unique(group).tolist():
        row = int(label[g])
        if row == NOTHING:
            if plane[g] >= 0:
                words[g] = cut.structure.labels[int(plane[g])]
            continue
        word = votes.words[row] or meant.get(g, "")
        if word:
            words[g] = word
        if votes.kind == "instances":
            ids[g] = votes.ids[row]
    return Named(group[piece], words, ids)


def cover(
    group: Ints,
    pieces: PatchGraph,
    label: Ints,
    plane: Ints,
    words: Sequence[str],
    planes: Sequence[str],
    options: SegmentOptions,
) -> tuple[Ints, dict[int, str]]:
    """Groups (N,) of pieces, and the words of the planes that groups without one cover.

    What no label speaks of on a plane joins what covers that plane and lies beside it, unless this
    has a word of its own: then crumbs alone do. So do they where crumbs are all that is left.
    `label` and `plane` (N,) are rows of `words`, empty where they say nothing, and of `planes`.
    """
    kinds = sorted(set(planes))
    kind = np.array([kinds.index(word) for word in planes], np.int64)
    said = label != NOTHING
    on = np.flatnonzero(said & (plane >= 0))
    count = len(pieces)
    whole = np.bincount(group[said], pieces.areas[said], count)
    of_kind = np.bincount(
        group[on] * len(kinds) + kind[plane[on]], pieces.areas[on], count * len(kinds)
    ).reshape(count, len(kinds))
    keys, row = np.unique(group[on] * len(planes) + plane[on], return_inverse=True)
    area = np.bincount(row, pieces.areas[on], len(keys))
    size = np.bincount(plane[plane >= 0], pieces.areas[plane >= 0], len(planes))
    g, p = keys // max(len(planes), 1), keys % max(len(planes), 1)
    on_kind = of_kind[g, kind[p]]
    good = (on_kind >= _MAIN * whole[g]) | ((on_kind >= _SOME * whole[g]) & (on_kind >= _VAST))
    good &= area >= np.minimum(_PART * size[p], _LARGE)
    bare = size - np.bincount(p, area, len(planes)) < options.carpet  # crumbs are all that is left
    meant: dict[int, str] = {}
    covers: dict[int, list[tuple[int, float, bool]]] = {}
    for i in np.flatnonzero(good | bare[p]).tolist():
        one, own = int(g[i]), int(p[i])
        word = words[int(label[one])]
        if good[i] and not word:
            meant[one] = planes[own]
        same = bool(good[i]) and (word or planes[own]) == planes[own]
        covers.setdefault(own, []).append((one, float(area[i]), same))
    open_ = np.flatnonzero(~said & (plane >= 0))
    return _joined(group, pieces, open_, plane, covers, options), meant


def _joined(
    group: Ints,
    pieces: PatchGraph,
    open_: Ints,
    plane: Ints,
    covers: dict[int, list[tuple[int, float, bool]]],
    options: SegmentOptions,
) -> Ints:
    """Groups (N,), pieces `open_` (K,) put into the covers of their planes they touch most.

    Covers of a plane are groups, their area on it [m2], and whether it is what they are.
    """
    a, b = pieces.ends.T
    order = np.argsort(a, kind="stable")
    starts = np.searchsorted(a[order], np.arange(len(pieces) + 1))
    out = group.copy()
    for piece in open_.tolist():
        area = float(pieces.areas[piece])
        near = order[starts[piece] : starts[piece + 1]]
        beside = np.bincount(group[b[near]], pieces.lengths[near], len(pieces))
        fit = [
            (float(beside[one]), much, -one)
            for one, much, same in covers.get(int(plane[piece]), [])
            if area < (much if same else options.carpet)
        ]
        best = max(fit, default=(0.0, 0.0, 0))
        if best[0] > 0 or (fit and area < options.carpet):
            out[piece] = -best[2]
    return out
