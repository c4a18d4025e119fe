"""Label images vote for faces, and labelled faces become objects."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera, Floats
from placegraph.errors import OptionError
from placegraph.indoor.map.floor import is_nameless
from placegraph.indoor.mapping.segment.faces import (
    Faces,
    PatchGraph,
    Samples,
    describe_patches,
    step_weights,
)
from placegraph.indoor.mapping.segment.geometry import (
    ROUNDS,
    Cut,
    absorb_lost,
    absorb_small,
    join_parts,
)
from placegraph.indoor.mapping.segment.segment_kernels import connect, elect
from placegraph.indoor.rays import RayCaster
from placegraph.io.capture.frame import Frame, LabelKind

if TYPE_CHECKING:
    from placegraph.indoor.mapping.segment import SegmentOptions

Ints = NDArray[np.int64]

NOTHING = 0  # What a pixel without a label votes for
_RAYS = 20_000  # of a frame: one in so many pixels is asked that there are about these
_NEAR = 0.05  # a depth reading may differ from the mesh by this [m] ...
_SLOPE = 0.03  # ... and by this share of the depth, else something else is seen
_HALF = 3.0  # at this depth a view counts half as much as close by [m]
_GRAZING = 0.1  # least cosine of incidence that counts
_HELD = 4_000_000  # votes held before those for one face and label are added up
_DOUBT = 0.2  # Votes that a face has for no label at all: few votes count less than their share
_PATCH = 1.0  # What the opinion of the patch around it is worth to the face's own
_CELL = 0.2
"""Side of the cubes that patches fall into for this [m]: pictures may lie in a wall's patch."""
_NEIGHBOURS = 0.7  # What its neighbours' labels are worth
_ROUNDS = 6


@dataclass(frozen=True, slots=True, eq=False)
class Votes:
    """Votes for the labels of faces; a face seen straight on and close by has one a frame."""

    kind: LabelKind
    words: tuple[str, ...]  # Of the labels; the first is `NOTHING`
    ids: tuple[int, ...]  # Of the labels, as the images have them; -1 of `NOTHING`
    starts: Ints  # (F + 1,) first vote of each face
    labels: Ints  # (K,) rows of words
    weights: Floats  # (K,)


def collect_votes(
    faces: Faces,
    frames: Sequence[Frame],
    poses: Floats,
    tell: Callable[[int, int], None] | None,
    left_out: Counter[str],
) -> Votes | None:
    """Collect votes of frames at poses (T, 4, 4) map_from_camera; None without labels.

    Rays through pixels find the faces; one that the frame's depth contradicts has no vote. Raises
    `OptionError` where some frames hold labels and others instances.
    """
    kinds = {f.label_kind for f in frames if f.label_kind is not None}
    if not kinds:
        return None
    if len(kinds) > 1:
        raise OptionError("frames: some hold labels, others instances; give those of one kind.")
    box = _VoteCounter(kinds.pop(), len(faces))
    caster = RayCaster(faces.points, faces.corners)
    for i, (frame, pose) in enumerate(zip(frames, poses, strict=True)):
        if tell is not None:
            tell(i, len(frames))
        image = frame.labels()
        if image is None:
            left_out["frames without labels"] += 1
            continue
        if not np.isfinite(pose).all():
            left_out["frames without a pose"] += 1
            continue
        face, pixel, weight = _cast_votes(faces, caster, frame, pose, image.shape[:2], i)
        label = box.rows(frame, image)[pixel]
        if (label < 0).any():
            left_out["pixels whose label has no name"] += int((label < 0).sum())
        box.put(face[label >= 0], label[label >= 0], weight[label >= 0])
    return box.votes()


class _VoteCounter:
    """Votes as they come in."""

    def __init__(self, kind: LabelKind, count: int) -> None:
        self.kind = kind
        self.count = count
        self.words = [""]
        self.ids = [-1]
        self._row: dict[object, int] = {}
        self._keys: list[Ints] = []
        self._weights: list[Floats] = []
        self._held = 0

    def rows(self, frame: Frame, image: NDArray[np.int32]) -> Ints:
        """Return rows of words (H * W,) of an image's pixels; -1 where a label has no name."""
        values, back = np.unique(image.ravel(), return_inverse=True)
        meant = [self._row_of(int(v), frame.label_names) for v in values]
        return np.array(meant, np.int64)[back]

    def _row_of(self, value: int, names: dict[int, str]) -> int:
        if value < 0:
            return NOTHING
        word = names.get(value, "")
        if self.kind == "labels" and not word:
            return -1
        if is_nameless(word):
            if self.kind == "labels":
                return NOTHING
            word = ""
        key: object = value if self.kind == "instances" else word.strip().casefold()
        if key not in self._row:
            self._row[key] = len(self.words)
            self.words.append(word.strip())
            self.ids.append(value)
        return self._row[key]

    def put(self, face: Ints, label: Ints, weight: Floats) -> None:
        """Add the votes of one frame: each face has its mean weight, shared by its labels."""
        if not len(face):
            return
        key, row, hits = np.unique(face << 20 | label, return_inverse=True, return_counts=True)
        own = key >> 20
        of_face = np.bincount(face, minlength=self.count)
        mean = np.bincount(row, weight, len(key)) / hits
        self._keys.append(key)
        self._weights.append(mean * hits / of_face[own])
        self._held += len(key)
        if self._held > _HELD:
            self._sum_up()

    def _sum_up(self) -> None:
        key, row = np.unique(
            np.concatenate([np.zeros(0, np.int64), *self._keys]), return_inverse=True
        )
        weights = np.concatenate([np.zeros(0), *self._weights])
        sums = np.asarray(np.bincount(row, weights, len(key)), np.float64)
        self._keys, self._weights = [key], [sums]
        self._held = 0

    def votes(self) -> Votes:
        """Return all votes, sorted by face."""
        self._sum_up()
        (key,), (weights,) = self._keys, self._weights
        starts = np.searchsorted(key >> 20, np.arange(self.count + 1))
        labels = key & ((1 << 20) - 1)
        return Votes(self.kind, tuple(self.words), tuple(self.ids), starts, labels, weights)


def _cast_votes(
    faces: Faces, caster: RayCaster, frame: Frame, pose: Floats, shape: tuple[int, ...], turn: int
) -> tuple[Ints, Ints, Floats]:
    """Cast rays at faces: faces (N,) that a frame shows, pixels (N,) that show them, weights (N,)."""
    camera = frame.label_camera or frame.camera
    height, width = shape
    step = max(int(np.ceil(np.sqrt(height * width / _RAYS))), 1)
    # other pixels in every frame: small faces are hit in some
    v, u = np.mgrid[turn % step : height : step, turn // step % step : width : step]
    v, u = v.ravel(), u.ravel()
    rays = camera.directions(np.stack([u, v], axis=1) + 0.5)
    ways = rays @ pose[:3, :3].T
    hits = caster.cast(pose[:3, 3], ways)
    depth = hits.distance.astype(np.float64)
    good = (hits.triangle >= 0) & ~_contradicts_depth(frame, rays, depth)
    face = hits.triangle[good].astype(np.int64)
    along = ways[good] / np.linalg.norm(ways[good], axis=1, keepdims=True)
    cosine = np.abs((along * faces.normals[face]).sum(axis=1))
    weight = np.maximum(cosine, _GRAZING) / (1.0 + (depth[good] / _HALF) ** 2)
    return face, (v * width + u)[good], weight


def _contradicts_depth(frame: Frame, rays: Floats, depth: Floats) -> NDArray[np.bool_]:
    """Return rays (N,) on which the frame measured another depth (N,) [m] than the mesh has."""
    out = np.zeros(len(rays), np.bool_)
    measured, camera = frame.depth(), frame.depth_camera
    if measured is None or camera is None:
        return out
    column, row, inside = _project_pixels(camera, rays)
    reading = measured[row[inside], column[inside]].astype(np.float64)
    with np.errstate(invalid="ignore"):
        off = np.abs(reading - depth[inside]) > _NEAR + _SLOPE * reading
    out[inside] = off & np.isfinite(reading)
    return out


def _project_pixels(camera: Camera, rays: Floats) -> tuple[Ints, Ints, NDArray[np.bool_]]:
    uv = np.floor(camera.project(rays))
    inside = (uv >= 0).all(axis=1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
    whole = np.where(inside[:, None], uv, 0.0).astype(np.int64)
    return whole[:, 0], whole[:, 1], inside


def label_faces(faces: Faces, votes: Votes, patch: Ints, steps: Floats) -> Ints:
    """Label each face (F,) by a row of `votes.words`; `NOTHING` where none is known.

    A face's score for a label is its own share of votes, that of its patch around it by area, and
    the share of its neighbours that bear the label, across steps (P,) less.
    """
    columns = [patch, *np.floor(faces.centres / _CELL).astype(np.int64).T]
    order = np.lexsort(columns)
    fresh = np.ones(len(patch), np.bool_)
    fresh[1:] = np.any([np.diff(column[order]) != 0 for column in columns], axis=0)
    out = np.empty(len(patch), np.int64)
    out[order] = np.cumsum(fresh) - 1
    patch = out
    count = len(votes.words)
    face = np.repeat(np.arange(len(faces)), np.diff(votes.starts))
    total = np.bincount(face, votes.weights, len(faces)) + _DOUBT
    share = votes.weights / total[face]
    patches = int(patch.max()) + 1
    weighed = share * faces.areas[face]
    table = np.bincount(patch[face] * count + votes.labels, weighed, patches * count)
    seen = np.zeros(len(faces), np.bool_)
    seen[face] = True
    area = np.bincount(patch, faces.areas * seen, patches)
    shares = table.reshape(patches, count) / np.maximum(area, 1e-12)[:, None]
    links = np.exp(-(np.minimum(steps, 20.0) ** 2)) * faces.lengths
    labels = np.where(area[patch] > 0, np.argmax(shares, axis=1)[patch], -1)
    for _ in range(_ROUNDS):
        labels = elect(
            votes.starts, votes.labels, share, patch, shares, faces.pairs, links, labels,
            _PATCH, _NEIGHBOURS,
        )  # fmt: skip
    return np.maximum(labels, 0)


_FRAGMENT = 0.15  # area of what may be a broken-off part of a thing [m2] ...
_NEARBY = 0.2  # ... and how far from it [m]
_MAJOR = 0.5  # of a thing's area, from which on its label is that of all of it
_SPILT = 0.5  # of the area of a thing: what its label spills over onto wall and floor is less
_MAIN = 0.5  # of its area lies on planes of one kind, or
_SOME, _VAST = 0.3, 4.0  # so much, and so many m2: walls have niches, and no cupboard is as large
_PART = 0.35  # of a plane that what is the plane covers; pictures and rugs cover less ...
_LARGE = 8.0  # ... and none is as large as this [m2]: a floor of many rooms has many parts


@dataclass(frozen=True, slots=True, eq=False)
class NamedGroups:
    """Groups (F,) of faces, and what is known of each group."""

    groups: Ints
    labels: dict[int, str]
    ids: dict[int, int]


def cut_by_labels(faces: Faces, cut: Cut, votes: Votes, options: SegmentOptions) -> NamedGroups:
    """Cut faces into objects by votes; `cut` decides where there are none."""
    normals, lab = faces.smoothed(ROUNDS)
    outward = cut.structure.outward
    steps = step_weights(faces, normals, lab, outward, options)
    label = label_faces(faces, votes, cut.patches.of_face, steps)
    object_of = cut.groups[cut.patches.of_face]
    plane = cut.patches.plane[object_of]
    count = len(votes.words)
    table = np.bincount(object_of * count + label, faces.areas, (int(object_of.max()) + 1) * count)
    table = table.reshape(-1, count)
    whole = table.sum(axis=1)
    table[:, NOTHING] = 0.0
    best = np.where(table.max(axis=1) >= _MAJOR * whole, np.argmax(table, axis=1), NOTHING)
    open_ = (label == NOTHING) & (plane < 0)
    out: Ints = np.where(open_, best[object_of], label)
    label = out
    a, b = faces.pairs.T
    same = (label[a] == label[b]) & (object_of[a] == object_of[b])
    piece = np.unique(connect(len(faces), faces.pairs[same]), return_inverse=True)[1]
    pieces = describe_patches(
        faces, normals, piece, np.full(len(faces), -1, np.int64), outward, options
    )
    first = np.unique(piece, return_index=True)[1]
    upright = np.array([word == "wall" for word in (*cut.structure.labels, "wall")])
    level = (plane[first] >= 0) & ~upright[plane[first]]
    spilt = _find_spilt(pieces, label[first], plane[first], level, options)
    label = np.where(spilt[piece], NOTHING, label)
    group = _group_pieces(pieces, label[first], object_of[first], plane[first], votes.kind, options)
    group, meant = assign_covers(
        group, pieces, label[first], plane[first], votes.words, cut.structure.labels, options
    )
    fixed = (label[first] == NOTHING) & (plane[first] >= 0)
    if votes.kind == "labels":
        group = _gather_fragments(faces, piece, pieces, label[first], group)
    group = absorb_small(group, pieces, fixed, options)
    group = absorb_lost(group, pieces, fixed, faces, options.least)
    return _name_groups(group, label[first], plane[first], votes, cut, piece, meant)


def _find_spilt(
    pieces: PatchGraph, label: Ints, plane: Ints, level: NDArray[np.bool_], options: SegmentOptions
) -> NDArray[np.bool_]:
    """Find pieces (N,) of floor or wall whose label is of a larger thing they touch, or that are small.

    Outlines in label images are rough: what stands before a wall is painted on it in part. `level`
    (N,) are pieces of the floor or a ceiling, where the stains are larger, and pictures none.
    """
    a, b = pieces.ends.T
    beside = (label[a] == label[b]) & (plane[a] >= 0) & (plane[b] < 0) & (label[a] != NOTHING)
    beside &= pieces.areas[a] < _SPILT * pieces.areas[b]
    out = (plane >= 0) & (pieces.areas < np.where(level, options.carpet, options.mark))
    out[a[beside]] = True
    return out


def _group_pieces(
    pieces: PatchGraph,
    label: Ints,
    object_of: Ints,
    plane: Ints,
    kind: str,
    options: SegmentOptions,
) -> Ints:
    if kind == "instances":
        key = np.where(label == NOTHING, -1 - object_of, label)
        _, first, row = np.unique(key, return_index=True, return_inverse=True)
        return first[row]
    a, b = pieces.ends.T
    same = (label[a] == label[b]) & (label[a] != NOTHING)
    same &= (plane[a] == plane[b]) | (plane[a] < 0) | (plane[b] < 0)  # walls stay apart
    group = join_parts(
        pieces, pieces.ends[same], pieces.lengths[same], pieces.concave[same], options
    )
    open_ = np.flatnonzero(label == NOTHING)
    _, first, row = np.unique(object_of[open_], return_index=True, return_inverse=True)
    group[open_] = open_[first[row]]
    return group


def _gather_fragments(
    faces: Faces, piece: Ints, pieces: PatchGraph, label: Ints, group: Ints
) -> Ints:
    """Gather fragments into the larger group nearby that bears their label; groups (N,)."""
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


def _name_groups(
    group: Ints,
    label: Ints,
    plane: Ints,
    votes: Votes,
    cut: Cut,
    piece: Ints,
    meant: dict[int, str],
) -> NamedGroups:
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
    return NamedGroups(group[piece], words, ids)


def assign_covers(
    group: Ints,
    pieces: PatchGraph,
    label: Ints,
    plane: Ints,
    words: Sequence[str],
    planes: Sequence[str],
    options: SegmentOptions,
) -> tuple[Ints, dict[int, str]]:
    """Assign unlabelled pieces of planes to the groups that cover these; groups (N,), and words of groups.

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
    return _join_covers(group, pieces, open_, plane, covers, options), meant


def _join_covers(
    group: Ints,
    pieces: PatchGraph,
    open_: Ints,
    plane: Ints,
    covers: dict[int, list[tuple[int, float, bool]]],
    options: SegmentOptions,
) -> Ints:
    """Join pieces `open_` (K,) to the covers of their planes they touch most.

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
