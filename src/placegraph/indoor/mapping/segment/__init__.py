"""Cutting an unlabelled coloured mesh into objects, by geometry and colour or by label images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import Floats
from placegraph.core.options import check_options, option
from placegraph.indoor.mapping.segment.faces import Faces
from placegraph.indoor.mapping.segment.geometry import cut_by_geometry
from placegraph.indoor.mapping.segment.labels import (
    NamedGroups,
    collect_votes,
    cut_by_labels,
)
from placegraph.indoor.mapping.segment.segment_kernels import nearest
from placegraph.io.capture.frame import Frame

Ints = NDArray[np.int64]

UNKNOWN = "unknown"  # Label of what nothing is known of
_FIRST = ("floor", "ceiling", "wall")


@dataclass(frozen=True, slots=True)
class SegmentOptions:
    """Everything that can be set about cutting; defaults serve rooms scanned at 2 to 5 cm."""

    flatness: float = option(
        0.05, "Largest distance of a triangle of floor or wall from its plane.", unit="m", above=0
    )
    wall_area: float = option(1.5, "Minimum area of a wall.", unit="m^2", above=0)
    wall_height: float = option(1.2, "Minimum height of a wall.", unit="m")
    crease: float = option(
        0.6, "Concave angle between neighbours that counts as a full step.", unit="rad", above=0
    )
    contrast: float = option(
        25.0,
        "Colour difference of neighbours that counts as a full step.",
        unit="CIE76 Delta E",
        above=0,
    )
    patch: float = option(
        0.02,
        "Area above which a smooth patch is not merged across half a step.",
        unit="m^2",
        above=0,
    )
    gap: float = option(
        0.03, "Maximum distance of touching parts without a common edge.", unit="m", above=0
    )
    support: float = option(
        0.12, "Minimum area of a level surface that supports separate objects.", unit="m^2", above=0
    )
    thin: float = option(
        0.5,
        "Minimum contact length for merging two parts, as a share of the square root of the "
        "smaller one's area.",
    )
    mark: float = option(
        0.05, "Minimum area of objects on a wall that differ only in colour.", unit="m^2"
    )
    carpet: float = option(
        0.5, "Minimum area of objects on the floor that differ only in colour.", unit="m^2"
    )
    least: float = option(
        0.02, "Minimum area of an object; smaller parts join a neighbour.", unit="m^2"
    )

    def __post_init__(self) -> None:
        check_options(self)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Segments:
    """N objects of a mesh of T triangles; every triangle belongs to one, every object has one."""

    object_of: NDArray[np.int32]
    """(T,) int32, rows of objects."""
    labels: tuple[str, ...]
    """(N,) "floor", "ceiling", "wall", what label images say, else "unknown"."""
    names: tuple[str, ...]
    """(N,) "floor", "wall 2", "object 3", "chair 1": no two alike."""
    floor: float | None
    """Height of the floor [m]; None where the mesh shows none."""
    ids: tuple[str, ...]
    """(N,) for the map: those of instance images, and numbers that are free for all else."""

    def __len__(self) -> int:
        return len(self.labels)

    def __repr__(self) -> str:
        return f"Segments({len(self)} objects, {len(self.object_of):,} triangles)"


def make_segments(
    faces: Faces,
    vertices: Floats,
    triangles: Ints,
    group: Ints,
    labels: Mapping[int, str],
    floor: float | None,
    ids: Mapping[int, int] | None = None,
) -> Segments:
    """Make segments of groups (F,) of faces, and of the triangles that are no faces.

    `labels` and `ids` of groups are those known. Floor, ceiling and walls come first, then the
    largest.
    """
    groups, row = np.unique(group, return_inverse=True)
    areas = np.bincount(row, faces.areas, len(groups))
    words = [labels.get(g, UNKNOWN) for g in groups.tolist()]
    rank = [_FIRST.index(word) if word in _FIRST else len(_FIRST) for word in words]
    order = np.lexsort((groups, -areas, np.array(rank))) if len(groups) else np.zeros(0, np.int64)
    place = np.empty(len(groups), np.int64)
    place[order] = np.arange(len(groups))
    object_of = _assign_triangles(faces, vertices, triangles, place[row])
    listed = tuple(words[i] for i in order.tolist())
    if not len(groups) and len(triangles):
        listed = (UNKNOWN,)  # nothing but lines and points
    known_ids = [(ids or {}).get(g) for g in groups[order].tolist()] or [None] * len(listed)
    return Segments(
        object_of.astype(np.int32), listed, _make_names(listed), floor, _make_ids(known_ids)
    )


def _assign_triangles(faces: Faces, vertices: Floats, triangles: Ints, of_face: Ints) -> Ints:
    """Assign each triangle (T,) to an object: one without area to that of the nearest face."""
    out = np.zeros(len(triangles), np.int64)
    known_ids = faces.of_triangle >= 0
    out[known_ids] = of_face[faces.of_triangle[known_ids]]
    strays = np.flatnonzero(~known_ids)
    if len(of_face) and strays.size:
        corners = vertices[triangles[strays]]
        finite = np.isfinite(corners).all(axis=2, keepdims=True)
        middle = np.where(finite, corners, 0.0).sum(axis=1) / np.maximum(finite.sum(axis=1), 1)
        # by corners: a sliver may touch a face whose centre is far
        own = np.repeat(of_face, 3)
        spots, first = np.unique(faces.corners.ravel(), return_index=True)
        out[strays] = own[first[nearest(middle, faces.points[spots])]]
    return out


def _make_names(labels: Sequence[str]) -> tuple[str, ...]:
    """Name objects by their label, and a number where there are several."""
    words = ["object" if label == UNKNOWN else label for label in labels]
    total = {word: words.count(word) for word in set(words)}
    seen: dict[str, int] = {}
    taken: set[str] = set()
    names = []
    for word in words:
        name = word if total[word] == 1 and word != "object" else ""
        while not name or name in taken:
            seen[word] = seen.get(word, 0) + 1
            name = f"{word} {seen[word]}"
        taken.add(name)
        names.append(name)
    return tuple(names)


def _make_ids(known_ids: Sequence[int | None]) -> tuple[str, ...]:
    taken = {i for i in known_ids if i is not None}
    free = (i for i in range(len(known_ids) + len(taken)) if i not in taken)
    return tuple(str(next(free) if i is None else i) for i in known_ids)


Progress = Callable[[str, int, int], None]

_STAGES = ("faces", "planes", "patches", "objects")


def segment(
    vertices: ArrayLike,
    triangles: ArrayLike,
    colours: ArrayLike | None = None,
    *,
    frames: Sequence[Frame] | None = None,
    poses: ArrayLike | None = None,
    options: SegmentOptions | None = None,
    progress: Progress | None = None,
    left_out: Counter[str] | None = None,
) -> Segments:
    """Cut a mesh into floor, ceiling, walls and objects, along edges of its triangles.

    By geometry and colour: large planes are the building, and the rest falls into objects where it
    bends inwards, changes colour or leaves a gap. Where frames with label images are given, they
    vote: connected regions of one label become objects, and what no label speaks of stays as
    geometry has it. The same mesh and frames give the same objects, in whatever order the
    triangles come.

    Raises `OptionError`: some frames hold labels, others instances; `InputError`: an image of a
    frame cannot be read.

    `vertices`, `triangles`: (V, 3) [m, map], z up; (T, 3) rows of vertices.
    `colours`: (V, 3) uint8 sRGB; none: the mesh is of one colour.
    `frames`, `poses`: frames with `labels()`: ids of labels with names, or ids of objects. Others
        are passed over. And (len(frames), 4, 4) map_from_camera [m]; the frames' odometry if not
        given.
    `progress`, `left_out`: are told a stage, how much of it is done, and of how much; what could
        not be used, by reason.
    """
    options = options or SegmentOptions()
    spots = np.asarray(vertices, np.float64).reshape(-1, 3)
    rows = np.asarray(triangles, np.int64).reshape(-1, 3)
    shades = np.full(spots.shape, 255, np.uint8) if colours is None else np.asarray(colours)

    def tell(stage: str) -> None:
        if progress is not None:
            progress(stage, _STAGES.index(stage), len(_STAGES))

    tell("faces")
    faces = Faces.of(spots, rows, shades)
    counts = Counter() if left_out is None else left_out
    if lost := int((faces.of_triangle < 0).sum()):
        counts["triangles without area"] += lost
    if not len(faces):
        return make_segments(faces, spots, rows, np.zeros(0, np.int64), {}, None)
    cut = cut_by_geometry(faces, options, tell)
    votes = None
    if frames:
        given = np.array([f.odometry for f in frames] if poses is None else poses, np.float64)
        told = None if progress is None else partial(progress, "votes")
        votes = collect_votes(faces, frames, given, told, counts)
    if votes is not None:
        named = cut_by_labels(faces, cut, votes, options)
    else:  # the planes of the building alone have labels
        planes = enumerate(cut.patches.plane.tolist())
        labels = {g: cut.structure.labels[p] for g, p in planes if p >= 0}
        named = NamedGroups(cut.groups[cut.patches.of_face], labels, {})
    floor = cut.structure.floor
    return make_segments(faces, spots, rows, named.groups, named.labels, floor, named.ids)
