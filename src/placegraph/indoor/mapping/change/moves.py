"""Objects that moved, and where to, by a capture of the place."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, vector_from_rotation
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.change import observe
from placegraph.indoor.mapping.change.align import (
    SurfaceSamples,
    invert_rigid,
    make_rigid,
    register,
    sample_surface,
    transform_points,
    turn_about,
)
from placegraph.indoor.mapping.change.appeared import Cluster
from placegraph.indoor.mapping.change.changes import DiffOptions
from placegraph.indoor.rays import RayCaster

POINTS = 120  # On a thing, for the first round
DENSE = 3000  # On a thing, for the fit
YAWS = 18
GRID = 0.1  # Step of positions tried [m]
LOOKS = 6  # Frames that the first round asks
_CHUNK = 200_000
_LEAST_POINTS = 12  # that a fit takes
_NUDGE = 0.15  # by how much a placement is turned to be fitted once more [rad]
_LIFT = 0.08  # what moved up or down less than this is tried at its old height, too [m]
_THROUGH = 2.0  # A reading behind the surface weighs this many on it
_KEPT = 6  # Placements of the first round that are fitted
LEAST_FIT = 0.75  # Share of the readings that have to end on the thing, of those that reach it
LEAST_COVER = 0.5  # Share of the unexplained readings where it stands that it has to explain


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Candidate place of an object that is gone from where it was."""

    motion: Floats  # (4, 4) after_from_before
    explained: int  # Readings that end on it and that nothing else explains
    fit: float  # Share of the readings that end on it, of those that reach it
    cover: float  # Share of the unexplained readings in its box that it explains
    frames: int  # That speak for it
    rivals: tuple[str, ...] = ()
    """Ids of other things that are gone and fit the place nearly as well."""
    share: float = 1.0
    """Probability of this object among its rivals, by the distance that each would have moved."""

    @property
    def is_good(self) -> bool:
        """Return whether the move is accepted."""
        return self.fit >= LEAST_FIT and self.cover >= LEAST_COVER

    @property
    def score(self) -> float:
        """The larger, the better."""
        return self.explained * self.fit * self.cover


class MovableObject:
    """One object of the map that may have moved."""

    def __init__(self, mesh: Mesh, row: int, rng: Generator) -> None:
        triangles = np.flatnonzero(mesh.object_of == row)
        self.row = row
        self.few: SurfaceSamples = sample_surface(mesh, triangles, POINTS, rng)
        self.many: SurfaceSamples = sample_surface(mesh, triangles, DENSE, rng)
        corners = mesh.vertices[mesh.triangles[triangles]].reshape(-1, 3).astype(np.float64)
        self.low, self.high = corners.min(axis=0), corners.max(axis=0)
        used, rows = np.unique(mesh.triangles[triangles], return_inverse=True)
        self.caster = RayCaster(mesh.vertices[used], rows.reshape(-1, 3))

    @property
    def middle(self) -> Floats:
        """(3,) of its box [m]."""
        return np.asarray((self.low + self.high) / 2.0)

    def measure_gap(self, cluster: Cluster) -> float:
        """Return the distance between the boxes of the object and of a cluster [m]."""
        gap = np.maximum(np.maximum(cluster.low - self.high, self.low - cluster.high), 0.0)
        return float(np.linalg.norm(gap))


def find_placements(
    unexplained: observe.UnexplainedReadings, movable: MovableObject, cluster: Floats, every: Floats
) -> list[Placement]:
    """Find placements of an object at a cluster of unexplained points (N, 3), best first.

    `every`: (M, 3) all unexplained points; thin things come in several clumps.
    """
    chosen = _select_frames(unexplained, cluster)
    starts = _list_starts(movable, cluster)
    if not chosen or not len(starts):
        return []
    scores = np.concatenate(
        [
            _score_starts(unexplained, chosen, movable, starts[i : i + _CHUNK // POINTS])
            for i in range(0, len(starts), _CHUNK // POINTS)
        ]
    )
    found = []
    for start in _keep_distinct(starts, scores):
        near = _find_inside(movable, start, every, 0.15)
        if np.count_nonzero(near) < _LEAST_POINTS:
            continue
        begin = invert_rigid(turn_about(movable.middle, start[3], start[:3]))
        back = register(every[near], movable.many, begin, reach=0.15, within=0.03)
        found.append(score_placement(unexplained, movable, invert_rigid(back)))
    found.sort(key=lambda p: -p.score)
    return [_refine_placement(unexplained, movable, every, found[0]), *found[1:]] if found else []


def _refine_placement(
    unexplained: observe.UnexplainedReadings,
    movable: MovableObject,
    every: Floats,
    placement: Placement,
) -> Placement:
    """Refine a placement: by fits from a little beside it, or at its old height."""
    best = placement
    for turn in (-_NUDGE, 0.0, _NUDGE):
        middle = transform_points(placement.motion, movable.middle[None])[0]
        start = turn_about(middle, turn, middle) @ placement.motion
        back = transform_points(invert_rigid(start), every)
        near = np.all((back > movable.low - 0.08) & (back < movable.high + 0.08), axis=1)
        if np.count_nonzero(near) < _LEAST_POINTS:
            continue
        fitted = register(every[near], movable.many, invert_rigid(start), reach=0.08, within=0.03)
        motion = invert_rigid(fitted)
        tried = [motion]
        if abs(motion[2, 3]) < _LIFT:  # what stood on the floor does so still
            level = motion.copy()
            level[2, 3] = 0.0
            tried.append(level)
        best = max(
            [best, *(score_placement(unexplained, movable, m) for m in tried)],
            key=lambda p: p.score,
        )
    return best


def score_placement(
    unexplained: observe.UnexplainedReadings, movable: MovableObject, motion: Floats
) -> Placement:
    """Score how well an object at a placement (4, 4) explains all frames, by rays at its mesh."""
    back = invert_rigid(motion)
    low, high = movable.low - 0.05, movable.high + 0.05
    corners = np.array(list(product(*zip(low, high, strict=True))))
    ends = through = new_readings = frames = 0
    for observation, left, new in zip(
        unexplained.observations, unexplained.depths, unexplained.new, strict=True
    ):
        if observation.depth is None:
            continue
        part = observe.find_window(observation, transform_points(motion, corners))
        if part is None:
            continue
        rays = observation.rays[part].reshape(-1, 3).astype(np.float64) @ back[:3, :3].T
        origin = transform_points(back, observation.map_from_camera[None, :3, 3])[0]
        distance = movable.caster.cast(origin, rays).distance
        reading, beyond = observation.depth[part].ravel(), left[part].ravel()
        slack = observe.tolerance(reading, unexplained.options)
        with np.errstate(invalid="ignore"):
            shows = distance < beyond - slack
            on = shows & (np.abs(reading - distance) <= slack)
            behind = shows & (reading > distance + slack)
        fresh = new[part].ravel()
        points = origin + rays[fresh] * reading[fresh, None]
        new_readings += int(np.all((points > low) & (points < high), axis=1).sum())
        ends += int((on & fresh).sum())
        through += int(behind.sum())
        frames += int((on & fresh).sum() >= 5)
    fit = ends / max(ends + through, 1)
    return Placement(motion, ends, fit, min(ends / max(new_readings, 1), 1.0), frames)


def _select_frames(unexplained: observe.UnexplainedReadings, cluster: Floats) -> list[int]:
    counts = []
    for observation, left in zip(unexplained.observations, unexplained.depths, strict=True):
        rows, columns, depth = observe.project(observation, cluster)
        inside = rows >= 0
        clear = depth[inside] < left[rows[inside], columns[inside]]
        counts.append(int(clear.sum()) if observation.depth is not None else 0)
    order = np.argsort(-np.array(counts), kind="stable")[:LOOKS]
    return [int(t) for t in order if counts[t] > 0.2 * counts[order[0]] and counts[t] > 5]


def _list_starts(movable: MovableObject, cluster: Floats) -> Floats:
    """List placements (S, 4) to try: middle of the object [m] and its turn [rad], upright."""
    size = (movable.high - movable.low) / 2.0
    low = np.percentile(cluster, 2, axis=0) - 0.5 * size.max()
    high = np.percentile(cluster, 98, axis=0) + 0.5 * size.max()
    x, y = (np.arange(low[k], high[k] + GRID, GRID) for k in (0, 1))
    # what stood goes on standing at its height; what the clump's own height speaks for, too
    lifts = {0.0}
    bottom = float(np.percentile(cluster[:, 2], 1)) - float(movable.low[2])
    if abs(bottom) > 0.1:
        lifts.add(bottom)
    yaws = np.arange(YAWS) * 2.0 * np.pi / YAWS
    grid = np.meshgrid(x, y, movable.middle[2] + np.array(sorted(lifts)), yaws, indexing="ij")
    starts = np.stack([g.ravel() for g in grid], axis=1)
    # a middle far from all points of the clump explains none of them
    cells = np.unique(np.round(cluster[:, :2] / 0.1).astype(np.int64), axis=0) * 0.1
    spots, at = np.unique(starts[:, :2], axis=0, return_inverse=True)
    far = np.full(len(spots), np.inf)
    for chunk in np.array_split(cells, max(1, len(cells) // 500)):
        gaps = np.linalg.norm(spots[:, None] - chunk[None], axis=2)
        far = np.minimum(far, gaps.min(axis=1))
    return np.asarray(starts[far[at] <= float(np.hypot(*size[:2]))])


def _score_starts(
    unexplained: observe.UnexplainedReadings,
    chosen: list[int],
    movable: MovableObject,
    starts: Floats,
) -> Floats:
    """Score starts (S,): readings on the object, less those behind it, by points and frames."""
    cos, sin = np.cos(starts[:, 3, None]), np.sin(starts[:, 3, None])
    offset = movable.few.points - movable.middle
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
        observation, left = unexplained.observations[t], unexplained.depths[t]
        assert observation.depth is not None  # noqa: S101  of frames without depth none is chosen
        rows, columns, depth = observe.project(observation, points)
        reading = observation.depth[rows, columns]
        slack = observe.tolerance(reading, unexplained.options)
        with np.errstate(invalid="ignore"):
            is_visible = (rows >= 0) & (depth < left[rows, columns] - slack)
            on = is_visible & (np.abs(reading - depth) <= slack)
            on &= unexplained.new[t][rows, columns]
            behind = is_visible & (reading > depth + slack)
        total += on.sum(axis=1) - _THROUGH * behind.sum(axis=1)
    return total / (len(chosen) * len(offset))


def _keep_distinct(starts: Floats, scores: Floats) -> list[Floats]:
    kept: list[Floats] = []
    for i in np.argsort(-scores, kind="stable")[:2000].tolist():
        if scores[i] <= 0.0 or len(kept) == _KEPT:
            break
        turns = [abs((starts[i, 3] - k[3] + np.pi) % (2 * np.pi) - np.pi) for k in kept]
        gaps = [float(np.linalg.norm(starts[i, :3] - k[:3])) for k in kept]
        if all(g > 0.15 or t > 0.6 for g, t in zip(gaps, turns, strict=True)):
            kept.append(starts[i])
    return kept


def _find_inside(
    movable: MovableObject, start: Floats, points: Floats, margin: float
) -> NDArray[np.bool_]:
    """Find points (N, 3) in the object's box at a placement, and a margin."""
    back = transform_points(invert_rigid(turn_about(movable.middle, start[3], start[:3])), points)
    inside = (back > movable.low - margin) & (back < movable.high + margin)
    return np.asarray(inside.all(axis=1))


_NEARNESS = 1.0
"""Distance [m] over which the score of a fit falls to a third; among like objects the nearest wins."""
_RIVAL = 0.7
"""Another thing that is gone and fits a place this well, against the best, may be it as well."""
_SHARED = 0.3  # Two things whose boxes share this much of the smaller stand at one place
_MOVED_GAIN = 1.2  # By how much a motion has to explain the frames better than staying does


class _Bid(NamedTuple):
    """Claim of an object to a place."""

    weight: float
    row: int
    placement: Placement


def find_moved(
    scene: Scene,
    unexplained: observe.UnexplainedReadings,
    clusters: Sequence[Cluster],
    suspects: NDArray[np.int64],
    counts: observe.Evidence,
) -> dict[int, Placement]:
    """Find the placement of each suspect that has one, no two at one place: the best fit first."""
    rng = np.random.default_rng(unexplained.options.seed)
    bids: list[_Bid] = []
    for row in suspects.tolist():
        movable = MovableObject(scene.mesh, row, rng)
        if counts.by_colour[row]:
            found = slide_on_wall(unexplained, movable)
            placements = [found] if found is not None else []
        else:
            placements = _find_better_placements(unexplained, movable, clusters)
        bids += _bid(unexplained.options, movable, placements)
    return _award(scene, bids)


def _find_better_placements(
    unexplained: observe.UnexplainedReadings, movable: MovableObject, clusters: Sequence[Cluster]
) -> list[Placement]:
    """Find the good placements of an object that explain the frames better than its staying does."""
    every = np.concatenate([np.zeros((0, 3)), *(cluster.points for cluster in clusters)])
    stays = score_placement(unexplained, movable, np.eye(4))
    return [
        placement
        for cluster in clusters
        if movable.measure_gap(cluster) < unexplained.options.reach
        for placement in find_placements(unexplained, movable, cluster.points, every)[:2]
        if placement.is_good
        and placement.explained >= unexplained.options.least_pixels / 2
        and placement.score > _MOVED_GAIN * stays.score
    ]


def _bid(
    options: DiffOptions, movable: MovableObject, placements: Sequence[Placement]
) -> Iterator[_Bid]:
    """Bid for the placements to which the object moved, and not too far."""
    for placement in placements:
        after = transform_points(placement.motion, movable.middle[None])[0]
        shift = float(np.linalg.norm(after - movable.middle))
        turn = np.degrees(np.linalg.norm(vector_from_rotation(placement.motion[:3, :3])))
        has_moved = shift >= options.least_shift or turn >= options.least_turn
        if has_moved and shift <= options.reach:
            yield _Bid(placement.score * np.exp(-shift / _NEARNESS), movable.row, placement)


def _award(scene: Scene, bids: Sequence[_Bid]) -> dict[int, Placement]:
    """Award each place to the object that bids most for it, each object one place."""
    won: dict[int, Placement] = {}
    places: list[tuple[Floats, Floats]] = []
    for weight, row, placement in sorted(bids, key=lambda bid: -bid.weight):
        box = measure_box(scene, row, placement.motion)
        if row in won or any(_measure_box_overlap(*box, *other) > _SHARED for other in places):
            continue
        rivals = {
            other.row: other.weight
            for other in reversed(bids)
            if other.row != row
            and other.placement.score > _RIVAL * placement.score
            and _measure_box_overlap(*box, *measure_box(scene, other.row, other.placement.motion))
            > _SHARED
        }
        share = weight / (weight + sum(rivals.values()))
        names = tuple(scene.graph.ids[other] for other in rivals)
        won[row] = replace(placement, rivals=names, share=share)
        places.append(box)
    return won


def measure_box(scene: Scene, row: int, motion: Floats) -> tuple[Floats, Floats]:
    """Return the corners of an object's box after a motion."""
    corners = scene.mesh.vertices[scene.mesh.triangles[scene.mesh.object_of == row]]
    points = transform_points(motion, corners.reshape(-1, 3).astype(np.float64))
    return points.min(axis=0), points.max(axis=0)


def _measure_box_overlap(low: Floats, high: Floats, other_low: Floats, other_high: Floats) -> float:
    """Measure the share of the smaller of two boxes that the other holds."""
    sides = np.maximum(np.minimum(high, other_high) - np.maximum(low, other_low), 0.0)
    least = min(np.prod(high - low), np.prod(other_high - other_low))
    return float(np.prod(sides) / max(least, 1e-9))


ACROSS, UP = 1.6, 0.4  # How far along the wall and up and down it is looked for [m]
COARSE, FINE = 0.04, 0.01  # Steps of the two rounds [m]
ALIKE = 0.6  # Least correlation with the thing's colours
BETTER = 0.15  # How much better than the map without it, and than 0.3 m beside, it has to fit
_EVERY = 8  # of a thing's points one is compared
_BLUR = 0.025  # its colours are averaged this far around it [m], about what three pixels cover
_LOOKS = 8
_SEEN = 0.6  # Share of the thing's face that a frame has to see to be asked


def slide_on_wall(
    unexplained: observe.UnexplainedReadings, movable: MovableObject
) -> Placement | None:
    """Find the placement of a flat object along its wall; None where nothing there looks like it."""
    spread = movable.many.normals.T @ movable.many.normals
    facing = np.linalg.eigh(spread)[1][:, -1]
    level = np.hypot(facing[0], facing[1])
    across = None if level < 0.8 else np.array([-facing[1], facing[0], 0.0]) / level
    face = _blur_face(movable)
    if across is None or float(np.ptp(face.colours, axis=0).max()) < 0.1:
        return None  # of one colour: it looks like any patch of such a colour
    chosen = _select_near(unexplained, movable, across)
    shifts = _make_grid(np.zeros(2), (ACROSS, UP), COARSE)
    scores, seen = _score_slides(unexplained, chosen, face, across, shifts)
    if not seen.any():
        return None
    best = int(np.where(seen, scores, -1.0).argmax())
    fine = _make_grid(shifts[best], (COARSE, COARSE), FINE)
    again, _ = _score_slides(unexplained, chosen, face, across, fine)
    shift, score = fine[int(again.argmax())], float(again.max())
    apart = seen & (np.linalg.norm(shifts - shift, axis=1) > 0.3)
    rival = float(scores[apart].max()) if apart.any() else 0.0
    without, frames, pixels = _correlate_background(
        unexplained, chosen, face, _shift_points(across, shift[None])
    )
    if score < ALIKE or score < without + BETTER or score < rival + BETTER:
        return None
    motion = make_rigid(np.eye(3), _shift_points(across, shift[None])[0])
    return Placement(motion, pixels, score, 1.0, frames)


@dataclass(frozen=True, slots=True, eq=False)
class _Face:
    """Points of a thing, with colours as blurred as a picture's."""

    points: Floats  # (P, 3) [m]
    normals: Floats  # (P, 3)
    colours: Floats  # (P, 3) sRGB, 0 to 1

    def faces(self, observation: observe.Observation) -> NDArray[np.bool_]:
        """Return whether a point's surface faces a camera (P,)."""
        towards = observation.map_from_camera[:3, 3] - self.points
        return np.asarray(np.einsum("nk,nk->n", self.normals, towards) > 0.0)

    def front(self, observation: observe.Observation) -> float:
        """Return the share of points that face a camera, at least 0.2."""
        return max(float(self.faces(observation).mean()), 0.2)


def _blur_face(movable: MovableObject) -> _Face:
    many = movable.many
    points, normals = many.points[::_EVERY], many.normals[::_EVERY]
    apart = np.linalg.norm(points[:, None] - many.points[None], axis=2)
    near = (apart < _BLUR) & (normals @ many.normals.T > 0.7)
    colours = near @ (many.colours / 255.0) / np.maximum(near.sum(axis=1, keepdims=True), 1)
    return _Face(points, normals, colours)


def _shift_points(across: Floats, shifts: Floats) -> Floats:
    """Convert shifts (S, 2) along the wall and up to shifts (S, 3) [m]."""
    return np.asarray(shifts[:, :1] * across + shifts[:, 1:] * np.array([0.0, 0.0, 1.0]))


def _select_near(
    unexplained: observe.UnexplainedReadings, movable: MovableObject, across: Floats
) -> list[int]:
    worth = []
    for observation in unexplained.observations:
        spots = movable.middle + np.linspace(-ACROSS, ACROSS, 9)[:, None] * across
        rows, _, depth = observe.project(observation, spots)
        worth.append(float(np.count_nonzero(rows >= 0) / (1.0 + np.abs(depth).min())))
    order = np.argsort(-np.array(worth), kind="stable")[:_LOOKS]
    return [int(t) for t in order if worth[t] > 0]


def _score_slides(
    unexplained: observe.UnexplainedReadings,
    chosen: Sequence[int],
    face: _Face,
    across: Floats,
    shifts: Floats,
) -> tuple[Floats, NDArray[np.bool_]]:
    """Correlate the object's colours with all frames at shifts (S, 2); also which shifts are seen."""
    moves = _shift_points(across, shifts)
    total, weight = np.zeros((2, len(shifts)))
    for t in chosen:
        observation = unexplained.observations[t]
        rows, columns, is_visible = _find_visible(unexplained, observation, face, moves)
        observed = blur_image(observation.rgb)[rows, columns]
        seen = is_visible.mean(axis=1)
        worth = np.where(seen >= _SEEN * face.front(observation), seen, 0.0)
        total += worth * _correlate(face.colours[None], observed, is_visible)
        weight += worth
    return np.where(weight > 0, total / np.maximum(weight, 1e-9), -1.0), weight > 0


def _correlate_background(
    unexplained: observe.UnexplainedReadings, chosen: Sequence[int], face: _Face, moves: Floats
) -> tuple[float, int, int]:
    """Correlate the object's colours with the map behind; also frames and pixels that see it."""
    values, frames, pixels = [], 0, 0
    for t in chosen:
        observation = unexplained.observations[t]
        rows, columns, is_visible = _find_visible(unexplained, observation, face, moves)
        if is_visible.mean() < _SEEN * face.front(observation):
            continue
        kept = (observation.front.depth >= unexplained.depths[t] - 1e-3)[..., None]
        left = blur_image(np.where(kept, observation.front.colour, observation.behind.colour))
        observed = left[rows, columns]
        values.append(float(_correlate(face.colours[None], observed, is_visible)[0]))
        frames += 1
        pixels += len(np.unique(rows[is_visible] * observation.camera.width + columns[is_visible]))
    return (float(np.mean(values)) if values else -1.0), frames, pixels


def _find_visible(
    unexplained: observe.UnexplainedReadings,
    observation: observe.Observation,
    face: _Face,
    moves: Floats,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Find the pixel rows and columns (S, P) of a face, and whether a surface is seen there."""
    rows, columns, depth = observe.project(observation, face.points[None] + moves[:, None])
    is_visible = (
        (rows >= 0) & np.isfinite(observation.rgb[rows, columns, 0]) & face.faces(observation)
    )
    if observation.depth is not None:
        reading = observation.depth[rows, columns]
        with np.errstate(invalid="ignore"):
            is_visible &= np.abs(reading - depth) <= observe.tolerance(reading, unexplained.options)
    return rows, columns, is_visible


def blur_image(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Average an image (H, W, 3) over 3 x 3 pixels."""
    channels = [observe.sum_window(image[..., k], 1) for k in range(3)]
    return (np.stack(channels, axis=-1) / 9.0).astype(np.float32)


def _correlate(
    wanted: Floats, observed: NDArray[np.float32], is_visible: NDArray[np.bool_]
) -> Floats:
    """Correlate (S,) colours (1 or S, P, 3) over points and channels where they are seen."""
    mask = is_visible[..., None].astype(np.float64)
    count = np.maximum(mask.sum(axis=1, keepdims=True), 1.0)
    a = np.broadcast_to(wanted, observed.shape) * mask
    b = np.nan_to_num(observed).astype(np.float64) * mask
    a = (a - a.sum(axis=1, keepdims=True) / count) * mask
    b = (b - b.sum(axis=1, keepdims=True) / count) * mask
    norm = np.sqrt((a**2).sum(axis=(1, 2)) * (b**2).sum(axis=(1, 2)))
    return np.asarray((a * b).sum(axis=(1, 2)) / np.maximum(norm, 1e-9))


def _make_grid(middle: Floats, half: tuple[float, float], step: float) -> Floats:
    x, y = (np.arange(-h, h + step / 2, step) + m for h, m in zip(half, middle, strict=True))
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
