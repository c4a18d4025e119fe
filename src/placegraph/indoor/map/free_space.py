"""Free space: places where a camera may stand, and what rays from there see in all directions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.indoor.map import map_kernels as kernels
from placegraph.indoor.map.floor import find_storeys
from placegraph.indoor.map.scene import Scene

MAX_ELEVATION = np.deg2rad(50.0)  # Elevations of the table end here, above and below the horizon


def _directions() -> NDArray[np.float32]:
    """Return unit rays (E * A, 3) in tiles of 4 x 4 bins; azimuth bins are centred on multiples of STEP."""
    azimuth = np.arange(kernels.AZIMUTHS) * kernels.STEP
    elevation = (
        (np.arange(kernels.ELEVATIONS) + 0.5) / kernels.ELEVATIONS * 2.0 - 1.0
    ) * MAX_ELEVATION
    e, a = np.meshgrid(elevation, azimuth, indexing="ij")
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)
    tiles = rays.reshape(kernels.ELEVATIONS // 4, 4, kernels.AZIMUTHS // 4, 4, 3).swapaxes(1, 2)
    return np.ascontiguousarray(tiles.reshape(-1, 3), np.float32)


DIRECTIONS = _directions()


def decode_ranges(steps: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return distances [m] of stored ranges."""
    table = kernels.NEAREST * np.exp(
        np.arange(256) / 254.0 * np.log(kernels.FARTHEST / kernels.NEAREST)
    )
    table[kernels.NOTHING] = np.inf
    return table.astype(np.float32)[steps]


def scale_colours(opponents: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return colours on the scale of the table's."""
    return np.asarray(opponents * kernels.COLOUR_SCALE + kernels.COLOUR_SHIFT, np.float32)


MAX_PLACES = 18_000  # Places of a grid and its layers; larger maps get a wider grid
LAYER_GAP = 0.43  # Most between two layers [m]
SEARCH_MARGIN = 1.5
"""Cameras are looked for this far beyond the box of the mesh [m]: a scan may look in from outside."""
_WALKED = 0.75  # around where a camera was, there may be one again [m]
_CLEARANCE = 0.15  # a camera is no nearer to a surface [m]
_ENCLOSED = 0.5  # nor in a place where half of what it sees is nearer than this [m]
_MAPPED = 0.04  # nor where less of its panorama is mapped: this share, or ...
_OWN, _MOST_MAPPED = 0.5, 0.1  # ... half of the least at the map's own cameras, but at most a tenth
_BACKS = 0.4  # nor beside the floor where so much of what is seen are backs of triangles
_TARGETS, _SIGHTED = 12, 0.25  # places on the floor looked for from one that has none; share seen
_PAIRS = 1 << 20  # of places compared at once: they take 32 MB
_PROBES = DIRECTIONS[5::61]


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Square cells of the ground, and layers of places above them."""

    origin: Floats  # (2,) lower corner [m]
    spacing: float
    shape: tuple[int, int]  # (nx, ny)
    floor: Floats  # (L, nx * ny) height of the floor that each place stands above [m, map]
    height: Floats  # (L, nx * ny) height of each place [m, map]; NaN: there is none
    camera: NDArray[np.int64]  # (W, nx * ny) viewpoint in a cell of the first W layers; -1: none

    @property
    def centres(self) -> Floats:
        """(nx * ny, 2) x, y of the cells [m]."""
        x, y = (
            self.origin[i] + (np.arange(n) + 0.5) * self.spacing for i, n in enumerate(self.shape)
        )
        return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)


def make_grid(scene: Scene, heights: Sequence[float], spacing: float) -> Grid:
    """Return places at `heights` [m] above all floors of a map, and where its viewpoints were.

    Layers stand at most `LAYER_GAP` apart, between the lowest and the highest of `heights`.
    """
    above = spread_heights(heights)
    levels = [find_storeys(scene, s) for s in range(len(scene.scenes))]
    count = max(map(len, levels))
    box = _find_search_box(scene, spacing)
    extent = box[1] - box[0]
    spacing = max(spacing, float(np.sqrt(np.prod(extent) * count * len(above) / MAX_PLACES)))
    nx, ny = np.maximum(1, np.ceil(extent / spacing).astype(int)).tolist()
    cells = nx * ny
    none = np.zeros((0, cells))
    bare = Grid(box[0], spacing, (nx, ny), none, none, none.astype(np.int64))
    within, away = find_nearest_scene(scene, bare.centres)
    # storeys (S, count) of each merged scene; NaN: it has fewer
    storeys = np.array([[*own, *[np.nan] * (count - len(own))] for own in levels])
    floors = storeys[within].T
    floor = np.repeat(floors, len(above), axis=0)
    height = np.where(away > SEARCH_MARGIN, np.nan, floor + np.tile(above, count)[:, None])
    camera = bare.camera
    if len(scene.viewpoints):
        # layers of each storey's cells that a camera came near, as high as the nearest camera
        own = storeys[find_nearest_scene(scene, scene.viewpoints[:, :2])[0]]
        storey = np.maximum((own <= scene.viewpoints[:, 2:]).sum(axis=1) - 1, 0)
        away = np.abs(bare.centres[:, None] - scene.viewpoints[None, :, :2])
        apart, within_cell = np.linalg.norm(away, axis=2), (away <= spacing / 2).all(axis=2)
        seen, camera = np.full((count, cells), np.nan), np.full((count, cells), -1)
        for level in np.unique(storey):
            here = np.where(storey == level, apart, np.inf)
            near = here.min(axis=1) < max(_WALKED, spacing)
            seen[level, near] = scene.viewpoints[here[near].argmin(axis=1), 2]
            here[~within_cell] = np.inf
            stood = np.isfinite(here).any(axis=1)
            camera[level, stood] = here[stood].argmin(axis=1)
        floor, height = np.vstack([floors, floor]), np.vstack([seen, height])
    return Grid(box[0], spacing, (nx, ny), floor, height, camera)


def spread_heights(heights: Sequence[float]) -> list[float]:
    """Return few heights, at most `LAYER_GAP` apart, between the lowest and the highest asked for."""
    low, high = min(heights), max(heights)
    count = max(1, int(np.ceil((high - low) / LAYER_GAP - 1e-9)))
    return [low + (high - low) * (i + 0.5) / count for i in range(count)]


def find_nearest_scene(scene: Scene, points: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Return row (N,) of the merged scene whose box each of points (N, 2) is in or nearest to, and how far.

    How far (N,) is meant along x and y together [m].
    """
    boxes = scene.scene_bounds[:, :, :2]
    outside = np.maximum(boxes[:, 0] - points[:, None], points[:, None] - boxes[:, 1])
    away = np.maximum(outside, 0.0).sum(axis=2)
    return away.argmin(axis=1), away.min(axis=1)


def _find_search_box(scene: Scene, spacing: float) -> Floats:
    """Return box (2, 2) in which cameras are looked for: around the map, or a vast map's better part.

    One triangle that reaches to the horizon must not spread the grid over nothing: where the box
    would hold more cells than the table can, it is cut to where all but a hundredth of the
    surface lies, no triangle counting for more than a square metre.
    """
    box = scene.bounds[:, :2].copy()
    if np.prod(box[1] - box[0]) > MAX_PLACES * spacing**2:
        corners = scene.mesh.vertices[scene.mesh.triangles].astype(np.float64)
        sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.minimum(np.linalg.norm(sides, axis=1) / 2.0, 1.0)
        for axis in range(2):
            centre = corners[:, :, axis].mean(axis=1)
            order = np.argsort(centre)
            share = np.cumsum(area[order]) / area.sum()
            box[:, axis] = centre[order][np.searchsorted(share, [0.005, 0.995])]
    beyond = np.array([[-SEARCH_MARGIN], [SEARCH_MARGIN]])
    if len(scene.viewpoints):
        seen = scene.viewpoints[:, :2]
        box = np.stack([np.minimum(box[0], seen.min(axis=0)), np.maximum(box[1], seen.max(axis=0))])
    return box + beyond


def probe_places(scene: Scene, points: Floats) -> NDArray[np.bool_]:
    """Return which of points (K, 3) may be free by a few rays.

    They say where a place is shut in or sees nothing. One without a floor below lies outside unless
    it looks in: sees places that have one. And who stands beside the floor of a map whose surfaces
    face inwards does not see their backs.
    """
    if not len(points):
        return np.zeros(0, np.bool_)
    count = len(_PROBES)
    hits = scene.caster.cast(np.repeat(points, count, axis=0), np.tile(_PROBES, (len(points), 1)))
    there, shape = hits.triangle >= 0, (len(points), count)
    towards = np.einsum(
        "nk,nk->n", scene.normals[hits.triangle], np.tile(_PROBES, (len(points), 1))
    )
    backs = (there & (towards > 0)).reshape(shape).sum(axis=1) / np.maximum(
        there.reshape(shape).sum(axis=1), 1
    )
    near = (hits.distance < _ENCLOSED).reshape(shape).mean(axis=1)
    able = there.reshape(shape).any(axis=1) & (near < 0.7)
    below = scene.caster.cast(points, np.tile([0.0, 0.0, -1.0], (len(points), 1)))
    floored = np.isfinite(below.distance)
    inside = np.flatnonzero(able & floored)
    if not len(inside):
        return able
    beside = np.flatnonzero(able & ~floored)
    if np.median(backs[inside]) < 0.5 * _BACKS:
        able[beside] &= backs[beside] < _BACKS
    able[beside] &= _sees_inside(scene, points[beside], points[inside])
    return able


def _sees_inside(scene: Scene, points: Floats, inside: Floats) -> NDArray[np.bool_]:
    """Return which of points (K, 3) see their share of places (M, 3): the nearest, and others all over."""
    if not len(points):
        return np.zeros(0, np.bool_)
    half = _TARGETS // 2
    nearest = np.concatenate(
        [
            np.argsort(np.linalg.norm(some[:, None] - inside[None], axis=2), axis=1)[:, :half]
            for some in np.array_split(points, -(-len(points) * len(inside) // _PAIRS))
        ]
    )
    spread = np.linspace(0, len(inside) - 1, half).round().astype(np.int64)
    rows = np.concatenate([nearest, np.broadcast_to(spread, (len(points), len(spread)))], axis=1)
    ways = (inside[rows] - points[:, None]).reshape(-1, 3)
    hits = scene.caster.cast(np.repeat(points, rows.shape[1], axis=0), ways)
    return np.asarray((hits.distance > 1.0).reshape(rows.shape).mean(axis=1) >= _SIGHTED)


def find_least_mapped_share(scene: Scene) -> float:
    """Return the share of its panorama that the map must hold at a place where no camera was.

    A sweep with a narrow view holds little even where its cameras were.
    """
    if not len(scene.viewpoints):
        return _MAPPED
    panoramas = kernels.render_panoramas(
        scene.caster.tracer, scene.surface, scene.viewpoints, DIRECTIONS, len(scene)
    )
    return float(min(_MOST_MAPPED, _OWN * _find_mapped_shares(panoramas).min()))


def _find_mapped_shares(panoramas: kernels.Panoramas) -> Floats:
    return np.asarray((panoramas.ranges != kernels.NOTHING).mean(axis=(1, 2)))


def find_free_places(panoramas: kernels.Panoramas, least: float) -> NDArray[np.int64]:
    """Return rows where a camera can be: not in a wall or a cupboard, and not where too little is mapped.

    `least`: share of a panorama that must be mapped (`find_least_mapped_share`).
    """
    ranges = decode_ranges(panoramas.ranges.reshape(-1, kernels.ELEVATIONS * kernels.AZIMUTHS))
    nearest = np.partition(ranges, ranges.shape[1] // 100, axis=1)[:, ranges.shape[1] // 100]
    enclosed = (ranges < _ENCLOSED).mean(axis=1) > 0.5
    mapped = _find_mapped_shares(panoramas) > least
    return np.flatnonzero((nearest > _CLEARANCE) & ~enclosed & mapped)
