"""Where frames of a window could have been taken: the table is asked before a ray is cast."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import OptionError
from placegraph.geometry import between
from placegraph.indoor.likelihood.observe import COARSE, spread
from placegraph.indoor.map.panoramas_kernels import AZIMUTHS, STEP
from placegraph.indoor.pose.particles import distinct
from placegraph.indoor.pose.window import timed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.random import Generator
    from numpy.typing import NDArray

    from placegraph.geometry import Floats
    from placegraph.indoor.likelihood.view import Noise, View
    from placegraph.indoor.likelihood.visibility import VisibilityTable
    from placegraph.indoor.pose.prior import Leaning
    from placegraph.indoor.pose.window import Window

LOOKS = 5
"""Frames of a window that are looked up in the table."""
SEEDS = 48
"""Places kept of them."""
SCREENED = 10
"""Frames that screen the seeds."""
_TRIES = 8  # poses tried around each seed
_POOL = 6000  # best cells among which distinct seeds are looked for
_UNTOLD = 0.3  # share of seeds that do not listen to a description
_FEWEST = 3  # seeds of a merged scene, however small its share


def search(window: Window, rng: Generator) -> Floats:
    """Seeds (K, 4): poses of the last frame that explain several frames at once, best first.

    None where a prior says where to look, or the start is the paper's.

    Raises
    ------
    OptionError
        The map has no free place at the camera's height.

    """
    with timed(window.seconds, "table"):
        if not len(window.table):
            raise OptionError(
                f"heights: {window.scene.source or 'the map'} has no free place at "
                f"{window.options.heights} m above its floor; give the camera's height."
            )
        views = window.views(COARSE)
    if window.options.start == "uniform" or window.query.prior is not None:
        return np.zeros((0, 4))
    with timed(window.seconds, "search"):
        poses, last = window.poses, len(window) - 1
        noise = window.scorer.model.noise
        seeds, _ = table_seeds(window.table, views, poses, noise, last, leaning=window.leaning)
        tries = around(seeds, _TRIES, 0.3, 0.06, rng)
        looked = spread(len(window), SCREENED)
        steps = between(poses[last], poses[looked])
        values = window.scorer.together(tries, [views[i] for i in looked], steps)
        values = values.reshape(len(seeds), _TRIES)
        best = tries.reshape(len(seeds), _TRIES, 4)[np.arange(len(seeds)), values.argmax(axis=1)]
        return np.asarray(best[np.argsort(-values.max(axis=1), kind="stable")])


def table_seeds(
    table: VisibilityTable,
    views: Sequence[View],
    poses: Floats,
    noise: Noise,
    reference: int,
    most: int = SEEDS,
    leaning: Leaning | None = None,
) -> tuple[Floats, Floats]:
    """Poses (K, 4) of the reference frame that fit up to `LOOKS` views together, and their ranks.

    `poses`: (T, 4) odometry of all views, level. The frames looked up are spread over the sequence.
    `leaning` adds what is known beforehand of the reference frame.
    """
    looked = spread(len(views), LOOKS)
    steps = between(poses[reference], poses[looked])
    ranks = table.ranks([views[i] for i in looked], steps, noise)
    if leaning is None:
        return _best(table, ranks, np.arange(len(table)), most)
    directed = ranks + leaning.logs
    parts = [
        _best(table, directed, rows, max(_FEWEST, round(share * most)))
        for rows, share in leaning.parts
    ]
    if leaning.sentence is not None:  # who speaks may err
        rows = np.concatenate([rows for rows, _ in leaning.parts])
        parts.append(_best(table, ranks, rows, round(_UNTOLD * most)))
    seeds, values = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(-values, kind="stable")
    return seeds[order], values[order]


def _best(
    table: VisibilityTable, ranks: NDArray[np.float32], rows: NDArray[np.int64], most: int
) -> tuple[Floats, Floats]:
    """Distinct poses (K, 4) of some positions, best first, and their ranks."""
    flat = ranks[rows].ravel()
    pool = np.argpartition(-flat, min(_POOL, flat.size - 1))[:_POOL]
    position, heading = np.divmod(pool, AZIMUTHS)
    found = np.column_stack([table.positions[rows[position]], heading * STEP])
    kept = distinct(found, flat[pool].astype(np.float64), most, apart=0.45, turned=0.3)
    return found[kept], flat[pool][kept].astype(np.float64)


def around(
    seeds: Floats, each: int | NDArray[np.int64], box: float, turn: float, rng: Generator
) -> Floats:
    """`each` (or each (K,)) poses spread evenly in a box around each seed; the first is the seed."""
    out = np.repeat(seeds, each, axis=0)
    offset = rng.uniform(-1.0, 1.0, out.shape) * np.array([box / 2, box / 2, box / 2, turn])
    count = np.broadcast_to(each, len(seeds))
    offset[np.cumsum(count) - count] = 0.0
    return out + offset
