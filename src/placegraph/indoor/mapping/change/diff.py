"""Differences between two maps of one place: what lies on what, and motions between objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.random import Generator

from placegraph.core.geometry import Floats, vector_from_rotation
from placegraph.indoor.map.floor import is_nameless, is_structural, labels_agree
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.change.align import (
    SurfaceSamples,
    align,
    find_touched,
    invert_rigid,
    register,
    sample_surface,
    transform_points,
    turn_about,
)
from placegraph.indoor.mapping.change.changes import Change, DiffOptions, Piece, SceneDiff
from placegraph.indoor.rays import RayCaster
from placegraph.io.mesh.nearest_kernels import find_nearest

_DENSITY = 400.0  # most points a square metre of an object
_AROUND = 0.75  # What is around an object: surfaces of others this near to its box [m]
_LEAST_AROUND = 20  # points that tell whether a place is covered
_YAWS = 12
_SIZES = 1.5  # By how much two objects' sizes may differ and still be one, seen in part
_AGREE = 0.8  # Of what has one id in both maps, the share that has to be vouched for
_LIES_ON = 0.3
"""Share of an object's points that lie on another: without a label, that vouches for its id."""
_BESIDE = 0.1  # What is in the other map under the same id, this near [m], is there still


@dataclass(frozen=True, eq=False)
class MapObject:
    """One object of a map, in the axes of the first."""

    row: int
    id: str
    name: str
    label: str
    built_in: bool
    surface: SurfaceSamples
    box: Floats  # (2, 3) [m]
    corners: Floats  # (3 T, 3) of its triangles [m]

    @property
    def middle(self) -> Floats:
        """(3,) of its box [m]."""
        return np.asarray(self.box.mean(axis=0))

    @cached_property
    def sizes(self) -> Floats:
        """(3,) how far its points spread in the plane, the wider first, and its height [m]."""
        flat = self.surface.points[:, :2]
        spread = np.linalg.eigvalsh(np.cov(flat.T)) if len(flat) > 1 else np.zeros(2)
        widths = np.sqrt(np.maximum(spread[::-1], 0.0))
        return np.array([*widths, 0.5 * np.ptp(self.box[:, 2])])

    @cached_property
    def caster(self) -> RayCaster:
        """Casts rays at its triangles."""
        return RayCaster(self.corners, np.arange(len(self.corners)).reshape(-1, 3))

    @cached_property
    def colour(self) -> Floats:
        """(3,) mean sRGB, 0 to 1."""
        return np.asarray(self.surface.colours.mean(axis=0) / 255.0)

    def may_be(self, other: MapObject) -> bool:
        """Return whether label and size let it be the same object."""
        if other.built_in or not labels_agree(self.label, other.label):
            return False
        ratio = (self.sizes + 0.03) / (other.sizes + 0.03)
        return bool(np.all((ratio < _SIZES) & (ratio > 1.0 / _SIZES)))


def sample_objects(
    scene: Scene, motion: Floats, options: DiffOptions, rng: Generator
) -> list[MapObject]:
    """Sample the objects of a map, moved by a motion (4, 4)."""
    mesh, graph, built_in = scene.mesh, scene.graph, is_structural(scene.graph.labels)
    order = np.argsort(mesh.object_of, kind="stable")
    starts = np.searchsorted(mesh.object_of[order], np.arange(len(scene) + 1))
    found = []
    for row in range(len(scene)):
        triangles = order[starts[row] : starts[row + 1]]
        count = options.points * (10 if built_in[row] else 1)
        surface = sample_surface(mesh, triangles, count, rng, _DENSITY).transform(motion)
        flat = mesh.vertices[mesh.triangles[triangles]].reshape(-1, 3).astype(np.float64)
        corners = transform_points(motion, flat)
        box = np.stack([corners.min(axis=0), corners.max(axis=0)])
        words = graph.ids[row], graph.names[row], graph.labels[row], bool(built_in[row])
        found.append(MapObject(row, *words, surface, box, corners))
    return found


class Coverage:
    """Coverage of some objects' points by the surfaces of another map.

    `motion` leads from the bodies' axes to that map's.
    """

    def __init__(
        self, some: Sequence[MapObject], other: Scene, motion: Floats, options: DiffOptions
    ) -> None:
        self._built_in = [body.built_in for body in some]
        self._boxes = np.stack([body.box for body in some])
        self._points = np.concatenate([body.surface.points for body in some])
        self._owner = np.repeat(np.arange(len(some)), [len(body.surface) for body in some])
        normals = np.concatenate([body.surface.normals for body in some]) @ motion[:3, :3].T
        rows = find_touched(
            transform_points(motion, self._points), normals, other.caster, options.within
        )
        self._on = (rows[0] >= 0) | (rows[1] >= 0)
        table = np.zeros((len(some), len(other)))
        first, second = (np.where(r >= 0, other.mesh.object_of[np.maximum(r, 0)], -1) for r in rows)
        for hit, twice in ((first, False), (second, True)):
            new = (hit >= 0) & ((hit != first) if twice else True)
            np.add.at(table, (self._owner[new], hit[new]), 1.0)
        counts = np.maximum(np.bincount(self._owner, minlength=len(some)), 1)
        self.share_on: Floats = table / counts[:, None]
        """(N, M) share of each body's points that lie on each object of the other map."""

    def around(self, row: int, lost: Sequence[int]) -> float:
        """Measure the share of an object's surroundings, of its own map, that the other map has too.

        Other bodies that are `lost` say nothing, as long as there is anything else: furniture, that
        is; the floor it stood on speaks where it is lost, too.
        """
        low, high = self._boxes[row]
        others = self._owner != row
        gone = [i for i in lost if not self._built_in[i]]
        staying = others & ~np.isin(self._owner, gone)
        for margin, near in ((_AROUND, staying), (2 * _AROUND, staying), (2 * _AROUND, others)):
            inside = np.all((self._points > low - margin) & (self._points < high + margin), axis=1)
            if np.count_nonzero(near & inside) >= _LEAST_AROUND:
                return float(self._on[near & inside].mean())
        return 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A rigid motion from one body to another."""

    after_from_before: Floats  # (4, 4)
    fit: float  # Share of the points of both that lie on each other after it
    colour: float  # From 1, of one colour, to 0, as different as can be

    @property
    def turn_deg(self) -> float:
        """Angle of its rotation [deg]."""
        vector = vector_from_rotation(self.after_from_before[:3, :3])
        return float(np.degrees(np.linalg.norm(vector)))


def fit_motion(
    ours: MapObject, theirs: MapObject, options: DiffOptions, *, near: bool = False
) -> Motion:
    """Fit the upright motion that lays one object on another best; of equal turns the smallest.

    `near`: begin where the body is, and nowhere else.
    """
    yaws = np.zeros(1) if near else np.arange(_YAWS) * 2.0 * np.pi / _YAWS
    start = ours.middle if near else theirs.middle
    reach = max(0.15, 0.3 * float(np.ptp(ours.box, axis=0).max()))
    best: tuple[float, Floats] | None = None
    for yaw in sorted(yaws, key=lambda y: min(y, 2 * np.pi - y)):
        guess = turn_about(ours.middle, float(yaw), start)
        there = register(
            ours.surface.points, theirs.surface, guess, reach=reach, within=options.within
        )
        both = 0.5 * (
            _measure_share(ours.surface, theirs, there, options.within)
            + _measure_share(theirs.surface, ours, invert_rigid(there), options.within)
        )
        if best is None or both > best[0] + 0.03:
            best = both, there
    if best is None:
        return Motion(np.eye(4), 0.0, 0.0)
    colour = 1.0 - float(np.abs(ours.colour - theirs.colour).max())
    return Motion(best[1], best[0], colour)


def _measure_share(ours: SurfaceSamples, theirs: MapObject, motion: Floats, within: float) -> float:
    there = ours.transform(motion)
    one, other = find_touched(there.points, there.normals, theirs.caster, within)
    return float(((one >= 0) | (other >= 0)).mean()) if len(ours) else 0.0


def match_ids(
    ours: Sequence[MapObject], theirs: Sequence[MapObject], on_theirs: Floats, on_ours: Floats
) -> dict[int, int]:
    """Match objects by their ids: rows of theirs by rows of ours; empty where ids say nothing.

    Ids count where most are shared, with labels that agree. Numbers agree by chance: objects with a
    label are to be of one size as well, others to lie on each other by their shares `on_theirs` (N, M)
    and `on_ours` (M, N).
    """
    row_of = {body.id: j for j, body in enumerate(theirs)}
    shared = {i: row_of[body.id] for i, body in enumerate(ours) if body.id in row_of}
    agree = {i: j for i, j in shared.items() if labels_agree(ours[i].label, theirs[j].label)}
    if not agree or len(agree) < 0.5 * min(len(ours), len(theirs)):
        return {}
    vouched = []
    for i, j in agree.items():
        a, b = ours[i], theirs[j]
        named = not (is_nameless(a.label) or is_nameless(b.label))
        vouched.append(
            (named and (a.built_in or a.may_be(b)))
            or max(on_theirs[i, j], on_ours[j, i]) >= _LIES_ON
        )
    if np.mean(vouched) < _AGREE:
        return {}
    # a wall that was found and numbered is no sofa
    return {i: j for i, j in shared.items() if i in agree or ours[i].built_in == theirs[j].built_in}


def is_still_there(ours: MapObject, theirs: MapObject) -> bool:
    """Return whether half of one lies within centimetres of the other, of whichever more does."""
    one, other = ours.surface.points, theirs.surface.points
    if not (len(one) and len(other)):
        return False
    near = (
        (find_nearest(one, other, _BESIDE) >= 0).mean(),
        (find_nearest(other, one, _BESIDE) >= 0).mean(),
    )
    return bool(max(near) >= 0.5)


STAYED = 0.6
"""Share of an object's points that lie on one object of the other map: that is it, and it stayed."""
EXPLAINED = 0.7
"""Share that lies on any surface of the other map: it is there, cut into objects another way."""
PART = 0.1  # The same of walls and floors
COVERED = 0.4  # Share of what is around an object that the other map has: it covers the place
FITS = 0.6  # Share of two objects' points that have to lie on each other after a motion
SUREST = 0.99  # No finding is surer than this
UNSURE = 0.3
"""Confidence of an object that may have been there before, and of all changes if the alignment is unsure."""


def diff(a: Scene, b: Scene, *, options: DiffOptions | None = None) -> SceneDiff:
    """Find what moved, appeared, vanished or got another label from map `a` to map `b` of one place.

    Raises `OptionError`: the maps cannot be laid on each other, or the transform given does not.

    `a`, `b`: the earlier map and the later one; their axes may differ by a rigid transform with z
        up.
    `options`: when something counts as changed; `b_from_a` says how the axes differ, if that is
        known.
    """
    options = options or DiffOptions()
    alignment = align(a, b, options)
    rng = np.random.default_rng(options.seed)
    ours = sample_objects(a, np.eye(4), options, rng)
    theirs = sample_objects(b, invert_rigid(alignment.b_from_a), options, rng)
    on_b = Coverage(ours, b, alignment.b_from_a, options)
    on_a = Coverage(theirs, a, np.eye(4), options)
    id_matches = match_ids(ours, theirs, on_b.share_on, on_a.share_on)
    pairs = _match_stayed(ours, theirs, on_b, on_a, id_matches)
    changes: list[Change] = []
    for i, j in pairs.items():
        changes += _compare_pair(ours[i], theirs[j], on_b.share_on[i, j], options)
    matched_others = set(pairs.values())
    lost = _find_unmatched(ours, on_b.share_on, theirs, set(pairs), matched_others)
    new = _find_unmatched(theirs, on_a.share_on, ours, matched_others, set(pairs))
    found = _match_moved(ours, theirs, lost, new, id_matches, options)
    changes += [_describe_moved(ours[i], theirs[j], motion) for (i, j), motion in found.items()]
    kept = {
        i: j for i, j in id_matches.items() if i not in pairs and is_still_there(ours[i], theirs[j])
    }
    gone = [i for i in lost if i not in kept and i not in {i for i, _ in found}]
    unseen = []
    for i in gone:
        around = on_b.around(i, lost)
        # a wall does not go: the other map ends there, or cuts it otherwise
        if around < COVERED or ours[i].built_in:
            unseen.append(ours[i].id)
            continue
        changes.append(_describe_vanished(ours[i], around))
    known = {*kept.values(), *(j for _, j in found)}
    changes += [
        _describe_appeared(b, theirs[j], on_a.around(j, new), alignment.b_from_a)
        for j in new
        if j not in known
    ]
    if alignment.doubtful:
        changes = [replace(c, confidence=min(c.confidence, UNSURE)) for c in changes]
    changed_ids = {c.id for c in changes} | set(unseen)
    return SceneDiff(
        changes=tuple(sorted(changes, key=lambda c: -c.confidence)),
        same=tuple(body.id for body in ours if body.id not in changed_ids),
        unseen=tuple(unseen),
        b_from_a=alignment.b_from_a,
        alignment=alignment.description,
        before=a.source,
        after=b.source,
    )


def _describe_vanished(body: MapObject, around: float) -> Change:
    reason = f"The other map covers {around:.0%} of its surroundings, but contains no match."
    return Change(
        kind="vanished", id=body.id, name=body.name, label=body.label, box=body.box,
        confidence=min(around, SUREST), reason=reason,
    )  # fmt: skip


def _match_stayed(
    ours: Sequence[MapObject],
    theirs: Sequence[MapObject],
    on_b: Coverage,
    on_a: Coverage,
    id_matches: dict[int, int],
) -> dict[int, int]:
    """Match pairs of objects that lie on each other, one to one, the best first.

    Those that ids deny are dropped: a chair may stand where another one stood.
    """
    rows, columns = np.nonzero((on_b.share_on >= STAYED) & (on_a.share_on.T >= STAYED))
    worth = on_b.share_on[rows, columns] + on_a.share_on[columns, rows]
    pairs_of = zip(rows.tolist(), columns.tolist(), strict=True)
    worth += [0.2 * (ours[i].label == theirs[j].label) for i, j in pairs_of]
    pairs: dict[int, int] = {}
    for k in np.argsort(-worth, kind="stable").tolist():
        i, j = int(rows[k]), int(columns[k])
        if i not in pairs and j not in pairs.values():
            pairs[i] = j
    back = {j: i for i, j in id_matches.items()}
    return {i: j for i, j in pairs.items() if id_matches.get(i, j) == j and back.get(j, i) == i}


def _find_unmatched(
    some: Sequence[MapObject],
    share_on: Floats,
    other_objects: Sequence[MapObject],
    matched: set[int],
    matched_others: set[int],
) -> list[int]:
    """Find objects without a pair that the other map does not hold cut otherwise.

    A wall that has its own counterpart does not explain the picture that hung on it. Of a wall
    itself a part will do: the other map may end there.
    """
    rows = []
    for i, body in enumerate(some):
        parts = [
            share
            for k, share in enumerate(share_on[i])
            if share > 0 and (k not in matched_others or other_objects[k].label == body.label)
        ]
        if i not in matched and sum(parts) < (PART if body.built_in else EXPLAINED):
            rows.append(i)
    return rows


def _compare_pair(
    ours: MapObject, theirs: MapObject, share: float, options: DiffOptions
) -> list[Change]:
    changes = []
    if not (ours.built_in or labels_agree(ours.label, theirs.label)):
        reason = f"{share:.0%} of it lies where the other map has a {theirs.label!r}."
        changes.append(
            Change(
                kind="relabelled", id=ours.id, name=ours.name, label=ours.label, other=theirs.id,
                new_label=theirs.label, confidence=min(share, SUREST), box=ours.box, reason=reason,
            )
        )  # fmt: skip
    if share < 0.9 and not ours.built_in:
        motion = fit_motion(ours, theirs, options, near=True)
        if motion.fit > share + 0.1 and _is_significant(motion, ours, options):
            changes.append(_describe_moved(ours, theirs, motion))
    return changes


def _match_moved(
    ours: Sequence[MapObject],
    theirs: Sequence[MapObject],
    lost: Sequence[int],
    new: Sequence[int],
    id_matches: dict[int, int],
    options: DiffOptions,
) -> dict[tuple[int, int], Motion]:
    bids: list[tuple[float, int, int, Motion]] = []
    for i in lost:
        if ours[i].built_in:
            continue
        for j in new:
            same_id = id_matches.get(i) == j
            if not same_id and (
                i in id_matches or j in id_matches.values() or not ours[i].may_be(theirs[j])
            ):
                continue
            motion = fit_motion(ours[i], theirs[j], options)
            least = 0.5 * FITS if same_id else FITS
            if motion.fit >= least and _is_significant(motion, ours[i], options):
                way = float(np.linalg.norm(theirs[j].middle - ours[i].middle))
                bids.append((motion.fit * (1.0 - 0.5 * way / (way + 5.0)) + same_id, i, j, motion))
    won: dict[tuple[int, int], Motion] = {}
    for _, i, j, motion in sorted(bids, key=lambda bid: -bid[0]):
        if all(i != k and j != m for k, m in won):
            won[i, j] = motion
    return won


def _is_significant(motion: Motion, body: MapObject, options: DiffOptions) -> bool:
    after = transform_points(motion.after_from_before, body.middle[None])[0]
    far = np.linalg.norm(after - body.middle) >= options.least_shift
    return bool(far or motion.turn_deg >= options.least_turn)


def _describe_moved(ours: MapObject, theirs: MapObject, motion: Motion) -> Change:
    return Change(
        kind="moved", id=ours.id, name=ours.name, label=ours.label, other=theirs.id,
        new_label="" if labels_agree(ours.label, theirs.label) else theirs.label,
        confidence=min(motion.fit * motion.colour, SUREST),
        after_from_before=motion.after_from_before, centre=ours.middle, box=theirs.box,
        reason=f"After the motion, {motion.fit:.0%} of it and of {theirs.id!r} overlap.",
    )  # fmt: skip


def _describe_appeared(b: Scene, theirs: MapObject, around: float, b_from_a: Floats) -> Change:
    sure = min(around, SUREST) if around >= COVERED and not theirs.built_in else UNSURE
    reason = f"The first map covers {around:.0%} of its surroundings, but contains no match."
    if around < COVERED:
        reason = "The first map hardly covers this place, so the object may have been there before."
    elif theirs.built_in:
        reason = "It is built in, so the first map may end there or segment it differently."
    return Change(
        kind="appeared", label=theirs.label, name=theirs.name, other=theirs.id, box=theirs.box,
        confidence=sure, piece=cut_piece(b, theirs.row, invert_rigid(b_from_a)), reason=reason,
    )  # fmt: skip


def cut_piece(scene: Scene, row: int, motion: Floats) -> Piece:
    """Cut out the surface of an object after a motion, with the colours of its corners."""
    mesh = scene.mesh
    own = np.flatnonzero(mesh.object_of == row)
    corners, at = np.unique(mesh.triangles[own], return_inverse=True)
    at = at.reshape(-1, 3)
    colours = np.zeros((len(corners), 3), np.uint8)
    for k, (u, v) in enumerate(((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))):
        shares = np.full(len(own), u, np.float32), np.full(len(own), v, np.float32)
        colours[at[:, k]] = mesh.colour_at(own.astype(np.int32), *shares)
    return Piece(transform_points(motion, mesh.vertices[corners].astype(np.float64)), at, colours)
