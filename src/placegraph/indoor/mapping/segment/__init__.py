"""From one unlabelled coloured mesh to objects: by geometry and colour, or by label images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.errors import OptionError
from placegraph.indoor.mapping.segment.faces import Faces
from placegraph.indoor.mapping.segment.geometry import Cut, cut_by_geometry
from placegraph.indoor.mapping.segment.instances import Named, cut_by_labels
from placegraph.indoor.mapping.segment.segments import SegmentOptions, Segments, as_segments
from placegraph.indoor.mapping.segment.votes import Votes, collect
from placegraph.io.capture.frame import Frame

Progress = Callable[[str, int, int], None]


__all__ = ["SegmentOptions", "Segments", "segment"]

_STAGES = ("faces", "planes", "patches", "objects")
_VOTES = "votes"


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

    Parameters
    ----------
    vertices, triangles
        (V, 3) [m, map], z up; (T, 3) rows of vertices.
    colours
        (V, 3) uint8 sRGB; none: the mesh is of one colour.
    frames, poses
        Frames with `labels()`: ids of labels with names, or ids of objects. Others are passed over.
        And (len(frames), 4, 4) map_from_camera [m]; the frames' odometry if not given.
    progress, left_out
        Are told a stage, how much of it is done, and of how much; what could not be used, by reason.

    Raises
    ------
    OptionError
        Arrays do not fit each other, or a triangle refers to vertices that are not there.
    InputError
        An image of a frame cannot be read.

    """
    options = options or SegmentOptions()
    spots, rows, shades = _checked(vertices, triangles, colours)

    tell = partial(_tell, progress)
    tell("faces")
    faces = Faces.of(spots, rows, shades)
    counts = Counter() if left_out is None else left_out
    if lost := int((faces.of_triangle < 0).sum()):
        counts["triangles without area"] += lost
    if not len(faces):
        return as_segments(faces, spots, rows, np.zeros(0, np.int64), {}, None)
    cut = cut_by_geometry(faces, options, tell)
    votes = _votes(faces, frames, poses, progress, counts) if frames else None
    named = _by_geometry(cut) if votes is None else cut_by_labels(faces, cut, votes, options)
    floor = cut.structure.floor
    return as_segments(faces, spots, rows, named.groups, named.labels, floor, named.ids)


def _tell(progress: Progress | None, stage: str) -> None:
    if progress is not None:
        progress(stage, _STAGES.index(stage), len(_STAGES))


def _votes(
    faces: Faces,
    frames: Sequence[Frame],
    poses: ArrayLike | None,
    progress: Progress | None,
    left_out: Counter[str],
) -> Votes | None:
    """What the label images of frames say of faces."""

    def tell(done: int, whole: int) -> None:
        if progress is not None:
            progress(_VOTES, done, whole)

    return collect(faces, frames, _poses(frames, poses), tell, left_out)


def _by_geometry(cut: Cut) -> Named:
    """Objects as geometry has them; the planes of the building alone have labels."""
    planes = enumerate(cut.patches.plane.tolist())
    labels = {g: cut.structure.labels[p] for g, p in planes if p >= 0}
    return Named(cut.groups[cut.patches.of_face], labels, {})


def _poses(frames: Sequence[Frame], poses: ArrayLike | None) -> NDArray[np.float64]:
    """Poses (T, 4, 4) map_from_camera of frames."""
    given = [f.odometry for f in frames] if poses is None else poses
    matrices = np.asarray(given, np.float64)
    if matrices.shape != (len(frames), 4, 4):
        raise OptionError(f"poses: {matrices.shape}; ({len(frames)}, 4, 4) belong, one a frame.")
    return matrices


def _checked(
    vertices: ArrayLike, triangles: ArrayLike, colours: ArrayLike | None
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.uint8]]:
    """Arrays of a mesh in the types that cutting works with."""
    spots, rows = np.asarray(vertices), np.asarray(triangles)
    spots = spots.reshape(-1, 3) if not spots.size else spots
    rows = rows.reshape(-1, 3).astype(np.int64) if not rows.size else rows
    if spots.ndim != 2 or spots.shape[1] != 3 or spots.dtype.kind not in "iuf":
        raise OptionError(f"vertices: {spots.dtype} {spots.shape}; give numbers (V, 3).")
    if rows.ndim != 2 or rows.shape[1] != 3 or rows.dtype.kind not in "iu":
        raise OptionError(f"triangles: {rows.dtype} {rows.shape}; give whole numbers (T, 3).")
    if rows.size and (int(rows.min()) < 0 or int(rows.max()) >= len(spots)):
        raise OptionError(
            f"triangles: vertices {rows.min()} to {rows.max()}, but there are {len(spots)}."
        )
    shades = np.full(spots.shape, 255, np.uint8) if colours is None else np.asarray(colours)
    if shades.shape != spots.shape or shades.dtype != np.uint8:
        raise OptionError(
            f"colours: {shades.dtype} {shades.shape}; {spots.shape} uint8 belong, one a vertex."
        )
    return spots.astype(np.float64), rows.astype(np.int64), shades
