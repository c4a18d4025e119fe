"""Captures of 3D Scanner App ("export all data"), recorded by ARKit.

For every frame N: `frame_N.json` with `cameraPoseARFrame` (16 numbers by rows, world_from_camera in
ARKit's axes, of the image as it is stored), `intrinsics` (9 by rows [px of the image]) and `time`;
`depth_N.png` (16 bits [mm]) and `conf_N.png` (0 to 2). Only some have a `frame_N.jpg`.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from placegraph.errors import InputError
from placegraph.io.capture.camera import read_json
from placegraph.io.capture.frame_files import DepthUnit, LazyImages, colour_file, depth_file
from placegraph.io.capture.frames import Capture
from placegraph.io.capture.images import image_size, images_of
from placegraph.io.capture.posed import (
    ARKIT_FROM_OPENCV,
    MAP_FROM_Y_UP,
    Shot,
    camera_of,
    capture_of,
    exact_pose,
    number,
    numbers,
    smaller_view,
)

_UNIT = 1000.0
_OFF_CENTRE = 0.15  # principal points lie nearer to the middle than this share of the width


def is_arkit_app(path: Path) -> bool:
    """Whether a folder holds a `frame_N.json`."""
    return path.is_dir() and next(path.glob("frame_[0-9]*.json"), None) is not None


def read_arkit_app(path: Path) -> Capture:
    """Read an export.

    Raises `InputError` where files are missing or broken, intrinsics are those of images of another
    size, or depth is not of the images' view.
    """
    images = images_of(path)
    left_out: Counter[str] = Counter()
    named = []
    for stem in images_of(path, (".json",)):
        row = stem.removeprefix("frame_")
        if row == stem or not (row.isascii() and row.isdigit()):
            continue  # info.json and the like
        lacking = [name for name in (stem, f"depth_{row}") if name not in images]
        if lacking:
            left_out["no colour image" if stem in lacking else "no depth"] += 1
        else:
            named.append(row)
    if not named:
        raise InputError(
            f"{path} has no frame with frame_*.json, frame_*.jpg and depth_*.png; export all data, "
            "recorded by a device with LiDAR."
        )
    first = images[f"frame_{named[0]}"], images[f"depth_{named[0]}"]
    return capture_of(path, (_shot(path, images, row, first) for row in named), left_out=left_out)


def _shot(path: Path, images: dict[str, Path], row: str, first: tuple[Path, Path]) -> Shot:
    """Frame of a number; `first` are the colour and the depth image whose sizes all have."""
    file = path / f"frame_{row}.json"
    content = read_json(file)
    if not isinstance(content, dict):
        raise InputError(f"{file} must be a JSON object with cameraPoseARFrame and intrinsics.")
    fx, _, cx, _, fy, cy, *_ = numbers(file, content, "intrinsics", 9)
    width, height = image_size(first[0])
    if not max(abs(cx / width - 0.5), abs(cy / height - 0.5)) < _OFF_CENTRE:
        raise InputError(
            f"{file}: the principal point {cx:g}, {cy:g} is not the middle of {first[0].name}, "
            f"{width} x {height}; the images were made smaller or turned: export them again."
        )
    camera = camera_of(f"{file}: intrinsics", (width, height), (fx, fy, cx, cy))
    depth, sure = images[f"depth_{row}"], images.get(f"conf_{row}")
    depth_camera = smaller_view(camera, image_size(first[1]), first[1])
    pose = exact_pose(numbers(file, content, "cameraPoseARFrame", 16), f"{file}: cameraPoseARFrame")
    return Shot(
        name=str(file),
        stamp=number(file, content, "time") if "time" in content else float(int(row)),
        pose=MAP_FROM_Y_UP @ pose @ ARKIT_FROM_OPENCV,
        camera=camera,
        images=LazyImages(
            colour_file(images[f"frame_{row}"], camera),
            depth_file(depth, depth_camera, _UNIT, confidence=sure),
            unit=DepthUnit(f"{path / 'depth_*.png'}", _UNIT),
        ),
        depth_camera=depth_camera,
    )
