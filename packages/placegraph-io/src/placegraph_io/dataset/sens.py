"""ScanNet's recordings as captures: a `.sens` file, or the folder that its tools export."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import partial as bound
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import InputError
from placegraph.io.capture.frame import Frame
from placegraph.io.capture.frame_files import (
    DepthUnit,
    LazyImages,
    colour_file,
    depth_file,
    posed_frame,
)
from placegraph.io.capture.frames import Capture
from placegraph.io.capture.images import ENDINGS, image_size
from placegraph_io.dataset.scannet_files import (
    camera_of_matrix,
    is_rigid,
    read_matrix,
    read_meta,
)
from placegraph_io.dataset.scannet_labels import LabelImages, Wanted, find_labels, numbered
from placegraph_io.dataset.sens_file import (
    SensFrame,
    SensHeader,
    read_colour,
    read_depth,
    read_frames,
    read_header,
)

DEPTH_PER_METRE = 1000.0
"""Units of depth in a metre of exported images."""
_RIGID = 1e-2
"""Poses are single precision, and rounded where they are exported."""
_INTRINSICS = ("intrinsic/intrinsic_{}.txt", "intrinsics_{}.txt")
"""Of SensReader, and of ScanNet's own selection of 25,000 frames."""


def is_sens(path: Path) -> bool:
    """Whether a path is a `.sens` file, or a folder with one of its name or with one alone."""
    return _sens_of(path) is not None


def is_scannet_export(path: Path) -> bool:
    """Whether a path is a folder with `color/`, `pose/` and ScanNet's intrinsics."""
    try:
        there = all((path / name).is_dir() for name in ("color", "pose"))
        return there and any((path / name.format("color")).is_file() for name in _INTRINSICS)
    except (OSError, ValueError):
        return False


def _sens_of(path: Path) -> Path | None:
    try:
        if path.is_file():
            return path if path.suffix.lower() == ".sens" else None
        own = path / f"{path.absolute().name}.sens"
        if own.is_file():
            return own
        found = [p for p in path.iterdir() if p.suffix.lower() == ".sens" and p.is_file()]
    except (OSError, ValueError):
        return None
    return found[0] if len(found) == 1 else None


def read_sens(
    path: str | PathLike[str],
    *,
    labels: Wanted = "auto",
    label_column: str | None = None,
    partial: bool = False,
) -> Capture:
    """Open a `.sens` file; its images are read, a frame at a time, when they are asked for.

    Frames without a finite pose were not tracked, and are left out and counted; a frame's `index` is
    its number in the file. Poses are those of ScanNet's reconstruction, in the axes of the scan's
    meshes (z up): `placegraph_io.dataset.scannet_files.axis_alignment` leads from there to the map.
    Colour and depth are taken as of one viewpoint, as ScanNet says they are; extrinsics are not
    applied.

    Parameters
    ----------
    path
        File, or the folder of the scan that it lies in.
    labels
        Which label images beside it to use: `instance-filt/`, `label-filt/`, either, or none.
    label_column
        Column of ScanNet's label table that names labels; `raw_category` if not given.
    partial
        Whether a truncated file is used as far as its frames are whole.

    Raises
    ------
    InputError
        The file is missing, of another version, or truncated, or no frame of it can be used.
    OptionError
        `labels` is none of its values; the table has no such column.

    """
    file = _sens_of(Path(path))
    if file is None:
        raise InputError(f"{path} is no .sens file, nor the folder of one.")
    counts: Counter[str] = Counter()
    header = read_header(file)
    entries = read_frames(header, partial=partial)
    if len(entries) < header.count:
        counts["frames that the truncated file lacks"] = header.count - len(entries)
    camera = camera_of_matrix(f"{file} (colour)", header.colour_intrinsic, header.colour_size)
    depth_camera = camera_of_matrix(f"{file} (depth)", header.depth_intrinsic, header.depth_size)
    notes = []
    if not np.allclose(*header.extrinsics, atol=_RIGID):
        notes.append(
            "The file has extrinsics between colour and depth; they are not applied, since ScanNet's "
            "images are aligned."
        )
    marks = find_labels(file.parent, labels, camera, label_column=label_column)
    used = _tracked(file, entries, counts)
    frames = [
        _frame(header, entry, stamp, camera, depth_camera, marks)
        for entry, stamp in zip(used, _stamps(used, notes), strict=True)
    ]
    return _capture(file, frames, camera, depth_camera, marks, notes, counts)


def _stamps(entries: Sequence[SensFrame], notes: list[str]) -> NDArray[np.float64]:
    """Seconds of frames (T,), or their numbers where seconds do not ascend, which is noted."""
    stamps = np.array([entry.stamp for entry in entries], np.float64) * 1e-6
    if np.any(np.diff(stamps) <= 0):
        notes.append("The file's stamps do not ascend; stamps are numbers of frames instead.")
        stamps = np.array([entry.number for entry in entries], np.float64)
    return stamps


def _tracked(file: Path, entries: Sequence[SensFrame], counts: Counter[str]) -> list[SensFrame]:
    """Entries with a pose and a colour image."""
    used = []
    for entry in entries:
        if not np.isfinite(entry.world_from_camera).all():
            counts["frames without a pose"] += 1
        elif not entry.colour_bytes:
            counts["frames without a colour image"] += 1
        else:
            _check_pose(f"{file}, frame {entry.number}", entry.world_from_camera)
            used.append(entry)
    return used


def _frame(
    header: SensHeader,
    entry: SensFrame,
    stamp: float,
    camera: Camera,
    depth_camera: Camera,
    marks: LabelImages,
) -> Frame:
    images = LazyImages(
        bound(read_colour, header, entry),
        bound(read_depth, header, entry) if entry.depth_bytes else None,
        marks.reader(entry.number),
        DepthUnit(f"the header of {header.path}", header.depth_per_metre),
    )
    return posed_frame(
        entry.number,
        stamp,
        entry.world_from_camera,
        camera,
        images,
        depth_camera=depth_camera,
        label_camera=marks.camera,
        label_kind=marks.kind,
        label_names=marks.names,
    )


def read_scannet_export(
    path: str | PathLike[str], *, labels: Wanted = "auto", label_column: str | None = None
) -> Capture:
    """Open a folder of exported frames: `color/7.jpg`, `depth/7.png`, `pose/7.txt`, intrinsics.

    Intrinsics are `intrinsic/intrinsic_color.txt` and `..._depth.txt` (ScanNet's SensReader), or
    `intrinsics_color.txt` and `intrinsics_depth.txt` (its selection of 25,000 frames). Images made
    smaller need `<scan>.txt` beside, which says what size the intrinsics are of. Depth is in
    millimetres. Stamps are the frames' numbers. Everything else is as in `read_sens`.

    Raises
    ------
    InputError
        A file is missing, unreadable, or not what it should be, or no frame can be used.
    OptionError
        `labels` is none of its values; the table has no such column.

    """
    path = Path(path)
    colours = numbered(path / "color", ENDINGS)
    if not colours:
        raise InputError(f"{path / 'color'} holds no image such as 0.jpg; export the frames again.")
    depths = numbered(path / "depth", (".png",))
    counts: Counter[str] = Counter()
    camera = _exported_camera(path, "color", next(iter(colours.values())))
    depth_camera = _exported_camera(path, "depth", next(iter(depths.values()))) if depths else None
    marks = find_labels(path, labels, camera, label_column=label_column)
    poses = numbered(path / "pose", (".txt",))
    frames = []
    for index, colour in colours.items():
        pose = read_matrix(poses[index]) if index in poses else None
        if pose is None or not np.isfinite(pose).all():
            counts["frames without a pose"] += 1
            continue
        _check_pose(poses[index], pose)
        metres = None
        if depth_camera and index in depths:
            metres = depth_file(depths[index], depth_camera, DEPTH_PER_METRE)
        images = LazyImages(
            colour_file(colour, camera),
            metres,
            marks.reader(index),
            DepthUnit(f"ScanNet's depth images in {path / 'depth'}", DEPTH_PER_METRE),
        )
        frames.append(
            posed_frame(
                index,
                float(index),
                pose,
                camera,
                images,
                depth_camera=depth_camera,
                label_camera=marks.camera,
                label_kind=marks.kind,
                label_names=marks.names,
            )
        )
    return _capture(path, frames, camera, depth_camera, marks, [], counts)


def _exported_camera(path: Path, what: str, image: Path) -> Camera:
    """Camera of the exported images that are like this one."""
    files = [path / name.format(what) for name in _INTRINSICS]
    file = next((f for f in files if f.is_file()), None)
    if file is None:
        raise InputError(f"{files[0]} does not exist; export the intrinsics of {what}/ too.")
    meta: dict[str, str] = {}
    for folder in (path.absolute(), path.absolute().parent):
        meta = meta or read_meta(folder / f"{folder.name}.txt")
    sides = [meta.get(f"{what}{side}", "") for side in ("Width", "Height")]
    said = None
    if all(s.isascii() and s.isdigit() and 0 < int(s[:9]) < 1 << 16 for s in sides):
        said = (int(sides[0]), int(sides[1]))
    return camera_of_matrix(file, read_matrix(file), image_size(image), said)


def _check_pose(name: object, pose: NDArray[np.float64]) -> None:
    if not is_rigid(pose, _RIGID):
        raise InputError(
            f"{name}: the pose is no rigid transform; the file is damaged: get it again."
        )


def _capture(
    path: Path,
    frames: Sequence[Frame],
    camera: Camera,
    depth_camera: Camera | None,
    marks: LabelImages,
    notes: Sequence[str],
    left_out: Counter[str],
) -> Capture:
    if not frames:
        why = ", ".join(f"{count} {what}" for what, count in left_out.items())
        raise InputError(f"{path} holds no frame that can be used ({why}); take another scan.")
    return Capture(
        path=path,
        frames=tuple(frames),
        camera=camera,
        depth_camera=depth_camera,
        label_camera=marks.camera,
        label_kind=None if marks.camera is None else marks.kind,
        label_names=marks.names,
        notes=(*marks.notes, *notes),
        left_out=left_out,
    )
