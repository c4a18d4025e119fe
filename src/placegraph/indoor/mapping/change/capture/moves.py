"""Which suspects moved, and where to: no two to one place, the best fit first.

Depth cannot tell a picture from the wall behind it. Its colours can: they are slid along the wall,
and correlated with what the frames show there. Correlation leaves the light on it alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, vector_from_rotation
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.change.capture.appeared import Clump
from placegraph.indoor.mapping.change.capture.looks import Look, project
from placegraph.indoor.mapping.change.capture.motion import Placement, Suspect, judge, placements
from placegraph.indoor.mapping.change.capture.tally import Rest, Tally, summed, tolerance
from placegraph.indoor.mapping.change.options import DiffOptions
from placegraph.indoor.mapping.change.register import moved, rigid

_NEARNESS = 1.0
"""Of things alike the nearest is meant: over this way [m] a fit's worth falls to a third."""
_RIVAL = 0.7
"""Another thing that is gone and fits a place this well, against the best, may be it as well."""
_SHARED = 0.3
"""Two things whose boxes share this much of the smaller stand at one place."""
_MOVED_GAIN = 1.2
"""By how much a motion has to explain the frames better than staying does."""


def moves(
    scene: Scene, left: Rest, clumps: Sequence[Clump], suspects: NDArray[np.int64], counts: Tally
) -> dict[int, Placement]:
    """Placement of each suspect that has one, no two at one place: the best fit first."""
    rng = np.random.default_rng(left.options.seed)
    bids: list[tuple[float, int, Placement]] = []
    every = np.concatenate([np.zeros((0, 3)), *(clump.points for clump in clumps)])
    for row in suspects.tolist():
        thing = Suspect(scene.mesh, row, rng)
        if counts.by_colour[row]:
            found = slid(left, thing)
            tried = [found] if found is not None else []
        else:
            stays = judge(left, thing, np.eye(4))
            tried = [
                placed
                for clump in clumps
                if _reaches(thing, clump, left.options)
                for placed in placements(left, thing, clump.points, every)[:2]
                if placed.good
                and placed.explained >= left.options.least_pixels / 2
                and placed.worth > _MOVED_GAIN * stays.worth
            ]
        for placed in tried:
            shift = float(
                np.linalg.norm(moved(placed.motion, thing.middle[None])[0] - thing.middle)
            )
            turn = np.degrees(np.linalg.norm(vector_from_rotation(placed.motion[:3, :3])))
            stirred = shift >= left.options.least_shift or turn >= left.options.least_turn
            if stirred and shift <= left.options.reach:
                bids.append((placed.worth * np.exp(-shift / _NEARNESS), row, placed))
    won: dict[int, Placement] = {}
    places: list[tuple[Floats, Floats]] = []
    for worth, row, placed in sorted(bids, key=lambda bid: -bid[0]):
        box = box_of(scene, row, placed.motion)
        if row in won or any(_common(*box, *other) > _SHARED for other in places):
            continue
        rivals = {
            other: bid
            for bid, other, too in reversed(bids)
            if other != row
            and too.worth > _RIVAL * placed.worth
            and _common(*box, *box_of(scene, other, too.motion)) > _SHARED
        }
        share = worth / (worth + sum(rivals.values()))
        names = tuple(scene.graph.ids[other] for other in rivals)
        won[row] = replace(placed, rivals=names, share=share)
        places.append(box)
    return won


def _reaches(thing: Suspect, clump: Clump, options: DiffOptions) -> bool:
    """Whether a clump is near enough and large enough to be the thing, or part of it."""
    gap = np.maximum(np.maximum(clump.low - thing.high, thing.low - clump.high), 0.0)
    return bool(np.linalg.norm(gap) < options.reach)


def box_of(scene: Scene, row: int, motion: Floats) -> tuple[Floats, Floats]:
    """Corners of an object's box after a motion."""
    corners = scene.mesh.vertices[scene.mesh.triangles[scene.mesh.object_of == row]]
    points = moved(motion, corners.reshape(-1, 3).astype(np.float64))
    return points.min(axis=0), points.max(axis=0)


def _common(low: Floats, high: Floats, other_low: Floats, other_high: Floats) -> float:
    """Share of the smaller of two boxes that the other holds."""
    sides = np.maximum(np.minimum(high, other_high) - np.maximum(low, other_low), 0.0)
    least = min(np.prod(high - low), np.prod(other_high - other_low))
    return float(np.prod(sides) / max(least, 1e-9))


ACROSS, UP = 1.6, 0.4
"""How far along the wall and up and down it is looked for [m]."""
COARSE, FINE = 0.04, 0.01
"""Steps of the two rounds [m]."""
ALIKE = 0.6
"""Least correlation with the thing's colours."""
BETTER = 0.15
"""How much better than the map without it, and than 0.3 m beside, it has to fit."""
_EVERY = 8  # of a thing's points one is compared
_BLUR = 0.025  # its colours are averaged this far around it [m], about what three pixels cover
_LOOKS = 8
_SEEN = 0.6
"""Share of the thing's face that a frame has to see to be asked."""


def slid(rest: Rest, thing: Suspect) -> Placement | None:
    """Placement of a flat thing along its wall, or None where nothing there looks like it."""
    across = _across(thing)
    face = _face(thing)
    if across is None or float(np.ptp(face.colours, axis=0).max()) < 0.1:
        return None  # of one colour: it looks like any patch of such a colour
    looks = _asked(rest, thing, across)
    shifts = _grid(np.zeros(2), (ACROSS, UP), COARSE)
    scores, seen = _scores(rest, looks, face, across, shifts)
    if not seen.any():
        return None
    best = int(np.where(seen, scores, -1.0).argmax())
    fine = _grid(shifts[best], (COARSE, COARSE), FINE)
    again, _ = _scores(rest, looks, face, across, fine)
    shift, score = fine[int(again.argmax())], float(again.max())
    apart = seen & (np.linalg.norm(shifts - shift, axis=1) > 0.3)
    rival = float(scores[apart].max()) if apart.any() else 0.0
    without, frames, pixels = _without(rest, looks, face, _moves(across, shift[None]))
    if score < ALIKE or score < without + BETTER or score < rival + BETTER:
        return None
    motion = rigid(np.eye(3), _moves(across, shift[None])[0])
    return Placement(motion, pixels, score, 1.0, frames)


@dataclass(frozen=True, slots=True, eq=False)
class _Face:
    """Points of a thing, with colours as blurred as a picture's."""

    points: Floats
    """(P, 3) [m]"""
    normals: Floats
    """(P, 3)"""
    colours: Floats
    """(P, 3) sRGB, 0 to 1."""

    def faces(self, look: Look) -> NDArray[np.bool_]:
        """(P,) whether a point's surface looks at a camera; the way there hardly turns it."""
        towards = look.map_from_camera[:3, 3] - self.points
        return np.asarray(np.einsum("nk,nk->n", self.normals, towards) > 0.0)

    def front(self, look: Look) -> float:
        """Share of the points that do."""
        return max(float(self.faces(look).mean()), 0.2)


def _face(thing: Suspect) -> _Face:
    many = thing.many
    points, normals = many.points[::_EVERY], many.normals[::_EVERY]
    apart = np.linalg.norm(points[:, None] - many.points[None], axis=2)
    near = (apart < _BLUR) & (normals @ many.normals.T > 0.7)
    colours = near @ (many.colours / 255.0) / np.maximum(near.sum(axis=1, keepdims=True), 1)
    return _Face(points, normals, colours)


def _moves(across: Floats, shifts: Floats) -> Floats:
    """(S, 3) of shifts (S, 2) along the wall and up [m]."""
    return np.asarray(shifts[:, :1] * across + shifts[:, 1:] * np.array([0.0, 0.0, 1.0]))


def _across(thing: Suspect) -> Floats | None:
    """(3,) level direction along the wall a flat thing hangs on; None of what lies."""
    spread = thing.many.normals.T @ thing.many.normals
    facing = np.linalg.eigh(spread)[1][:, -1]
    level = np.hypot(facing[0], facing[1])
    return None if level < 0.8 else np.array([-facing[1], facing[0], 0.0]) / level


def _asked(rest: Rest, thing: Suspect, across: Floats) -> list[int]:
    """Frames that look at the wall from near by."""
    worth = []
    for look in rest.looks:
        spots = thing.middle + np.linspace(-ACROSS, ACROSS, 9)[:, None] * across
        rows, _, depth = project(look, spots)
        worth.append(float(np.count_nonzero(rows >= 0) / (1.0 + np.abs(depth).min())))
    order = np.argsort(-np.array(worth), kind="stable")[:_LOOKS]
    return [int(t) for t in order if worth[t] > 0]


def _scores(
    rest: Rest, looks: Sequence[int], face: _Face, across: Floats, shifts: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """Correlation (S,) of the thing's colours with all frames at shifts (S, 2), and who saw it."""
    moves = _moves(across, shifts)
    total, weight = np.zeros((2, len(shifts)))
    for t in looks:
        look = rest.looks[t]
        rows, columns, there = _visible(rest, look, face, moves)
        shown = blurred(look.rgb)[np.maximum(rows, 0), np.maximum(columns, 0)]
        seen = there.mean(axis=1)
        worth = np.where(seen >= _SEEN * face.front(look), seen, 0.0)
        total += worth * _correlation(face.colours[None], shown, there)
        weight += worth
    return np.where(weight > 0, total / np.maximum(weight, 1e-9), -1.0), weight > 0


def _without(
    rest: Rest, looks: Sequence[int], face: _Face, moves: Floats
) -> tuple[float, int, int]:
    """How well the map without the thing fits its colours there; frames and pixels that see it."""
    values, frames, pixels = [], 0, 0
    for t in looks:
        look = rest.looks[t]
        rows, columns, there = _visible(rest, look, face, moves)
        if there.mean() < _SEEN * face.front(look):
            continue
        kept = (look.front.depth >= rest.depths[t] - 1e-3)[..., None]
        left = blurred(np.where(kept, look.front.colour, look.behind.colour))
        shown = left[np.maximum(rows, 0), np.maximum(columns, 0)]
        values.append(float(_correlation(face.colours[None], shown, there)[0]))
        frames += 1
        pixels += len(np.unique(rows[there] * look.camera.width + columns[there]))
    return (float(np.mean(values)) if values else -1.0), frames, pixels


def _visible(
    rest: Rest, look: Look, face: _Face, moves: Floats
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Pixel rows, columns (S, P) and whether a surface is seen there that may be the thing's."""
    rows, columns, depth = project(look, face.points[None] + moves[:, None])
    at = np.maximum(rows, 0), np.maximum(columns, 0)
    there = (rows >= 0) & np.isfinite(look.rgb[*at, 0]) & face.faces(look)
    if look.depth is not None:
        reading = look.depth[at]
        with np.errstate(invalid="ignore"):
            there &= np.abs(reading - depth) <= tolerance(reading, rest.options)
    return rows, columns, there


def blurred(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Image (H, W, 3) averaged over three by three pixels."""
    channels = [summed(image[..., k], 1) for k in range(3)]
    return (np.stack(channels, axis=-1) / 9.0).astype(np.float32)


def _correlation(wanted: Floats, shown: NDArray[np.float32], there: NDArray[np.bool_]) -> Floats:
    """(S,) correlation over points and channels of colours (1 or S, P, 3) where they are seen."""
    mask = there[..., None].astype(np.float64)
    count = np.maximum(mask.sum(axis=1, keepdims=True), 1.0)
    a = np.broadcast_to(wanted, shown.shape) * mask
    b = np.nan_to_num(shown).astype(np.float64) * mask
    a = (a - a.sum(axis=1, keepdims=True) / count) * mask
    b = (b - b.sum(axis=1, keepdims=True) / count) * mask
    norm = np.sqrt((a**2).sum(axis=(1, 2)) * (b**2).sum(axis=(1, 2)))
    return np.asarray((a * b).sum(axis=(1, 2)) / np.maximum(norm, 1e-9))


def _grid(middle: Floats, half: tuple[float, float], step: float) -> Floats:
    """(S, 2) shifts around a middle [m]."""
    x, y = (np.arange(-h, h + step / 2, step) + m for h, m in zip(half, middle, strict=True))
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
