"""First particles: where the visibility table says the sequence could be, around a prior, or everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import OptionError
from placegraph.geometry import between
from placegraph.indoor.likelihood.observe import spread
from placegraph.indoor.map.panoramas_kernels import AZIMUTHS, STEP
from placegraph.indoor.pose.particles import distinct

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.random import Generator
    from numpy.typing import NDArray

    from placegraph.indoor.likelihood.score import Noise, View
    from placegraph.indoor.likelihood.visibility import VisibilityTable
    from placegraph.indoor.options import FilterOptions
    from placegraph.indoor.pose.leaning import Leaning

LOOKS = 5
"""Frames of a sequence that are looked up in the table."""
SEEDS = 48
"""Places kept of them."""
_POOL = 6000  # best cells among which distinct seeds are looked for
_UNTOLD = 0.3  # share of seeds that do not listen to a description
_FEWEST = 3  # seeds of a merged scene, however small its share


@dataclass(frozen=True, slots=True)
class Prior:
    """Roughly where the first frame was taken: standard deviations of a Gaussian."""

    x: float
    y: float
    z: float | None = None
    """[m, map]; None: one of the camera heights."""
    yaw: float | None = None
    """[rad]; None: any."""
    spread: float = 1.0
    """Of the position [m]."""
    turn: float = 0.3
    """Of the yaw [rad]."""

    def __post_init__(self) -> None:
        numbers = (self.x, self.y, self.z or 0.0, self.yaw or 0.0, self.spread, self.turn)
        if not np.isfinite(numbers).all() or self.spread <= 0 or self.turn <= 0:
            raise OptionError("prior: numbers must be finite, spread and turn greater than 0.")


def table_seeds(
    table: VisibilityTable,
    views: Sequence[View],
    poses: NDArray[np.float64],
    noise: Noise,
    reference: int,
    most: int = SEEDS,
    leaning: Leaning | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distinct poses (K, 4) of some positions, best first, and their ranks."""
    flat = ranks[rows].ravel()
    pool = np.argpartition(-flat, min(_POOL, flat.size - 1))[:_POOL]
    position, heading = np.divmod(pool, AZIMUTHS)
    found = np.column_stack([table.positions[rows[position]], heading * STEP])
    kept = distinct(found, flat[pool].astype(np.float64), most, apart=0.45, turned=0.3)
    return found[kept], flat[pool][kept].astype(np.float64)


def around(
    seeds: NDArray[np.float64], each: int, box: float, turn: float, rng: Generator
) -> NDArray[np.float64]:
    """`each` poses (K * each, 4) spread evenly in a box around each seed; the first is the seed."""
    out = np.repeat(seeds, each, axis=0)
    offset = rng.uniform(-1.0, 1.0, out.shape) * np.array([box / 2, box / 2, box / 2, turn])
    offset[::each] = 0.0
    return out + offset


def everywhere(
    table: VisibilityTable, floors: NDArray[np.float64], options: FilterOptions, rng: Generator
) -> NDArray[np.float64]:
    """The paper's start (Sec. 3.1): `per_cell` poses a free cell and height, yaws at random.

    `table`: of the same spacing; `floors`: (K,) floor under its positions.
    """
    cells = np.unique(np.column_stack([table.positions[:, :2], floors]), axis=0)
    count = len(options.heights) * options.per_cell
    out = np.empty((len(cells) * count, 4))
    out[:, :2] = np.repeat(cells[:, :2], count, axis=0)
    out[:, :2] += rng.uniform(-0.5, 0.5, (len(out), 2)) * table.spacing
    heights = np.tile(np.repeat(options.heights, options.per_cell), len(cells))
    out[:, 2] = np.repeat(cells[:, 2], count) + heights
    out[:, 3] = rng.uniform(-np.pi, np.pi, len(out))
    return out


def near_prior(
    prior: Prior, floor: float, count: int, options: FilterOptions, rng: Generator
) -> NDArray[np.float64]:
    """`count` poses (count, 4) drawn around a prior."""
    out = rng.normal(size=(count, 4)) * np.array([prior.spread, prior.spread, 0.05, prior.turn])
    out[:, :2] += (prior.x, prior.y)
    out[:, 2] += floor + rng.choice(options.heights, count) if prior.z is None else prior.z
    if prior.yaw is None:
        out[:, 3] = rng.uniform(-np.pi, np.pi, count)
    else:
        out[:, 3] += prior.yaw
    return out
