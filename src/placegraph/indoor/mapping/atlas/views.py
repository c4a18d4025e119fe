"""Which frames colour a surface, and their images as compiled code reads them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.core.threads import processors
from placegraph.indoor.mapping.atlas.view_kernels import Keyframes, around, resampled
from placegraph.indoor.rays import RayCaster
from placegraph.io.capture.frame import Frame

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]


STEP = 0.10
"""Frames nearer than this to each other [m] ..."""
TURN = np.radians(8.0)
"""... and turned less than this are of one place: the sharpest is kept."""
LONGEST = 960
"""Longer images [px] are made smaller: their pixels are finer than texels."""
DEPTH_LONGEST = 320
"""Longest side of the depth against which views are tested [px]."""
LEVELS = 4
UNREAD = 0.05
"""Worth of a view at a pixel without depth, of a frame that has some."""
_WIDER = 1.2  # steps grow by this until few enough frames are left


def keyframes(poses: Floats, most: int) -> list[list[int]]:
    """At most `most` groups of consecutive frames, each taken from nearly one place.

    `poses`: (T, 4, 4) map_from_camera.
    """
    scale = 1.0
    while True:
        groups: list[list[int]] = []
        for i, pose in enumerate(poses):
            if groups:
                first = poses[groups[-1][0]]
                moved = np.linalg.norm(pose[:3, 3] - first[:3, 3])
                cosine = (np.trace(first[:3, :3].T @ pose[:3, :3]) - 1.0) / 2.0
                turned = np.arccos(np.clip(cosine, -1.0, 1.0))
                if moved < scale * STEP and turned < min(scale * TURN, np.pi):
                    groups[-1].append(i)
                    continue
            groups.append([i])
        if len(groups) <= most:
            return groups
        if scale > 1e6:  # frames all over the world: some of them
            picked = np.linspace(0, len(groups) - 1, most).round().astype(int)
            return [groups[i] for i in picked.tolist()]
        scale *= _WIDER


def looked(
    frames: Sequence[Frame],
    poses: Floats,
    groups: Sequence[Sequence[int]],
    caster: RayCaster,
    progress: Callable[[int, int], None] | None,
) -> Keyframes:
    """Views of the sharpest frame of each group, all as pinhole cameras of one size, gains 1."""
    total, done = sum(len(g) for g in groups), 0
    first = _plain(frames[groups[0][0]].camera)

    def view(group: Sequence[int]) -> tuple[int, Bytes, NDArray[np.float32], NDArray[np.float32]]:
        colours = [frames[i].rgb() for i in group]
        best = int(np.argmax([sharpness(c) for c in colours]))
        row, frame = group[best], frames[group[best]]
        depth, sure = _depth(frame, poses[row], caster, first)
        return row, _upright(colours[best], frame.camera, first), around(depth), sure

    found = []
    with ThreadPoolExecutor(processors()) as pool:  # Pillow and kernels work outside the lock
        for group, one in zip(groups, pool.map(view, groups), strict=True):
            found.append(one)
            done += len(group)
            if progress:
                progress(done, total)
    rows, images, depths, trust = (list(column) for column in zip(*found, strict=True))
    map_from_camera = poses[rows]
    pinhole = np.array([first.fx, first.fy, first.cx, first.cy])
    return Keyframes(
        camera_from_map=np.ascontiguousarray(np.linalg.inv(map_from_camera)[:, :3]),
        centres=np.ascontiguousarray(map_from_camera[:, :3, 3]),
        pinholes=np.tile(pinhole, (len(rows), 1)),
        levels=_levels(np.stack(images)),
        bounds=np.stack(depths),
        trust=np.stack(trust),
        gains=np.ones((len(rows), 3), np.float32),
    )


def sharpness(colours: Bytes) -> float:
    """How sharp an image (H, W, 3) is beside others of the same: variance of its Laplacian."""
    grey = colours[:, :, 1].astype(np.float32)
    middle = 4.0 * grey[1:-1, 1:-1]
    around_ = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:]
    laplacian = middle - around_
    return float(laplacian.var()) if laplacian.size else 0.0


def _plain(camera: Camera) -> Camera:
    """The camera without distortion, no larger than `LONGEST`."""
    camera = replace(camera, distortion=(), model="opencv")
    scale = LONGEST / max(camera.width, camera.height)
    if scale >= 1.0:
        return camera
    width, height = (max(1, round(s * scale)) for s in (camera.width, camera.height))
    return camera.resized(width, height)


def _upright(colours: Bytes, camera: Camera, plain: Camera) -> Bytes:
    """Image (h, w, 3) as a camera without distortion would have taken it."""
    if camera == plain:
        return colours
    from PIL import Image

    if camera.width > 1.5 * plain.width:  # averaged first, so that nothing aliases
        size = (plain.width, round(camera.height * plain.width / camera.width))
        colours = np.asarray(Image.fromarray(colours).resize(size, Image.Resampling.BOX))
        camera = camera.resized(*size)
    out = np.empty((plain.height, plain.width, 3), np.uint8)
    resampled(colours, _places(camera, plain), out)
    return out


@lru_cache(maxsize=2)
def _places(camera: Camera, plain: Camera) -> Floats:
    """Where a camera sees what each pixel of another shows (h, w, 2) [px]; NaN: beyond its lens."""
    v, u = np.mgrid[: plain.height, : plain.width] + 0.5
    rays = plain.directions(np.stack([u, v], axis=-1))
    places = camera.project(rays)
    # a strong distortion folds what lies far outside back into the image
    back = camera.directions(places)
    folded = ~(np.abs(back - rays).max(axis=-1) < 0.01)
    places[folded] = np.nan
    return np.ascontiguousarray(places)


def _depth(
    frame: Frame, pose: Floats, caster: RayCaster, plain: Camera
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth (h, w) of the frame, of the mesh where there is none [m]; inf: neither. And its worth.

    Where a frame has depth but a pixel has none, there often is something dark, thin or shiny that
    the mesh does not hold: it would be painted on what lies behind.
    """
    scale = min(1.0, DEPTH_LONGEST / max(plain.width, plain.height))
    width, height = (max(1, round(s * scale)) for s in (plain.width, plain.height))
    small = plain.resized(width, height)
    hits = caster.cast(pose[:3, 3], _rays(small) @ pose[:3, :3].T)  # z is 1: distance is depth
    out = hits.distance.reshape(height, width)
    trust = np.ones((height, width), np.float32)
    read = frame.depth()
    if read is not None and frame.depth_camera is not None:
        row, column, inside = _readings(small, frame.depth_camera)
        measured = np.where(inside, read[row, column], np.nan)
        trust[~np.isfinite(measured)] = UNREAD
        out = np.where(np.isfinite(measured), measured, out)
    return np.ascontiguousarray(out, np.float32), trust


@lru_cache(maxsize=2)
def _rays(camera: Camera) -> Floats:
    """Rays (h * w, 3) through the centres of a camera's pixels, z = 1."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    return camera.directions(np.stack([u, v], axis=-1)).reshape(-1, 3)


@lru_cache(maxsize=2)
def _readings(
    camera: Camera, depth_camera: Camera
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Row, column (h, w) of the reading that each pixel sees, and whether there is one."""
    at = depth_camera.project(_rays(camera)).reshape(camera.height, camera.width, 2)
    x, y = np.moveaxis(at, 2, 0)
    inside = (x > 0) & (x < depth_camera.width) & (y > 0) & (y < depth_camera.height)
    row, column = (np.where(inside, p, 0.0).astype(np.int64) for p in (y, x))
    return row, column, inside


def _levels(images: Bytes) -> tuple[Bytes, ...]:
    """Images (K, H, W, 3) and their halves, quarters, ... as long as they have pixels."""
    out = [np.ascontiguousarray(images)]
    for _ in range(LEVELS - 1):
        h, w = out[-1].shape[1:3]
        if min(h, w) < 4:
            out.append(out[-1])
            continue
        large = out[-1][:, : h // 2 * 2, : w // 2 * 2]
        pairs = large[:, ::2].astype(np.uint16) + large[:, 1::2]
        out.append(((pairs[:, :, ::2] + pairs[:, :, 1::2] + 2) // 4).astype(np.uint8))
    return tuple(out)
