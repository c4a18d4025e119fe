"""What a frame of known pose shows, beside what the map says it should: pixel by pixel.

Each pixel's ray is cast twice: at the first surface of the map, and at the first surface behind it
of another object. What is seen can then be held against "it is still there" and "it is gone".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera, Floats
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.change.capture.capture_kernels import paint
from placegraph.indoor.render import camera_rays
from placegraph.io.capture.frame import Frame

WIDTH = 320
"""Pictures are compared at most this wide [px]."""
_LAYERS = 12  # surfaces of one object behind each other that are looked through
_STEP = 1e-4  # beyond a hit the next ray starts this far on [m]


class Layer(NamedTuple):
    """What rays hit. H rows, W columns."""

    depth: NDArray[np.float32]
    """(H, W) along the optical axis [m]; inf: nothing."""
    objects: NDArray[np.int32]
    """(H, W) rows of objects; -1: nothing."""
    colour: NDArray[np.float32]
    """(H, W, 3) sRGB, 0 to 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """One frame beside the map."""

    index: int
    """Of the frame."""
    camera: Camera
    map_from_camera: Floats
    """(4, 4)"""
    depth: NDArray[np.float32] | None
    """(H, W) [m], NaN: no reading."""
    rgb: NDArray[np.float32]
    """(H, W, 3) sRGB, 0 to 1."""
    front: Layer
    """What the map has there."""
    behind: Layer
    """What the map has behind the object in front."""

    @property
    def rays(self) -> NDArray[np.float32]:
        """(H, W, 3) in map axes; as long as the way along them for a metre of depth."""
        flat = camera_rays(self.camera)
        ahead = np.concatenate([flat, np.ones((*flat.shape[:2], 1), np.float32)], axis=-1)
        turned: NDArray[np.float32] = ahead @ self.map_from_camera[:3, :3].T.astype(np.float32)
        return turned

    def points(self, mask: NDArray[np.bool_]) -> Floats:
        """(N, 3) points [m, map] that the depth shows at the pixels of a mask."""
        if self.depth is None:
            return np.zeros((0, 3))
        along = self.rays[mask].astype(np.float64) * self.depth[mask][:, None]
        return np.asarray(along + self.map_from_camera[:3, 3])


def look(scene: Scene, frame: Frame, map_from_camera: Floats) -> Look:
    """Frame beside the map; raises `InputError` where an image is broken."""
    depth = frame.depth()
    camera = (frame.depth_camera or frame.camera) if depth is not None else frame.camera
    if camera.width > WIDTH:
        factor = -(-camera.width // WIDTH)
        camera = camera.resized(-(-camera.width // factor), -(-camera.height // factor))
        if depth is not None:
            depth = _picked(depth, camera)
    rgb = _colours(frame, camera)
    return seen(scene, frame.index, camera, map_from_camera, depth, rgb)


def seen(
    scene: Scene,
    index: int,
    camera: Camera,
    map_from_camera: Floats,
    depth: NDArray[np.float32] | None,
    rgb: NDArray[np.float32],
) -> Look:
    """Pictures beside the map."""
    bare = Layer(np.zeros(0, np.float32), np.zeros(0, np.int32), np.zeros(0, np.float32))
    empty = Look(index, camera, map_from_camera, depth, rgb, bare, bare)
    rays = empty.rays.reshape(-1, 3)
    origin = map_from_camera[:3, 3].astype(np.float32)
    hits = scene.caster.cast(np.broadcast_to(origin, rays.shape), rays)
    front = _layer(scene, camera, hits.triangle, hits.distance, hits.u, hits.v)
    triangle, distance = hits.triangle.copy(), hits.distance.copy()
    u, v = hits.u.copy(), hits.v.copy()
    own = front.objects.ravel()
    lengths = np.linalg.norm(rays, axis=1)
    open_ = np.flatnonzero(own >= 0)
    for _ in range(_LAYERS):
        if not open_.size:
            break
        begin = distance[open_] + _STEP / lengths[open_]
        again = scene.caster.cast(origin + rays[open_] * begin[:, None], rays[open_])
        triangle[open_], distance[open_] = again.triangle, begin + again.distance
        u[open_], v[open_] = again.u, again.v
        same = scene.mesh.object_of[np.maximum(again.triangle, 0)] == own[open_]
        open_ = open_[same & (again.triangle >= 0)]
    triangle[open_] = -1  # deeper than we look: nothing is known to be behind
    distance[open_] = np.inf
    behind = _layer(scene, camera, triangle, distance, u, v)
    return Look(index, camera, map_from_camera, depth, rgb, front, behind)


def _layer(
    scene: Scene,
    camera: Camera,
    triangle: NDArray[np.int32],
    distance: NDArray[np.float32],
    u: NDArray[np.float32],
    v: NDArray[np.float32],
) -> Layer:
    shape = camera.height, camera.width
    footprint = (distance / np.float32(camera.fx)).astype(np.float32)
    colour = np.zeros((len(triangle), 3), np.float32)
    paint(scene.surface, triangle, u, v, footprint, colour)
    objects = np.where(triangle >= 0, scene.mesh.object_of[np.maximum(triangle, 0)], -1)
    return Layer(
        distance.reshape(shape), objects.astype(np.int32).reshape(shape), colour.reshape(*shape, 3)
    )


def _picked(depth: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
    """Depth (h, w) at the centres of another camera's pixels: readings are never mixed."""
    h, w = depth.shape
    y = ((np.arange(camera.height) + 0.5) * h / camera.height).astype(int)
    x = ((np.arange(camera.width) + 0.5) * w / camera.width).astype(int)
    return depth[y[:, None], x]


def _colours(frame: Frame, camera: Camera) -> NDArray[np.float32]:
    """Image (H, W, 3), 0 to 1, as `camera` at the same place would take it."""
    from PIL import Image

    rgb, own = frame.rgb(), frame.camera
    if own.resized(camera.width, camera.height) == camera:
        size = camera.width, camera.height
        picture = Image.fromarray(rgb).resize(size, Image.Resampling.BOX)
        return np.asarray(picture, np.float32) / 255.0
    uv = own.project(
        np.concatenate([camera_rays(camera), np.ones((camera.height, camera.width, 1))], axis=-1)
    )
    with np.errstate(invalid="ignore"):
        x, y = np.floor(np.nan_to_num(uv, nan=-1.0)).astype(int).transpose(2, 0, 1)
    inside = (x >= 0) & (x < own.width) & (y >= 0) & (y < own.height)
    out = np.full((camera.height, camera.width, 3), np.nan, np.float32)
    out[inside] = rgb[y[inside], x[inside]] / np.float32(255.0)
    return out


def project(
    look: Look, points: Floats
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """Pixel rows and columns (...) of points (..., 3), -1 outside, and their depths (...) [m]."""
    camera, pose = look.camera, look.map_from_camera.astype(np.float32)
    local = (points.astype(np.float32) - pose[:3, 3]) @ pose[:3, :3]
    depth = np.asarray(local[..., 2], np.float32)
    uv: NDArray[np.floating[Any]]
    if not camera.straight:
        uv = camera.project(local)
    else:  # as `Camera.project`, with half of its bytes
        far = np.where(depth > 0.0, depth, np.float32(np.nan))[..., None]
        focal, centre = np.array([[camera.fx, camera.fy], [camera.cx, camera.cy]], np.float32)
        uv = local[..., :2] / far * focal + centre
    with np.errstate(invalid="ignore"):
        inside = np.all((uv >= 0) & (uv < (camera.width, camera.height)), axis=-1)
    pixels = np.where(inside[..., None], uv, -1.0).astype(np.int64)
    return pixels[..., 1], pixels[..., 0], depth


def window(look: Look, corners: Floats) -> tuple[slice, slice] | None:
    """Rows and columns of a picture that hold a box (8, 3); None where it lies outside."""
    pose, camera = look.map_from_camera, look.camera
    local = (corners - pose[:3, 3]) @ pose[:3, :3]
    if (local[:, 2] <= 0.05).all():
        return None
    if (local[:, 2] <= 0.05).any():  # beside the camera: all of the picture
        return slice(0, camera.height), slice(0, camera.width)
    uv = camera.project(local)
    low = np.maximum(np.floor(uv.min(axis=0)).astype(int), 0)
    high = np.minimum(np.ceil(uv.max(axis=0)).astype(int), (camera.width, camera.height))
    if (high <= low).any():
        return None
    return slice(low[1], high[1]), slice(low[0], high[0])
