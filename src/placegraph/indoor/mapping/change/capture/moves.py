"""Which suspects moved, and where to: no two to one place, the best fit first."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from placegraph.geometry import vector_from_rotation
from placegraph.indoor.mapping.change.capture.motion import Placement, Suspect, judge, placements
from placegraph.indoor.mapping.change.capture.slide import slid
from placegraph.indoor.mapping.change.register import moved

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from placegraph.geometry import Floats
    from placegraph.indoor.map.scene import Scene
    from placegraph.indoor.mapping.change.capture.appeared import Clump
    from placegraph.indoor.mapping.change.capture.tally import Rest, Tally
    from placegraph.indoor.mapping.change.options import DiffOptions

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
