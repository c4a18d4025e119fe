"""Cutting by labels: label images vote for faces, and labelled faces become objects."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

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
        raise OptionError("frames: some have labels, others instances; give frames of one kind.")
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
    patch = _split_patches(patch, faces.centres)
    count, patches = len(votes.words), int(patch.max()) + 1
    face = np.repeat(np.arange(len(faces)), np.diff(votes.starts))
    total = np.bincount(face, votes.weights, len(faces)) + _DOUBT
    share = votes.weights / total[face]
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


def _split_patches(patch: Ints, centres: Floats) -> Ints:
    """Split the patches (F,) of faces where they cross the borders of cubes; rows (F,) of parts."""
    columns = [patch, *np.floor(centres / _CELL).astype(np.int64).T]
    order = np.lexsort(columns)
    fresh = np.ones(len(patch), np.bool_)
    fresh[1:] = np.any([np.diff(column[order]) != 0 for column in columns], axis=0)
    out = np.empty(len(patch), np.int64)
    out[order] = np.cumsum(fresh) - 1
    return out


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


@dataclass(frozen=True, slots=True, eq=False)
class _Pieces:
    """N pieces of faces that hang together and bear one label, in one object of the cut."""

    graph: PatchGraph
    label: Ints  # (N,) rows of `Votes.words`
    plane: Ints  # (N,) rows of the structure's planes, -1: none
    object_of: Ints  # (N,) groups of the cut without labels

    @property
    def is_named(self) -> NDArray[np.bool_]:
        """(N,) whether a label speaks of a piece."""
        return self.label != NOTHING


def cut_by_labels(faces: Faces, cut: Cut, votes: Votes, options: SegmentOptions) -> NamedGroups:
    """Cut faces into objects by votes; `cut` decides where there are none."""
    normals, lab = faces.smooth(ROUNDS)
    outward = cut.structure.outward
    steps = step_weights(faces, normals, lab, outward, options)
    object_of = cut.groups[cut.patches.of_face]
    plane = cut.patches.plane[object_of]
    label = label_faces(faces, votes, cut.patches.of_face, steps)
    best = _find_main_labels(label, object_of, faces.areas, len(votes.words))
    label = np.where((label == NOTHING) & (plane < 0), best[object_of], label)
    a, b = faces.pairs.T
    same = (label[a] == label[b]) & (object_of[a] == object_of[b])
    piece = np.unique(connect(len(faces), faces.pairs[same]), return_inverse=True)[1]
    graph = describe_patches(
        faces, normals, piece, np.full(len(faces), -1, np.int64), outward, options
    )
    first = np.unique(piece, return_index=True)[1]
    pieces = _Pieces(graph, label[first], plane[first], object_of[first])
    spilt = _find_spilt(pieces, cut.structure.labels, options)
    pieces.label[spilt] = NOTHING
    group = _group_pieces(pieces, votes.kind, options)
    group, words = _assign_covers(group, pieces, votes.words, cut.structure.labels, options)
    fixed = ~pieces.is_named & (pieces.plane >= 0)
    if votes.kind == "labels":
        group = _gather_fragments(faces, pieces, group)
    group = absorb_small(group, graph, fixed, options)
    group = absorb_lost(group, graph, fixed, faces, options.least)
    return _name_groups(group, pieces, votes, cut.structure.labels, words)


def _find_main_labels(label: Ints, object_of: Ints, areas: Floats, count: int) -> Ints:
    """Find the label (N,) that most of an object's area bears, `NOTHING` where none does."""
    shape = int(object_of.max()) + 1, count
    table = np.bincount(object_of * count + label, areas, shape[0] * count).reshape(shape)
    whole = table.sum(axis=1)
    table[:, NOTHING] = 0.0
    return np.where(table.max(axis=1) >= _MAJOR * whole, np.argmax(table, axis=1), NOTHING)


def _find_spilt(
    pieces: _Pieces, planes: Sequence[str], options: SegmentOptions
) -> NDArray[np.bool_]:
    """Find pieces (N,) of floor or wall whose label is of a larger thing they touch, or that are small.

    Outlines in label images are rough: what stands before a wall is painted on it in part. On floors
    and ceilings the stains are larger, and pictures none.
    """
    label, plane, areas = pieces.label, pieces.plane, pieces.graph.areas
    upright = np.array([word == "wall" for word in (*planes, "wall")])
    a, b = pieces.graph.ends.T
    beside = (label[a] == label[b]) & (plane[a] >= 0) & (plane[b] < 0) & pieces.is_named[a]
    beside &= areas[a] < _SPILT * areas[b]
    out = (plane >= 0) & (areas < np.where(upright[plane], options.mark, options.carpet))
    out[a[beside]] = True
    return out


def _group_pieces(pieces: _Pieces, kind: LabelKind, options: SegmentOptions) -> Ints:
    """Group pieces (N,) of one label, and the unlabelled ones as the cut has them."""
    graph, label, plane = pieces.graph, pieces.label, pieces.plane
    if kind == "instances":
        key = np.where(pieces.is_named, label, -1 - pieces.object_of)
        _, first, row = np.unique(key, return_index=True, return_inverse=True)
        return first[row]
    a, b = graph.ends.T
    same = (label[a] == label[b]) & pieces.is_named[a]
    same &= (plane[a] == plane[b]) | (plane[a] < 0) | (plane[b] < 0)  # walls stay apart
    group = join_parts(graph, graph.ends[same], graph.lengths[same], graph.concave[same], options)
    nameless = np.flatnonzero(~pieces.is_named)
    _, first, row = np.unique(pieces.object_of[nameless], return_index=True, return_inverse=True)
    group[nameless] = nameless[first[row]]
    return group


def _gather_fragments(faces: Faces, pieces: _Pieces, group: Ints) -> Ints:
    """Gather fragments into the larger group nearby that bears their label; groups (N,)."""
    label, group_of = pieces.label, group[pieces.graph.of_face]
    areas = np.bincount(group, pieces.graph.areas, len(label))
    samples = Samples.of(
        faces, np.flatnonzero(pieces.is_named[pieces.graph.of_face]), 0.5 * _NEARBY
    )
    a, b = group_of[samples.face[samples.find_touching(group_of, _NEARBY)]].T
    better = (label[a] == label[b]) & (areas[a] < _FRAGMENT)
    better &= (areas[b] > areas[a]) | ((areas[b] == areas[a]) & (b < a))  # never in a circle
    to = np.arange(len(label))
    for fragment in np.unique(a[better]).tolist():
        near = np.unique(b[better & (a == fragment)])
        to[fragment] = near[np.argmax(areas[near])]
    while (to != to[to]).any():
        to = to[to]
    return to[group]


def _name_groups(
    group: Ints, pieces: _Pieces, votes: Votes, planes: Sequence[str], words: dict[int, str]
) -> NamedGroups:
    """Name groups (N,) by their labels, else by `words` of groups, else by their planes."""
    names: dict[int, str] = {}
    ids: dict[int, int] = {}
    for g in np.unique(group).tolist():
        label, plane = int(pieces.label[g]), int(pieces.plane[g])
        if label == NOTHING:
            if plane >= 0:
                names[g] = planes[plane]
            continue
        word = votes.words[label] or words.get(g, "")
        if word:
            names[g] = word
        if votes.kind == "instances":
            ids[g] = votes.ids[label]
    return NamedGroups(group[pieces.graph.of_face], names, ids)


class _Cover(NamedTuple):
    """Group on a plane."""

    group: int
    area: float  # On the plane [m2]
    is_plane: bool  # Whether it is the plane itself, and not something on it


def _assign_covers(
    group: Ints,
    pieces: _Pieces,
    words: Sequence[str],
    planes: Sequence[str],
    options: SegmentOptions,
) -> tuple[Ints, dict[int, str]]:
    """Assign unlabelled pieces of planes to the groups that cover these; groups (N,), and words of groups.

    What no label speaks of on a plane joins what covers that plane and lies beside it, unless this
    has a word of its own: then crumbs alone do. So do they where crumbs are all that is left.
    """
    plane, areas, named = pieces.plane, pieces.graph.areas, pieces.is_named
    kinds = sorted(set(planes))
    kind = np.array([kinds.index(word) for word in planes], np.int64)
    on = np.flatnonzero(named & (plane >= 0))
    count = len(areas)
    whole = np.bincount(group[named], areas[named], count)
    of_kind = np.bincount(
        group[on] * len(kinds) + kind[plane[on]], areas[on], count * len(kinds)
    ).reshape(count, len(kinds))
    keys, row = np.unique(group[on] * len(planes) + plane[on], return_inverse=True)
    area = np.bincount(row, areas[on], len(keys))
    size = np.bincount(plane[plane >= 0], areas[plane >= 0], len(planes))
    g, p = keys // max(len(planes), 1), keys % max(len(planes), 1)
    on_kind = of_kind[g, kind[p]]
    good = (on_kind >= _MAIN * whole[g]) | ((on_kind >= _SOME * whole[g]) & (on_kind >= _VAST))
    good &= area >= np.minimum(_PART * size[p], _LARGE)
    bare = size - np.bincount(p, area, len(planes)) < options.carpet  # crumbs are all that is left
    meant: dict[int, str] = {}
    covers: dict[int, list[_Cover]] = {}
    for i in np.flatnonzero(good | bare[p]).tolist():
        cover, own = int(g[i]), int(p[i])
        word = words[int(pieces.label[cover])]
        if good[i] and not word:
            meant[cover] = planes[own]
        is_plane = bool(good[i]) and (word or planes[own]) == planes[own]
        covers.setdefault(own, []).append(_Cover(cover, float(area[i]), is_plane))
    return _join_covers(group, pieces, covers, options), meant


def _join_covers(
    group: Ints, pieces: _Pieces, covers: dict[int, list[_Cover]], options: SegmentOptions
) -> Ints:
    """Join unlabelled pieces of planes to the covers of their planes they touch most; groups (N,)."""
    graph = pieces.graph
    a, b = graph.ends.T
    order = np.argsort(a, kind="stable")
    starts = np.searchsorted(a[order], np.arange(len(graph) + 1))
    out = group.copy()
    for piece in np.flatnonzero(~pieces.is_named & (pieces.plane >= 0)).tolist():
        area = float(graph.areas[piece])
        near = order[starts[piece] : starts[piece + 1]]
        contact = np.bincount(group[b[near]], graph.lengths[near], len(graph))
        fit = [
            (float(contact[cover.group]), cover.area, -cover.group)
            for cover in covers.get(int(pieces.plane[piece]), [])
            if area < (cover.area if cover.is_plane else options.carpet)
        ]
        best = max(fit, default=(0.0, 0.0, 0))
        if best[0] > 0 or (fit and area < options.carpet):
            out[piece] = -best[2]
    return out
