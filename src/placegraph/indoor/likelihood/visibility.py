"""Visibility table, which ranks positions and headings before a ray is cast.

From free cells of a coarse grid, in layers from a robot's height to a raised hand's, one panorama each
is ray-cast: which object, how far, which colour, in bins of azimuth and elevation. A view is then
compared with all headings at a position by running along the azimuth axis, which is a matrix
product in all but name: no ray, no trigonometry, and positions that share a ray share its work. The
table is derived from the mesh in about a second, so it is not stored in the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.errors import OptionError
from placegraph.indoor.likelihood.observe import Background, Noise, View
from placegraph.indoor.likelihood.score import TEMPERATURE, reading_ratio
from placegraph.indoor.likelihood.score_kernels import COLOUR, DEPTH, SEMANTIC
from placegraph.indoor.map.free_space import (
    DIRECTIONS,
    MAX_ELEVATION,
    decode_ranges,
    find_free_places,
    find_least_mapped_share,
    find_nearest_scene,
    make_grid,
    probe_places,
    scale_colours,
)
from placegraph.indoor.map.map_kernels import (
    AZIMUTHS,
    ELEVATIONS,
    FARTHEST,
    HEADINGS,
    NOTHING,
    STEP,
    Bins,
    Panoramas,
    add_shifted,
    render_panoramas,
    scan_headings,
)
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.rays.trace_kernels import LANES

_ASKED = {
    SEMANTIC: 240,
    DEPTH: 360,
    COLOUR: 720,
}  # samples of all views, by the sense that tells most
_USUAL = (1.05, 1.85)  # heights at which cameras are carried and mounted [m] ...
_RARE = -4.0  # ... and the log prior of others, in units of the views' temperature
_THINNED = 7  # values of a scan that tell its percentiles: every seventh
_BLURRED = 0.5  # of the grid's spacing: how far off a range is at the next position of the table


@dataclass(frozen=True, slots=True, eq=False)
class VisibilityTable:
    """Panoramas from all free positions of a map, at one or more heights."""

    positions: Floats
    """(K, 3) [m, map]; positions of one layer after those of another."""
    ground: Floats
    """(K,) height of the floor below [m, map]."""
    panoramas: Panoramas
    origin: Floats
    """(2,) lower corner of the grid [m]."""
    spacing: float
    index: NDArray[np.int32]
    """(layers, nx, ny) row of the position of each cell; -1: not free."""
    layer: NDArray[np.int32]
    """(K,) layer of each position."""
    is_common: NDArray[np.bool_]
    """(K,) whether cameras are common there: as high as the map's own, else as people hold them."""
    background: Background
    """Background model of the map."""

    def __len__(self) -> int:
        return len(self.positions)

    def ranks(self, views: Sequence[View], steps: Floats, noise: Noise) -> NDArray[np.float32]:
        """Return the log-likelihood (K, HEADINGS) of every position and heading of the reference frame.

        `steps`: (T, 4) from the reference frame to each view's frame (`geometry.between`). Positions
        where cameras are common come first among equals.
        """
        total = np.zeros((len(self), HEADINGS), np.float32)
        rare = _RARE * TEMPERATURE * np.sqrt(len(views))
        total[~self.is_common] = np.float32(rare)
        for scan, step in zip(self.scans(views, steps[:, 3], noise), steps, strict=True):
            # positions that the table lacks are unlikely, not impossible
            unknown = np.float32(np.percentile(scan.ravel()[::_THINNED], 5.0))
            add_shifted(
                total,
                scan,
                unknown,
                self.positions,
                self.layer,
                self.index,
                self.origin,
                self.spacing,
                step[:3],
            )
        return total

    def scans(self, views: Sequence[View], turns: Floats, noise: Noise) -> NDArray[np.float32]:
        """Return the log-likelihood (T, K, HEADINGS) of each view alone at every position.

        Heading a is that of the reference frame; view t looks along a * 2 pi / HEADINGS + `turns`[t].
        """
        senses = [term for term in _ASKED if all(v.terms[term] for v in views)]
        asked = _ASKED[senses[0] if senses else COLOUR]
        share = asked / max(1, sum(np.count_nonzero(v.patch >= 0) for v in views))
        lanes = min(LANES, int(np.ceil(share * LANES)))
        found = [
            _find_bins(view, turn, lanes, t, noise, _BLURRED * self.spacing)
            for t, (view, turn) in enumerate(zip(views, turns, strict=True))
        ]
        counts = [len(part.band) for part in found]
        columns = []
        for parts in zip(*(part[1:] for part in found), strict=True):
            most = max(parts, key=np.size)  # views say nothing of a sense that only others have
            none = (np.zeros((n, *most.shape[1:]), most.dtype) for n in counts)
            rows = zip(parts, none, strict=True)
            columns.append(np.concatenate([own if own.size else zeros for own, zeros in rows]))
        bins = Bins(np.cumsum(counts), *columns)
        return scan_headings(self.panoramas, bins, np.float32(noise.colour_weight))


def visibility(scene: Scene, options: PoseSearchOptions) -> VisibilityTable:
    """Return the visibility table for cameras at `options.heights`; built once for each."""
    key = ("visibility", options.heights, options.spacing)
    return scene.compute_once(key, lambda scene: build_table(scene, options))


def build_table(scene: Scene, options: PoseSearchOptions) -> VisibilityTable:
    """Build the table of a map for cameras at `options.heights`; empty if no position is free.

    Raises `OptionError` where the map has more objects than a bin of the table can name.
    """
    if len(scene) > np.iinfo(np.uint16).max:
        raise OptionError(
            f"{scene.source or 'The map'} has {len(scene):,} objects, but localization "
            f"supports at most {np.iinfo(np.uint16).max:,}; split the map."
        )
    grid = make_grid(scene, options.heights, options.spacing)
    least = find_least_mapped_share(scene)
    render = partial(
        render_panoramas, scene.caster.tracer, scene.surface,
        directions=DIRECTIONS, objects=len(scene),
    )  # fmt: skip
    places = []  # layer, cells, points and panoramas
    for layer, height in enumerate(grid.height):
        cells = np.flatnonzero(np.isfinite(height))
        points = np.column_stack([grid.centres[cells], height[cells]])
        able = probe_places(scene, points)
        cells, points = cells[able], points[able]
        seen = render(points)
        rows = find_free_places(seen, least)
        places.append((layer, cells[rows], points[rows], Panoramas(*(a[rows] for a in seen))))
        if layer < len(grid.camera):
            # where a camera was one can be, whatever the map shows there
            own = grid.camera[layer]
            lost = np.setdiff1d(np.flatnonzero(own >= 0), cells[rows])
            points = scene.viewpoints[own[lost]]
            places.append((layer, lost, points, render(points)))
    cells, positions = (np.concatenate([place[i] for place in places]) for i in (1, 2))
    panoramas = Panoramas(
        *(_concatenate(parts) for parts in zip(*(place[3] for place in places), strict=True))
    )
    layer_of = np.repeat(
        np.array([place[0] for place in places], np.int32), [len(place[1]) for place in places]
    )
    index = np.full(grid.height.shape, -1, np.int32)
    index[layer_of, cells] = np.arange(len(cells))
    ground = grid.floor[layer_of, cells]
    return VisibilityTable(
        positions=positions,
        ground=ground,
        panoramas=panoramas,
        background=_background(panoramas, len(scene)),
        origin=grid.origin,
        spacing=grid.spacing,
        index=index.reshape(len(grid.height), *grid.shape),
        layer=layer_of,
        is_common=_find_common_positions(scene, layer_of < len(grid.camera), positions, ground),
    )


def _concatenate(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Concatenate panoramas (K, ...), with positions beside each other in memory (`scan_headings`)."""
    out = np.empty((*parts[0].shape[1:], sum(map(len, parts))), parts[0].dtype)
    return np.concatenate(parts, out=np.moveaxis(out, -1, 0))


def _find_common_positions(
    scene: Scene, is_walked: NDArray[np.bool_], positions: Floats, ground: Floats
) -> NDArray[np.bool_]:
    """Return whether cameras are common (K,) at `positions` (K, 3) in layers above `ground` (K,) [m].

    In each merged scene as high as its own cameras (`is_walked` (K,)), or as people hold them if it
    has none.
    """
    above, within = positions[:, 2] - ground, find_nearest_scene(scene, positions[:, :2])[0]
    walked = np.zeros(len(scene.scenes), np.bool_)
    if len(scene.viewpoints):
        walked[find_nearest_scene(scene, scene.viewpoints[:, :2])[0]] = True
    held = (above > _USUAL[0]) & (above < _USUAL[1])
    is_common = np.where(walked[within], is_walked, held)
    return is_common if is_common.any() else np.ones(len(above), np.bool_)


def _background(panoramas: Panoramas, objects: int) -> Background:
    """Return the shares of objects and ranges among all rays that hit, a little smoothed."""
    seen = np.bincount(panoramas.objects.ravel(), minlength=objects + 1)[:objects] + 1.0
    ranges = np.empty((ELEVATIONS, 256))
    for e in range(ELEVATIONS):
        ranges[e] = np.bincount(panoramas.ranges[:, e].ravel(), minlength=256) + 1.0
    ranges[:, NOTHING] = 0.0
    distances = decode_ranges(np.arange(256, dtype=np.uint8)).astype(np.float64)
    distances[NOTHING] = FARTHEST
    return Background(
        seen / seen.sum(), ranges / ranges.sum(axis=1, keepdims=True), distances, MAX_ELEVATION
    )


def floor_under(scene: Scene, points: Floats) -> Floats:
    """Return the floor height (N,) of the merged scene that each of points (N, 2) is in, or nearest."""
    return np.asarray(scene.floors[find_nearest_scene(scene, points)[0]])


def _find_bins(view: View, turn: float, lanes: int, offset: int, noise: Noise, blur: float) -> Bins:
    """Find the bins that `lanes` samples of each tile of a view meet, turned by `turn` [rad].

    `offset`: selects other lanes.
    """
    d = view.directions.astype(np.float64)
    reach = np.linalg.norm(d, axis=1)
    elevation = np.arcsin(d[:, 2] / reach)
    # spread over the tile as queens on a chessboard, others in each view
    lane = (_SPREAD[np.arange(len(d)) % LANES] + 5 * offset) % LANES
    asked = (view.patch >= 0) & (np.abs(elevation) < MAX_ELEVATION)
    use = np.flatnonzero(asked & (lane < lanes))
    band = ((elevation[use] / MAX_ELEVATION + 1.0) / 2.0 * ELEVATIONS).astype(np.int64)
    turned = np.arctan2(d[use, 1], d[use, 0]) + turn
    azimuth = np.round(turned / STEP).astype(np.int64) % AZIMUTHS
    # samples of one bin count together
    bin_of = np.minimum(band, ELEVATIONS - 1) * AZIMUTHS + azimuth
    order = np.argsort(bin_of, kind="stable")
    use, (met, first) = use[order], np.unique(bin_of[order], return_index=True)
    odd = len(met) % 2  # a last bin that says nothing makes pairs
    met = np.pad(met, (0, odd))

    def join(rows: NDArray[np.floating]) -> NDArray[np.float32]:
        return np.pad(np.add.reduceat(rows, first).astype(np.float32), ((0, odd), (0, 0)))

    reach, patch, terms = reach[use], view.patch[use], view.terms
    semantic = depth = colour = np.zeros((len(met), 0), np.float32)
    if terms[SEMANTIC]:
        share = np.bincount(patch, minlength=len(view.weight))
        # a sample of a patch that has several speaks for its share of it, and for patches left out
        there = np.bincount(view.patch[asked], minlength=len(view.weight)) > 0
        left = view.weight[there].sum() / max(view.weight[share > 0].sum(), 1e-6)
        weight = (left * view.weight / np.maximum(share, 1))[:, None]
        semantic = join((np.log(np.maximum(view.semantic, 1e-6)) * weight)[patch])
    if terms[DEPTH]:
        ranges = view.depth[use] * reach
        depth = join(_depth_costs(ranges, view.background_depth[use], noise, blur))
    # where labels and depth are there, colours are left to the rays: they are the dearest here
    if terms[COLOUR] and not (terms[SEMANTIC] and terms[DEPTH]):
        shown = scale_colours(view.colour[use])
        shown -= shown.mean(axis=0) if len(shown) else 0.0
        colour = join(np.concatenate([np.ones((len(use), 1)), shown, shown**2], axis=1))
    return Bins(np.array([len(met)]), *np.divmod(met, AZIMUTHS), semantic, depth, colour)


_SPREAD = np.array([0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5])


def _depth_costs(
    ranges: Floats, is_common: NDArray[np.float32], noise: Noise, blur: float
) -> NDArray[np.float32]:
    """Return the log-likelihood (S, 256) of each measured range [m] for every stored range.

    `blur`: deviation of a range because the true position lies between those of the table [m].
    """
    expected = decode_ranges(np.arange(256, dtype=np.uint8))[None, :]
    measured = ranges[:, None]
    sd = noise.depth_floor + blur + noise.depth_slope * measured
    table = reading_ratio(expected - measured, sd, noise) - is_common[:, None]
    table[:, NOTHING] = 0.0
    table[ranges <= 0] = 0.0
    return np.asarray(table * (noise.depth_weight / max(1, len(ranges))), np.float32)
