"""The map as a camera would see it from any pose: colour, depth, objects, triangles, 3D points.

SG2Loc, Sec. 3.6, matches the query with such pictures. Depth, objects, triangles and points belong
to the ray through each pixel's centre and are never mixed; colours are means over what a pixel
covers: of a texture by its mip levels, across edges by several rays.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import Camera, Floats
from placegraph.core.threads import run_parallel
from placegraph.errors import OptionError
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.options import check_device
from placegraph.indoor.rays import RayCaster
from placegraph.indoor.render_kernels import TILE, Eye, Picture, World, draw, smooth

SAMPLES = (1, 2, 4, 8, 16)  # Rays a pixel at edges may get
_EVERYWHERE = np.zeros((0, 0), bool)
_FARTHEST = 1e6  # A camera farther from the map's origin than this [m] is a mistake
_RIGID = 1e-3  # How far a pose's rotation may be from one


@dataclass(frozen=True, eq=False)
class Rendering:
    """Images (H, W) of the map as a camera would see it."""

    colour: NDArray[np.uint8]
    """(H, W, 3) sRGB; black where there is nothing."""
    depth: NDArray[np.float32]
    """(H, W) along the optical axis [m]; NaN: nothing."""
    objects: NDArray[np.int32]
    """(H, W) rows of the map's objects; -1: nothing."""
    triangles: NDArray[np.int32]
    """(H, W) rows of the mesh's triangles; -1: nothing."""
    points: NDArray[np.float32]
    """(H, W, 3) [m, map]; NaN: nothing."""

    @classmethod
    def empty(cls, camera: Camera) -> Rendering:
        """Make a picture of nothing."""
        shape = camera.height, camera.width
        return cls(
            np.zeros((*shape, 3), np.uint8),
            np.full(shape, np.nan, np.float32),
            np.full(shape, -1, np.int32),
            np.full(shape, -1, np.int32),
            np.full((*shape, 3), np.nan, np.float32),
        )

    def blank(self, hidden: NDArray[np.bool_]) -> None:
        """Show nothing at the pixels of a mask (H, W)."""
        self.colour[hidden] = 0
        self.depth[hidden] = self.points[hidden] = np.nan
        self.objects[hidden] = self.triangles[hidden] = -1

    @property
    def mask(self) -> NDArray[np.bool_]:
        """(H, W), where the map shows anything."""
        seen: NDArray[np.bool_] = self.triangles >= 0
        return seen

    def normals(self, mesh: Mesh, map_from_camera: ArrayLike) -> NDArray[np.float32]:
        """Return (H, W, 3) float32 unit normals in map axes that face the camera; NaN: nothing.

        `mesh` and `map_from_camera` (4, 4) are those of the rendering.
        """
        seen = self.mask
        rows, at = np.unique(self.triangles[seen], return_inverse=True)
        a, b, c = np.moveaxis(mesh.vertices[mesh.triangles[rows]].astype(np.float64), 1, 0)
        normal = np.cross(b - a, c - a)
        with np.errstate(invalid="ignore", divide="ignore"):
            normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True))[at]
        towards = np.asarray(map_from_camera, np.float64)[:3, 3] - self.points[seen]
        away = np.einsum("nk,nk->n", normal, towards) < 0
        out = np.full(self.points.shape, np.nan, np.float32)
        out[seen] = np.where(away[:, None], -normal, normal)
        return out


def render(
    scene: Scene,
    map_from_camera: ArrayLike,
    camera: Camera,
    *,
    samples: int = 4,
    device: str = "auto",
) -> Rendering:
    """Return a picture of the map from one pose; for many, keep a `Renderer`.

    Raises `OptionError`: the pose is not rigid or not finite, `samples` is another number, there is
    no such device.

    `map_from_camera`: (4, 4) rigid, any six degrees of freedom [m]; camera axes x right, y down, z
        forward.
    `camera`: size, intrinsics and distortion of the picture.
    `samples`: rays a pixel at edges of objects, of materials and of faces, whose colours are mixed:
        1, 2, 4, 8 or 16. 1 leaves stairs.
    `device`: ``auto`` or ``cpu``, which are the same.
    """
    check_device(device)
    return Renderer(scene).render(map_from_camera, camera, samples=samples)


class Renderer:
    """Renders one map again and again.

    It takes as many threads as `threads.limit_threads` lets it, and may be asked by any number of
    threads. Parameters and errors: `render`; `caster` is the map's own where none is given.
    """

    def __init__(self, scene: Scene, *, caster: RayCaster | None = None) -> None:
        mesh = scene.mesh
        coloured = bool((mesh.colours != 255).any())
        tracer = (caster or scene.caster).tracer
        self._world = World(tracer, scene.surface, mesh.vertices, coloured)

    def render(
        self,
        map_from_camera: ArrayLike,
        camera: Camera,
        *,
        samples: int = 4,
        wanted: NDArray[np.bool_] | None = None,
    ) -> Rendering:
        """Render the map from a pose (4, 4); parameters and errors as of `render`.

        `wanted`: (H / 4, W / 4), rounded up, tiles of 4 x 4 pixels that are looked at; others may be
        left empty.
        """
        if samples not in SAMPLES:
            raise OptionError(f"samples is {samples}; choose one of {SAMPLES}.")
        pose = check_pose(map_from_camera)
        eye = Eye(
            camera_rays(camera),
            np.ascontiguousarray(pose[:3, :3], np.float32),
            np.ascontiguousarray(pose[:3, 3], np.float32),
            _EVERYWHERE if wanted is None else wanted,
        )
        drawn = self._draw(eye, Rendering.empty(camera), sample_pattern(samples))
        if camera.model == "fisheye":
            drawn.blank(_find_hidden(camera))
        return drawn

    def _draw(self, eye: Eye, drawn: Rendering, offsets: NDArray[np.float32]) -> Rendering:
        rows = len(drawn.depth)
        picture = Picture(drawn.colour, drawn.depth, drawn.objects, drawn.triangles, drawn.points)
        run_parallel(draw, -(-rows // TILE), self._world, eye, picture)
        if len(offsets) == 1:
            return drawn
        colour = drawn.colour.copy()
        run_parallel(smooth, rows, self._world, eye, picture, colour, offsets)
        return Rendering(colour, drawn.depth, drawn.objects, drawn.triangles, drawn.points)


def check_pose(map_from_camera: ArrayLike) -> Floats:
    """Check a pose (4, 4), returned as float64; raises `OptionError` unless finite and rigid."""
    try:
        pose = np.asarray(map_from_camera, np.float64)
    except (TypeError, ValueError) as error:
        raise OptionError(f"map_from_camera is not a numeric matrix: {error}.") from error
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise OptionError(
            f"map_from_camera has shape {pose.shape}; it must be 4 x 4 finite numbers."
        )
    rotation = pose[:3, :3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not (off < _RIGID and np.linalg.det(rotation) > 0) or (pose[3] != (0, 0, 0, 1)).any():
        raise OptionError(
            "map_from_camera is not rigid: it must be a rotation and a position, and its last row "
            "0, 0, 0, 1."
        )
    if not np.abs(pose[:3, 3]).max() <= _FARTHEST:
        raise OptionError(
            f"map_from_camera is {pose[:3, 3].tolist()} m away; positions must be within "
            f"{_FARTHEST:.0e} m."
        )
    return pose


@lru_cache(maxsize=4)
def camera_rays(camera: Camera) -> NDArray[np.float32]:
    """Compute the rays (H, W, 2) float32 through a camera's pixel centres, with z = 1.

    Kept for the last four cameras: distortion takes far longer to undo than the map to render.
    """
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = camera.directions(np.stack([u, v], axis=-1))
    out = np.ascontiguousarray(rays[..., :2], np.float32)
    # where the distortion cannot be undone, a ray straight ahead beats one that is no number
    out[~np.isfinite(out).all(axis=-1)] = 0.0
    out.flags.writeable = False
    return out


@lru_cache(maxsize=2)
def _find_hidden(camera: Camera) -> NDArray[np.bool_]:
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    return np.isnan(camera.directions(np.stack([u, v], axis=-1))[..., 0])


@lru_cache(maxsize=len(SAMPLES))
def sample_pattern(samples: int) -> NDArray[np.float32]:
    """Return ray positions (S, 2) float32 in a pixel, from its centre [px]: Hammersley's points.

    No two share a row or a column, so that an edge that is nearly upright gets S shades.
    """
    bits = samples.bit_length() - 1
    x = (np.arange(samples) + 0.5) / samples
    turned = [int(format(i, f"0{bits}b")[::-1], 2) if bits else 0 for i in range(samples)]
    y = (np.array(turned) + 0.5) / samples
    out = np.stack([x - 0.5, y - 0.5], axis=1).astype(np.float32)
    out.flags.writeable = False
    return out
