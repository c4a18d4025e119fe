"""Where a thing that is gone from its place stands now: by depth that nothing else explains.

Positions and turns are tried around each clump of unexplained points: a placement is right where
readings end on the thing's surface, and wrong where they go on behind it. What does best is fitted
(ICP) and then judged by rays at its mesh, with all that it hides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.change.capture.looks import project, window
from placegraph.indoor.mapping.change.capture.tally import Rest, tolerance
from placegraph.indoor.mapping.change.register import (
    Sampled,
    about,
    inverse,
    moved,
    register,
    sample,
)
from placegraph.indoor.rays import RayCaster

POINTS = 120
"""On a thing, for the first round."""
DENSE = 3000
"""On a thing, for the fit."""
YAWS = 18
GRID = 0.1
"""Step of positions tried [m]."""
LOOKS = 6
"""Frames that the first round asks."""
_CHUNK = 200_000
_LEAST_POINTS = 12  # that a fit takes
_NUDGE = 0.15  # by how much a placement is turned to be fitted once more [rad]
_LIFT = 0.08  # what moved up or down less than this is tried at its old height, too [m]
_THROUGH = 2.0
"""A reading behind the surface weighs this many on it."""
_KEPT = 6
"""Placements of the first round that are fitted."""
LEAST_FIT = 0.75
"""Share of the readings that have to end on the thing, of those that reach it."""
LEAST_COVER = 0.5
"""Share of the unexplained readings where it stands that it has to explain."""


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Where a thing may stand now."""

    motion: Floats
    """(4, 4) after_from_before"""
    explained: int
    """Readings that end on it and that nothing else explains."""
    fit: float
    """Share of the readings that end on it, of those that reach it."""
    cover: float
    """Share of the unexplained readings in its box that it explains."""
    frames: int
    """That speak for it."""
    rivals: tuple[str, ...] = ()
    """Ids of other things that are gone and fit the place nearly as well."""
    share: float = 1.0
    """How likely it is this thing, and none of those, by how far each would have come."""

    @property
    def good(self) -> bool:
        """Whether it is taken for true."""
        return self.fit >= LEAST_FIT and self.cover >= LEAST_COVER

    @property
    def worth(self) -> float:
        """The larger, the better."""
        return self.explained * self.fit * self.cover


class Suspect:
    """One object of the map that may have moved."""

    def __init__(self, mesh: Mesh, row: int, rng: Generator) -> None:
        triangles = np.flatnonzero(mesh.object_of == row)
        self.row = row
        self.few: Sampled = sample(mesh, triangles, POINTS, rng)
        self.many: Sampled = sample(mesh, triangles, DENSE, rng)
        corners = mesh.vertices[mesh.triangles[triangles]].reshape(-1, 3).astype(np.float64)
        self.low, self.high = corners.min(axis=0), corners.max(axis=0)
        used, rows = np.unique(mesh.triangles[triangles], return_inverse=True)
        self.caster = RayCaster(mesh.vertices[used], rows.reshape(-1, 3))

    @property
    def middle(self) -> Floats:
        """(3,) of its box [m]."""
        return np.asarray((self.low + self.high) / 2.0)


def placements(rest: Rest, thing: Suspect, clump: Floats, every: Floats) -> list[Placement]:
    """Placements of a thing at a clump of unexplained points (N, 3), best first; may be empty.

    `every`: (M, 3) all unexplained points; thin things come in several clumps.
    """
    chosen = _telling(rest, clump)
    starts = _starts(thing, clump)
    if not chosen or not len(starts):
        return []
    scores = np.concatenate(
        [
            _scores(rest, chosen, thing, starts[i : i + _CHUNK // POINTS])
            for i in range(0, len(starts), _CHUNK // POINTS)
        ]
    )
    found = []
    for start in _distinct(starts, scores):
        near = _within(thing, start, every, 0.15)
        if np.count_nonzero(near) < _LEAST_POINTS:
            continue
        begin = inverse(about(thing.middle, start[3], start[:3]))
        back = register(every[near], thing.many, begin, reach=0.15, within=0.03)
        found.append(judge(rest, thing, inverse(back.motion)))
    found.sort(key=lambda p: -p.worth)
    return [_polished(rest, thing, every, found[0]), *found[1:]] if found else []


def _polished(rest: Rest, thing: Suspect, every: Floats, placed: Placement) -> Placement:
    """A placement, or what a fit from a little beside it finds, or that at its old height."""
    best = placed
    for turn in (-_NUDGE, 0.0, _NUDGE):
        middle = moved(placed.motion, thing.middle[None])[0]
        start = about(middle, turn, middle) @ placed.motion
        back = moved(inverse(start), every)
        near = np.all((back > thing.low - 0.08) & (back < thing.high + 0.08), axis=1)
        if np.count_nonzero(near) < _LEAST_POINTS:
            continue
        fitted = register(every[near], thing.many, inverse(start), reach=0.08, within=0.03)
        motion = inverse(fitted.motion)
        tried = [motion]
        if abs(motion[2, 3]) < _LIFT:  # what stood on the floor does so still
            level = motion.copy()
            level[2, 3] = 0.0
            tried.append(level)
        best = max([best, *(judge(rest, thing, m) for m in tried)], key=lambda p: p.worth)
    return best


def judge(rest: Rest, thing: Suspect, motion: Floats) -> Placement:
    """How well a thing at a placement (4, 4) explains all frames, by rays at its mesh."""
    back = inverse(motion)
    low, high = thing.low - 0.05, thing.high + 0.05
    ends = through = unexplained = frames = 0
    for look, left, new in zip(rest.looks, rest.depths, rest.new, strict=True):
        if look.depth is None:
            continue
        part = window(look, moved(motion, _corners(low, high)))
        if part is None:
            continue
        rays = look.rays[part].reshape(-1, 3).astype(np.float64) @ back[:3, :3].T
        origin = moved(back, look.map_from_camera[None, :3, 3])[0]
        distance = thing.caster.cast(origin, rays).distance
        reading, beyond = look.depth[part].ravel(), left[part].ravel()
        slack = tolerance(reading, rest.options)
        with np.errstate(invalid="ignore"):
            shows = distance < beyond - slack
            on = shows & (np.abs(reading - distance) <= slack)
            behind = shows & (reading > distance + slack)
        fresh = new[part].ravel()
        points = origin + rays[fresh] * reading[fresh, None]
        unexplained += int(np.all((points > low) & (points < high), axis=1).sum())
        ends += int((on & fresh).sum())
        through += int(behind.sum())
        frames += int((on & fresh).sum() >= 5)
    fit = ends / max(ends + through, 1)
    return Placement(motion, ends, fit, min(ends / max(unexplained, 1), 1.0), frames)


def _telling(rest: Rest, clump: Floats) -> list[int]:
    """Frames that see most of a clump, a few."""
    counts = []
    for look, left in zip(rest.looks, rest.depths, strict=True):
        rows, columns, depth = project(look, clump)
        inside = rows >= 0
        clear = depth[inside] < left[rows[inside], columns[inside]]
        counts.append(int(clear.sum()) if look.depth is not None else 0)
    order = np.argsort(-np.array(counts), kind="stable")[:LOOKS]
    return [int(t) for t in order if counts[t] > 0.2 * counts[order[0]] and counts[t] > 5]


def _starts(thing: Suspect, clump: Floats) -> Floats:
    """Placements (S, 4) to try: middle of the thing [m] and its turn [rad], upright as it was."""
    size = (thing.high - thing.low) / 2.0
    low = np.percentile(clump, 2, axis=0) - 0.5 * size.max()
    high = np.percentile(clump, 98, axis=0) + 0.5 * size.max()
    x, y = (np.arange(low[k], high[k] + GRID, GRID) for k in (0, 1))
    # what stood goes on standing at its height; what the clump's own height speaks for, too
    lifts = {0.0}
    bottom = float(np.percentile(clump[:, 2], 1)) - float(thing.low[2])
    if abs(bottom) > 0.1:
        lifts.add(bottom)
    yaws = np.arange(YAWS) * 2.0 * np.pi / YAWS
    grid = np.meshgrid(x, y, thing.middle[2] + np.array(sorted(lifts)), yaws, indexing="ij")
    starts = np.stack([g.ravel() for g in grid], axis=1)
    # a middle far from all points of the clump explains none of them
    cells = np.unique(np.round(clump[:, :2] / 0.1).astype(np.int64), axis=0) * 0.1
    spots, at = np.unique(starts[:, :2], axis=0, return_inverse=True)
    far = np.full(len(spots), np.inf)
    for chunk in np.array_split(cells, max(1, len(cells) // 500)):
        gaps = np.linalg.norm(spots[:, None] - chunk[None], axis=2)
        far = np.minimum(far, gaps.min(axis=1))
    return np.asarray(starts[far[at] <= float(np.hypot(*size[:2]))])


def _scores(rest: Rest, chosen: list[int], thing: Suspect, starts: Floats) -> Floats:
    """(S,) readings on the thing, less those behind it, as a share of its points and frames."""
    cos, sin = np.cos(starts[:, 3, None]), np.sin(starts[:, 3, None])
    offset = thing.few.points - thing.middle
    points = np.stack(
        [
            cos * offset[:, 0] - sin * offset[:, 1] + starts[:, 0, None],
            sin * offset[:, 0] + cos * offset[:, 1] + starts[:, 1, None],
            offset[:, 2] + starts[:, 2, None],
        ],
        axis=-1,
    )
    total = np.zeros(len(starts))
    for t in chosen:
        look, left, new = rest.looks[t], rest.depths[t], rest.new[t]
        if look.depth is None:
            continue
        rows, columns, depth = project(look, points)
        rows0, columns0 = np.maximum(rows, 0), np.maximum(columns, 0)
        reading = look.depth[rows0, columns0]
        slack = tolerance(reading, rest.options)
        with np.errstate(invalid="ignore"):
            there = (rows >= 0) & (depth < left[rows0, columns0] - slack)
            on = there & (np.abs(reading - depth) <= slack) & new[rows0, columns0]
            behind = there & (reading > depth + slack)
        total += on.sum(axis=1) - _THROUGH * behind.sum(axis=1)
    return total / (len(chosen) * len(offset))


def _distinct(starts: Floats, scores: Floats) -> list[Floats]:
    """The best placements that differ."""
    kept: list[Floats] = []
    for i in np.argsort(-scores, kind="stable")[:2000].tolist():
        if scores[i] <= 0.0 or len(kept) == _KEPT:
            break
        turns = [abs((starts[i, 3] - k[3] + np.pi) % (2 * np.pi) - np.pi) for k in kept]
        gaps = [float(np.linalg.norm(starts[i, :3] - k[:3])) for k in kept]
        if all(g > 0.15 or t > 0.6 for g, t in zip(gaps, turns, strict=True)):
            kept.append(starts[i])
    return kept


def _within(thing: Suspect, start: Floats, points: Floats, margin: float) -> NDArray[np.bool_]:
    """Which points (N, 3) lie in the thing's box at a placement, and a margin."""
    back = moved(inverse(about(thing.middle, start[3], start[:3])), points)
    inside = (back > thing.low - margin) & (back < thing.high + margin)
    return np.asarray(inside.all(axis=1))


def _corners(low: Floats, high: Floats) -> Floats:
    """(8, 3) corners of a box."""
    return np.array([[(low, high)[i >> k & 1][k] for k in range(3)] for i in range(8)])
