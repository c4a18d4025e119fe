"""What changed between a scene map and a capture whose poses in it are known.

Frame by frame the depth is held against the map's, object by object. Readings behind an object say
that it is gone, readings before the map that something is new; an object that is gone and fits what
is new has moved. What no frame shows enough of is unseen, never vanished.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import InputError, OptionError
from placegraph.estimate import PoseEstimate, Status
from placegraph.geometry import vector_from_rotation
from placegraph.indoor.map.structure import structure
from placegraph.indoor.mapping.change.appeared import Clump, appeared, gather
from placegraph.indoor.mapping.change.changes import Change, SceneDiff
from placegraph.indoor.mapping.change.looks import look
from placegraph.indoor.mapping.change.motion import Placement, Rest, Suspect, judge, placements
from placegraph.indoor.mapping.change.options import DiffOptions
from placegraph.indoor.mapping.change.register import inverse, moved
from placegraph.indoor.mapping.change.slide import slid
from placegraph.indoor.mapping.change.tally import around, summed, tally, tolerance
from placegraph.indoor.rays import RayCaster
from placegraph.indoor.render import checked_pose

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import ArrayLike, NDArray

    from placegraph.formats.capture.capture import Capture
    from placegraph.formats.capture.frame import Frame
    from placegraph.geometry import Floats
    from placegraph.indoor.map.scene import Scene
    from placegraph.indoor.mapping.change.looks import Look
    from placegraph.indoor.mapping.change.tally import Tally

SUSPECT, SUSPECT_BY_COLOUR = 0.2, 0.35
"""Share of an object's pixels that have to speak for being gone before a motion is looked for."""
GONE = 0.6
"""... and without a motion, before it counts as vanished."""
_AGREE = 0.5
"""Share of all readings that have to end on the map, whatever changed."""
_NEARNESS = 1.0
"""Of things alike the nearest is meant: over this way [m] a fit's worth falls to a third."""
_RIVAL = 0.7
"""Another thing that is gone and fits a place this well, against the best, may be it as well."""
_SHARED = 0.3
"""Two things whose boxes share this much of the smaller stand at one place."""
_MOVED_GAIN = 1.2
"""By how much a motion has to explain the frames better than staying does."""


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
    share, built_in = counts.share, structure(scene.graph.labels)
    least = np.where(counts.by_colour, SUSPECT_BY_COLOUR, SUSPECT)
    suspects = np.flatnonzero(counts.seen & (share >= least) & ~built_in)
    left = _left(scene, looks, suspects, options)
    tell("gathering", 0, 1)
    clumps = gather(left)
    tell("fitting", 0, len(suspects))
    found = _moves(scene, left, clumps, suspects, counts)
    changes = [_moved(scene, counts, row, placed) for row, placed in found.items()]
    rest = [int(r) for r in suspects if r not in found and share[r] >= GONE]
    changes += [_vanished(scene, counts, row) for row in rest]
    used = [_explained(scene, found[row], row) for row in found]
    if len(rest) + len(found) < len(suspects):  # what is not gone explains what it did before
        left = _left(scene, looks, np.array([*found, *rest], np.int64), options)
        clumps = gather(left)
    changes += appeared(left, clumps, used, frames, matrices)
    told = {c.id for c in changes}
    same = [i for i in np.flatnonzero(counts.seen).tolist() if scene.graph.ids[i] not in told]
    if np.any(built_in):
        shown = _shown(looks, len(scene), options)
        same = sorted({*same, *np.flatnonzero(built_in & shown).tolist()})
    known = {scene.graph.ids[i] for i in same} | told
    return SceneDiff(
        changes=tuple(sorted(changes, key=lambda c: -c.confidence)),
        same=tuple(scene.graph.ids[i] for i in same),
        unseen=tuple(id_ for id_ in scene.graph.ids if id_ not in known),
        b_from_a=np.eye(4),
        alignment=f"{len(frames)} frames with poses in the map",
        before=scene.source,
        after=name,
    )


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


def _left(
    scene: Scene, looks: Sequence[Look], suspects: NDArray[np.int64], options: DiffOptions
) -> Rest:
    """The map without the suspects, and what it does not explain."""
    suspected = np.zeros(len(scene) + 1, np.bool_)
    suspected[suspects] = True
    mesh = scene.mesh
    kept = ~suspected[mesh.object_of]
    caster = RayCaster(mesh.vertices, mesh.triangles[kept]) if kept.any() else None
    depths, new = [], []
    for seen in looks:
        depth = seen.front.depth.copy()
        gone = suspected[seen.front.objects]
        if gone.any():
            origin = seen.map_from_camera[:3, 3]
            rays = seen.rays[gone]
            depth[gone] = caster.cast(origin, rays).distance if caster else np.inf
        depths.append(depth)
        new.append(_new(seen, depth, options))
    return Rest(looks, depths, new, options)


def _new(seen: Look, depth: NDArray[np.float32], options: DiffOptions) -> NDArray[np.bool_]:
    """(H, W) readings that end before all surfaces around, and are not alone in it."""
    if seen.depth is None:
        return np.zeros(depth.shape, np.bool_)
    near, _ = around(depth)
    with np.errstate(invalid="ignore"):
        before = seen.depth < near - tolerance(seen.depth, options)
    before &= np.isfinite(depth)  # beyond the map's end nothing is known to be new
    return before & (summed(before, 1) >= 5)


def _shown(looks: Sequence[Look], count: int, options: DiffOptions) -> NDArray[np.bool_]:
    """(N,) whether readings that agree with the map end on an object."""
    pixels = np.zeros(count)
    for seen in looks:
        agrees = seen.front.objects >= 0
        if seen.depth is not None:
            with np.errstate(invalid="ignore"):
                off = np.abs(seen.depth - seen.front.depth)
                agrees &= off <= tolerance(seen.depth, options)
        pixels += np.bincount(seen.front.objects[agrees], minlength=count)
    return pixels >= options.least_pixels


def _moves(
    scene: Scene,
    left: Rest,
    clumps: Sequence[Clump],
    suspects: NDArray[np.int64],
    counts: Tally,
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
        box = _box(scene, row, placed.motion)
        if row in won or any(_common(*box, *other) > _SHARED for other in places):
            continue
        rivals = {
            other: bid
            for bid, other, too in reversed(bids)
            if other != row
            and too.worth > _RIVAL * placed.worth
            and _common(*box, *_box(scene, other, too.motion)) > _SHARED
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


def _box(scene: Scene, row: int, motion: Floats) -> tuple[Floats, Floats]:
    """Corners of an object's box after a motion."""
    corners = scene.mesh.vertices[scene.mesh.triangles[scene.mesh.object_of == row]]
    points = moved(motion, corners.reshape(-1, 3).astype(np.float64))
    return points.min(axis=0), points.max(axis=0)


def _common(low: Floats, high: Floats, other_low: Floats, other_high: Floats) -> float:
    """Share of the smaller of two boxes that the other holds."""
    sides = np.maximum(np.minimum(high, other_high) - np.maximum(low, other_low), 0.0)
    least = min(np.prod(high - low), np.prod(other_high - other_low))
    return float(np.prod(sides) / max(least, 1e-9))


def _explained(scene: Scene, placed: Placement, row: int) -> tuple[Floats, Floats, Floats]:
    """Box of an object before it moved, and the motion back: what lies in it is no news."""
    low, high = _box(scene, row, np.eye(4))
    return low, high, inverse(placed.motion)


def _moved(scene: Scene, counts: Tally, row: int, placed: Placement) -> Change:
    graph, (low, high) = scene.graph, _box(scene, row, placed.motion)
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
    graph, (low, high) = scene.graph, _box(scene, row, np.eye(4))
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
