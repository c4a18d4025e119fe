"""A plain truncated signed distance volume: frames with known poses become a coloured mesh.

Curless and Levoy, "A volumetric method for building complex models from range images", 1996. It
stands here until maps are built from captures (issue E), so that the benchmark has a map of real
images: the poses are the true ones of the map's half, which only evaluation may read.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import InputError, MissingExtraError, OptionError
from placegraph.evaluate.decimate import decimate
from placegraph.evaluate.tsdf_kernels import blend, integrate
from placegraph.indoor.mesh import Mesh

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    from placegraph.formats.frame import Frame
    from placegraph.geometry import Camera

    Floats = NDArray[np.float64]
    Floats32 = NDArray[np.float32]
    Ints = NDArray[np.int64]

VOXEL = 0.03
"""Edge of a voxel [m]."""
TRUNCATION = 0.10
"""Distances beyond this are cut [m]: three voxels, and three times the noise of the depth."""
REACH = 7.5
"""Greatest depth that is used [m]."""
LEAST = 0.05
"""Weight that a voxel needs: one view weighs 1 / depth^2, so one at 4 m or several beyond."""
SPECK = 100
"""Parts of fewer triangles than this (before decimation) are dropped: about 0.04 m^2."""
LARGEST = 120_000_000
"""Voxels of the largest volume, 2.9 GB."""


@dataclass(frozen=True, eq=False)
class Volume:
    """Signed distances on a grid; `take` adds views, `mesh` finds the surface."""

    origin: Floats
    """(3,) centre of voxel (0, 0, 0) in the map [m]."""
    voxel: float
    truncation: float
    distance: Floats32
    """(X, Y, Z) [m], positive in front of surfaces, cut at the truncation."""
    weight: Floats32
    """(X, Y, Z) sum of 1 / depth^2 of the views [1 / m^2]."""
    colour: Floats32
    """(X, Y, Z, 3) mean sRGB near surfaces, 0 to 255."""
    paint: Floats32
    """(X, Y, Z) weight of the colour."""

    @classmethod
    def around(
        cls, bounds: Floats, *, voxel: float = VOXEL, truncation: float = TRUNCATION
    ) -> Volume:
        """Empty volume that holds bounds (2, 3) [m].

        Raises `OptionError` where that takes more voxels than memory should.
        """
        low, high = bounds
        shape = tuple(int(n) for n in np.ceil((high - low) / voxel) + 1)
        if voxel <= 0 or not np.isfinite(bounds).all() or np.prod(shape) > LARGEST:
            raise OptionError(
                f"voxel is {voxel} for a volume of {high - low} m; at most {LARGEST:,} voxels fit."
            )
        return cls(
            origin=np.array(low, np.float64),
            voxel=voxel,
            truncation=truncation,
            distance=np.full(shape, truncation, np.float32),
            weight=np.zeros(shape, np.float32),
            colour=np.zeros((*shape, 3), np.float32),
            paint=np.zeros(shape, np.float32),
        )

    def take(self, frame: Frame, map_from_camera: Floats, *, reach: float = REACH) -> None:
        """Take in the depth and colour of a frame, in place; one without depth changes nothing."""
        depth = frame.depth()
        if depth is None or frame.depth_camera is None:
            return
        eyes = np.array([pinhole(frame.depth_camera), pinhole(frame.camera)])
        pose = np.linalg.inv(map_from_camera)
        integrate(
            self.distance,
            self.weight,
            self.colour,
            self.paint,
            self.origin,
            self.voxel,
            self.truncation,
            depth,
            frame.rgb(),
            eyes,
            pose,
            reach,
        )

    def surface(self, *, least: float = LEAST, speck: int = SPECK) -> tuple[Floats, Ints]:
        """Vertices (V, 3) [voxels] and triangles (T, 3) where the distance is zero.

        Raises
        ------
        InputError
            Where there is none.
        MissingExtraError
            Without scikit-image.
        """
        try:
            from skimage.measure import marching_cubes
        except ImportError as error:
            raise MissingExtraError(
                "Meshes from depth need scikit-image: pip install scikit-image."
            ) from error
        known = self.weight > least
        whole = np.ones([n - 1 for n in known.shape], bool)  # cubes whose eight corners are known
        for i, j, k in np.ndindex(2, 2, 2):
            part = (slice(o, n - 1 + o) for o, n in zip((i, j, k), known.shape, strict=True))
            whole &= known[tuple(part)]
        mask = np.zeros_like(known)
        mask[1:, 1:, 1:] = whole  # scikit-image asks the last corner of a cube
        signs = self.distance[known]
        if not whole.any() or signs.min() >= 0 or signs.max() <= 0:
            raise InputError("The frames show no surface; a map needs depth images that overlap.")
        vertices, triangles, _, _ = marching_cubes(self.distance, 0.0, mask=mask)
        return without_specks(np.asarray(vertices, np.float64), np.asarray(triangles), speck)

    def mesh(self, target: int = 80_000, *, least: float = LEAST, speck: int = SPECK) -> Mesh:
        """Coloured mesh of one object, of about `target` triangles, facing free space."""
        fine, corners = self.surface(least=least, speck=speck)
        colours = blend(self.colour, self.paint, fine)
        points = self.origin + self.voxel * fine
        vertices, triangles, _ = decimate(points, corners, target)
        nearest = nearest_rows(points, vertices)
        return Mesh.plain(vertices, triangles, colours=colours[nearest])


def fuse(
    frames: Iterable[Frame],
    poses: Floats,
    *,
    voxel: float = VOXEL,
    truncation: float = TRUNCATION,
    reach: float = REACH,
) -> Volume:
    """Volume of frames with their true poses map_from_camera (T, 4, 4)."""
    views = [(frame, pose) for frame, pose in zip(frames, poses, strict=True)]
    seen = [scattered(frame, pose, reach) for frame, pose in views]
    points = np.concatenate([np.zeros((0, 3)), *seen])
    if not len(points):
        raise InputError("The frames have no depth; a map needs depth images.")
    # A few wild readings should not blow the volume up.
    bounds = np.percentile(points, [0.05, 99.95], axis=0) + np.array([[-1.5], [1.5]]) * truncation
    volume = Volume.around(bounds, voxel=voxel, truncation=truncation)
    for frame, pose in views:
        volume.take(frame, pose, reach=reach)
    return volume


def scattered(frame: Frame, map_from_camera: Floats, reach: float = REACH, step: int = 5) -> Floats:
    """Every `step`-th depth reading of every `step`-th line as points (N, 3) in the map [m]."""
    depth, camera = frame.depth(), frame.depth_camera
    if depth is None or camera is None:
        return np.zeros((0, 3))
    v, u = np.mgrid[step // 2 : depth.shape[0] : step, step // 2 : depth.shape[1] : step]
    z = depth[v, u]
    near = z < reach  # false for NaN
    rays = camera.directions(np.stack([u[near], v[near]], axis=-1) + 0.5)
    points = rays * z[near][:, None]
    moved: Floats = points @ map_from_camera[:3, :3].T + map_from_camera[:3, 3]
    return moved


def pinhole(camera: Camera) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy; `OptionError` where the camera has distortion: undistort the images first."""
    if any(camera.distortion):
        raise OptionError("camera: the volume takes images without distortion; undistort first.")
    return camera.fx, camera.fy, camera.cx, camera.cy


def without_specks(points: Floats, triangles: Ints, least: int) -> tuple[Floats, Ints]:
    """Drop connected parts of fewer than `least` triangles, and vertices that nothing uses."""
    part = parts_of(len(points), triangles)
    size = np.bincount(part[triangles[:, 0]], minlength=len(points))
    kept = triangles[size[part[triangles[:, 0]]] >= least]
    used, renamed = np.unique(kept, return_inverse=True)
    return points[used], renamed.reshape(-1, 3)


def parts_of(count: int, triangles: Ints) -> Ints:
    """Lowest vertex (V,) of the connected part that every vertex belongs to."""
    root = np.arange(count)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]]])
    while True:  # lower roots spread over the edges; chains are cut short as they grow
        low = root[edges].min(axis=1)
        after = root.copy()
        for end in (0, 1):
            np.minimum.at(after, root[edges[:, end]], low)
        after = after[after]
        if (after == root).all():
            return root
        root = after


def nearest_rows(points: Floats, asked: Floats32) -> Ints:
    """Rows (N,) of the points (V, 3) that are nearest to those asked for (N, 3)."""
    from scipy.spatial import cKDTree

    rows: Ints = cKDTree(points).query(asked)[1]
    return rows


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write vertices, their colours and triangles as binary PLY."""
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(mesh.vertices)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
        f"element face {len(mesh.triangles)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    rows = np.empty(len(mesh.vertices), [("at", "<f4", 3), ("colour", "u1", 3)])
    rows["at"], rows["colour"] = mesh.vertices, mesh.colours
    faces = np.empty(len(mesh.triangles), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.triangles
    path.write_bytes("\n".join(head).encode("ascii") + rows.tobytes() + faces.tobytes())
