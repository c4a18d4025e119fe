"""What changed between two scene maps of one place, and between a map and a capture in it.

Maps are laid on each other first (`diff_align`). What has kept its surface stayed; the rest is
matched one to one, by id where ids mean the same in both, else by label, shape, colour and nearness,
and fitted (ICP): what fits elsewhere moved, what fits nowhere appeared, or vanished - if the other
map covers the place at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.map.structure import same_label
from placegraph.indoor.mapping.change.align import align
from placegraph.indoor.mapping.change.capture.diff import diff_capture
from placegraph.indoor.mapping.change.changes import Change, Piece, SceneDiff
from placegraph.indoor.mapping.change.objects import (
    Body,
    Cover,
    Motion,
    bodies,
    by_id,
    motion_between,
    still_there,
)
from placegraph.indoor.mapping.change.options import DiffOptions
from placegraph.indoor.mapping.change.register import inverse, moved

__all__ = ["DiffOptions", "diff", "diff_capture"]

STAYED = 0.6
"""Share of an object's points that lie on one object of the other map: that is it, and it stayed."""
EXPLAINED = 0.7
"""Share that lies on any surface of the other map: it is there, cut into objects another way."""
PART = 0.1
"""The same of walls and floors."""
COVERED = 0.4
"""Share of what is around an object that the other map has: it covers the place."""
FITS = 0.6
"""Share of two objects' points that have to lie on each other after a motion."""
SUREST = 0.99
"""No finding is surer than this."""
UNSURE = 0.3
"""Of what may have been there before, and of all between maps that are doubtfully aligned."""


def diff(a: Scene, b: Scene, *, options: DiffOptions | None = None) -> SceneDiff:
    """What moved, appeared, vanished or got another label from map `a` to map `b` of one place.

    Parameters
    ----------
    a, b
        The earlier map and the later one; their axes may differ by a rigid transform with z up.
    options
        When something counts as changed; `b_from_a` says how the axes differ, if that is known.

    Raises
    ------
    OptionError
        The maps cannot be laid on each other, or the transform given does not.

    """
    options = options or DiffOptions()
    alignment = align(a, b, options)
    rng = np.random.default_rng(options.seed)
    ours = bodies(a, np.eye(4), options, rng)
    theirs = bodies(b, inverse(alignment.b_from_a), options, rng)
    on_b = Cover(ours, b, alignment.b_from_a, options)
    on_a = Cover(theirs, a, np.eye(4), options)
    pairs = _stayed(ours, theirs, on_b, on_a)
    known = by_id(ours, theirs, on_b.share_on, on_a.share_on)
    pairs = _allowed(pairs, known)
    changes: list[Change] = []
    for i, j in list(pairs.items()):
        changes += _stirred(ours[i], theirs[j], on_b.share_on[i, j], options)
    taken = set(pairs.values())
    lost = _without(ours, on_b.share_on, theirs, set(pairs), taken)
    new = _without(theirs, on_a.share_on, ours, taken, set(pairs))
    found = _moves(ours, theirs, lost, new, known, options)
    changes += [_moved(ours[i], theirs[j], motion) for (i, j), motion in found.items()]
    kept = {i: j for i, j in known.items() if i not in pairs and still_there(ours[i], theirs[j])}
    gone = [i for i in lost if i not in kept and i not in {i for i, _ in found}]
    around = {i: on_b.around(i, lost) for i in gone}
    # a wall does not go: the other map ends there, or cuts it otherwise
    unseen = [i for i in gone if around[i] < COVERED or ours[i].built_in]
    changes += [_vanished(ours[i], around[i]) for i in gone if i not in unseen]
    met = {*kept.values(), *(j for _, j in found)}
    come = [j for j in new if j not in met]
    changes += [_appeared(b, theirs[j], on_a.around(j, new), alignment.b_from_a) for j in come]
    if alignment.doubtful:
        changes = [replace(c, confidence=min(c.confidence, UNSURE)) for c in changes]
    told = {c.id for c in changes} | {ours[i].id for i in unseen}
    return SceneDiff(
        changes=tuple(sorted(changes, key=lambda c: -c.confidence)),
        same=tuple(body.id for body in ours if body.id not in told),
        unseen=tuple(ours[i].id for i in unseen),
        b_from_a=alignment.b_from_a,
        alignment=alignment.said,
        before=a.source,
        after=b.source,
    )


def _stayed(
    ours: Sequence[Body], theirs: Sequence[Body], on_b: Cover, on_a: Cover
) -> dict[int, int]:
    """Pairs of objects that lie on each other, one to one, the best first."""
    rows, columns = np.nonzero((on_b.share_on >= STAYED) & (on_a.share_on.T >= STAYED))
    worth = on_b.share_on[rows, columns] + on_a.share_on[columns, rows]
    pairs_of = zip(rows.tolist(), columns.tolist(), strict=True)
    worth += [0.2 * (ours[i].label == theirs[j].label) for i, j in pairs_of]
    pairs: dict[int, int] = {}
    for k in np.argsort(-worth, kind="stable").tolist():
        i, j = int(rows[k]), int(columns[k])
        if i not in pairs and j not in pairs.values():
            pairs[i] = j
    return pairs


def _without(
    some: Sequence[Body],
    share_on: Floats,
    others: Sequence[Body],
    paired: set[int],
    taken: set[int],
) -> list[int]:
    """Rows of bodies that have no pair, and are not there in the other map cut otherwise."""
    return [
        i
        for i, body in enumerate(some)
        if i not in paired and not _cut_otherwise(body, share_on[i], others, taken)
    ]


def _cut_otherwise(body: Body, shares: Floats, others: Sequence[Body], taken: set[int]) -> bool:
    """Whether a body is there in the other map, as part of another object or in several parts.

    A wall that has its own counterpart does not explain the picture that hung on it. Of a wall
    itself a part will do: the other map may end there.
    """
    parts = [
        share
        for k, share in enumerate(shares)
        if share > 0 and (k not in taken or others[k].label == body.label)
    ]
    return sum(parts) >= (PART if body.built_in else EXPLAINED)


def _allowed(pairs: dict[int, int], known: dict[int, int]) -> dict[int, int]:
    """Pairs without those that ids deny: a chair may stand where another one stood."""
    back = {j: i for i, j in known.items()}
    return {i: j for i, j in pairs.items() if known.get(i, j) == j and back.get(j, i) == i}


def _stirred(ours: Body, theirs: Body, share: float, options: DiffOptions) -> list[Change]:
    """What changed of an object that is about where it was: its label, or its place a little."""
    changes = []
    if not (ours.built_in or same_label(ours.label, theirs.label)):
        changes.append(
            Change(
                kind="relabelled",
                id=ours.id,
                name=ours.name,
                label=ours.label,
                other=theirs.id,
                new_label=theirs.label,
                confidence=min(share, SUREST),
                box=ours.box,
                reason=f"{share:.0%} of it lies where the other map has a {theirs.label!r}.",
            )
        )
    if share < 0.9 and not ours.built_in:
        motion = motion_between(ours, theirs, options, near=True)
        if motion.fit > share + 0.1 and _counts(motion, ours, options):
            changes.append(_moved(ours, theirs, motion))
    return changes


def _moves(
    ours: Sequence[Body],
    theirs: Sequence[Body],
    lost: Sequence[int],
    new: Sequence[int],
    known: dict[int, int],
    options: DiffOptions,
) -> dict[tuple[int, int], Motion]:
    """Motions of what is lost onto what is new, one to one."""
    bids: list[tuple[float, int, int, Motion]] = []
    for i in lost:
        if ours[i].built_in:
            continue
        for j in new:
            by_id = known.get(i) == j
            if not by_id and (i in known or j in known.values() or not ours[i].may_be(theirs[j])):
                continue
            motion = motion_between(ours[i], theirs[j], options)
            if motion.fit >= (0.5 * FITS if by_id else FITS) and _counts(motion, ours[i], options):
                way = float(np.linalg.norm(theirs[j].middle - ours[i].middle))
                bids.append((motion.fit * (1.0 - 0.5 * way / (way + 5.0)) + by_id, i, j, motion))
    won: dict[tuple[int, int], Motion] = {}
    for _, i, j, motion in sorted(bids, key=lambda bid: -bid[0]):
        if all(i != k and j != m for k, m in won):
            won[i, j] = motion
    return won


def _counts(motion: Motion, body: Body, options: DiffOptions) -> bool:
    """Whether a motion is one, and not noise."""
    after = moved(motion.after_from_before, body.middle[None])[0]
    far = np.linalg.norm(after - body.middle) >= options.least_shift
    return bool(far or motion.turn_deg >= options.least_turn)


def _moved(ours: Body, theirs: Body, motion: Motion) -> Change:
    return Change(
        kind="moved", id=ours.id, name=ours.name, label=ours.label, other=theirs.id,
        new_label="" if same_label(ours.label, theirs.label) else theirs.label,
        confidence=min(motion.fit * motion.colour, SUREST),
        after_from_before=motion.after_from_before, centre=ours.middle, box=theirs.box,
        reason=f"After the motion {motion.fit:.0%} of it and of {theirs.id!r} lie on each other.",
    )  # fmt: skip


def _vanished(ours: Body, around: float) -> Change:
    return Change(
        kind="vanished", id=ours.id, name=ours.name, label=ours.label, box=ours.box,
        confidence=min(around, SUREST),
        reason=f"The other map has {around:.0%} of what is around it, and nothing that fits it.",
    )  # fmt: skip


def _appeared(b: Scene, theirs: Body, around: float, b_from_a: Floats) -> Change:
    sure = min(around, SUREST) if around >= COVERED and not theirs.built_in else UNSURE
    said = f"The first map has {around:.0%} of what is around it, and nothing that fits it."
    if around < COVERED:
        said = "The first map hardly covers the place: it may have been there before."
    elif theirs.built_in:
        said = "It is built in: the first map may end there, or cut it otherwise."
    return Change(
        kind="appeared", label=theirs.label, name=theirs.name, other=theirs.id, box=theirs.box,
        confidence=sure, piece=piece_of(b, theirs.row, inverse(b_from_a)), reason=said,
    )  # fmt: skip


def piece_of(scene: Scene, row: int, motion: Floats) -> Piece:
    """Surface of an object of a map after a motion, with the colours of its corners."""
    mesh = scene.mesh
    own = np.flatnonzero(mesh.object_of == row)
    corners, at = np.unique(mesh.triangles[own], return_inverse=True)
    at = at.reshape(-1, 3)
    colours = np.zeros((len(corners), 3), np.uint8)
    for k, (u, v) in enumerate(((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))):
        shares = np.full(len(own), u, np.float32), np.full(len(own), v, np.float32)
        colours[at[:, k]] = mesh.colour_at(own.astype(np.int32), *shares)
    return Piece(moved(motion, mesh.vertices[corners].astype(np.float64)), at, colours)
