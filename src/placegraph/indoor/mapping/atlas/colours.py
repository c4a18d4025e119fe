"""Colours of a surface: from the frames that saw it, or from a mesh that has some."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera, Floats
from placegraph.core.threads import count_processors, run_parallel
from placegraph.indoor.map.mesh import Mesh, Surface
from placegraph.indoor.mapping.atlas import colour_kernels as kernels
from placegraph.indoor.mapping.fuse import View, find_readings, shrink_camera
from placegraph.indoor.rays import RayCaster
from placegraph.io.capture.frame import Frame
from placegraph.io.mesh.nearest_kernels import find_nearest

if TYPE_CHECKING:
    from placegraph.indoor.mapping.atlas.bake import ColourOf

Bytes = NDArray[np.uint8]

STEP = 0.10  # Frames nearer than this to each other [m] ..
TURN = np.radians(8.0)  # ... and turned less than this are of one place: the sharpest is kept
DEPTH_LONGEST = 320  # Longest side of the depth against which views are tested [px]
LEVELS = 4
UNREAD = 0.05  # Worth of a view at a pixel without depth, of a frame that has some
_WIDER = 1.2  # steps grow by this until few enough frames are left


def group_keyframes(poses: Floats, most: int) -> list[list[int]]:
    """Group consecutive frames taken from nearly one place, `most` groups at most.

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


class SharpestViews:
    """Views of the sharpest of the frames that were taken from nearly one place."""

    def __init__(self, frames: Sequence[Frame], poses: Floats) -> None:
        """Group the frames that have colours by their poses (T, 4, 4) map_from_camera."""
        coloured = [row for row, frame in enumerate(frames) if frame.has_colour]
        self._groups = {
            coloured[i]: group for group in group_keyframes(poses[coloured], VIEWS) for i in group
        }
        self._found: dict[int, tuple[float, View]] = {}

    def add(self, view: View) -> None:
        """Keep the view of a frame, if it is the sharpest of its group so far."""
        group = self._groups.get(view.row, ())
        if group:
            sharp = measure_sharpness(view.image) if len(group) > 1 else 0.0
            if group[0] not in self._found or sharp > self._found[group[0]][0]:
                self._found[group[0]] = sharp, view

    @property
    def views(self) -> list[View]:
        """The sharpest view of each group."""
        return [view for _, view in self._found.values()]


def measure_sharpness(colours: Bytes) -> float:
    """Measure the sharpness of an image (H, W, 3): the variance of its Laplacian."""
    grey = colours[:, :, 1].astype(np.float32)
    middle = 4.0 * grey[1:-1, 1:-1]
    around_ = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:]
    laplacian = middle - around_
    return float(laplacian.var()) if laplacian.size else 0.0


def _read_depth(view: View, caster: RayCaster) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Read depth (h, w) of a view, or of the mesh, and its weights (h, w) [m]; inf: neither has any.

    Where a frame has depth but a pixel has none, there often is something dark, thin or shiny that
    the mesh does not hold: it would be painted on what lies behind.
    """
    (depth_camera, plain), pose = view.cameras, view.map_from_camera
    small = shrink_camera(plain, DEPTH_LONGEST / max(plain.width, plain.height))
    shape = small.height, small.width
    out, trust = (np.full(shape, value, np.float32) for value in (np.nan, 1.0))
    if view.depth.size:
        table = find_readings(depth_camera, small)
        out = np.where(table >= 0, view.depth.ravel()[table], np.float32(np.nan))
        trust[~np.isfinite(out)] = UNREAD
    bare = ~np.isfinite(out)
    rays = _pixel_rays(small)[bare.ravel()] @ pose[:3, :3].T  # z is 1: distance is depth
    out[bare] = caster.cast(pose[:3, 3], rays).distance
    return np.ascontiguousarray(out, np.float32), trust


@lru_cache(maxsize=2)
def _pixel_rays(camera: Camera) -> Floats:
    """Return rays (h * w, 3) through the centres of a camera's pixels, z = 1."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    return camera.directions(np.stack([u, v], axis=-1)).reshape(-1, 3)


def _build_pyramid(image: Bytes) -> tuple[Bytes, ...]:
    """Build the pyramid of an image (H, W, 3): halves, quarters, ... as long as they have pixels."""
    out = [np.ascontiguousarray(image)]
    for _ in range(LEVELS - 1):
        h, w = out[-1].shape[:2]
        if min(h, w) < 4:
            out.append(out[-1])
            continue
        large = out[-1][: h // 2 * 2, : w // 2 * 2]
        pairs = large[::2].astype(np.uint16) + large[1::2]
        out.append(((pairs[:, ::2] + pairs[:, 1::2] + 2) // 4).astype(np.uint8))
    return tuple(out)


VIEWS = 120  # Keyframes, at most
TEXEL = 0.01  # Width that a colour is the mean of [m]
_POINTS = 20_000  # of the surface, at which exposures are compared
_PRIOR = 10.0  # observations that speak for an exposure like the others'
_ROUNDS = 4
_FAR_OFF = 0.15  # of a logarithm: a highlight or another surface, no exposure
REACH = 0.10  # The other mesh lies within this of the surface [m]
_STEP = 1e-4  # [m]
_LAYERS = 3  # of faces that look away


def frame_colours(views: Sequence[View], vertices: Floats, triangles: NDArray[Any]) -> ColourOf:
    """Make the function that colours a surface as views with images of one size saw it.

    A texel looks at those that see it near, frontal, away from the image's border and from edges of
    depth, and not behind something nearer than the frame's depth, or than the mesh where there is
    none. Of the five best, those that agree are mixed. Before that, each frame's exposure is solved
    for over what frames share.
    """
    caster = RayCaster(vertices, triangles)

    def build(view: View) -> tuple[tuple[Bytes, ...], NDArray[np.float32], NDArray[np.float32]]:
        depth, sure = _read_depth(view, caster)
        return _build_pyramid(view.image), kernels.bound_depth(depth), sure

    with ThreadPoolExecutor(count_processors()) as pool:  # NumPy and kernels work outside the lock
        pyramids, depths, trust = zip(*pool.map(build, views), strict=True)
    map_from_camera = np.array([view.map_from_camera for view in views])
    seen = kernels.Keyframes(
        camera_from_map=np.ascontiguousarray(np.linalg.inv(map_from_camera)[:, :3]),
        centres=np.ascontiguousarray(map_from_camera[:, :3, 3]),
        pinholes=np.array([view.pinholes[1] for view in views]),
        levels=tuple(np.stack(images) for images in zip(*pyramids, strict=True)),
        bounds=np.stack(depths),
        weights=np.stack(trust),
        gains=np.ones((len(views), 3), np.float32),
    )
    seen = seen._replace(gains=_solve_gains(seen, np.asarray(vertices, np.float64), triangles))

    def colour_of(points: Floats, normals: Floats, _: Any) -> tuple[Bytes, Any]:  # noqa: ANN401
        out, valid = np.zeros((len(points), 3), np.uint8), np.zeros(len(points), bool)
        run_parallel(kernels.mix_views, len(points), seen, points, normals, TEXEL, out, valid)
        return out, valid

    return colour_of


def _solve_gains(
    views: kernels.Keyframes, vertices: Floats, triangles: NDArray[Any]
) -> NDArray[np.float32]:
    points, normals = _spread_points(vertices, triangles, _POINTS)
    rows = np.full((len(points), kernels.OBSERVED), -1, np.int64)
    colours = np.zeros((len(points), kernels.OBSERVED, 3))
    run_parallel(kernels.observe_points, len(points), views, points, normals, 0.04, rows, colours)
    count = len(views.centres)
    fair = (rows >= 0) & (colours.min(axis=2) > 12) & (colours.max(axis=2) < 245)
    fair &= (fair.sum(axis=1) > 1)[:, None]
    logs = np.log(np.maximum(colours, 1.0))
    out = np.ones((count, 3))
    for c in range(3):
        weights = fair.astype(np.float64)
        for _ in range(_ROUNDS):
            matrix, right = _PRIOR * np.eye(count), np.zeros(count)
            kernels.add_gain_equations(rows, logs[:, :, c], weights, matrix, right)
            exposure = np.linalg.solve(matrix, right)
            left = logs[:, :, c] - exposure[rows]
            total = np.maximum(weights.sum(axis=1, keepdims=True), 1e-9)
            off = left - (weights * left).sum(axis=1, keepdims=True) / total
            weights = fair / (1.0 + (off / _FAR_OFF) ** 2) ** 2  # Geman and McClure
        out[:, c] = np.exp(-exposure)
    return np.clip(out, 0.2, 5.0).astype(np.float32)


def _spread_points(vertices: Floats, triangles: NDArray[Any], count: int) -> tuple[Floats, Floats]:
    """Spread about `count` points (N, 3) evenly over a surface; also unit normals (N, 3)."""
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    doubled = np.cross(b - a, c - a)
    area = np.linalg.norm(doubled, axis=1)
    ends = np.cumsum(area)
    if not ends[-1] > 0:
        return np.zeros((0, 3)), np.zeros((0, 3))
    rows = np.searchsorted(ends, (np.arange(count) + 0.5) / count * ends[-1])
    rows = np.minimum(rows, len(area) - 1)
    # a sequence of low discrepancy (Roberts), folded into the triangle
    uv = (np.arange(count)[:, None] * (0.7548776662, 0.5698402910) + 0.5) % 1.0
    uv = np.where(uv.sum(axis=1, keepdims=True) > 1, 1.0 - uv, uv)
    points = a[rows] + uv[:, :1] * (b - a)[rows] + uv[:, 1:] * (c - a)[rows]
    return points, doubled[rows] / np.maximum(area[rows], 1e-30)[:, None]


def mesh_colours(mesh: Mesh) -> ColourOf:
    """Return the colours of a mesh of the same surface, with textures or without.

    A point has the colour that a ray along its normal, or against it, meets within `REACH`, rather
    on a face that looks the same way; where there is none, that of the nearest vertex within twice
    `REACH`; else none. Textures are averaged over `TEXEL`.
    """
    caster = RayCaster(mesh.vertices, mesh.triangles)
    surface, normals = Surface.of(mesh), mesh.normals()
    vertices = mesh.vertices.astype(np.float64)
    first_of = np.zeros(len(vertices), np.int64)  # a triangle and a corner of each vertex
    first_of[mesh.triangles.ravel()] = np.arange(mesh.triangles.size)

    def colour_of(points: Floats, along: Floats, _: Any) -> tuple[NDArray[np.uint8], Any]:  # noqa: ANN401
        triangle, u, v = _find_facing(caster, normals, points, along)
        bare = np.flatnonzero(triangle < 0)
        if len(bare):
            rows = find_nearest(points[bare], vertices, 2.0 * REACH)
            place = first_of[rows[rows >= 0]]
            met = bare[rows >= 0]
            triangle[met], u[met], v[met] = place // 3, place % 3 == 1, place % 3 == 2
        out = np.zeros((len(points), 3), np.uint8)
        run_parallel(
            kernels.sample_colours, len(points), surface, triangle, u, v, np.float32(TEXEL), out
        )
        return out, triangle >= 0

    return colour_of


def _find_facing(
    caster: RayCaster, normals: Floats, points: Floats, along: Floats
) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]:
    """Find the triangle (N,), -1: none, beside each point, and weights of its corners 1 and 2."""
    best = np.full(len(points), np.inf)
    triangle = np.full(len(points), -1, np.int32)
    u, v = np.zeros(len(points), np.float32), np.zeros(len(points), np.float32)
    for way in (1.0, -1.0):
        rows = np.arange(len(points))
        # from a little behind, so that a surface right at the point is met both ways
        begun = np.full(len(points), -_STEP)
        for _ in range(_LAYERS):
            heading = way * along[rows]
            hits = caster.cast(points[rows] + begun[:, None] * heading, heading)
            far = np.abs(hits.distance + begun)
            same = np.einsum("nk,nk->n", normals[hits.triangle], along[rows]) > 0
            off = far + np.where(same, 0.0, REACH)
            met = (hits.triangle >= 0) & (far <= REACH)
            nearer = met & (off < best[rows])
            own = rows[nearer]
            best[own], triangle[own] = off[nearer], hits.triangle[nearer]
            u[own], v[own] = hits.u[nearer], hits.v[nearer]
            behind = met & ~same  # the back of something thin: what looks our way may lie behind it
            rows, begun = rows[behind], (begun + hits.distance + _STEP)[behind]
    return triangle, u, v
