"""A scene map's source from an RGB-D capture: fused, cut into objects, coloured by its frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geo import Anchor
from placegraph.errors import InputError, OptionError
from placegraph.indoor.encode.networks import Segmenter
from placegraph.indoor.map.floor import find_floor_height
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.scene import Landmarks, Scene
from placegraph.indoor.map.scene_file import MAX_VIEWPOINTS
from placegraph.io.capture.capture import load_capture
from placegraph.io.mesh.model import Model, ModelObject, Texture

if TYPE_CHECKING:
    from placegraph.indoor.mapping.atlas.bake import ColourOf
    from placegraph.indoor.mapping.fuse import FusedSurface, FuseStats
    from placegraph.indoor.mapping.segment import Segments

Progress = Callable[[str, int, int], None]
"""Is told a stage, how much of it is done, and of how much."""
UNKNOWN = "unknown"  # Label of what nobody named
_LOWEST = 0.005  # Share of the surface that may lie below a floor that nobody saw


@dataclass(frozen=True, slots=True)
class FromCapture:
    """Options of making a mesh from a capture."""

    frames: slice = field(default_factory=lambda: slice(None))
    """Which of its frames, such as slice(0, 186)."""
    poses: str | PathLike[str] | None = None
    """'odometry', 'trajectory' or a TUM file, as of `open_capture`; None: trajectory.tum where there
    is one, else what the recorder has."""
    voxel: float = 0.03
    """Edge of a voxel of the fused volume [m]."""
    reach: float = 7.5
    """Greatest depth that is used [m]."""
    segmenter: Segmenter | None = None
    """Labels images that bring no labels; see `placegraph.indoor.encode.networks`."""
    landmarks: bool = False
    """Keep local features on its surfaces, at most 0.8 MB; needs the extra `sift`."""


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """Model, with the colours, landmarks and viewpoints that its capture gave."""

    model: Model
    colour_of: ColourOf | None = None  # Colours of its surface, sharper than those of its vertices
    notes: tuple[str, ...] = ()  # What was found out or taken for granted, in sentences
    finish: Callable[[Model], Source] | None = None
    """Remaining step, called when the model is in metres and upright."""
    landmarks: Landmarks | None = None  # Points that its frames show again and again
    viewpoints: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    """(V, 3) where its frames were taken from, thinned [m]."""
    anchors: tuple[Anchor, ...] = ()
    """Anchors on Earth that the source gives; the map then keeps the source's axes."""
    measure: Callable[[Scene], NDArray[np.float64]] | None = None
    """Measures the agreement (9,) of its frames with the finished scene (`Scene.own_agreement`)."""


def read_capture(
    path: Path,
    how: FromCapture,
    left_out: Counter[str],
    progress: Progress | None = None,
    *,
    reader: Mapping[str, Any] | None = None,
) -> Source:
    """Read a model of RGB-D frames: fused, and cut into objects by labels or geometry and colour.

    `reader`: options of the recorder's own reader, such as `scale` and `up` of COLMAP. Raises
    `InputError` where the capture has no depth.
    """
    from placegraph.indoor.mapping.atlas.colours import SharpestViews, frame_colours
    from placegraph.indoor.mapping.fuse import fuse
    from placegraph.indoor.mapping.landmarks import map_landmarks
    from placegraph.indoor.mapping.own_agreement import measure_own_agreement
    from placegraph.indoor.mapping.segment import segment

    has_trajectory = how.poses is None and (path / "trajectory.tum").exists()
    poses_of = "trajectory" if has_trajectory else how.poses
    capture = load_capture(path, {"poses": poses_of, **(reader or {})})[how.frames]
    if not len(capture):
        raise OptionError(f"frames: {path} has no frame in {_format_slice(how.frames)}.")
    if capture.depth_camera is None:
        raise InputError(
            f"{path} has no depth images, which a map needs; record depth, or build from a mesh."
        )
    left_out.update(capture.left_out)
    poses = np.array([f.odometry for f in capture.frames])
    sharpest = SharpestViews(capture.frames, poses)
    try:
        fused = fuse(
            capture.frames, voxel=how.voxel, reach=how.reach, watch=sharpest.add,
            progress=_report_stage(progress, "fusing"), left_out=left_out,
        )  # fmt: skip
    except InputError as error:
        where = "" if str(path) in str(error) else f"{path}: "
        raise InputError(f"{where}{error}") from error
    if how.segmenter is not None:
        from placegraph.indoor.encode.networks import label_capture

        capture = label_capture(capture, how.segmenter)
    with ThreadPoolExecutor(1) as pool:  # both need the surface alone
        seen = sharpest.views, fused.vertices, fused.triangles
        colouring = pool.submit(frame_colours, *seen) if seen[0] else None
        segments = segment(
            fused.vertices, fused.triangles, fused.colours,
            frames=None if capture.label_camera is None else capture.frames,
            progress=progress, left_out=left_out,
        )  # fmt: skip
        colour_of = colouring.result() if colouring else None
    floor, guessed = _find_floor(path, fused, segments)
    model = Model(
        path=path, objects=make_things(segments), vertices=fused.vertices, triangles=fused.triangles,
        object_of=segments.object_of.astype(np.int64), colours=fused.colours,
        uv=np.zeros((len(fused.vertices), 2)),
        picture_of=np.zeros(len(fused.triangles), np.int64), pictures=(Texture(None),),
        floor=floor,
    )  # fmt: skip
    landmarks = None
    if how.landmarks:
        coloured = [f for f in capture.frames if f.has_colour]
        looks = np.array([f.odometry for f in coloured])
        landmarks = map_landmarks(coloured, looks, _report_stage(progress, "landmarks"))
    notes = _write_notes(path, has_trajectory, fused.stats, segments.labels)
    measure = partial(measure_own_agreement, frames=capture.frames, poses=poses)
    return Source(
        model, colour_of, (*capture.notes, *notes, *guessed), landmarks=landmarks,
        viewpoints=thin_points(poses[:, :3, 3]), measure=measure,
    )  # fmt: skip


def thin_points(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Thin points (N, 3) [m] to at most `MAX_VIEWPOINTS`, one in each cube."""
    edge, points = 0.25, np.round(points, 2)  # to a centimetre, as a map file holds them
    while True:
        _, first = np.unique(np.floor(points / edge), axis=0, return_index=True)
        if len(first) <= MAX_VIEWPOINTS:
            return np.asarray(points[np.sort(first)])
        edge *= 1.25


def _find_floor(
    path: Path, fused: FusedSurface, segments: Segments
) -> tuple[float, tuple[str, ...]]:
    """Find the height of the floor [m]; also a note where cameras saw none of it."""
    if segments.floor is not None:
        return segments.floor, ()
    mesh = Mesh.plain(fused.vertices, fused.triangles, segments.object_of)
    height = find_floor_height(mesh, segments.labels)
    if height is not None:
        return height, ()
    lowest = float(np.quantile(fused.vertices[:, 2], _LOWEST))
    said = (
        f"{path}: no floor was found, so it is assumed at the lower end of the surface, z = "
        f"{lowest:.2f} m"
    )
    return lowest, (f"{said}; give its height if you know it (floor=0.0, or --floor 0).",)


def make_things(segments: Segments) -> tuple[ModelObject, ...]:
    """Make the model's objects from segments."""
    return tuple(map(ModelObject, segments.ids, segments.labels, segments.names))


def _write_notes(
    path: Path, has_trajectory: bool, stats: FuseStats, labels: tuple[str, ...]
) -> list[str]:
    rate = stats.frames / max(stats.seconds, 1e-9)
    apart = 100 * stats.agreement
    notes = [f"{stats.frames} frames fused, {rate:.0f} a second."]
    notes.append(f"The depth readings lie within {apart:.1f} cm of the surface (median).")
    if has_trajectory:
        notes.append(f"The poses are those of {path / 'trajectory.tum'}.")
    if stats.coarser:
        notes.append(stats.coarser)
    known = sum(label != UNKNOWN for label in labels)
    notes.append(
        f"The mesh was segmented into {len(labels)} objects, {known} of them with a label."
    )
    return notes


def _report_stage(progress: Progress | None, stage: str) -> Callable[[int, int], None] | None:
    return None if progress is None else lambda done, total: progress(stage, done, total)


def _format_slice(frames: slice) -> str:
    parts = [frames.start, frames.stop, *([frames.step] if frames.step else [])]
    return ":".join("" if part is None else str(part) for part in parts)
