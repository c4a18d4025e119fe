"""Alignment of maps: points on surfaces, and the motions that lay them on each other (ICP)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, rotation_from_vector, rotation_z
from placegraph.errors import OptionError
from placegraph.indoor.map.floor import is_structural
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.change.changes import DiffOptions
from placegraph.indoor.rays import RayCaster
from placegraph.io.mesh.nearest_kernels import find_nearest

_ROUNDS = 30
_STILL = 1e-5  # A step below this [m, rad] ends the search
_SLIDES = 1e-3
"""A direction along which residuals change less than this share of the best is held fast: a round
table's turn, a picture's slide along its wall."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceSamples:
    """Points of a surface, evenly by area."""

    points: Floats  # (N, 3) [m]
    normals: Floats  # (N, 3) unit
    colours: NDArray[np.uint8]  # (N, 3) sRGB
    rows: NDArray[np.int32]  # (N,) rows of the triangles they lie on

    def __len__(self) -> int:
        return len(self.points)

    def subsample(self, count: int) -> SurfaceSamples:
        """Return at most `count` of the points."""
        step = max(1, -(-len(self) // count))
        return SurfaceSamples(
            self.points[::step], self.normals[::step], self.colours[::step], self.rows[::step]
        )

    def transform(self, motion: Floats) -> SurfaceSamples:
        """Return the samples after a motion (4, 4)."""
        return SurfaceSamples(
            transform_points(motion, self.points),
            self.normals @ motion[:3, :3].T,
            self.colours,
            self.rows,
        )


def sample_surface(
    mesh: Mesh, triangles: NDArray[np.int64], count: int, rng: Generator, most: float = np.inf
) -> SurfaceSamples:
    """Sample about `count` points on triangles of a mesh, at most `most` a square metre."""
    corners = mesh.vertices[mesh.triangles[triangles]].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    total = float(lengths.sum())
    count = int(min(count, np.ceil(most * total / 2.0))) if total > 0 else 0
    # evenly along the running sum of areas: as many on each triangle as its area says
    at = (np.arange(count) + rng.uniform(size=count)) / max(count, 1) * total
    which = np.minimum(np.searchsorted(np.cumsum(lengths), at), len(triangles) - 1)
    u, v = rng.uniform(size=(2, count))
    over = u + v > 1.0
    u[over], v[over] = 1.0 - u[over], 1.0 - v[over]
    shares = np.stack([1.0 - u - v, u, v], axis=1)
    rows = triangles[which].astype(np.int32)
    return SurfaceSamples(
        points=np.einsum("nc,nck->nk", shares, corners[which]),
        normals=normals[which] / np.maximum(lengths[which], 1e-12)[:, None],
        colours=mesh.colour_at(rows, u.astype(np.float32), v.astype(np.float32)),
        rows=rows,
    )


def register(
    source: Floats, target: SurfaceSamples, start: Floats, *, reach: float, within: float = 0.03
) -> Floats:
    """Find the upright motion (4, 4) near `start` that brings points (N, 3) onto a surface.

    ICP, point to plane: points farther than `reach` [m] are left out; it shrinks to twice `within`.
    """
    motion = np.array(start, np.float64)
    limit = reach
    for _ in range(_ROUNDS):
        points = transform_points(motion, source)
        rows = find_nearest(points, target.points, limit)
        close = rows >= 0
        if np.count_nonzero(close) < 6:
            break
        step = _step(points[close], target.points[rows[close]], target.normals[rows[close]])
        motion = step @ motion
        size = max(float(np.abs(step[:3, 3]).max()), float(np.abs(step[:3, :3] - np.eye(3)).max()))
        if size < _STILL and limit <= 2 * within:
            break
        limit = max(2 * within, 0.8 * limit)
    return motion


def find_touched(
    points: Floats, normals: Floats, caster: RayCaster, within: float
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Find triangles (N,) of a mesh that points of another surface lie on, from either side; -1: none.

    Rays are cast along the normals (N, 3), so that sparse points tell of whole surfaces; both sides
    are asked since something thin may lie on what is meant.
    """
    found = []
    for side in (normals, -normals):
        hits = caster.cast(points + within * side, -side)
        found.append(np.where(hits.distance <= 2.0 * within, hits.triangle, -1))
    return found[0], found[1]


def _step(points: Floats, onto: Floats, normals: Floats) -> Floats:
    """Compute a small motion (4, 4) by least squares of distances along the normals."""
    middle = points.mean(axis=0)
    arm = np.cross(points - middle, normals)
    jacobian = np.concatenate([normals, arm[:, 2:]], axis=1)
    error = np.einsum("nk,nk->n", onto - points, normals)
    weight = 1.0 / (1.0 + (error / max(float(np.median(np.abs(error))) * 3.0, 1e-4)) ** 2)
    information = jacobian.T @ (jacobian * weight[:, None])
    values, axes = np.linalg.eigh(information)
    known = values > _SLIDES * values[-1]
    right = axes.T @ (jacobian.T @ (weight * error))
    solved = axes[:, known] @ (right[known] / values[known])
    rotation = rotation_from_vector(np.array([0.0, 0.0, solved[3]]))
    return make_rigid(rotation, solved[:3] + middle - rotation @ middle)


def make_rigid(rotation: Floats, shift: Floats) -> Floats:
    """Make the matrix (4, 4) of a rotation (3, 3) followed by a shift (3,)."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, shift
    return out


def invert_rigid(motion: Floats) -> Floats:
    """Invert a rigid motion (4, 4)."""
    back: Floats = motion[:3, :3].T
    return make_rigid(back, -back @ motion[:3, 3])


def turn_about(middle: Floats, yaw: float, to: Floats) -> Floats:
    """Make the motion (4, 4) that turns by `yaw` [rad] about a point's vertical and moves it to another."""
    rotation = rotation_z(yaw)
    return make_rigid(rotation, to - rotation @ middle)


def transform_points(motion: Floats, points: Floats) -> Floats:
    """Transform points (N, 3) by a rigid motion (4, 4)."""
    out: Floats = points @ motion[:3, :3].T + motion[:3, 3]
    return out


POINTS = 20_000  # On each map
DENSITY = 60.0  # Most points a square metre
LEAST = 0.5
"""Share of the smaller map's surface, and of what is upright in it, that has to lie on the other's:
floors and ceilings of any two rooms do."""
SURE = 0.8
"""With less an estimate is doubtful: two looks at one place that share half of it, or two rooms."""
LEAST_GIVEN = 0.2  # The same of a transform that is given
_BINS = 180
_TURNS = 8
_SHIFTS = 3
_CELL = 0.1
_COARSE = 0.3  # What a start may be off [m]
_FINE = 0.4  # Share of `within` by which motions that fit are compared
_BUILDING = 0.2
"""Minimum share of a map's surface that must be built in, so that the map is aligned by this part; in
a map of unlabelled objects, surface without an object counts as built in."""
_UPRIGHT = 0.3  # What is upright has normals no steeper than this
_FEW = 0.05  # A smaller share of upright surface tells nothing
_SOME = 1500  # Points by which starts are compared


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Rigid transform between two maps, and how well it fits."""

    b_from_a: Floats  # (4, 4)
    description: str  # In a sentence
    doubtful: bool = False  # The two may be different places; nothing that follows from it is sure


def align(a: Scene, b: Scene, options: DiffOptions) -> Alignment:
    """Transform from a's axes to b's: the one that is given, checked, or one that is found.

    Raises `OptionError` where none is found, or the one given fits nowhere.
    """
    rng = np.random.default_rng(options.seed)
    ours, theirs = _sample_building(a, rng), _sample_building(b, rng)
    if options.b_from_a is not None:
        share = _measure_overlap(a, b, ours, theirs, options.b_from_a, options.within)
        if share < LEAST_GIVEN:
            raise OptionError(
                f"b_from_a: it aligns only {share:.0%} of {_name(a)} with {_name(b)}; check "
                "that it maps the first map's frame to the second's, not the reverse. "
                "Remove it to estimate the alignment."
            )
        return Alignment(options.b_from_a, f"given; {_describe_overlap(share, options)}")
    few = ours.subsample(_SOME), theirs.subsample(_SOME)
    best, motion = -1.0, np.eye(4)
    for start in _propose_starts(a, b, ours, theirs):
        share = _measure_overlap(a, b, *few, start, 0.5 * _COARSE)
        share += _score_labels(a, b, start)
        if share > best + 0.02:  # of starts as good as each other the first: the axes as they are
            best, motion = share, start
    # from the map that shows less no point is drawn to a surface that it does not show
    forth = register(ours.points, theirs, motion, reach=_COARSE, within=options.within)
    back = register(theirs.points, ours, invert_rigid(motion), reach=_COARSE, within=options.within)
    found = max(
        (forth, invert_rigid(back), motion),
        key=lambda m: _measure_overlap(a, b, ours, theirs, m, _FINE * options.within),
    )
    share = _measure_overlap(a, b, ours, theirs, found, options.within)
    agreed = _measure_overlap(a, b, ours, theirs, found, options.within, upright=True)
    if agreed < LEAST:
        raise OptionError(
            f"{_name(a)} and {_name(b)} cannot be aligned (at best {agreed:.0%} of their "
            "walls agree); check that they show the same place in the same unit, or give "
            "b_from_a."
        )
    moved_by = np.linalg.norm(found[:3, 3])
    turn = np.degrees(np.arctan2(found[1, 0], found[0, 0]))
    description = (
        f"estimated: rotation of {turn:.1f} degrees, translation of {moved_by:.2f} m; "
        f"{_describe_overlap(share, options)}"
    )
    if agreed < SURE:
        description += (
            f", but only {agreed:.0%} of the upright surfaces. The alignment and all "
            "changes are therefore uncertain: the maps may show different places or overlap "
            "only in part. If they show the same place, give b_from_a"
        )
    return Alignment(found, description, doubtful=agreed < SURE)


def _describe_overlap(share: float, options: DiffOptions) -> str:
    return (
        f"{share:.0%} of the smaller map's surface lies within {options.within:g} m of the other's"
    )


def _sample_building(scene: Scene, rng: np.random.Generator) -> SurfaceSamples:
    """Sample points on walls, floors and ceilings; on everything where few of them are labelled."""
    built_in = is_structural(scene.graph.labels)[scene.mesh.object_of]
    chosen = np.flatnonzero(built_in)
    areas = np.linalg.norm(scene.mesh.normals(), axis=1)
    if areas[chosen].sum() < _BUILDING * areas.sum():
        chosen = np.arange(len(scene.mesh))
    return sample_surface(scene.mesh, chosen, POINTS, rng, DENSITY)


def _measure_overlap(
    a: Scene,
    b: Scene,
    ours: SurfaceSamples,
    theirs: SurfaceSamples,
    motion: Floats,
    within: float,
    *,
    upright: bool = False,
) -> float:
    """Measure the share of points of one map that lie on the other; the larger of both ways.

    `upright`: of all points or of those on what is upright, whichever is less.
    """
    shares = []
    for points, scene, way in ((ours, b, motion), (theirs, a, invert_rigid(motion))):
        there = points.transform(way)
        one, other = find_touched(there.points, there.normals, scene.caster, within)
        lies = (one >= 0) | (other >= 0)
        walls = lies[np.abs(there.normals[:, 2]) < _UPRIGHT]
        few = not upright or len(walls) < _FEW * len(lies)
        shares.append(float(lies.mean() if few else min(lies.mean(), walls.mean())))
    return max(shares)


def _score_labels(a: Scene, b: Scene, motion: Floats) -> float:
    """Score a motion by the share of a's objects that have one of their label nearby in b, halved."""
    movable = np.flatnonzero(~is_structural(a.graph.labels))
    if not movable.size:
        return 0.0
    there = transform_points(motion, a.graph.positions[movable])
    gaps = np.linalg.norm(there[:, None] - b.graph.positions[None], axis=2)
    labels = np.array(a.graph.labels, np.str_)[movable, None] == np.array(b.graph.labels, np.str_)
    return 0.5 * float((np.where(labels, gaps, np.inf).min(axis=1) < _COARSE).mean())


def _propose_starts(
    a: Scene, b: Scene, ours: SurfaceSamples, theirs: SurfaceSamples
) -> list[Floats]:
    """Propose transforms: axes as they are, then by turns and shifts of the walls."""
    lift = float(b.floors[0] - a.floors[0])
    starts = [np.eye(4), make_rigid(np.eye(3), np.array([0.0, 0.0, lift]))]
    upright = [np.abs(s.normals[:, 2]) < _UPRIGHT for s in (ours, theirs)]
    if not (upright[0].any() and upright[1].any()):
        return starts
    headings = [
        np.bincount(
            np.floor(
                np.arctan2(s.normals[u, 1], s.normals[u, 0]) % (2 * np.pi) / (2 * np.pi) * _BINS
            ).astype(int)
            % _BINS,
            minlength=_BINS,
        )
        for s, u in zip((ours, theirs), upright, strict=True)
    ]
    match = np.fft.irfft(np.conj(np.fft.rfft(headings[0])) * np.fft.rfft(headings[1]), _BINS)
    for turn in _find_peaks(match + np.roll(match, 1) + np.roll(match, -1)):
        rotation = rotation_z(turn * 2 * np.pi / _BINS)
        walls = ours.points[upright[0]] @ rotation.T
        slides = _propose_shifts(walls[:, :2], theirs.points[upright[1], :2])
        starts += [make_rigid(rotation, np.array([*shift, lift])) for shift in slides]
    return starts


def _find_peaks(values: Floats) -> list[int]:
    """Find the highest values on a ring, at least 10 degrees apart."""
    left, found = np.array(values, np.float64), []
    gap = round(_BINS * 10 / 360)
    for _ in range(_TURNS):
        best = int(left.argmax())
        found.append(best)
        left[np.arange(best - gap, best + gap + 1) % _BINS] = -np.inf
    return found


def _propose_shifts(walls: Floats, other_walls: Floats) -> list[Floats]:
    """Propose shifts (2,) [m] by which walls seen from above lie on each other, the best few."""
    size = np.ceil((np.ptp(walls, axis=0) + np.ptp(other_walls, axis=0)) / _CELL).astype(int) + 8
    size = np.minimum(size, 4096)
    rasters = []
    for points in (walls, other_walls):
        cells = np.floor((points - points.min(axis=0)) / _CELL).astype(int) + 2
        cells = np.minimum(cells, size - 1)
        raster = np.zeros(tuple(size))
        raster[cells[:, 0], cells[:, 1]] = 1.0
        spread = sum(np.roll(raster, s, axis=k) for k in (0, 1) for s in (-1, 1))
        rasters.append(raster + 0.5 * np.minimum(spread, 1.0))
    match = np.fft.irfft2(np.conj(np.fft.rfft2(rasters[0])) * np.fft.rfft2(rasters[1]), tuple(size))
    base = other_walls.min(axis=0) - walls.min(axis=0)
    found = []
    for _ in range(_SHIFTS):
        at = np.array(np.unravel_index(int(match.argmax()), match.shape))
        signed: NDArray[np.int64] = np.where(at > size // 2, at - size, at)
        found.append(base + signed * _CELL)
        for i in range(-3, 4):
            for j in range(-3, 4):
                match[(at[0] + i) % size[0], (at[1] + j) % size[1]] = -np.inf
    return found


def _name(scene: Scene) -> str:
    return scene.source or scene.scenes[0]
