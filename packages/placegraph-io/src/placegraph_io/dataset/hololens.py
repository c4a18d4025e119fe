"""Recordings of HoloLens 2 by Microsoft's StreamRecorder, unpacked.

`*_pv.txt`: `ox,oy,width,height`, then rows `ticks,fx,fy` and world_from_camera by rows; `PV/` or `rgb/`
hold the images, TICKS.png or .bytes (BGRA). `Depth Long Throw/TICKS.pgm` are distances along rays [mm],
`Depth Long Throw_lut.bin` the rays, `_rig2world.txt` rows of ticks and world_from_rig, `_extrinsics.txt`
depth_from_rig. A tick is 100 ns; world and colour camera have y up. (Microsoft's HoloLens2ForCV.)
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera, Floats
from placegraph.errors import InputError
from placegraph.io.capture.frame import (
    Capture,
    DepthUnit,
    LazyImages,
    check_shape,
    colour_file,
    depth_file,
)
from placegraph.io.capture.images import image_size, list_images
from placegraph.io.capture.posed import (
    ARKIT_FROM_OPENCV,
    MAP_FROM_Y_UP,
    StoredFrame,
    make_camera,
    make_capture,
    match_stamps,
    orthonormalize_pose,
    read_rows,
)
from placegraph_io.ros.decode import Registration

_DEPTH = "Depth Long Throw"
_UNIT, _SECOND = 1000.0, 1e7  # of depth in a metre, and ticks
_TOLERANCE = 0.05  # between an image and depth [s]; both have poses of their own


def is_hololens(path: Path) -> bool:
    """Return whether a folder has `*_pv.txt` and the rays of its depth."""
    return (path / f"{_DEPTH}_lut.bin").is_file() and any(path.glob("*_pv.txt"))


def read_hololens(path: Path) -> Capture:
    """Read a recording: a frame for each depth image, which is registered to the nearest colour image.

    Raises `InputError` where files are missing or broken.
    """
    depths, endings = _list(path / _DEPTH, (".pgm",)), (".png", ".bytes")
    colours = _list(path / "PV", endings) or _list(path / "rgb", endings)
    if not (depths and colours):
        lacking = "PV/*.png or PV/*.bytes" if depths else f"{_DEPTH}/*.pgm"
        raise InputError(f"{path} contains no {lacking}; unpack the recording's .tar files.")
    (head, first), *listed = read_rows(
        next(path.glob("*_pv.txt")), (4, 19), "ticks, fx, fy, world_from_camera"
    )
    if len(first) != 4 or any(len(row) != 19 for _, row in listed):
        raise InputError(
            f"{head}: write `ox, oy, width, height` in the first line, and only there."
        )
    (ox, oy, *size), rows = first, [(w, r) for w, r in listed if r[0] in colours]
    rigs = read_rows(path / f"{_DEPTH}_rig2world.txt", (17,), "ticks, world_from_rig")
    rig_of = {
        ticks: (where, pose) for where, (ticks, *pose) in rigs if pose[-1]
    }  # else not located
    where, extrinsics = read_rows(path / f"{_DEPTH}_extrinsics.txt", (16,), "depth_from_rig")[0]
    rig_from_depth = np.linalg.inv(orthonormalize_pose(extrinsics, where))
    rays, view = _read_rays(path, image_size(next(iter(depths.values()))))
    moments = np.array([row[0] for _, row in rows]) / _SECOND
    near = match_stamps(moments, np.array(list(depths)) / _SECOND, _TOLERANCE).tolist()
    left_out, frames = Counter[str](), []
    for (depth_ticks, file), row in zip(depths.items(), near, strict=True):
        if row < 0 or not rows[row][1][-1] or depth_ticks not in rig_of:
            left_out[f"no {'colour image within 50 ms' if row < 0 else 'pose'}"] += 1
            continue
        where, (ticks, fx, fy, *pose) = rows[row]
        width, height = int(size[0]), int(size[1])
        # x of the published calibration runs to the left
        camera = make_camera(where, (width, height), (fx, fy, width - ox, oy))
        world_from_colour = orthonormalize_pose(pose, where) @ ARKIT_FROM_OPENCV
        rig_where, rig = rig_of[depth_ticks]
        world_from_depth = orthonormalize_pose(rig, rig_where) @ rig_from_depth
        moved = np.asarray(np.linalg.inv(world_from_colour) @ world_from_depth, np.float64)
        image, registration = colours[ticks], Registration(camera, view, rays)
        metres = partial(_register, registration, depth_file(file, view, _UNIT), moved)
        unit = DepthUnit(f"{path / _DEPTH}, written by StreamRecorder's rule", _UNIT)
        read = (
            colour_file(image, camera)
            if image.suffix == ".png"
            else partial(_read_bytes, image, camera)
        )
        frames.append(
            StoredFrame(
                str(image), ticks / _SECOND, MAP_FROM_Y_UP @ world_from_colour, camera,
                LazyImages(read, metres, unit=unit), registration.camera,
            )
        )  # fmt: skip
    return make_capture(path, frames, left_out=left_out)


def _list(folder: Path, endings: tuple[str, ...]) -> dict[float, Path]:
    """Return the files TICKS of a folder by their ticks."""
    return {float(stem): p for stem, p in list_images(folder, endings).items() if stem.isdigit()}


def _read_rays(path: Path, size: tuple[int, int]) -> tuple[Floats, Camera]:
    """Return the unit rays (h, w, 3) of the depth images, and a camera about as sharp."""
    file, (width, height) = path / f"{_DEPTH}_lut.bin", size
    numbers = np.fromfile(file, "<f4")
    if numbers.size != 3 * width * height:
        raise InputError(
            f"{file} has {numbers.size} numbers, but {width} x {height} rays; copy it again."
        )
    rays = numbers.reshape(height, width, 3).astype(np.float64)
    middle = rays[height // 2 - 1 :, width // 2 - 1 :]
    flat = middle[:2, :2, :2] / middle[:2, :2, 2:]
    focal = 1.0 / np.abs((flat[0, 1] - flat[0, 0])[0]), 1.0 / np.abs((flat[1, 0] - flat[0, 0])[1])
    return rays, make_camera(str(file), size, (*focal, 0.5 * width, 0.5 * height))


def _read_bytes(file: Path, camera: Camera) -> NDArray[np.uint8]:
    pixels = np.fromfile(file, np.uint8)
    if pixels.size != 4 * camera.width * camera.height:
        raise InputError(
            f"{file} is not {camera.width} x {camera.height} pixels of BGRA; copy it again."
        )
    image = np.ascontiguousarray(pixels.reshape(camera.height, camera.width, 4)[..., 2::-1])
    check_shape(image, camera, str(file))
    return image


def _register(
    registration: Registration, read: Callable[[], NDArray[np.float32]], moved: Floats
) -> NDArray[np.float32]:
    return registration(read(), moved)
