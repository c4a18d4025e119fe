"""Pictures of a furnished flat: its own small renderer, so that captures differ from the map.

Rays are cast through the pixels' centres; light falls from the lamps and, by day, through the
windows, with shadows, Lambert's cosine and the square of the distance; the rest is ambient. Map
and picture share nothing but geometry and albedo.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.textures import linear_from_srgb, srgb_from_linear
from placegraph.indoor.rays import RayCaster

if TYPE_CHECKING:
    from placegraph_lab.worlds.flat.interior import Interior

Floats = NDArray[np.float32]

AMBIENT = 0.22  # light that comes from everywhere, as a share of a well lit white wall's
SOFTEN = 0.3  # added to squared distances [m2]: lamps are no points
FAINT = 0.02  # light of one lamp below this is left out


@dataclass(frozen=True, eq=False)
class GeometryImage:
    """Geometry in a camera's pixels.

    `depth`: (h, w) float32 [m] along the optical axis, NaN where nothing is hit; `ids`: (h, w)
    int32, -1 for nothing; `facing`: (h, w) float32, cosine between ray and surface normal.
    """

    depth: Floats
    ids: NDArray[np.int32]
    facing: Floats


class _Hits(NamedTuple):
    """Hits of the pixels that see something: rows of pixels, and what is there."""

    pixel: NDArray[np.intp]
    triangle: NDArray[np.int32]
    distance: Floats
    u: Floats
    v: Floats
    points: Floats
    normals: Floats
    facing: Floats


def mesh_of(interior: Interior) -> Mesh:
    """One mesh of all things of a flat; `object_of` holds their ids."""
    surfaces = [(thing.id, s) for thing in interior.objects for s in thing.surfaces]
    counts = [len(s.vertices) for _, s in surfaces]
    starts = np.cumsum([0, *counts[:-1]])
    faces = [len(s.triangles) for _, s in surfaces]
    return Mesh(
        vertices=np.concatenate([s.vertices for _, s in surfaces]).astype(np.float32),
        triangles=np.concatenate(
            [s.triangles + start for (_, s), start in zip(surfaces, starts, strict=True)]
        ).astype(np.int32),
        object_of=np.repeat(np.array([i for i, _ in surfaces], np.int32), faces),
        colours=np.full((sum(counts), 3), 255, np.uint8),
        uv=np.concatenate([s.uv for _, s in surfaces]).astype(np.float32),
        texture_of=np.repeat(np.arange(len(surfaces), dtype=np.int32), faces),
        textures=tuple(s.texture for _, s in surfaces),
    )


class Stage:
    """A flat that is lit and ready for pictures.

    `interior`: the flat; `rng`: varies the strength of every lamp; `daylight`: from 0, a dark
    evening with lamps on, to 1, a bright day with lamps off.
    """

    def __init__(
        self, interior: Interior, rng: np.random.Generator, *, daylight: float = 0.5
    ) -> None:
        self.mesh = interior.mesh()
        self.caster = RayCaster(self.mesh.vertices, self.mesh.triangles)
        normals = self.mesh.normals()
        self._normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype("f4")
        texels, self._starts, self._sizes = self.mesh.texels()
        linear = linear_from_srgb(np.arange(256) / 255.0).astype(np.float32)
        self._texels = linear[texels]
        emission = np.zeros(max(thing.id for thing in interior.objects) + 1, np.float32)
        for thing in interior.objects:
            emission[thing.id] = thing.emission * (daylight if thing.is_window else 1.0 - daylight)
        self._emission = emission
        strength = np.array([3.0 * daylight if lamp.is_window else 1.6 * (1.0 - daylight)
                             for lamp in interior.lamps])  # fmt: skip
        strength *= rng.uniform(0.7, 1.3, len(strength))
        self._lamps = np.array([lamp.position for lamp in interior.lamps], np.float32)
        tints = np.array([(0.92, 1.0, 1.1) if lamp.is_window else (1.1, 1.0, 0.8)
                          for lamp in interior.lamps])  # fmt: skip
        self._colours = (strength[:, None] * tints).astype(np.float32)

    def geometry(self, camera: Camera, map_from_camera: NDArray[np.float64]) -> GeometryImage:
        """Geometry that a camera sees from a pose (4, 4)."""
        hits = self._cast(camera, map_from_camera)
        shape = camera.height, camera.width
        return GeometryImage(
            _spread(hits.distance, hits.pixel, shape, np.nan),  # rays have z = 1
            _spread(self.mesh.object_of[hits.triangle], hits.pixel, shape, -1),
            _spread(hits.facing, hits.pixel, shape, 0.0),
        )

    def radiance(self, camera: Camera, map_from_camera: NDArray[np.float64]) -> Floats:
        """Light (h, w, 3) float32, linear, that a camera sees from a pose (4, 4).

        1 is a well lit white wall; nothing is black.
        """
        hits = self._cast(camera, map_from_camera)
        light = self._light(hits.points, hits.normals)
        light += self._emission[self.mesh.object_of[hits.triangle], None]
        light *= self._albedo(hits.triangle, hits.u, hits.v)
        return _spread(light, hits.pixel, (camera.height, camera.width), 0.0)

    def _cast(self, camera: Camera, map_from_camera: NDArray[np.float64]) -> _Hits:
        v, u = np.mgrid[: camera.height, : camera.width] + 0.5
        rays = camera.directions(np.stack([u, v], axis=-1)).reshape(-1, 3)
        directions = (rays @ map_from_camera[:3, :3].T).astype(np.float32)
        origin = map_from_camera[:3, 3].astype(np.float32)
        hits = self.caster.cast(origin, directions)
        pixel = np.flatnonzero(hits.triangle >= 0)
        triangle, distance = hits.triangle[pixel], hits.distance[pixel]
        directions = directions[pixel]
        normals = self._normals[triangle]
        cosine = _dot(normals, directions)
        normals = np.where(cosine[:, None] > 0, -normals, normals)
        facing = np.abs(cosine / np.sqrt(_dot(directions, directions))).astype(np.float32)
        points = origin + directions * distance[:, None]
        return _Hits(
            pixel, triangle, distance, hits.u[pixel], hits.v[pixel], points, normals, facing
        )

    def _light(self, points: Floats, normals: Floats) -> Floats:
        """Light (N, 3) that falls on points (N, 3) with normals (N, 3)."""
        total = np.full((len(points), 3), AMBIENT, np.float32)
        lifted = points + 2e-3 * normals
        for lamp, colour in zip(self._lamps, self._colours, strict=True):
            towards = lamp - lifted
            square = _dot(towards, towards)
            slope = _dot(towards, normals) / np.sqrt(square)
            power = slope / (square + SOFTEN)
            lit = np.flatnonzero(power * colour.max() > FAINT)
            if lit.size:
                blocked = self.caster.cast(lifted[lit], towards[lit]).distance < 1.0
                lit = lit[~blocked]
                total[lit] += power[lit, None] * colour
        return total

    def _albedo(self, triangle: NDArray[np.int32], u: Floats, v: Floats) -> Floats:
        """Linear colours (N, 3) between the four nearest texels."""
        shares = np.stack([1.0 - u - v, u, v], axis=1)
        uv = np.einsum("nk,nkc->nc", shares, self.mesh.uv[self.mesh.triangles[triangle]])
        which = self.mesh.texture_of[triangle]
        size, start = self._sizes[which], self._starts[which]
        at = uv * size - 0.5
        low = np.floor(at).astype(np.int64)
        part = (at - low).astype(np.float32)
        left, right = low[:, 0] % size[:, 0], (low[:, 0] + 1) % size[:, 0]
        top = start + low[:, 1] % size[:, 1] * size[:, 0]
        bottom = start + (low[:, 1] + 1) % size[:, 1] * size[:, 0]
        x, y = part[:, :1], part[:, 1:]
        upper = self._texels[top + left] * (1 - x) + self._texels[top + right] * x
        lower = self._texels[bottom + left] * (1 - x) + self._texels[bottom + right] * x
        mixed: Floats = upper * (1 - y) + lower * y
        return mixed


def _dot(a: Floats, b: Floats) -> Floats:
    product: Floats = np.einsum("nc,nc->n", a, b)
    return product


_Number = TypeVar("_Number", bound=np.generic)


def _spread(
    values: NDArray[_Number], pixel: NDArray[np.intp], shape: tuple[int, int], empty: float
) -> NDArray[_Number]:
    """Image (h, w, ...) of the values of the pixels that see something."""
    full = np.full((shape[0] * shape[1], *values.shape[1:]), empty, values.dtype)
    full[pixel] = values
    return full.reshape(*shape, *values.shape[1:])


FARTHEST = 9.5  # beyond this the depth camera reads nothing [m]


def develop(
    radiance: NDArray[np.float32], exposure: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Colour image (h, w, 3) uint8 sRGB of linear radiance (h, w, 3).

    Automatic exposure, off by the factor `exposure`; darker corners; a soft shoulder; shot and
    read noise.
    """
    h, w = radiance.shape[:2]
    y, x = np.mgrid[:h, :w]
    corner = np.hypot((x + 0.5) / w - 0.5, (y + 0.5) / h - 0.5) / np.hypot(0.5, 0.5)
    level = float(np.exp(np.log(radiance.mean(axis=2) + 1e-3).mean()))
    gain = 0.3 * exposure / max(level, 1e-3)
    light = 1.0 - np.exp(-gain * radiance * (1.0 - 0.25 * corner**2)[..., None])
    noise = np.sqrt(0.00025 * light + 0.00001)
    light = light + noise * rng.standard_normal(light.shape)
    encoded = srgb_from_linear(np.clip(light, 0.0, 1.0))
    return np.rint(encoded * 255.0).astype(np.uint8)


def simulate_depth(geometry: GeometryImage, rng: np.random.Generator) -> NDArray[np.uint16]:
    """Depth image (h, w) uint16 [mm], 0 = no reading.

    The error grows with the square of the distance and is partly common to neighbours; holes are
    at grazing angles, at edges, in blobs, beyond `FARTHEST`, and 2 % of the rest.
    """
    z = np.nan_to_num(geometry.depth.astype(np.float64), nan=np.inf)
    near = np.minimum(z, FARTHEST + 1.0)
    sigma = 0.0012 + 0.0019 * (near - 0.4) ** 2
    common = _smooth(rng.standard_normal((z.shape[0] // 4 + 2, z.shape[1] // 4 + 2)), z.shape)
    noisy = near + sigma * (0.7 * rng.standard_normal(z.shape) + 0.7 * common)
    edge = np.zeros(z.shape, bool)
    for axis in (0, 1):
        jump = np.abs(np.diff(near, axis=axis)) > 0.05 * np.minimum(
            np.take(near, range(1, z.shape[axis]), axis),
            np.take(near, range(z.shape[axis] - 1), axis),
        )
        before, after = [(0, 0), (0, 0)], [(0, 0), (0, 0)]
        before[axis], after[axis] = (1, 0), (0, 1)
        edge |= np.pad(jump, before) | np.pad(jump, after)
    knots = rng.standard_normal((z.shape[0] // 12 + 2, z.shape[1] // 12 + 2))
    lost = (z > FARTHEST) | (geometry.facing < 0.12) | (_smooth(knots, z.shape) > 1.6)
    lost |= edge & (rng.random(z.shape) < 0.6)
    lost |= rng.random(z.shape) < 0.02
    return np.where(lost, 0, np.rint(noisy * 1000.0)).astype(np.uint16)


def _smooth(knots: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
    """Image of a shape, linear between knots, which are one row and column more than cells."""
    for axis in (0, 1):
        cells = knots.shape[axis] - 1
        at = (np.arange(shape[axis]) + 0.5) * cells / shape[axis]
        low = np.floor(at).astype(int)
        part = np.expand_dims(at - low, 1 - axis)
        knots = np.take(knots, low, axis) * (1 - part) + np.take(knots, low + 1, axis) * part
    return knots
