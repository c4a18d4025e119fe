"""Search of poses that explain a window: by the visibility table, then by rays around the seeds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, between, compose, wrap_angle
from placegraph.errors import OptionError
from placegraph.indoor.likelihood.observe import COARSE, Noise, View, spread
from placegraph.indoor.likelihood.score_kernels import DEPTH
from placegraph.indoor.likelihood.visibility import VisibilityTable, floor_under
from placegraph.indoor.map.map_kernels import AZIMUTHS, HEADINGS
from placegraph.indoor.pose.prior import LogPrior, Prior
from placegraph.indoor.pose.search_kernels import Rig, align_poses, select_rows
from placegraph.indoor.pose.window import Window, time_stage
from placegraph.indoor.rays.trace_kernels import LANES

APART = 0.75
"""Modes are at least this far apart [m] ..."""
TURNED = np.pi / 4
"""... or turned by this much [rad]."""
LOOKS = 5
"""Number of frames of a window that the table is scanned with."""
SEEDS = 48
"""Number of seeds from the table."""
SCREENED = 10
"""Frames that screen the seeds."""
_POOL = 6000  # best cells among which distinct seeds are looked for
_UNTOLD = 0.3  # share of seeds without the description
_FEWEST = 3  # seeds of a merged scene, however small its share


_ALIGNED = 96  # seeds from the table where depth aligns them
_TILES, _FINEST = 9, 5.0  # of samples that align a frame, and least stride to get as many [px]
_SAME = {"apart": 0.2, "turned": 0.1}  # aligned seeds nearer than this are one


class _SearchRound(NamedTuple):
    """One round in which seeds are moved to the best of poses tried around them."""

    each: int
    box: float
    """Edge of the box around each seed [m] ..."""
    turn: float
    """... and half its width in yaw [rad]."""
    frames: int
    thinned: int
    """Every so many tiles of a view take part."""
    most: int
    """Seeds that go on."""


_TRIES = (
    _SearchRound(12, 0.5, 0.1, LOOKS, 3, SEEDS // 2),
    _SearchRound(8, 0.3, 0.05, SCREENED, 2, SEEDS // 2),
)
"""From a cell of the table to a hand's breadth: many tries by few rays, then few by many."""


class _AlignmentRound(NamedTuple):
    """One round in which seeds are moved onto the map's surfaces by depth."""

    each: int
    """Poses drawn around each seed where depth leaves it free; the best is aligned."""
    deviations: tuple[float, ...]
    """Of the steps of the alignment: distances up to which readings count in full [m]."""
    frames: int
    thinned: int
    """Every so many tiles of a view take part."""
    most: int
    """Seeds that go on."""


_ALIGNMENTS = (
    _AlignmentRound(1, (0.3, 0.2, 0.1), LOOKS, 3, 32),
    _AlignmentRound(8, (0.2, 0.1, 0.05), SCREENED, 2, 24),
)
"""From wherever in a cell of the table to a few centimetres."""


def search(window: Window, rng: Generator) -> Floats:
    """Seeds (K, 4): poses of the last frame that explain several frames at once, best first.

    Drawn around a prior, if there is one, else looked up in the table; none where the start is the
    paper's. Depth then aligns them with the map's surfaces, which reaches farther than tries do.

    Raises
    ------
    OptionError
        The map has no free place at the camera's height.

    """
    with time_stage(window.seconds, "table"):
        if not len(window.table):
            raise OptionError(
                f"heights: {window.scene.source or 'the map'} has no free place "
                f"{window.options.heights} m above its floor; give the camera's height."
            )
        views = window.views(COARSE)
    options = window.options.particle_filter
    if options is not None and options.start == "uniform":
        return np.zeros((0, 4))
    with time_stage(window.seconds, "search"):
        last, noise = len(window) - 1, window.scorer.model.noise
        table, log_prior, prior = window.table, window.log_prior, window.query.prior
        first, *rounds = _TRIES
        aligned = any(views[i].terms[DEPTH] for i in spread(len(window), LOOKS))
        if prior is None or prior.is_wide:
            most = _ALIGNED if aligned else SEEDS
            seeds, _ = table_seeds(
                table, views, window.poses, noise, last, most, log_prior=log_prior
            )
        else:
            drawn = draw_near_prior(prior, window, first.each * SEEDS, rng)
            seeds = compose(drawn, between(window.poses[0], window.poses[-1]))
            first = first._replace(each=1)  # they lie as dense as tries
            if aligned:
                seeds = _move_seeds(window, seeds, first._replace(most=_ALIGNED), rng)
        if aligned:
            return _align_seeds(window, seeds, rng)
        for round_ in (first, *rounds):
            seeds = _move_seeds(window, seeds, round_, rng)
        return seeds


def _move_seeds(window: Window, seeds: Floats, round_: _SearchRound, rng: Generator) -> Floats:
    """Move each seed (K, 4) to the best of poses drawn around it; best first."""
    tries = scatter_poses(seeds, round_.each, round_.box, round_.turn, rng)
    steps, views = _select_views(window, round_)
    best, values = _best_tries(window, tries.reshape(len(seeds), round_.each, 4), views, steps)
    return np.asarray(best[np.argsort(-values, kind="stable")[: round_.most]])


def _align_seeds(window: Window, seeds: Floats, rng: Generator) -> Floats:
    """Align seeds (K, 4) with the map's surfaces by depth; best first, distinct ones alone.

    Along a corridor, or above a bare floor, depth fixes no pose: there the other senses choose.
    """
    scene, spreads, stride = window.scene, np.zeros((len(seeds), 4, 4)), COARSE
    while stride > _FINEST and len(window.views(stride)[-1].patch) < _TILES * LANES:
        stride /= 2.0  # small images have few samples
    for round_ in _ALIGNMENTS:
        steps, views = _select_views(window, round_, stride)
        drawn = rng.normal(size=(len(seeds), round_.each, 4))
        drawn[:, 0] = 0.0
        tries = seeds[:, None] + np.einsum("kij,knj->kni", spreads, drawn)
        best, values = _best_tries(window, tries, views, steps)
        aligned, covariances = align_poses(
            scene.caster.tracer, scene.normals, best, make_rig(views, steps),
            np.array(round_.deviations),
        )  # fmt: skip
        seeds = np.concatenate([aligned, best])
        values = np.concatenate([window.scorer.together(aligned, views, steps), values])
        order = np.argsort(-values, kind="stable")
        rows = order[select_rows(seeds[order], round_.most, **_SAME)]
        seeds, spreads = seeds[rows], np.linalg.cholesky(covariances[rows % len(best)])
    return seeds


def _select_views(
    window: Window, round_: _SearchRound | _AlignmentRound, stride: float = COARSE
) -> tuple[Floats, list[View]]:
    """Return steps (T, 4) from the last frame to those of a round, and their thinned views."""
    looked = spread(len(window), round_.frames)
    views = window.views(stride)
    return between(window.poses[-1], window.poses[looked]), [
        thin_view(views[i], round_.thinned, i) for i in looked
    ]


def _best_tries(
    window: Window, tries: Floats, views: Sequence[View], steps: Floats
) -> tuple[Floats, Floats]:
    """Return the best (K, 4) of tries (K, N, 4) around each seed, and their log-likelihoods (K,)."""
    count, each, _ = tries.shape
    values = window.scorer.together(tries.reshape(-1, 4), views, steps).reshape(count, each)
    return tries[np.arange(count), values.argmax(axis=1)], values.max(axis=1)


def make_rig(views: Sequence[View], steps: Floats) -> Rig:
    """Return the readings of depth of views whose frames are `steps` (T, 4) from a reference frame."""
    origins, directions, depths = [], [], []
    for view, step in zip(views, steps, strict=True):
        c, s = np.cos(step[3]), np.sin(step[3])
        turned = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        if view.terms[DEPTH]:
            origins.append(np.broadcast_to(step[:3], view.directions.shape))
            directions.append(view.directions @ turned)
            depths.append(np.where(view.patch >= 0, view.depth, 0.0))
    columns = map(np.concatenate, (origins, directions, depths))
    return Rig(*(np.ascontiguousarray(column, np.float32) for column in columns))


def thin_view(view: View, step: int, offset: int) -> View:
    """Keep one of `step` tiles of a view, and raise the weight of its patches as much."""
    tiles = np.arange(len(view.patch) // LANES)
    use = np.repeat(tiles % step == offset % step, LANES)
    if step > len(tiles):
        return view
    return view._replace(
        directions=view.directions[use], patch=view.patch[use], depth=view.depth[use],
        background_depth=view.background_depth[use], colour=view.colour[use],
        weight=view.weight * np.float32(len(use) / use.sum()),
    )  # fmt: skip


def table_seeds(
    table: VisibilityTable,
    views: Sequence[View],
    poses: Floats,
    noise: Noise,
    reference: int,
    most: int = SEEDS,
    log_prior: LogPrior | None = None,
) -> tuple[Floats, Floats]:
    """Find poses (K, 4) of the reference frame that fit up to `LOOKS` views together, and their ranks.

    `poses`: (T, 4) level odometry of all views. `log_prior`: of the reference frame.
    """
    looked = spread(len(views), LOOKS)
    steps = between(poses[reference], poses[looked])
    ranks = table.ranks([views[i] for i in looked], steps, noise)
    if log_prior is None:
        return _best(table, ranks, np.arange(len(table)), most)
    directed = ranks + log_prior.logs[:, :: AZIMUTHS // HEADINGS]
    parts = [
        _best(table, directed, rows, max(_FEWEST, round(share * most)))
        for rows, share in log_prior.parts
    ]
    if log_prior.sentence is not None:  # a description may be wrong
        rows = np.concatenate([rows for rows, _ in log_prior.parts])
        parts.append(_best(table, ranks, rows, round(_UNTOLD * most)))
    seeds, values = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(-values, kind="stable")
    return seeds[order], values[order]


def _best(
    table: VisibilityTable, ranks: NDArray[np.float32], rows: NDArray[np.int64], most: int
) -> tuple[Floats, Floats]:
    """Return distinct poses (K, 4) of some positions, best first, and their ranks."""
    flat = ranks[rows].ravel()
    pool = np.argpartition(-flat, min(_POOL, flat.size - 1))[:_POOL]
    pool = pool[np.argsort(-flat[pool], kind="stable")]
    position, heading = np.divmod(pool, HEADINGS)
    found = np.column_stack([table.positions[rows[position]], heading * (2.0 * np.pi / HEADINGS)])
    kept = select_rows(found, most, apart=0.45, turned=0.3)
    return found[kept], flat[pool][kept].astype(np.float64)


def scatter_poses(
    seeds: Floats, each: int | NDArray[np.int64], box: float, turn: float, rng: Generator
) -> Floats:
    """`each` (or each (K,)) poses spread evenly in a box around each seed; the first is the seed."""
    out = np.repeat(seeds, each, axis=0)
    offset = rng.uniform(-1.0, 1.0, out.shape) * np.array([box / 2, box / 2, box / 2, turn])
    count = np.broadcast_to(each, len(seeds))
    offset[np.cumsum(count) - count] = 0.0
    return out + offset


def draw_near_prior(prior: Prior, window: Window, count: int, rng: Generator) -> Floats:
    """Poses (count, 4) of the first frame drawn around a prior."""
    floor = float(floor_under(window.scene, np.array([[prior.x, prior.y]]))[0])
    low, high = min(window.options.heights), max(window.options.heights)
    out = rng.normal(size=(count, 4)) * np.array([prior.spread, prior.spread, 0.05, prior.turn])
    out[:, :2] += (prior.x, prior.y)
    out[:, 2] += floor + rng.uniform(low, high, count) if prior.z is None else prior.z
    if prior.yaw is None:
        out[:, 3] = rng.uniform(-np.pi, np.pi, count)
    else:
        out[:, 3] += prior.yaw
    return out


def select_distinct(
    poses: Floats,
    scores: Floats,
    most: int,
    *,
    apart: float = APART,
    turned: float = TURNED,
) -> NDArray[np.int64]:
    """Select at most `most` of poses (N, 4), best score (N,) first, no two near each other."""
    order = np.argsort(-scores, kind="stable")
    return np.asarray(order[select_rows(poses[order], most, apart, turned)])


def are_near(
    poses: Floats,
    pose: Floats,
    apart: float = APART,
    turned: float = TURNED,
) -> NDArray[np.bool_]:
    """Return which of poses (N, 4) belong to the mode at a pose (4,)."""
    close = np.linalg.norm(poses[:, :3] - pose[:3], axis=1) <= apart
    return np.asarray(close & (np.abs(wrap_angle(poses[:, 3] - pose[3])) <= turned))
