"""Frames of known pose beside the map, pixel by pixel, and the evidence that follows.

Each pixel's ray is cast twice: at the first surface of the map, and at the first surface behind it
of another object. What is seen can then be held against "it is still there" and "it is gone".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera, Floats
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.change.change_kernels import paint
from placegraph.indoor.mapping.change.changes import DiffOptions
from placegraph.indoor.rays import RayCaster
from placegraph.indoor.render import camera_rays
from placegraph.io.capture.frame import Frame

WIDTH = 320  # Pictures are compared at most this wide [px]
_LAYERS = 12  # surfaces of one object behind each other that are looked through
_STEP = 1e-4  # beyond a hit the next ray starts this far on [m]


class Layer(NamedTuple):
    """Surfaces that rays hit. H rows, W columns."""

    depth: NDArray[np.float32]  # (H, W) along the optical axis [m]; inf: nothing
    objects: NDArray[np.int32]  # (H, W) rows of objects; -1: nothing
    colour: NDArray[np.float32]  # (H, W, 3) sRGB, 0 to 1


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """One frame beside the map."""

    index: int  # Of the frame
    camera: Camera
    map_from_camera: Floats  # (4, 4)
    depth: NDArray[np.float32] | None  # (H, W) [m], NaN: no reading
    rgb: NDArray[np.float32]  # (H, W, 3) sRGB, 0 to 1
    front: Layer  # What the map has there
    behind: Layer  # What the map has behind the object in front

    @property
    def rays(self) -> NDArray[np.float32]:
        """(H, W, 3) in map axes; as long as the way along them for a metre of depth."""
        flat = camera_rays(self.camera)
        ahead = np.concatenate([flat, np.ones((*flat.shape[:2], 1), np.float32)], axis=-1)
        turned: NDArray[np.float32] = ahead @ self.map_from_camera[:3, :3].T.astype(np.float32)
        return turned

    def points(self, mask: NDArray[np.bool_]) -> Floats:
        """Return (N, 3) points [m, map] that the depth shows at the pixels of a mask."""
        if self.depth is None:
            return np.zeros((0, 3))
        along = self.rays[mask].astype(np.float64) * self.depth[mask][:, None]
        return np.asarray(along + self.map_from_camera[:3, 3])


def observe_frame(scene: Scene, frame: Frame, map_from_camera: Floats) -> Observation:
    """Observe the map beside a frame; raises `InputError` where an image is broken."""
    depth = frame.depth()
    camera = (frame.depth_camera or frame.camera) if depth is not None else frame.camera
    if camera.width > WIDTH:
        factor = -(-camera.width // WIDTH)
        camera = camera.resize(-(-camera.width // factor), -(-camera.height // factor))
        if depth is not None:
            h, w = depth.shape
            y = ((np.arange(camera.height) + 0.5) * h / camera.height).astype(int)
            x = ((np.arange(camera.width) + 0.5) * w / camera.width).astype(int)
            depth = depth[y[:, None], x]
    rgb = _resample_colours(frame, camera)
    return observe_images(scene, frame.index, camera, map_from_camera, depth, rgb)


def observe_images(
    scene: Scene,
    index: int,
    camera: Camera,
    map_from_camera: Floats,
    depth: NDArray[np.float32] | None,
    rgb: NDArray[np.float32],
) -> Observation:
    """Observe the map beside images."""
    bare = Layer(np.zeros(0, np.float32), np.zeros(0, np.int32), np.zeros(0, np.float32))
    empty = Observation(index, camera, map_from_camera, depth, rgb, bare, bare)
    rays = empty.rays.reshape(-1, 3)
    origin = map_from_camera[:3, 3].astype(np.float32)
    hits = scene.caster.cast(np.broadcast_to(origin, rays.shape), rays)
    front = _make_layer(scene, camera, hits.triangle, hits.distance, hits.u, hits.v)
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
    behind = _make_layer(scene, camera, triangle, distance, u, v)
    return Observation(index, camera, map_from_camera, depth, rgb, front, behind)


def _make_layer(
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


def _resample_colours(frame: Frame, camera: Camera) -> NDArray[np.float32]:
    """Resample an image to (H, W, 3), 0 to 1, as `camera` at the same place would take it."""
    from PIL import Image

    if not frame.has_colour:
        return np.full((camera.height, camera.width, 3), np.nan, np.float32)
    rgb, own = frame.rgb(), frame.camera
    if own.resize(camera.width, camera.height) == camera:
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
    observation: Observation, points: Floats
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """Project points (..., 3): pixel rows and columns (...), -1 outside, and depths (...) [m]."""
    camera, pose = observation.camera, observation.map_from_camera.astype(np.float32)
    local = (points.astype(np.float32) - pose[:3, 3]) @ pose[:3, :3]
    depth = np.asarray(local[..., 2], np.float32)
    uv: NDArray[np.floating[Any]]
    if not camera.is_rectilinear:
        uv = camera.project(local)
    else:  # as `Camera.project`, with half of its bytes
        far = np.where(depth > 0.0, depth, np.float32(np.nan))[..., None]
        focal, centre = np.array([[camera.fx, camera.fy], [camera.cx, camera.cy]], np.float32)
        uv = local[..., :2] / far * focal + centre
    with np.errstate(invalid="ignore"):
        inside = np.all((uv >= 0) & (uv < (camera.width, camera.height)), axis=-1)
    pixels = np.where(inside[..., None], uv, -1.0).astype(np.int64)
    return pixels[..., 1], pixels[..., 0], depth


def find_window(observation: Observation, corners: Floats) -> tuple[slice, slice] | None:
    """Find rows and columns of a picture that hold a box (8, 3); None where it lies outside."""
    pose, camera = observation.map_from_camera, observation.camera
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


Mask = NDArray[np.bool_]

RING = 7  # Width of the surroundings of an object that tell the light on it [px]
_RING_PIXELS = 30
_CONTRAST = 0.08
"""Colours of object and background that differ less than this cannot be told apart (0 to 1)."""
_SPEAKING = 0.1  # Share of `least_pixels` in a frame from which on it counts as a frame that speaks
_FLAT = 0.6  # Colours decide where they can tell at this share of an object's pixels or more


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """T frames, N objects."""

    gone: Floats  # (T, N) pixels that speak for being gone
    stays: Floats  # (T, N) pixels that speak for being there
    by_colour: NDArray[np.bool_]  # (N,) whether these pixels were judged by colour
    least: tuple[int, int]  # Pixels in all and frames that are needed

    @property
    def is_observed(self) -> NDArray[np.bool_]:
        """(N,) whether enough pixels of enough frames speak of an object."""
        pixels = self.gone + self.stays
        frames = np.count_nonzero(pixels >= _SPEAKING * self.least[0], axis=0)
        return (pixels.sum(axis=0) >= self.least[0]) & (frames >= self.least[1])

    @property
    def share(self) -> Floats:
        """(N,) share of the pixels that speak for being gone."""
        gone = self.gone.sum(axis=0)
        return np.asarray(gone / np.maximum(gone + self.stays.sum(axis=0), 1.0))

    def describe(self, row: int) -> str:
        """Return the numbers of pixels and frames that show an object, in words."""
        pixels = self.gone[:, row] + self.stays[:, row]
        frames = int(np.count_nonzero(pixels))
        return f"{pixels.sum():,.0f} pixels in {frames} frame{'s' * (frames != 1)}"

    def confidence(self, row: int) -> float:
        """Return the probability that an object is gone: the rule of succession over frames.

        Pixels of one frame are right or wrong together, so a frame counts once, by its share.
        """
        pixels = self.gone[:, row] + self.stays[:, row]
        weight = np.minimum(pixels / (2.0 * _SPEAKING * self.least[0]), 1.0)
        share = self.gone[:, row] / np.maximum(pixels, 1.0)
        return float((np.sum(weight * share) + 0.5) / (np.sum(weight) + 1.0))


def count_evidence(
    observations: Sequence[Observation], count: int, options: DiffOptions
) -> Evidence:
    """Count the evidence of all frames for and against `count` objects."""
    depth_gone, depth_stays, colour_gone, colour_stays = np.zeros((4, len(observations), count))
    for t, observation in enumerate(observations):
        agrees = np.isfinite(observation.front.depth)
        flat = agrees
        if observation.depth is not None:
            slack = tolerance(observation.depth, options)
            near, far = bound_window(observation.front.depth)
            with np.errstate(invalid="ignore"):
                agrees = (observation.depth >= near - slack) & (observation.depth <= far + slack)
                apart = observation.behind.depth - observation.front.depth > 2.0 * slack
                even = far - near < 2.0 * slack + 0.1
                through = (observation.depth > far + slack) & apart & even
            depth_gone[t] = _count_pixels(observation, through, count)
            depth_stays[t] = _count_pixels(observation, agrees & apart & even, count)
            flat = agrees & ~apart
        if options.colour:
            _count_by_colour(observation, flat, agrees, colour_gone[t], colour_stays[t])
    by_depth = (depth_gone + depth_stays).sum(axis=0)
    by_colour = (colour_gone + colour_stays).sum(axis=0)
    flat_ones = by_colour > _FLAT * (by_depth + by_colour)
    least = options.least_pixels, min(options.least_frames, len(observations))
    return Evidence(
        np.where(flat_ones, colour_gone, depth_gone),
        np.where(flat_ones, colour_stays, depth_stays),
        flat_ones,
        least,
    )


def tolerance(depth: NDArray[np.float32], options: DiffOptions) -> NDArray[np.float32]:
    """Return the tolerance of a reading about the surface it shows [m]."""
    slack = options.depth_floor + options.depth_slope * np.nan_to_num(depth)
    return np.asarray(slack, np.float32)


def bound_window(image: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the least and largest value (H, W) of each pixel and its eight neighbours."""
    padded = np.pad(image, 1, mode="edge")
    h, w = image.shape
    parts = [padded[i : i + h, j : j + w] for i in range(3) for j in range(3)]
    return np.minimum.reduce(parts), np.maximum.reduce(parts)


def sum_window(mask: NDArray[np.generic], by: int) -> NDArray[np.float64]:
    """Sum (H, W) over the square of pixels up to `by` rows and columns away."""
    total = np.pad(mask.astype(np.float64), ((by + 1, by), (by + 1, by)))
    total = total.cumsum(axis=0).cumsum(axis=1)
    k = 2 * by + 1
    return np.asarray(total[k:, k:] - total[:-k, k:] - total[k:, :-k] + total[:-k, :-k])


def estimate_light(observation: Observation, where: Mask) -> Floats | None:
    """Estimate the factors (3,) from the map's colours to the image's; None for too few pixels."""
    where = where & np.isfinite(observation.rgb[..., 0])
    if np.count_nonzero(where) < _RING_PIXELS:
        return None
    ratio = observation.rgb[where] / np.maximum(observation.front.colour[where], 0.02)
    return np.asarray(np.median(ratio, axis=0), np.float64)


def _count_by_colour(
    observation: Observation, flat: Mask, agrees: Mask, gone: Floats, stays: Floats
) -> None:
    """Write pixels (N,) for and against every object that colours can tell from its background."""
    objects = observation.front.objects
    usable = (
        flat
        & (objects >= 0)
        & np.isfinite(observation.rgb[..., 0])
        & (observation.behind.objects >= 0)
    )
    for row in np.unique(objects[usable]).tolist():
        own = objects == row
        here = usable & own
        if np.count_nonzero(here) < _RING_PIXELS:
            continue
        lit = estimate_light(
            observation, (sum_window(own, RING) > 0) & ~own & agrees & (objects >= 0)
        )
        if lit is None:
            continue
        there, behind = observation.front.colour[here] * lit, observation.behind.colour[here] * lit
        telling = np.abs(there - behind).mean(axis=1) > _CONTRAST
        colours = observation.rgb[here][telling]
        off_there, off_behind, apart = (
            np.abs(a - b).sum(axis=1)
            for a, b in (
                (colours, there[telling]), (colours, behind[telling]), (there[telling], behind[telling])
            )
        )  # fmt: skip
        # 1 where the colour is that of the background, 0 where it is the thing's, between between
        closer = 0.5 + 0.5 * (off_there - off_behind) / apart
        gone[row], stays[row] = closer.sum(), (1.0 - closer).sum()


def _count_pixels(observation: Observation, mask: Mask, count: int) -> Floats:
    rows = observation.front.objects[mask]
    return np.asarray(np.bincount(rows[rows >= 0], minlength=count), np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class UnexplainedReadings:
    """Map without all that may be gone, frame by frame, and readings it does not explain."""

    observations: Sequence[Observation]
    depths: Sequence[NDArray[np.float32]]
    """T arrays (H, W) of the depth of what is left [m]; inf: nothing."""
    new: Sequence[NDArray[np.bool_]]
    """T masks (H, W) of readings that end before it: nothing explains them yet."""
    options: DiffOptions


def explain_without(
    scene: Scene,
    observations: Sequence[Observation],
    suspects: NDArray[np.int64],
    options: DiffOptions,
) -> UnexplainedReadings:
    """Remove the suspects from the map, and find the readings that it does not explain."""
    suspected = np.zeros(len(scene) + 1, np.bool_)
    suspected[suspects] = True
    mesh = scene.mesh
    kept = ~suspected[mesh.object_of]
    caster = RayCaster(mesh.vertices, mesh.triangles[kept]) if kept.any() else None
    depths, new = [], []
    for observation in observations:
        depth = observation.front.depth.copy()
        gone = suspected[observation.front.objects]
        if gone.any():
            origin = observation.map_from_camera[:3, 3]
            rays = observation.rays[gone]
            depth[gone] = caster.cast(origin, rays).distance if caster else np.inf
        depths.append(depth)
        new.append(_find_unexplained(observation, depth, options))
    return UnexplainedReadings(observations, depths, new, options)


def _find_unexplained(
    observation: Observation, depth: NDArray[np.float32], options: DiffOptions
) -> NDArray[np.bool_]:
    """Find readings (H, W) that end before all surfaces around, and are not alone in it."""
    if observation.depth is None:
        return np.zeros(depth.shape, np.bool_)
    near, _ = bound_window(depth)
    with np.errstate(invalid="ignore"):
        before = observation.depth < near - tolerance(observation.depth, options)
    before &= np.isfinite(depth)  # beyond the map's end nothing is known to be new
    return before & (sum_window(before, 1) >= 5)


def find_confirmed(
    observations: Sequence[Observation], count: int, options: DiffOptions
) -> NDArray[np.bool_]:
    """Find the objects (N,) on which readings that agree with the map end."""
    pixels = np.zeros(count)
    for observation in observations:
        agrees = observation.front.objects >= 0
        if observation.depth is not None:
            with np.errstate(invalid="ignore"):
                off = np.abs(observation.depth - observation.front.depth)
                agrees &= off <= tolerance(observation.depth, options)
        pixels += np.bincount(observation.front.objects[agrees], minlength=count)
    return pixels >= options.least_pixels
