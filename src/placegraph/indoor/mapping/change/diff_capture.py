"""What changed between a scene map and a capture whose poses in it are known.

Frame by frame the depth is held against the map's, object by object. Readings behind an object say
that it is gone, readings before the map that something is new; an object that is gone and fits what
is new has moved. What no frame shows enough of is unseen, never vanished.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from placegraph.core.estimate import PoseEstimate, Status
from placegraph.core.geometry import Floats
from placegraph.errors import InputError, OptionError
from placegraph.indoor.map.floor import structure
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.change.align import inverse
from placegraph.indoor.mapping.change.changes import Change, DiffOptions, SceneDiff
from placegraph.indoor.mapping.change.moves import Clump, Placement, appeared, box_of, gather, moves
from placegraph.indoor.mapping.change.observe import (
    Look,
    Rest,
    Tally,
    around,
    look,
    rest_of,
    shown,
    tally,
    tolerance,
)
from placegraph.indoor.render import checked_pose
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame

SUSPECT, SUSPECT_BY_COLOUR = 0.2, 0.35
"""Share of an object's pixels that have to speak for being gone before a motion is looked for."""
GONE = 0.6  # ... and without a motion, before it counts as vanished
_AGREE = 0.5  # Share of all readings that have to end on the map, whatever changed


def diff_capture(
    scene: Scene,
    capture: Capture | Sequence[Frame],
    poses: ArrayLike | PoseEstimate,
    *,
    options: DiffOptions | None = None,
    name: str = "",
    progress: Callable[[str, int, int], None] | None = None,
) -> SceneDiff:
    """What moved, vanished and appeared since the map was made, as far as a capture shows it.

    Parameters
    ----------
    scene
        The map; it is only read.
    capture
        Frames; with depth all kinds of changes are found, without it only what colours tell of
        objects before a background of another colour.
    poses
        (T, 4, 4) map_from_camera [m] of the frames, or what `scene.localize` said of the capture.
    options
        When something counts as changed.
    name
        Of the capture, for messages.
    progress
        Called with what is done, how far, and of how much.

    Raises
    ------
    InputError
        An image is broken; the estimate is lost, or the poses are none in this map.
    OptionError
        Poses are none, not rigid, or not one for each frame.

    """
    options = options or DiffOptions()
    frames, matrices = _posed(capture, poses, name)
    tell = progress or (lambda _step, _done, _total: None)
    looks: list[Look] = []
    for i, (frame, pose) in enumerate(zip(frames, matrices, strict=True)):
        tell("looking", i, len(frames))
        seen = look(scene, frame, pose)
        looks.append(seen if options.depth else replace(seen, depth=None))
    if all(seen.depth is None for seen in looks) and not options.colour:
        raise OptionError("The capture has no depth, and colour is off: nothing can be compared.")
    _check_poses(looks, options, name)
    counts = tally(looks, len(scene), options)
    changes, left = _stirred(scene, looks, counts, options, tell)
    changes += appeared(left[0], left[1], left[2], frames, matrices)
    same, unseen = _unchanged(scene, looks, counts, {c.id for c in changes}, options)
    return SceneDiff(
        changes=tuple(sorted(changes, key=lambda c: -c.confidence)), same=same, unseen=unseen,
        b_from_a=np.eye(4), alignment=f"{len(frames)} frames with poses in the map",
        before=scene.source, after=name,
    )  # fmt: skip


def _stirred(
    scene: Scene,
    looks: Sequence[Look],
    counts: Tally,
    options: DiffOptions,
    tell: Callable[[str, int, int], None],
) -> tuple[list[Change], tuple[Rest, list[Clump], list[tuple[Floats, Floats, Floats]]]]:
    """What moved and vanished; and of what is left the clumps, and what of them that explains."""
    share = counts.share
    least = np.where(counts.by_colour, SUSPECT_BY_COLOUR, SUSPECT)
    built_in = structure(scene.graph.labels)
    suspects = np.flatnonzero(counts.seen & (share >= least) & ~built_in)
    left = rest_of(scene, looks, suspects, options)
    tell("gathering", 0, 1)
    clumps = gather(left)
    tell("fitting", 0, len(suspects))
    found = moves(scene, left, clumps, suspects, counts)
    changes = [_moved(scene, counts, row, placed) for row, placed in found.items()]
    gone = [int(r) for r in suspects if r not in found and share[r] >= GONE]
    changes += [_vanished(scene, counts, row) for row in gone]
    # what lies in the box of a thing before it moved, and the motion back, is no news
    used = [(*box_of(scene, row, np.eye(4)), inverse(found[row].motion)) for row in found]
    if len(gone) + len(found) < len(suspects):  # what is not gone explains what it did before
        left = rest_of(scene, looks, np.array([*found, *gone], np.int64), options)
        clumps = gather(left)
    return changes, (left, clumps, used)


def _unchanged(
    scene: Scene, looks: Sequence[Look], counts: Tally, told: set[str], options: DiffOptions
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Ids of what was seen again where it was, and of what was not seen enough of."""
    ids, built_in = scene.graph.ids, structure(scene.graph.labels)
    same = [i for i in np.flatnonzero(counts.seen).tolist() if ids[i] not in told]
    if np.any(built_in):
        there = built_in & shown(looks, len(scene), options)
        same = sorted({*same, *np.flatnonzero(there).tolist()})
    known = {ids[i] for i in same} | told
    return tuple(ids[i] for i in same), tuple(id_ for id_ in ids if id_ not in known)


def _posed(
    capture: Capture | Sequence[Frame], poses: ArrayLike | PoseEstimate, name: str
) -> tuple[list[Frame], list[Floats]]:
    """Frames that are used, and their poses."""
    frames = list(capture)
    if isinstance(poses, PoseEstimate):
        if poses.status is Status.LOST or poses.best is None:
            raise InputError(
                f"{name or 'The capture'} was not found in the map ({poses.status.name}: "
                f"{poses.reason}); nothing can be compared. Give its poses if they are known."
            )
        by_index = {frame.index: frame for frame in frames}
        if missing := [i for i in poses.frames.tolist() if i not in by_index]:
            raise OptionError(f"poses: frame {missing[0]} of the estimate is none of the capture.")
        frames = [by_index[i] for i in poses.frames.tolist()]
        matrices: Floats = poses.trajectory
    else:
        matrices = np.asarray(poses, np.float64)
    if matrices.ndim != 3 or len(matrices) != len(frames) or not frames:
        raise OptionError(
            f"poses: shape {matrices.shape}; (T, 4, 4) belongs, one for each of {len(frames)} frames."
        )
    return frames, [checked_pose(m) for m in matrices]


def _check_poses(looks: Sequence[Look], options: DiffOptions, name: str) -> None:
    """Raise where so few readings end on the map that the poses, not the place, are other ones."""
    readings = agree = 0
    for seen in looks:
        if seen.depth is not None:
            there = np.isfinite(seen.depth) & np.isfinite(seen.front.depth)
            near, far = around(seen.front.depth)
            slack = tolerance(seen.depth, options)
            with np.errstate(invalid="ignore"):
                agree += int(
                    (there & (seen.depth > near - slack) & (seen.depth < far + slack)).sum()
                )
            readings += int(there.sum())
    if agree < _AGREE * readings:
        raise InputError(
            f"{name or 'The capture'}: only {agree / readings:.0%} of its depth readings end on the "
            "map's surfaces; its poses are not in this map, or its depth has another unit."
        )


def _moved(scene: Scene, counts: Tally, row: int, placed: Placement) -> Change:
    graph, (low, high) = scene.graph, box_of(scene, row, placed.motion)
    by = "colours fit" if counts.by_colour[row] else "readings end on it"
    gone = counts.confidence(row)
    sure = placed.fit * (placed.frames + 0.5) / (placed.frames + 1.0)
    sure *= placed.share  # gone it is; which of those alike came here is a guess
    alike = f" So does {', '.join(placed.rivals)}, from farther off." if placed.rivals else ""
    return Change(
        kind="moved", id=graph.ids[row], name=graph.names[row], label=graph.labels[row],
        confidence=float(np.clip(max(gone, 0.5) * sure, 0.0, 1.0)),
        after_from_before=placed.motion, centre=graph.positions[row], box=np.stack([low, high]),
        reason=f"{counts.share[row]:.0%} of {_pixels(counts, row)} are seen through it; where it is "
        f"now {placed.fit:.0%} {by} in {placed.frames} frames.{alike}",
    )  # fmt: skip


def _vanished(scene: Scene, counts: Tally, row: int) -> Change:
    graph, (low, high) = scene.graph, box_of(scene, row, np.eye(4))
    what = "show what is behind it" if counts.by_colour[row] else "go on behind it"
    return Change(
        kind="vanished", id=graph.ids[row], name=graph.names[row], label=graph.labels[row],
        confidence=counts.confidence(row), box=np.stack([low, high]),
        reason=f"{counts.share[row]:.0%} of {_pixels(counts, row)} {what}, and nothing near fits it.",
    )  # fmt: skip


def _pixels(counts: Tally, row: int) -> str:
    pixels = counts.gone[:, row] + counts.stays[:, row]
    frames = int(np.count_nonzero(pixels))
    return f"{pixels.sum():,.0f} pixels in {frames} frame{'s' * (frames != 1)}"
