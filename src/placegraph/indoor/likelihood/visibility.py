"""What is visible from where: a table that ranks positions and headings before a ray is cast.

From every free cell of the floor, at camera height, one panorama is ray-cast: which object, how
far, which colour, in bins of azimuth and elevation. A view is then compared with all headings at a
position by running along the azimuth axis, which is a matrix product in all but name: no ray, no
trigonometry, and positions that share a ray share its work. The table is derived from the mesh in a
fraction of a second, so it is not stored in the map.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import OptionError
from placegraph.indoor.likelihood.calibrated import reading_ratio
from placegraph.indoor.likelihood.score_kernels import COLOUR, DEPTH, SEMANTIC
from placegraph.indoor.likelihood.view import Background
from placegraph.indoor.map.panoramas import DIRECTIONS, HIGHEST, as_bytes, range_of
from placegraph.indoor.map.panoramas_kernels import (
    AZIMUTHS,
    ELEVATIONS,
    FARTHEST,
    NOTHING,
    STEP,
    Panoramas,
    add_moved,
    look_around,
    scan_headings,
)
from placegraph.indoor.rays.layout import LANES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from placegraph.geometry import Floats
    from placegraph.indoor.likelihood.view import Noise, View
    from placegraph.indoor.map.scene import Scene
    from placegraph.indoor.options import FilterOptions

_MOST = 12_000  # positions; larger maps get a wider grid
_CLEARANCE = 0.15  # a camera is no nearer to a surface [m]
_ENCLOSED = 0.5  # nor in a place where half of what it sees is nearer than this [m]
_CLOSED = 0.95
_MAPPED = 0.1  # nor where less than this share of its panorama is mapped


@dataclass(frozen=True, slots=True, eq=False)
class VisibilityTable:
    """Panoramas from all free positions of a map, at one or more heights."""

    positions: Floats
    """(K, 3) [m, map]; positions of one layer after those of another."""
    panoramas: Panoramas
    origin: Floats
    """(2,) lower corner of the grid [m]."""
    spacing: float
    index: NDArray[np.int32]
    """(layers, nx, ny) row of the position of each cell; -1: not free."""
    layer: NDArray[np.int32]
    """(K,) layer of each position."""

    mapped: NDArray[np.bool_]
    """(K,) whether all rays of a panorama hit."""
    background: Background
    """What is seen on average."""

    def __len__(self) -> int:
        return len(self.positions)

    def ranks(self, views: Sequence[View], steps: Floats, noise: Noise) -> NDArray[np.float32]:
        """Log-likelihood (K, A) of every position and heading of the reference frame.

        `steps`: (T, 4) from the reference frame to each view's frame (`geometry.between`).
        """
        total = np.zeros((len(self), AZIMUTHS), np.float32)
        for view, step in zip(views, steps, strict=True):
            scan = self.scan(view, noise)
            # what the table does not know is taken for bad, not for impossible
            unknown = np.float32(np.percentile(scan, 5.0))
            add_moved(
                total,
                scan,
                unknown,
                self.positions,
                self.layer,
                self.index,
                self.origin,
                self.spacing,
                step,
            )
        return total

    def scan(self, view: View, noise: Noise) -> NDArray[np.float32]:
        """Log-likelihood (K, A) of one view at every position and heading a * STEP."""
        d = view.directions.astype(np.float64)
        reach = np.linalg.norm(d, axis=1)
        elevation = np.arcsin(d[:, 2] / reach)
        # every other sample, as on a chessboard: the bins are no finer
        lane = np.arange(len(d)) % LANES
        use = (view.patch >= 0) & (np.abs(elevation) < HIGHEST) & ((lane // 4 + lane) % 2 == 0)
        d, reach, elevation = d[use], reach[use], elevation[use]
        patch = view.patch[use]
        band = ((elevation / HIGHEST + 1.0) / 2.0 * ELEVATIONS).astype(np.int32)
        azimuth = np.round(np.arctan2(d[:, 1], d[:, 0]) / STEP).astype(np.int32) % AZIMUTHS
        share = np.bincount(patch, minlength=len(view.weight))
        # a sample of a patch that has several speaks for its share of it
        weight = (view.weight / np.maximum(share, 1))[:, None].astype(np.float32)
        semantic = np.log(np.maximum(view.semantic, 1e-6)) * weight
        terms = view.terms
        # where labels and depth are there, colours are left to the rays: they are the dearest here
        coloured = terms[COLOUR] and not (terms[SEMANTIC] and terms[DEPTH])
        return scan_headings(
            self.panoramas,
            self.mapped,
            patch,
            np.minimum(band, ELEVATIONS - 1),
            azimuth,
            semantic.astype(np.float32) if terms[SEMANTIC] else np.zeros((0, 0), np.float32),
            _depth_costs(view.depth[use] * reach, view.usual_depth[use], noise)
            if terms[DEPTH]
            else _NO_COSTS,
            as_bytes(view.colour[use]) if coloured else np.zeros((0, 3), np.float32),
            np.float32(noise.colour_weight),
        )


_NO_COSTS = np.zeros((0, 256), np.float32)


def visibility(scene: Scene, options: FilterOptions) -> VisibilityTable:
    """What is visible from where, for cameras at `options.heights`; made once for each."""
    key = ("visibility", options.heights, options.spacing)
    return scene.derived(key, lambda scene: build_table(scene, options))


def build_table(scene: Scene, options: FilterOptions) -> VisibilityTable:
    """Table of a map for cameras at `options.heights`; empty where no position is free.

    Raises `OptionError` where the map has more objects than a bin of the table can name.
    """
    if len(scene) > np.iinfo(np.uint16).max:
        raise OptionError(
            f"{scene.source or 'The map'} has {len(scene):,} objects; "
            f"up to {np.iinfo(np.uint16).max:,} can be localized in. Split it."
        )
    bounds = _ground(scene, options.spacing)
    extent = bounds[1, :2] - bounds[0, :2]
    spacing = max(options.spacing, float(np.sqrt(np.prod(extent) / _MOST)))
    nx, ny = np.maximum(1, np.ceil(extent / spacing).astype(int))
    x = bounds[0, 0] + (np.arange(nx) + 0.5) * spacing
    y = bounds[0, 1] + (np.arange(ny) + 0.5) * spacing
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    floors = floor_under(scene, grid)
    layers = _layers(options.heights)
    index = np.full((len(layers), nx * ny), -1, np.int32)
    positions: list[Floats] = []
    parts: list[Panoramas] = []
    for layer, height in enumerate(layers):
        points = np.column_stack([grid, floors + height])
        panoramas = look_around(scene.caster.tracer, scene.surface, points, DIRECTIONS, len(scene))
        below = scene.caster.cast(points, np.tile([0.0, 0.0, -1.0], (len(points), 1)))
        free = _free(panoramas, np.isfinite(below.distance))
        index[layer, free] = sum(len(p) for p in positions) + np.arange(len(free))
        positions.append(points[free])
        parts.append(Panoramas(*(a[free] for a in panoramas)))
    panoramas = Panoramas(*(np.concatenate(a) for a in zip(*parts, strict=True)))
    return VisibilityTable(
        positions=np.concatenate(positions),
        panoramas=panoramas,
        mapped=(panoramas.ranges != NOTHING).all(axis=(1, 2)),
        background=_background(panoramas, len(scene)),
        origin=bounds[0, :2].copy(),
        spacing=spacing,
        index=index.reshape(len(layers), nx, ny),
        layer=np.repeat(np.arange(len(layers), dtype=np.int32), [len(p) for p in positions]),
    )


def _ground(scene: Scene, spacing: float) -> Floats:
    """Box (2, 3) in which cameras are looked for: the map's, or of a vast map its better part.

    One triangle that reaches to the horizon must not spread the grid over nothing: where the box
    would hold more cells than the table can, it is cut to where all but a hundredth of the
    surface lies, no triangle counting for more than a square metre.
    """
    bounds = scene.bounds
    if np.prod(bounds[1, :2] - bounds[0, :2]) <= _MOST * spacing**2:
        return bounds
    corners = scene.mesh.vertices[scene.mesh.triangles].astype(np.float64)
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.minimum(np.linalg.norm(sides, axis=1) / 2.0, 1.0)
    out = bounds.copy()
    for axis in range(2):
        centre = corners[:, :, axis].mean(axis=1)
        order = np.argsort(centre)
        share = np.cumsum(area[order]) / area.sum()
        ends = centre[order][np.searchsorted(share, [0.005, 0.995])]
        out[:, axis] = np.clip(ends + np.array([-1.0, 1.0]), *bounds[:, axis])
    return out


def _background(panoramas: Panoramas, objects: int) -> Background:
    """Shares of objects and ranges among all rays that hit, a little smoothed."""
    seen = np.bincount(panoramas.objects.ravel(), minlength=objects + 1)[:objects] + 1.0
    ranges = np.empty((ELEVATIONS, 256))
    for e in range(ELEVATIONS):
        ranges[e] = np.bincount(panoramas.ranges[:, e].ravel(), minlength=256) + 1.0
    ranges[:, NOTHING] = 0.0
    distances = range_of(np.arange(256, dtype=np.uint8)).astype(np.float64)
    distances[NOTHING] = FARTHEST
    return Background(
        seen / seen.sum(), ranges / ranges.sum(axis=1, keepdims=True), distances, HIGHEST
    )


def floor_under(scene: Scene, points: Floats) -> Floats:
    """Height of the floor (N,) of the merged scene that each of points (N, 2) is in, or nearest."""
    boxes = scene.scene_bounds[:, :, :2]
    outside = np.maximum(boxes[:, 0] - points[:, None], points[:, None] - boxes[:, 1])
    nearest = np.maximum(outside, 0.0).sum(axis=2).argmin(axis=1)
    return np.asarray(scene.floors[nearest])


def _layers(heights: Sequence[float]) -> list[float]:
    """Few heights, at most 0.35 m apart, between the lowest and the highest asked for."""
    low, high = min(heights), max(heights)
    count = max(1, int(np.ceil((high - low) / 0.35)))
    return [low + (high - low) * (i + 0.5) / count for i in range(count)]


def _free(panoramas: Panoramas, floored: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Rows where a camera can be: not in a wall or a cupboard, and not off the map.

    `floored`: (K,) whether there is anything straight below.
    """
    ranges = range_of(panoramas.ranges.reshape(len(panoramas.ranges), -1))
    mapped = (panoramas.ranges != NOTHING).mean(axis=(1, 2))
    nearest = np.partition(ranges, ranges.shape[1] // 100, axis=1)[:, ranges.shape[1] // 100]
    enclosed = (ranges < _ENCLOSED).mean(axis=1) > 0.5
    able = (nearest > _CLEARANCE) & ~enclosed & (mapped > _MAPPED)
    # in a map that is closed below the horizon, a place without floor lies outside
    low = (panoramas.ranges[:, : ELEVATIONS // 2] != NOTHING).mean(axis=(1, 2))
    if able.any() and np.median(low[able]) > _CLOSED:
        able &= floored
    return np.flatnonzero(able)


def _depth_costs(ranges: Floats, usual: NDArray[np.float32], noise: Noise) -> NDArray[np.float32]:
    """Log-likelihood (S, 256) of each measured range [m] for every stored one."""
    expected = range_of(np.arange(256, dtype=np.uint8))[None, :]
    measured = ranges[:, None]
    # the true position lies up to 0.7 of the grid's spacing away from the nearest of the table
    sd = noise.depth_floor + 0.1 + noise.depth_slope * measured
    table = reading_ratio(expected - measured, sd, noise) - usual[:, None]
    table[:, NOTHING] = 0.0
    table[ranges <= 0] = 0.0
    return np.asarray(table * (noise.depth_weight / max(1, len(ranges))), np.float32)
