"""What is visible from where: a table that ranks positions and headings before a ray is cast.

From every free cell of the floor, at camera height, one panorama is ray-cast: which object, how
far, which colour, in bins of azimuth and elevation. A view is then compared with all headings at a
position by running along the azimuth axis, which is a matrix product in all but name: no ray, no
trigonometry, and positions that share a ray share its work. The table is derived from the mesh in a
fraction of a second, so it is not stored in the map.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit, prange

from placegraph.indoor.raycast.packets import (
    DIRECTION,
    FAR,
    LANES,
    ORIGIN,
    TRIANGLE,
    U,
    V,
    new_packet,
    trace16,
)
from placegraph.indoor.observe import Background
from placegraph.indoor.score import COLOUR, DEPTH, SEMANTIC
from placegraph.indoor.surface import colour_at, opponent

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from placegraph.indoor.options import FilterOptions
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.indoor.score import Noise, View

AZIMUTHS = 72
ELEVATIONS = 20
STEP = 2.0 * np.pi / AZIMUTHS
"""Bin of azimuth, and step of headings [rad]: 5 degrees."""
HIGHEST = np.deg2rad(50.0)
"""Elevations of the table end here, above and below the horizon."""
_NEAREST, _FARTHEST = 0.1, 30.0  # ranges are stored in 255 steps of their logarithm, 2.3 % each
_NOTHING = 255
_CHUNKS = 64
_MOST = 12_000  # positions; larger maps get a wider grid
_CLEARANCE = 0.15  # a camera is no nearer to a surface [m]
_ENCLOSED = 0.5  # nor in a place where half of what it sees is nearer than this [m]
_MAPPED = 0.1  # nor where less than this share of its panorama is mapped


class Panoramas(NamedTuple):
    """K panoramas of E elevations and A azimuths."""

    objects: NDArray[np.uint16]
    """(K, E, A) row of the object; their number where the map ends."""
    ranges: NDArray[np.uint8]
    """(K, E, A) logarithmic; 255: the map ends."""
    colours: NDArray[np.uint8]
    """(K, E, 3, A) `surface.opponent`, scaled to bytes."""


@dataclass(frozen=True, slots=True, eq=False)
class VisibilityTable:
    """Panoramas from all free positions of a map, at one or more heights."""

    positions: NDArray[np.float64]
    """(K, 3) [m, map]; positions of one layer after those of another."""
    panoramas: Panoramas
    origin: NDArray[np.float64]
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

    def ranks(
        self,
        views: Sequence[View],
        steps: NDArray[np.float64],
        noise: Noise,
    ) -> NDArray[np.float32]:
        """Log-likelihood (K, A) of every position and heading of the reference frame.

        `steps`: (T, 4) from the reference frame to each view's frame (`geometry.between`).
        """
        total = np.zeros((len(self), AZIMUTHS), np.float32)
        for view, step in zip(views, steps, strict=True):
            scan = self.scan(view, noise)
            # what the table does not know is taken for bad, not for impossible
            unknown = np.float32(np.percentile(scan, 5.0))
            _add_moved(total, scan, unknown, self.positions, self.layer, self.index, self.origin, self.spacing, step)
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
        return _scan(
            self.panoramas,
            self.mapped,
            patch,
            np.minimum(band, ELEVATIONS - 1),
            azimuth,
            semantic.astype(np.float32) if terms[SEMANTIC] else np.zeros((0, 0), np.float32),
            _depth_costs(view.depth[use] * reach, view.usual_depth[use], noise)
            if terms[DEPTH]
            else _NO_COSTS,
            _as_bytes(view.colour[use]) if coloured else np.zeros((0, 3), np.float32),
            np.float32(noise.colour_weight),
        )


_NO_COSTS = np.zeros((0, 256), np.float32)


def build_table(
    scene: SceneMap,
    options: FilterOptions,
    progress: Callable[[str, int, int], None] | None = None,
) -> VisibilityTable:
    """Table of a map for cameras at `options.heights`; empty where no position is free."""
    bounds = scene.bounds
    extent = bounds[1, :2] - bounds[0, :2]
    spacing = max(options.spacing, float(np.sqrt(np.prod(extent) / _MOST)))
    nx, ny = np.maximum(1, np.ceil(extent / spacing).astype(int))
    x = bounds[0, 0] + (np.arange(nx) + 0.5) * spacing
    y = bounds[0, 1] + (np.arange(ny) + 0.5) * spacing
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    floors = floor_under(scene, grid)
    layers = _layers(options.heights)
    index = np.full((len(layers), nx * ny), -1, np.int32)
    positions, parts = [], []
    for layer, height in enumerate(layers):
        if progress:
            progress("looking around", layer, len(layers))
        points = np.column_stack([grid, floors + height])
        panoramas = _panoramas(
            scene.caster.tracer, scene.surface, points, _DIRECTIONS, len(scene)
        )
        free = _free(panoramas)
        index[layer, free] = sum(map(len, positions)) + np.arange(len(free))
        positions.append(points[free])
        parts.append(Panoramas(*(a[free] for a in panoramas)))
    panoramas = Panoramas(*(np.concatenate(a) for a in zip(*parts, strict=True)))
    return VisibilityTable(
        positions=np.concatenate(positions),
        panoramas=panoramas,
        mapped=(panoramas.ranges != _NOTHING).all(axis=(1, 2)),
        background=_background(panoramas, len(scene)),
        origin=bounds[0, :2].copy(),
        spacing=spacing,
        index=index.reshape(len(layers), nx, ny),
        layer=np.repeat(np.arange(len(layers), dtype=np.int32), [len(p) for p in positions]),
    )


def _background(panoramas: Panoramas, objects: int) -> Background:
    """Shares of objects and ranges among all rays that hit, a little smoothed."""
    seen = np.bincount(panoramas.objects.ravel(), minlength=objects + 1)[:objects] + 1.0
    ranges = np.empty((ELEVATIONS, 256))
    for e in range(ELEVATIONS):
        ranges[e] = np.bincount(panoramas.ranges[:, e].ravel(), minlength=256) + 1.0
    ranges[:, _NOTHING] = 0.0
    distances = range_of(np.arange(256, dtype=np.uint8)).astype(np.float64)
    distances[_NOTHING] = _FARTHEST
    return Background(
        seen / seen.sum(), ranges / ranges.sum(axis=1, keepdims=True), distances, HIGHEST
    )


def floor_under(scene: SceneMap, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height of the floor (N,) of the merged scene that each of points (N, 2) is in, or nearest."""
    boxes = scene.scene_bounds[:, :, :2]
    outside = np.maximum(boxes[:, 0] - points[:, None], points[:, None] - boxes[:, 1])
    nearest = np.maximum(outside, 0.0).sum(axis=2).argmin(axis=1)
    return np.asarray(scene.floors[nearest])


def _layers(heights: Sequence[float]) -> list[float]:
    """Few heights, at most 0.3 m apart, between the lowest and the highest asked for."""
    low, high = min(heights), max(heights)
    count = max(1, int(np.ceil((high - low) / 0.35)))
    return [low + (high - low) * (i + 0.5) / count for i in range(count)]


def _directions() -> NDArray[np.float32]:
    """Unit rays (E * A, 3) in tiles of 4 x 4 bins; azimuth bins are centred on multiples of STEP."""
    azimuth = np.arange(AZIMUTHS) * STEP
    elevation = ((np.arange(ELEVATIONS) + 0.5) / ELEVATIONS * 2.0 - 1.0) * HIGHEST
    e, a = np.meshgrid(elevation, azimuth, indexing="ij")
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)
    tiles = rays.reshape(ELEVATIONS // 4, 4, AZIMUTHS // 4, 4, 3).swapaxes(1, 2)
    return np.ascontiguousarray(tiles.reshape(-1, 3), np.float32)


_DIRECTIONS = _directions()


def _free(panoramas: Panoramas) -> NDArray[np.int64]:
    """Rows where a camera can be: not in a wall or a cupboard, and not off the map."""
    ranges = range_of(panoramas.ranges.reshape(len(panoramas.ranges), -1))
    mapped = (panoramas.ranges != _NOTHING).mean(axis=(1, 2))
    nearest = np.partition(ranges, ranges.shape[1] // 100, axis=1)[:, ranges.shape[1] // 100]
    enclosed = (ranges < _ENCLOSED).mean(axis=1) > 0.5
    return np.flatnonzero((nearest > _CLEARANCE) & ~enclosed & (mapped > _MAPPED))


def range_of(steps: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Distances [m] of stored ranges."""
    table = _NEAREST * np.exp(np.arange(256) / 254.0 * np.log(_FARTHEST / _NEAREST))
    table[_NOTHING] = np.inf
    return table.astype(np.float32)[steps]


def _depth_costs(
    ranges: NDArray[np.float64], usual: NDArray[np.float32], noise: Noise
) -> NDArray[np.float32]:
    """Log-likelihood (S, 256) of each measured range [m] for every stored one."""
    expected = range_of(np.arange(256, dtype=np.uint8))[None, :]
    measured = ranges[:, None]
    # the true position lies up to 0.7 of the grid's spacing away from the nearest of the table
    sd = noise.depth_floor + 0.1 + noise.depth_slope * measured
    with np.errstate(invalid="ignore"):
        good = 1.0 / (1.0 + ((expected - measured) / sd) ** 2)
    cost = np.where(expected > measured, noise.near_cost, noise.far_cost)
    table = good * noise.depth_gain - (1.0 - good) * cost - usual[:, None]
    table[:, _NOTHING] = 0.0
    table[ranges <= 0] = 0.0
    return np.asarray(table * (noise.depth_weight / max(1, len(ranges))), np.float32)


def _as_bytes(opponents: NDArray[np.float32]) -> NDArray[np.float32]:
    """Colours on the scale of the table's."""
    return np.asarray(opponents * _SCALE + _SHIFT, np.float32)


_SCALE = np.array([85.0, 127.0, 63.0], np.float32)
_SHIFT = np.array([0.0, 127.0, 127.0], np.float32)


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def _panoramas(tracer, surface, points, directions, objects):
    """Panoramas from points (K, 3)."""
    n = len(points)
    seen = np.full((n, ELEVATIONS, AZIMUTHS), objects, np.uint16)
    ranges = np.full((n, ELEVATIONS, AZIMUTHS), _NOTHING, np.uint8)
    colours = np.zeros((n, ELEVATIONS, 3, AZIMUTHS), np.uint8)
    scale = np.float32(254.0 / np.log(_FARTHEST / _NEAREST))
    for chunk in prange(_CHUNKS):
        packet, ints, valid = new_packet()
        for k in range(chunk * n // _CHUNKS, (chunk + 1) * n // _CHUNKS):
            for tile in range(len(directions) // LANES):
                for lane in range(LANES):
                    for axis in range(3):
                        packet[ORIGIN + axis, lane] = points[k, axis]
                        packet[DIRECTION + axis, lane] = directions[tile * LANES + lane, axis]
                    packet[FAR, lane] = np.inf
                trace16(tracer, packet, ints, valid)
                for lane in range(LANES):
                    triangle = ints[TRIANGLE, lane]
                    if triangle < 0:
                        continue
                    e = tile // (AZIMUTHS // 4) * 4 + lane // 4
                    a = tile % (AZIMUTHS // 4) * 4 + lane % 4
                    seen[k, e, a] = surface.object_of[triangle]
                    steps = np.log(packet[FAR, lane] / np.float32(_NEAREST)) * scale
                    ranges[k, e, a] = np.uint8(min(max(steps, np.float32(0)), np.float32(254)))
                    red, green, blue = colour_at(
                        surface,
                        triangle,
                        packet[U, lane],
                        packet[V, lane],
                        packet[FAR, lane] * np.float32(STEP),
                    )
                    rendered = opponent(red, green, blue)
                    for c in range(3):
                        byte = rendered[c] * _SCALE[c] + _SHIFT[c]
                        colours[k, e, c, a] = np.uint8(
                            min(max(byte, np.float32(0)), np.float32(255))
                        )
    return Panoramas(seen, ranges, colours)


@njit(cache=True, nogil=True, parallel=True, fastmath=True, error_model="numpy")
def _scan(panoramas, mapped, patch, band, azimuth, semantic, depth, colour, colour_weight):
    """Log-likelihood (K, A): for each sample, its bin's column turned through all headings."""
    n = len(panoramas.objects)
    samples = len(patch)
    out = np.empty((n, AZIMUTHS), np.float32)
    sums = np.zeros((3, 2), np.float32)
    for s in range(len(colour)):
        for c in range(3):
            sums[c, 0] += colour[s, c]
            sums[c, 1] += colour[s, c] * colour[s, c]
    for k in prange(n):
        whole = mapped[k]
        total = np.zeros(AZIMUTHS, np.float32)
        hits = np.zeros(AZIMUTHS, np.float32)
        m = np.zeros((3, 5, AZIMUTHS), np.float32)
        for s in range(samples):
            shift = azimuth[s]
            for part in range(2):
                # heading a looks at azimuth a + shift: two runs without a modulo in the loop
                first, last = (0, AZIMUTHS - shift) if part == 0 else (AZIMUTHS - shift, AZIMUTHS)
                offset = shift if part == 0 else shift - AZIMUTHS
                ranges = panoramas.ranges[k, band[s]]
                if len(semantic):
                    objects = panoramas.objects[k, band[s]]
                    says = semantic[patch[s]]
                    for a in range(first, last):
                        total[a] += says[objects[a + offset]]
                if len(depth):
                    costs = depth[s]
                    for a in range(first, last):
                        total[a] += costs[ranges[a + offset]]
                if len(colour) and whole:
                    for c in range(3):
                        q = colour[s, c]
                        column = panoramas.colours[k, band[s], c]
                        for a in range(first, last):
                            r = np.float32(column[a + offset])
                            m[c, 1, a] += r
                            m[c, 3, a] += r * r
                            m[c, 4, a] += q * r
                elif len(colour):
                    for a in range(first, last):
                        hits[a] += np.float32(ranges[a + offset] != _NOTHING)
                    for c in range(3):
                        q = colour[s, c]
                        column = panoramas.colours[k, band[s], c]
                        for a in range(first, last):
                            there = np.float32(ranges[a + offset] != _NOTHING)
                            r = np.float32(column[a + offset]) * there
                            m[c, 0, a] += q * there
                            m[c, 1, a] += r
                            m[c, 2, a] += q * q * there
                            m[c, 3, a] += r * r
                            m[c, 4, a] += q * r
        if len(colour) and whole:  # sums of the image alone: the same everywhere
            hits[:] = samples
            for c in range(3):
                m[c, 0] = sums[c, 0]
                m[c, 2] = sums[c, 1]
        if len(colour):
            _add_correlation(total, hits, m, colour_weight / np.float32(samples))
        out[k] = total
    return out


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _add_correlation(total, hits, m, weight):
    """Add what the colours tell (`score._correlation`) to all headings of one position."""
    for a in range(AZIMUTHS):
        n = hits[a]
        if n < LANES:
            continue
        told = np.float32(0.0)
        for c in range(3):
            q, r = m[c, 0, a] / n, m[c, 1, a] / n
            vq, vr = m[c, 2, a] / n - q * q, m[c, 3, a] / n - r * r
            if vq > 1.0 and vr > 1.0:
                rho = (m[c, 4, a] / n - q * r) / np.sqrt(vq * vr)
                rho = min(max(rho, np.float32(0.0)), np.float32(0.99))
                told -= np.log(np.float32(1.0) - rho * rho)
        total[a] += weight * n * told / np.float32(6.0)


@njit(cache=True, nogil=True, parallel=True)
def _add_moved(total, scan, unknown, positions, layer_of, index, origin, spacing, step):
    """Add to each pose of the reference frame what `scan` says of it moved by `step`."""
    _, nx, ny = index.shape
    cosines, sines = np.cos(np.arange(AZIMUTHS) * STEP), np.sin(np.arange(AZIMUTHS) * STEP)
    turn = int(np.round(step[3] / STEP))
    for k in prange(len(positions)):
        for a in range(AZIMUTHS):
            c, s = cosines[a], sines[a]
            x = positions[k, 0] + c * step[0] - s * step[1]
            y = positions[k, 1] + s * step[0] + c * step[1]
            i = int(np.floor((x - origin[0]) / spacing))
            j = int(np.floor((y - origin[1]) / spacing))
            row = -1
            if 0 <= i < nx and 0 <= j < ny:
                row = index[layer_of[k], i, j]
            if row >= 0:
                total[k, a] += scan[row, (a + turn) % AZIMUTHS]
            else:
                total[k, a] += unknown
