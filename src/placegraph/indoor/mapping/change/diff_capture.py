"""Differences between a scene map and a capture whose poses in it are known.

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
from placegraph.indoor.map.floor import is_structural
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.change import observe
from placegraph.indoor.mapping.change.align import invert_rigid
from placegraph.indoor.mapping.change.appeared import find_appeared, gather_clusters
from placegraph.indoor.mapping.change.changes import Change, DiffOptions, SceneDiff
from placegraph.indoor.mapping.change.moves import Placement, find_moved, measure_box
from placegraph.indoor.render import check_pose
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
    """Find what moved, vanished and appeared since the map was made, as far as a capture shows it.

    Raises `InputError`: an image is broken; the estimate is lost, or the poses are none in this
    map; `OptionError`: poses are none, not rigid, or not one for each frame.

    `scene`: the map; it is only read.
    `capture`: frames; with depth all kinds of changes are found, without it only what colours tell
        of objects before a background of another colour.
    `poses`: (T, 4, 4) map_from_camera [m] of the frames, or what `scene.localize` said of the
        capture.
    `options`: when something counts as changed.
    `name`: of the capture, for messages.
    `progress`: called with what is done, how far, and of how much.
    """
    options = options or DiffOptions()
    frames, matrices = _select_frames(capture, poses, name)
    tell = progress or (lambda _step, _done, _total: None)
    observations: list[observe.Observation] = []
    for i, (frame, pose) in enumerate(zip(frames, matrices, strict=True)):
        tell("looking", i, len(frames))
        observation = observe.observe_frame(scene, frame, pose)
        observations.append(observation if options.depth else replace(observation, depth=None))
    if all(observation.depth is None for observation in observations) and not options.colour:
        raise OptionError(
            "The capture has no depth, and colour is switched off, so nothing can be compared; "
            "give depth, or use colours."
        )
    _check_poses(observations, options, name)
    counts = observe.count_evidence(observations, len(scene), options)
    changes = _find_changes(scene, observations, counts, options, frames, matrices, tell)
    changed_ids = {c.id for c in changes}
    ids, built_in = scene.graph.ids, is_structural(scene.graph.labels)
    same = [i for i in np.flatnonzero(counts.is_observed).tolist() if ids[i] not in changed_ids]
    if np.any(built_in):
        there = built_in & observe.find_confirmed(observations, len(scene), options)
        same = sorted({*same, *np.flatnonzero(there).tolist()})
    known = {ids[i] for i in same} | changed_ids
    return SceneDiff(
        changes=tuple(sorted(changes, key=lambda c: -c.confidence)),
        same=tuple(ids[i] for i in same), unseen=tuple(id_ for id_ in ids if id_ not in known),
        b_from_a=np.eye(4), alignment=f"{len(frames)} frames with poses in the map",
        before=scene.source, after=name,
    )  # fmt: skip


def _find_changes(
    scene: Scene,
    observations: Sequence[observe.Observation],
    counts: observe.Evidence,
    options: DiffOptions,
    frames: Sequence[Frame],
    poses: Sequence[Floats],
    tell: Callable[[str, int, int], None],
) -> list[Change]:
    """Find what moved and vanished, and what appeared of what these leave unexplained."""
    share, graph = counts.share, scene.graph
    least = np.where(counts.by_colour, SUSPECT_BY_COLOUR, SUSPECT)
    suspects = np.flatnonzero(counts.is_observed & (share >= least) & ~is_structural(graph.labels))
    left = observe.explain_without(scene, observations, suspects, options)
    tell("gathering", 0, 1)
    clumps = gather_clusters(left)
    tell("fitting", 0, len(suspects))
    found = find_moved(scene, left, clumps, suspects, counts)
    changes = [_describe_moved(scene, counts, row, placement) for row, placement in found.items()]
    gone = [int(r) for r in suspects if r not in found and share[r] >= GONE]
    for row in gone:
        what = "show what is behind it" if counts.by_colour[row] else "continue behind it"
        changes.append(
            Change(
                kind="vanished", id=graph.ids[row], name=graph.names[row], label=graph.labels[row],
                confidence=counts.confidence(row), box=np.stack(measure_box(scene, row, np.eye(4))),
                reason=f"{share[row]:.0%} of {counts.describe(row)} {what}, and no match is near.",
            )
        )  # fmt: skip
    # what lies in the box of a thing before it moved, and the motion back, is no news
    used = [(*measure_box(scene, row, np.eye(4)), invert_rigid(found[row].motion)) for row in found]
    if len(gone) + len(found) < len(suspects):  # what is not gone explains what it did before
        left = observe.explain_without(
            scene, observations, np.array([*found, *gone], np.int64), options
        )
        clumps = gather_clusters(left)
    return changes + find_appeared(left, clumps, used, frames, poses)


def _select_frames(
    capture: Capture | Sequence[Frame], poses: ArrayLike | PoseEstimate, name: str
) -> tuple[list[Frame], list[Floats]]:
    """Select the frames that are used, and their poses; raises as `diff_capture`."""
    frames = list(capture)
    if isinstance(poses, PoseEstimate):
        if poses.status is Status.LOST or poses.best is None:
            raise InputError(
                f"{name or 'The capture'} could not be localized in the map "
                f"({poses.status.name}: {poses.reason}), so nothing can be compared. Give "
                "its poses if you know them."
            )
        by_index = {frame.index: frame for frame in frames}
        if missing := [i for i in poses.frames.tolist() if i not in by_index]:
            raise OptionError(
                f"poses: frame {missing[0]} of the estimate is not in the capture; give the "
                "capture that was localized."
            )
        frames = [by_index[i] for i in poses.frames.tolist()]
        matrices: Floats = poses.trajectory
    else:
        matrices = np.asarray(poses, np.float64)
    if matrices.ndim != 3 or len(matrices) != len(frames) or not frames:
        raise OptionError(
            f"poses: shape is {matrices.shape}, expected (T, 4, 4), one pose for each of "
            f"{len(frames)} frames."
        )
    return frames, [check_pose(m) for m in matrices]


def _check_poses(
    observations: Sequence[observe.Observation], options: DiffOptions, name: str
) -> None:
    """Raise where so few readings end on the map that the poses, not the place, are other ones."""
    readings = agree = 0
    for observation in observations:
        if observation.depth is not None:
            there = np.isfinite(observation.depth) & np.isfinite(observation.front.depth)
            near, far = observe.bound_window(observation.front.depth)
            slack = observe.tolerance(observation.depth, options)
            with np.errstate(invalid="ignore"):
                agree += int(
                    (
                        there
                        & (observation.depth > near - slack)
                        & (observation.depth < far + slack)
                    ).sum()
                )
            readings += int(there.sum())
    if agree < _AGREE * readings:
        raise InputError(
            f"{name or 'The capture'}: only {agree / readings:.0%} of its depth readings "
            "lie on the map's surfaces; check that its poses are in the map's frame, and "
            "the unit of its depth."
        )


def _describe_moved(
    scene: Scene, counts: observe.Evidence, row: int, placement: Placement
) -> Change:
    graph = scene.graph
    by = "colours fit" if counts.by_colour[row] else "readings end on it"
    sure = placement.fit * (placement.frames + 0.5) / (placement.frames + 1.0)
    sure *= placement.share  # gone it is; which of those alike came here is a guess
    alike = (
        f" {', '.join(placement.rivals)} also matches, but from farther away."
        if placement.rivals
        else ""
    )
    return Change(
        kind="moved", id=graph.ids[row], name=graph.names[row], label=graph.labels[row],
        confidence=float(np.clip(max(counts.confidence(row), 0.5) * sure, 0.0, 1.0)),
        after_from_before=placement.motion, centre=graph.positions[row],
        box=np.stack(measure_box(scene, row, placement.motion)),
        reason=f"{counts.share[row]:.0%} of {counts.describe(row)} pass through its old place; at "
        f"its new place {placement.fit:.0%} {by} in {placement.frames} frames.{alike}",
    )  # fmt: skip
