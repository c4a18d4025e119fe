"""Raw data of Polycam, as its developer mode exports it.

`keyframes/` holds `images/`, `cameras/` and, where the app optimized its poses, `corrected_images/`
(undistorted) and `corrected_cameras/`, further `depth/` (PNG of 16 bits [mm]) and `confidence/` (0,
127, 255). A frame's files bear its time in microseconds. `cameras/*.json`: `fx fy cx cy width
height` and `t_00` to `t_23`, by rows: world_from_camera in ARKit's axes, of the image as it is
stored. (README of PolyCam/polyform.)
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
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
    smaller_view,
)

_UNIT = 1000.0


def is_polycam(path: Path) -> bool:
    """Whether a folder is an export, or its `keyframes/`."""
    return (_keyframes(path) / "cameras").is_dir() or (
        _keyframes(path) / "corrected_cameras"
    ).is_dir()


def read_polycam(path: Path) -> Capture:
    """Read an export; the corrected images and poses are used where there are any.

    Raises `InputError` where files are missing or broken, or depth is not of the images' view.
    """
    folder = _keyframes(path)
    corrected = images_of(folder / "corrected_images")
    kind = "corrected_" if corrected and images_of(folder / "corrected_cameras", (".json",)) else ""
    colours = corrected if kind else images_of(folder / "images")
    cameras = images_of(folder / f"{kind}cameras", (".json",))
    depths, sure = images_of(folder / "depth"), images_of(folder / "confidence")
    if not colours:
        raise InputError(f"{folder / 'images'} holds no image; export the raw data again.")
    if not depths:
        raise InputError(
            f"{folder / 'depth'} holds no image; only captures of LiDAR or room mode have depth."
        )
    first = next(iter(depths.values()))
    size, unit = image_size(first), DepthUnit(str(folder / "depth"), _UNIT)
    left_out: Counter[str] = Counter()
    shots = []
    for i, (stem, file) in enumerate(colours.items()):
        if stem not in cameras or stem not in depths:
            left_out[f"no {'camera' if stem not in cameras else 'depth'}"] += 1
            continue
        camera, pose = _read_camera(cameras[stem])
        depth_camera = smaller_view(camera, size, first)
        depth = depth_file(depths[stem], depth_camera, _UNIT, confidence=sure.get(stem))
        shots.append(
            Shot(
                name=str(cameras[stem]),
                stamp=int(stem) / 1e6 if stem.isascii() and stem.isdigit() else float(i),
                pose=pose,
                camera=camera,
                images=LazyImages(colour_file(file, camera), depth, unit=unit),
                depth_camera=depth_camera,
            )
        )
    notes = (
        () if kind else ("Polycam's uncorrected poses and images are used: there are no others.",)
    )
    return capture_of(path, shots, left_out=left_out, notes=notes)


def _keyframes(path: Path) -> Path:
    return path if path.name == "keyframes" else path / "keyframes"


def _read_camera(path: Path) -> tuple[Camera, NDArray[np.float64]]:
    """Intrinsics, and the pose (4, 4) of a frame."""
    content = read_json(path)
    if not isinstance(content, dict):
        raise InputError(f"{path} must be a JSON object with fx, fy, cx, cy and t_00 to t_23.")
    try:
        width, height = (int(number(path, content, name)) for name in ("width", "height"))
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: width and height are whole numbers of pixels.") from error
    intrinsics = [number(path, content, name) for name in ("fx", "fy", "cx", "cy")]
    rows = [number(path, content, f"t_{i}{j}") for i in range(3) for j in range(4)]
    pose = MAP_FROM_Y_UP @ exact_pose(rows, str(path)) @ ARKIT_FROM_OPENCV
    return camera_of(str(path), (width, height), intrinsics), pose
