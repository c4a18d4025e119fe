"""Depth refinement by small_gicp, which our own has to beat to be worth its code.

The depth of a sequence is one cloud, carried together by odometry. It is aligned to the cloud of
points that the map would show the same cameras: where their rays hit the mesh from the pose so far.
(Against the whole map as one cloud it did worse in the house: backs of walls and things pull too.)
Needs small_gicp, which only this comparison uses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.errors import MissingExtraError, OptionError
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.frame import Frame

Kind = Literal["PLANE_ICP", "GICP"]

STEP = 6
"""Pixels of the depth image between readings, and between rays."""
VOXEL = 0.05
"""Clouds hold one point a voxel of this edge [m]."""
NEIGHBOURS = 10
"""Points that a normal is fitted to."""
REACHES = ((1.0, 0.3), (0.3, 0.1))
"""For each time the rays are cast: how far a point may be from its partner [m], one alignment each.
small_gicp's Python has no robust kernel: shorter reaches take its place."""
ITERATIONS = 30


@dataclass(frozen=True, eq=False)
class Aligned:
    """Where an alignment ended."""

    map_from_camera: Floats
    """(4, 4) of the last frame."""
    converged: bool
    readings: int
    """Of the sequence's cloud."""
    inliers: int
    """Of these, points with a partner within reach at the end."""


def align(
    scene: SceneMap,
    frames: Sequence[Frame],
    start: Floats,
    *,
    kind: Kind = "PLANE_ICP",
    threads: int = 1,
) -> Aligned:
    """Align the depth of frames to the map, from `start` (4, 4), the last frame's map_from_camera.

    Where the map shows the cameras nothing, the pose stays what it was and has not converged.

    Raises
    ------
    OptionError
        No frame has depth.
    MissingExtraError
        small_gicp is not installed.

    """
    try:
        import small_gicp
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            "The comparison with small_gicp needs it: pip install small_gicp."
        ) from error
    cloud = sequence_cloud(frames)
    if not len(cloud):
        raise OptionError("frames: none has a depth reading, so there is nothing to align.")
    source, _ = _prepared(cloud, threads)
    pose, converged, inliers = start, False, 0
    for reaches in REACHES:
        seen = visible_cloud(scene, frames, pose)
        if len(seen) <= NEIGHBOURS:
            return Aligned(pose, converged=False, readings=source.size(), inliers=0)
        target, tree = _prepared(seen, threads)
        for reach in reaches:
            found = small_gicp.align(
                target,
                source,
                tree,
                pose,
                registration_type=kind,
                max_correspondence_distance=reach,
                num_threads=threads,
                max_iterations=ITERATIONS,
            )
            pose, converged, inliers = found.T_target_source, found.converged, found.num_inliers
    return Aligned(np.asarray(pose), bool(converged), source.size(), int(inliers))


def sequence_cloud(frames: Sequence[Frame]) -> Floats:
    """Readings (N, 3) of all frames on a grid of `STEP` pixels, in the last frame's camera axes."""
    clouds = [np.zeros((0, 3))]
    for frame, last_from_frame in zip(frames, _steps(frames), strict=True):
        depth = frame.depth()
        if depth is None or frame.depth_camera is None:
            continue
        v, u = np.mgrid[STEP // 2 : depth.shape[0] : STEP, STEP // 2 : depth.shape[1] : STEP]
        metres = depth[v, u]
        read = np.isfinite(metres)
        uv = np.stack([u[read], v[read]], axis=-1) + 0.5
        points = frame.depth_camera.directions(uv) * metres[read][:, None]
        clouds.append(points @ last_from_frame[:3, :3].T + last_from_frame[:3, 3])
    return np.concatenate(clouds)


def visible_cloud(scene: SceneMap, frames: Sequence[Frame], pose: Floats) -> Floats:
    """Points (N, 3) of the map [m] that the frames' depth cameras would see, the last at `pose`."""
    clouds = [np.zeros((0, 3))]
    for frame, last_from_frame in zip(frames, _steps(frames), strict=True):
        camera = frame.depth_camera
        if camera is None:
            continue
        v, u = np.mgrid[STEP // 2 : camera.height : STEP, STEP // 2 : camera.width : STEP]
        map_from_frame = pose @ last_from_frame
        rays = camera.directions(np.stack([u.ravel(), v.ravel()], axis=-1) + 0.5)
        directions = rays @ map_from_frame[:3, :3].T
        origins = np.broadcast_to(map_from_frame[:3, 3], directions.shape)
        hits = scene.caster.cast(origins, directions)
        hit = hits.triangle >= 0
        clouds.append(origins[hit] + directions[hit] * hits.distance[hit][:, None])
    return np.concatenate(clouds)


def _steps(frames: Sequence[Frame]) -> list[Floats]:
    """last_from_frame (4, 4) of each frame, by odometry."""
    last_from_odometry = np.linalg.inv(frames[-1].odometry)
    return [last_from_odometry @ frame.odometry for frame in frames]


def _prepared(cloud: Floats, threads: int) -> tuple[Any, Any]:
    """Thinned cloud with normals and covariances, and its tree."""
    import small_gicp

    prepared: tuple[Any, Any] = small_gicp.preprocess_points(
        cloud, downsampling_resolution=VOXEL, num_neighbors=NEIGHBOURS, num_threads=threads
    )
    return prepared
