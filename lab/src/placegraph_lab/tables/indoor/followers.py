"""Followers that robots have today: depth aligned to a cloud by small_gicp, laser AMCL on a grid.

Both are told where they start, move on by odometry, and find themselves again only by chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.random import Generator
from scipy.ndimage import distance_transform_edt

from placegraph.core.geometry import Floats, between, compose, pose_matrix, split_pose
from placegraph.io.capture.frame import Frame

STEP = 6  # pixels of the depth image between readings
VOXEL = 0.05  # clouds hold one point a voxel, grids one cell, of this edge [m]
NEIGHBOURS = 10  # points that a covariance is fitted to
REACH = 0.5  # how far a point may be from its partner [m]

BEAM = np.radians(1.0)  # between beams: about 60 in the field of a camera
PARTICLES = 2000
SIGMA, Z_HIT, Z_RAND, RANGE = 0.2, 0.5, 0.5, 8.0  # of the likelihood field; [m], shares, [m]
FAR = 2.0  # largest distance to an obstacle that the field knows [m]
ALPHA = 0.2  # all five shares of motion's noise
MOVED, TURNED = 0.25, 0.2  # way [m] and turn [rad] after which a scan is looked at
BAND = 0.3  # points so far above and below the laser make the grid [m]
SLICE = 0.1  # ... and these the scan [m]
"""Nav2's defaults of AMCL's field, motion and updates; the scan is that of `pointcloud_to_laserscan`."""


def depth_points(frame: Frame) -> Floats:
    """Points (N, 3) [m, camera] of every `STEP`-th reading of a frame's depth; none without depth."""
    depth, camera = frame.depth(), frame.depth_camera
    if depth is None or camera is None:
        return np.zeros((0, 3))
    v, u = np.mgrid[STEP // 2 : depth.shape[0] : STEP, STEP // 2 : depth.shape[1] : STEP]
    read = np.isfinite(depth[v, u])
    rays = camera.directions(np.stack([u[read], v[read]], axis=-1) + 0.5)
    return rays * depth[v, u][read][:, None]


def map_points(frames: Sequence[Frame], poses: Floats) -> Floats:
    """Points (N, 3) [m, map] of the depth of frames at poses (T, 4, 4) map_from_camera."""
    clouds = [
        depth_points(frame) @ pose[:3, :3].T + pose[:3, 3]
        for frame, pose in zip(frames, poses, strict=True)
    ]
    return np.concatenate([np.zeros((0, 3)), *clouds])


class CloudFollower:
    """GICP (Segal et al. 2009) of each frame's depth to the cloud of a map, by small_gicp."""

    def __init__(self, path: Path, start: Floats) -> None:
        """Read a cloud; `start`: map_from_camera (4, 4) of the first frame."""
        self._target, self._tree = _prepare(np.load(path).astype(np.float64))
        self._pose, self._odometry = start, np.zeros(0)

    @staticmethod
    def build(frames: Sequence[Frame], poses: Floats, path: Path) -> None:
        """Write the cloud of frames at poses (T, 4, 4): one point a voxel, 12 bytes each."""
        import small_gicp

        thinned = small_gicp.voxelgrid_sampling(map_points(frames, poses), VOXEL)
        np.save(path, thinned.points()[:, :3].astype(np.float32))

    def step(self, frame: Frame) -> Floats:
        """Return map_from_camera (4, 4) of the next frame."""
        import small_gicp

        if len(self._odometry):
            self._pose = self._pose @ np.linalg.inv(self._odometry) @ frame.odometry
        self._odometry = frame.odometry
        points = depth_points(frame)
        if len(points) > NEIGHBOURS:
            found = small_gicp.align(
                self._target, _prepare(points)[0], self._tree, self._pose,
                registration_type="GICP", max_correspondence_distance=REACH,
            )  # fmt: skip
            self._pose = np.asarray(found.T_target_source)
        return self._pose


def _prepare(points: Floats) -> tuple[object, object]:
    import small_gicp

    cloud, tree = small_gicp.preprocess_points(
        points, downsampling_resolution=VOXEL, num_neighbors=NEIGHBOURS
    )
    return cloud, tree


@dataclass(eq=False)
class LaserFollower:
    """Monte Carlo localization by a planar scan in an occupancy grid, as Nav2's AMCL does it.

    Its likelihood field, motion model (omnidirectional) and defaults; the particles' number is fixed.
    Height and tilt are those of odometry.
    """

    field_: Floats  # (H, W) distance of a cell to the next obstacle [m], at most `FAR`
    corner: Floats  # (2,) of the grid [m]
    start: Floats  # map_from_camera (4, 4) of the first frame
    rng: Generator
    particles: Floats = field(init=False)  # (P, 3) x, y [m], yaw [rad]
    pose: Floats = field(init=False)  # (4,) x, y, z [m], yaw [rad]
    _moved: tuple[float, float] = field(init=False, default=(np.inf, np.inf))
    _odometry: Floats | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self.pose = split_pose(self.start)[0]
        spread = self.rng.standard_normal((PARTICLES, 3)) * (0.5, 0.5, 0.26)  # AMCL's first guess
        self.particles = self.pose[[0, 1, 3]] + spread

    @classmethod
    def open(cls, path: Path, start: Floats, rng: Generator) -> LaserFollower:
        """Read a grid, and make its likelihood field; `start`: map_from_camera (4, 4)."""
        with np.load(path) as grid:
            shape, corner = tuple(grid["shape"].tolist()), grid["corner"]
            taken = np.unpackbits(grid["taken"])[: shape[0] * shape[1]].reshape(shape)
        apart = VOXEL * distance_transform_edt(taken == 0)
        return cls(np.minimum(apart, FAR), corner, start, rng)

    @staticmethod
    def build(frames: Sequence[Frame], poses: Floats, path: Path) -> None:
        """Write the grid of frames at poses (T, 4, 4): what is about as high as the cameras were."""
        points = map_points(frames, poses)
        height = np.median(poses[:, 2, 3])
        points = points[np.abs(points[:, 2] - height) < BAND, :2]
        corner = points.min(axis=0) - FAR
        at = ((points - corner) / VOXEL).astype(np.int64)
        shape = at.max(axis=0) + int(FAR / VOXEL)
        counts = np.zeros(shape, np.int64)
        np.add.at(counts, tuple(at.T), 1)
        np.savez(path, taken=np.packbits(counts > 1), shape=shape, corner=corner)

    def step(self, frame: Frame) -> Floats:
        """Return map_from_camera (4, 4) of the next frame."""
        odometry, level = split_pose(frame.odometry)
        if self._odometry is not None:
            step = between(self._odometry, odometry)
            self.pose = compose(self.pose, step)
            self._move(step)
        self._odometry = odometry
        if self._moved[0] >= MOVED or self._moved[1] >= TURNED:
            self._resample_by_scan(depth_points(frame) @ level.T)
            self._moved = (0.0, 0.0)
            x, y, yaw = self.particles.T
            mean = np.arctan2(np.sin(yaw).mean(), np.cos(yaw).mean())
            self.pose = np.array([x.mean(), y.mean(), self.pose[2], mean])
        return pose_matrix(self.pose, level)

    def _move(self, step: Floats) -> None:
        way, turn = float(np.hypot(*step[:2])), abs(float(step[3]))
        self._moved = (self._moved[0] + way, self._moved[1] + turn)
        noise = self.rng.standard_normal((PARTICLES, 3))
        spread = np.sqrt(ALPHA * (way**2 + turn**2)) * noise
        bearing = self.particles[:, 2] + np.arctan2(step[1], step[0])
        along, aside = way + spread[:, 0], spread[:, 1]
        self.particles[:, 0] += along * np.cos(bearing) - aside * np.sin(bearing)
        self.particles[:, 1] += along * np.sin(bearing) + aside * np.cos(bearing)
        self.particles[:, 2] += step[3] + spread[:, 2]

    def _resample_by_scan(self, points: Floats) -> None:
        """Weigh and resample the particles by the scan of levelled points (N, 3) [m]."""
        scan = points[np.abs(points[:, 2]) < SLICE, :2]
        if not len(scan):
            return
        bearing, distance = np.arctan2(scan[:, 1], scan[:, 0]), np.hypot(*scan.T)
        beam = (bearing / BEAM).astype(np.int64)
        order = np.lexsort((distance, beam))
        nearest = order[np.unique(beam[order], return_index=True)[1]]
        ends = scan[nearest[distance[nearest] < RANGE]]
        c, s = np.cos(self.particles[:, 2:]), np.sin(self.particles[:, 2:])
        x = self.particles[:, :1] + c * ends[:, 0] - s * ends[:, 1]
        y = self.particles[:, 1:2] + s * ends[:, 0] + c * ends[:, 1]
        at = ((np.stack([x, y]) - self.corner[:, None, None]) / VOXEL).astype(np.int64)
        inside = ((at >= 0) & (at < np.array(self.field_.shape)[:, None, None])).all(axis=0)
        at *= inside
        apart = np.where(inside, self.field_[at[0], at[1]], FAR)
        hit = Z_HIT * np.exp(-0.5 * (apart / SIGMA) ** 2) + Z_RAND / RANGE
        weight = 1.0 + (hit**3).sum(axis=1)
        steps = (self.rng.random() + np.arange(PARTICLES)) / PARTICLES
        rows = np.searchsorted(np.cumsum(weight) / weight.sum(), steps)
        self.particles = self.particles[np.minimum(rows, PARTICLES - 1)]
