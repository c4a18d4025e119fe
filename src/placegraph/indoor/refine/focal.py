"""Whether images would fit another focal length better: wrong intrinsics make poses that fit well.

Seen by a camera of a focal length ten percent too long, a room fits its images from a few hand's
breadths farther away, and nothing but the fit's own curve over focal lengths tells.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.refine.joint import solve

if TYPE_CHECKING:
    from collections.abc import Sequence

    from placegraph.geometry import Floats
    from placegraph.indoor.refine.joint import Problem
    from placegraph.indoor.refine.pixels import Sights

TRIED = (0.9, 0.95, 1.05, 1.1)
"""Factors on the focal length that are tried."""
BETTER = 0.05
"""Share of the robust cost that another focal length must save. At the right one the shared data save
up to 0.03, where maps are blurred; at one ten percent off, sharp maps save 0.05 to 0.5, blurred ones
less than this: there the curve tells nothing."""
ENOUGH = 300
"""Matches below which the curve tells nothing."""
_WIDTHS = ((6.0, 6.0), (3.0, 3.0))
_WIDTH = 3.0  # of the kernel by which costs are compared


def better_focal(problem: Problem, poses: Floats) -> float:
    """Factor on the focal length that fits the matches clearly better; 1 where none does.

    Poses (T, 4, 4) are fitted anew for each, to the matches alone.
    """
    if sum(map(len, problem.sights)) < ENOUGH:
        return 1.0
    images = replace(problem, readings=[None] * len(poses))
    costs = {k: _cost(images, poses, k) for k in (1.0, *TRIED)}
    best = min(costs, key=lambda k: costs[k])
    return best if costs[best] < (1.0 - BETTER) * costs[1.0] else 1.0


def _cost(problem: Problem, poses: Floats, factor: float) -> float:
    """Mean robust cost, 0 to 1, of the matches seen by a camera of another focal length."""
    sights = [replace(s, rays=s.rays / factor) for s in problem.sights]
    solution = solve(replace(problem, sights=sights), poses, _WIDTHS)
    return _mean_cost(sights, solution.poses)


def _mean_cost(sights: Sequence[Sights], poses: Floats) -> float:
    ratios = np.concatenate(
        [(s.errors(p) / (_WIDTH * s.sigma)) ** 2 for s, p in zip(sights, poses, strict=True)]
    )
    return float(np.mean(1.0 - 1.0 / (1.0 + ratios)))
