"""Sequences of the TUM RGB-D benchmark, and what is recorded in its layout.

`rgb.txt`, `depth.txt`: rows `stamp file`; depth in 1/5000 m. `groundtruth.txt`: rows `stamp tx ty
tz qx qy qz qw`, world_from_camera, z up, camera axes as OpenCV's, interpolated. Stamps are associated
within 20 ms. `accelerometer.txt` is left alone: its axes are not the camera's, and written nowhere.
"""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import numpy as np

from placegraph.core.geometry import Camera
from placegraph.errors import InputError
from placegraph.io.capture.frame import Capture, DepthUnit, LazyImages, colour_file, depth_file
from placegraph.io.capture.json_files import read_camera
from placegraph.io.capture.posed import (
    SAME_MOMENT,
    StoredFrame,
    interpolate_poses,
    make_capture,
    match_stamps,
    read_text,
)
from placegraph.io.capture.tum import read_tum

PER_METRE = 5000.0  # Units of depth in a metre
_DISTORTION = {
    1: (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    2: (0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    3: (),
}
# published for pixels whose centre is a whole number: half a pixel less than ours
CAMERAS = {
    n: Camera(640, 480, fx, fy, cx + 0.5, cy + 0.5, _DISTORTION[n])
    for n, (fx, fy, cx, cy) in {
        1: (517.306408, 516.469215, 318.643040, 255.313989),
        2: (520.908620, 521.007327, 325.141442, 249.701764),
        3: (535.433105, 539.212524, 320.106653, 247.632132),
    }.items()
}
"""Calibrations of the colour cameras freiburg1, freiburg2 and freiburg3, to which depth is
registered."""


def is_tum_rgbd(path: Path) -> bool:
    """Return whether a folder has `rgb.txt` and `depth.txt`."""
    return (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()


def read_tum_rgbd(path: Path, *, poses: Path | None = None) -> Capture:
    """Read a sequence; `poses` is a trajectory of the same clock, `groundtruth.txt` if not given.

    Intrinsics and the scale of depth are those of `camera.json` where the folder has one, else the
    published ones of the camera that the folder's name tells. Raises `InputError` where neither
    says, a list or file is missing or broken, or no stamps fit.
    """
    trajectory = read_tum(poses or _find_ground_truth(path))
    camera, depth_camera, per_metre, unit_source = _cameras(path)
    colours, depths = _read_list(path, "rgb.txt"), _read_list(path, "depth.txt")
    stamps = [stamp for stamp, _ in colours]
    depth_of = match_stamps([stamp for stamp, _ in depths], stamps, SAME_MOMENT)
    lost = match_stamps(trajectory.stamps, stamps, SAME_MOMENT) < 0
    known = interpolate_poses(trajectory.stamps, trajectory.poses, stamps)
    if poses and len(trajectory) == len(colours):
        known, lost = trajectory.poses, np.zeros(len(colours), bool)
    left_out: Counter[str] = Counter()
    frames = []
    unit = DepthUnit(unit_source, per_metre)
    for i, (stamp, file) in enumerate(colours):
        if depth_of[i] < 0 or lost[i]:
            left_out[f"no {'depth' if depth_of[i] < 0 else 'pose'} within 20 ms"] += 1
            continue
        depth = depth_file(depths[depth_of[i]][1], depth_camera, per_metre)
        frames.append(
            StoredFrame(
                name=f"rgb.txt, {file.name}",
                stamp=stamp,
                pose=known[i],
                camera=camera,
                images=LazyImages(colour_file(file, camera), depth, unit=unit),
                depth_camera=depth_camera,
            )
        )
    notes = (
        ()
        if poses
        else ((f"The poses are those of {path / 'groundtruth.txt'}, the ground truth."),)
    )
    return make_capture(path, frames, left_out=left_out, notes=notes)


def _find_ground_truth(path: Path) -> Path:
    file = path / "groundtruth.txt"
    if not file.is_file():
        raise InputError(
            f"{file} does not exist; give a trajectory as poses: a TUM file of any odometry or "
            "SLAM, with z up."
        )
    return file


def _cameras(path: Path) -> tuple[Camera, Camera, float, str]:
    """Return the camera of colour and of depth, units of depth in a metre, and the source of that."""
    file = path / "camera.json"
    if file.is_file():
        content = read_camera(file, depth_scale=PER_METRE)
        return content.camera, content.depth, content.depth_scale, f"`depth.scale` in {file}"
    names = (path.resolve().name, path.resolve().parent.name)
    found = [m for m in (re.search(r"(?:freiburg|fr)([123])(?![0-9])", n) for n in names) if m]
    if not found:
        raise InputError(
            f"{file} does not exist, and the name {path.name!r} contains none of freiburg1, "
            "freiburg2 and freiburg3, so the camera is unknown; write camera.json with width, "
            "height, fx, fy, cx, cy."
        )
    camera = CAMERAS[int(found[0][1])]
    return camera, camera, PER_METRE, f"{path / 'depth'}, written by the benchmark's rule"


def _read_list(path: Path, name: str) -> list[tuple[float, Path]]:
    """Return the stamps and files of a list, whose rows are `stamp file`."""
    rows = []
    for number, line in enumerate(read_text(path / name).splitlines(), 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            stamp, file = float(words[0]), " ".join(words[1:])
        except ValueError:
            stamp, file = np.nan, ""
        if not (np.isfinite(stamp) and file):
            raise InputError(f"{path / name}, line {number}: a row must be `stamp file`.")
        rows.append((stamp, path / file))
    if not rows:
        raise InputError(f"{path / name} lists no image; write rows `stamp file`.")
    return rows
