"""What the network is told of an object: shape, size, place above the floor, colours, label.

All of it is read from the map: points spread evenly over each object's surface say what it is like.
Colours are told as they are and relative to the mean of the map, as `picture` does, since a map's
exposure is as arbitrary as a picture's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.encode.compact.picture import log_light
from placegraph.indoor.encode.compact.picture_kernels import colours_at
from placegraph.indoor.encode.words import DIMENSION
from placegraph.indoor.map.textures import linear_from_srgb

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.indoor.map.scene import Scene

    Floats = NDArray[np.float32]

POINTS = 128
"""Points that stand for an object's surface."""
FOOTPRINT = 0.03
"""Width of what such a point stands for [m]: of a pixel of a small picture, a few metres off."""
TURNS = 18
SHAPE = 27
BINS = 8
_RANGES = ((-3.2, 2.4), (-1.2, 1.2), (-1.2, 1.2))
"""Of lightness and of two chromaticities, in logarithms of light; BINS bins each."""
COLOUR = 28 + 3 * BINS
FEATURES = SHAPE + COLOUR + DIMENSION + 2
"""Shape, colours, whether there are any, label, whether it says anything."""


@dataclass(frozen=True, eq=False)
class Things:
    """N objects of a map, without their labels."""

    form: Floats
    """(N, SHAPE)"""
    light: Floats
    """(N, POINTS, 3) linear light of the points of each object; of a map without colours, ones."""
    area: Floats
    """(N,) [m2]"""
    scene_of: NDArray[np.int32]
    """(N,) which of several merged scenes an object is in."""
    coloured: bool
    """Whether the map has colours."""


def describe(scene: Scene) -> Things:
    """Objects of a map."""
    mesh, count = scene.mesh, len(scene)
    doubled = np.linalg.norm(mesh.normals(), axis=1)
    order = np.argsort(mesh.object_of, kind="stable")
    ends = np.cumsum(doubled[order]) / 2.0
    area = np.asarray(np.bincount(mesh.object_of, doubled / 2.0, count), np.float64)
    start = np.concatenate([[0.0], np.cumsum(area)[:-1]])
    share = (np.arange(POINTS) + 0.5) / POINTS
    row = np.searchsorted(ends, start[:, None] + share * area[:, None])
    first = np.searchsorted(mesh.object_of[order], np.arange(count))
    last = np.searchsorted(mesh.object_of[order], np.arange(count), side="right") - 1
    triangle = order[np.clip(row, first[:, None], last[:, None])].astype(np.int32)
    u, v = _barycentrics()
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles[triangle]].astype(np.float64), 2, 0)
    points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    floor = scene.floors[scene.scene_of]
    points[..., 2] -= floor[:, None]
    light = np.ones((count, POINTS, 3), np.float32)
    if scene.coloured:
        one, two = (np.tile(w.astype(np.float32), count) for w in (u, v))
        srgb = colours_at(scene.surface, triangle.ravel(), one, two, np.float32(FOOTPRINT))
        light = linear_from_srgb(srgb.astype(np.float64)).astype(np.float32)
        light = light.reshape(count, POINTS, 3)
    high = (scene.scene_bounds[:, 1, 2] - scene.floors)[scene.scene_of]
    upright = 1.0 - np.abs(scene.normals[triangle, 2])
    return Things(
        form=_shape(points, upright, area, high, scene.scene_of),
        light=light,
        area=area.astype(np.float32),
        scene_of=scene.scene_of,
        coloured=scene.coloured,
    )


def features(things: Things, words: Floats) -> Floats:
    """What the network is told (N, FEATURES) of objects whose labels have vectors `words` (N, d)."""
    count = len(things.form)
    out = np.zeros((count, FEATURES), np.float32)
    out[:, :SHAPE] = things.form
    if things.coloured:
        out[:, SHAPE : SHAPE + COLOUR] = _colour(things)
        out[:, SHAPE + COLOUR] = 1.0
    out[:, SHAPE + COLOUR + 1 : -1] = words
    out[:, -1] = words.any(axis=1)
    return out


def _barycentrics() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights (POINTS,) of corners 1 and 2, spread evenly over a triangle (the R2 sequence)."""
    i = np.arange(POINTS)
    u, v = (0.5 + i * 0.7548776662466927) % 1.0, (0.5 + i * 0.5698402909980532) % 1.0
    over = u + v > 1.0
    return np.where(over, 1.0 - u, u), np.where(over, 1.0 - v, v)


def _shape(
    points: NDArray[np.float64],
    upright: NDArray[np.floating],
    area: NDArray[np.floating],
    high: NDArray[np.float64],
    scene_of: NDArray[np.int32],
) -> Floats:
    """Numbers (N, SHAPE) of points (N, POINTS, 3) [m], heights above the floor.

    `upright`: (N, POINTS) 0 of level surfaces, 1 of walls; `high`: (N,) height of its scene.
    """
    z = np.sort(points[..., 2], axis=1)
    across, tall = _across(points[..., :2]), np.ptp(z, axis=1)
    spread = points - points.mean(axis=1, keepdims=True)
    turn = np.einsum("npi,npj->nij", spread, spread) / POINTS
    axes = np.sqrt(np.maximum(np.linalg.eigvalsh(turn)[:, ::-1], 0.0))
    flat = axes[:, 1:] / np.maximum(axes[:, :1], 1e-6)
    total = np.bincount(scene_of, area)[scene_of]
    box = 2.0 * (across.prod(axis=1) + tall * across.sum(axis=1))
    number = np.bincount(scene_of)[scene_of]
    at = [0, POINTS // 8, POINTS // 2, POINTS - 1 - POINTS // 8, POINTS - 1]
    columns = [
        np.log(area + 1e-2),
        *np.log(across + 0.05).T,
        np.log(tall + 0.05),
        *np.log(axes + 0.02).T,
        *flat.T,
        *z[:, at].T,
        z[:, -1] - high,
        z[:, 0] < 0.15,
        z[:, 0] > high - 0.3,
        *((upright < 0.3).mean(axis=1), (upright > 0.7).mean(axis=1)),
        # how upright its lower and upper halves are: a table is not a chest
        *_halves(points[..., 2], upright).T,
        np.log((area + 1e-3) / (total + 1e-3)),
        np.log((area + 1e-2) / (box + 1e-2)),
        np.log(across.prod(axis=1) * tall + 1e-4),
        np.log(number),
        np.log(total + 1.0),
        high,
    ]
    return np.stack(columns, axis=1).astype(np.float32)


def _across(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shorter and longer side (N, 2) [m] of the smallest rectangle around points (N, P, 2).

    However the map is turned: of TURNS rectangles, and of the one along which the points spread
    most, which is right for what is thin.
    """
    x, y = np.moveaxis(points - points.mean(axis=1, keepdims=True), 2, 0)
    along = np.arctan2(2.0 * (x * y).mean(axis=1), (x * x - y * y).mean(axis=1)) / 2.0
    sides = np.full((len(points), 2), np.inf)
    for angle in (along, *np.arange(TURNS) * (np.pi / 2.0 / TURNS)):
        c, s = (np.reshape(f(angle), (-1, 1)) for f in (np.cos, np.sin))
        turned = np.stack([np.ptp(c * x + s * y, axis=1), np.ptp(c * y - s * x, axis=1)], axis=1)
        turned.sort(axis=1)
        smaller = turned.prod(axis=1) < sides.prod(axis=1)
        sides[smaller] = turned[smaller]
    return sides


def _halves(z: NDArray[np.float64], upright: NDArray[np.floating]) -> NDArray[np.float64]:
    """Mean (N, 2) of `upright` (N, POINTS) over points below and above the middle of heights z."""
    middle = (z.min(axis=1, keepdims=True) + z.max(axis=1, keepdims=True)) / 2.0
    above = z > middle
    some = [np.maximum(side.sum(axis=1), 1) for side in (~above, above)]
    return np.stack([(upright * ~above).sum(axis=1), (upright * above).sum(axis=1)], 1) / np.stack(
        some, axis=1
    )


def _colour(things: Things) -> Floats:
    """Numbers (N, COLOUR) of the light of objects."""
    log = log_light(things.light)
    own = log.mean(axis=1)
    total = np.maximum(np.bincount(things.scene_of, things.area), 1e-9)
    usual, varied = (
        np.stack([np.bincount(things.scene_of, things.area * x) / total for x in values.T], 1)
        for values in (own, (log * log).mean(axis=1))
    )
    varied = np.sqrt(np.maximum(varied - usual * usual, 0.0))[things.scene_of]
    usual = usual[things.scene_of].astype(np.float32)
    relative = log - usual[:, None]
    red, green, blue = np.moveaxis(relative, 2, 0)
    opponents = (red + green + blue) / 3.0, red - blue, green - (red + blue) / 2.0
    shade = opponents[0]
    order = np.argsort(shade, axis=1)[:, :, None]
    third = POINTS // 3
    sorted_ = np.take_along_axis(relative, order, axis=1)
    columns = [
        relative.mean(axis=1),
        own + 1.5,
        relative.std(axis=1),
        *(o.std(axis=1)[:, None] for o in opponents),
        np.take_along_axis(shade, order[:, [POINTS // 8, POINTS // 2, -POINTS // 8], 0], axis=1),
        sorted_[:, :third].mean(axis=1),
        sorted_[:, -third:].mean(axis=1),
        usual - usual.mean(axis=1, keepdims=True),
        usual.mean(axis=1, keepdims=True) + 1.5,
        varied,
        *(_histogram(o, *r) for o, r in zip(opponents, _RANGES, strict=True)),
    ]
    return np.concatenate(columns, axis=1).astype(np.float32)


def _histogram(values: Floats, low: float, high: float) -> Floats:
    """Shares (N, BINS) of values (N, POINTS), each divided between the two bins that are nearest."""
    at = np.clip((values - low) / (high - low) * (BINS - 1), 0.0, BINS - 1 - 1e-4)
    bin_ = at.astype(np.int64)
    part = at - bin_
    rows = np.arange(len(values))[:, None] * BINS
    total = np.bincount((rows + bin_).ravel(), (1.0 - part).ravel(), len(values) * BINS)
    total += np.bincount((rows + bin_ + 1).ravel(), part.ravel(), len(values) * BINS)
    return (total / POINTS).reshape(len(values), BINS).astype(np.float32)
