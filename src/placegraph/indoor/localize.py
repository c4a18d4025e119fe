"""A capture finds its pose in a scene map: table, polish, verdict, refinement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from placegraph.core.estimate import PoseEstimate, Status
from placegraph.errors import OptionError
from placegraph.indoor.encode.labels import foreign
from placegraph.indoor.likelihood.observe import sight
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.options import check_device
from placegraph.indoor.pose.covariance import explore_unobservable
from placegraph.indoor.pose.drift import correct_drift
from placegraph.indoor.pose.estimate import add_earth_poses, estimate_pose
from placegraph.indoor.pose.faults import (
    COVERED,
    find_divided_capture,
    find_fault,
    find_spoiled,
    is_blank,
)
from placegraph.indoor.pose.local_fit import fit_window, heaviest_modes
from placegraph.indoor.pose.particle_filter import run_passes
from placegraph.indoor.pose.search import search
from placegraph.indoor.pose.window import PoseQuery, Window, observe, timed
from placegraph.indoor.refine import (
    RefineOptions,
    RefineSetup,
    find_camera_correction,
    refine_estimate,
)
from placegraph.indoor.refine.landmarks import locate_by_landmarks
from placegraph.indoor.refine.matching import Matcher
from placegraph.indoor.status import (
    add_note,
    diagnostics_of,
    doubt_tracked,
    explain_by_fault,
    needs_fault_search,
    reject_frames,
)
from placegraph.indoor.track.tracker import Tracker, track_capture
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame

WINDOW = 30
"""Frames that are searched and fitted together; a longer capture is tracked, where it can be."""


def localized(
    scene: Scene,
    capture: Capture | Sequence[Frame],
    *,
    refine: bool | RefineOptions = True,
    matcher: str | Matcher = "auto",
    device: str = "auto",
    **asked: Any,  # noqa: ANN401  # of `PoseQuery.of`
) -> PoseEstimate:
    """The answer to a question in keywords; parameters and errors: `SceneMap.localize`."""
    if not isinstance(refine, bool | RefineOptions):
        raise OptionError(f"refine is {refine!r}; it is True, False or RefineOptions.")
    query = PoseQuery.of(scene, capture, **asked)
    options = refine if isinstance(refine, RefineOptions) else None
    refining = RefineSetup.of(options, matcher, device) if refine else None
    check_device(device, network=refining is not None and refining.matcher is not None)
    return add_earth_poses(scene, localize(query, refining))


def localize(query: PoseQuery, refining: RefineSetup | None) -> PoseEstimate:
    """Where the last frame asked about, and every other, was taken (SG2Loc, Sec. 3).

    The same query on the same machine gives the same answer. `refining` says how the best mode is
    fitted to images and depth; None: not at all. Errors: `SceneMap.localize`.
    """
    window, estimate = _found(query, refining)
    mend = refining and find_camera_correction(window, estimate, refining)
    if mend:
        mended = replace(query, frames=mend.frames(query.frames))
        chosen = mend.chosen(query, estimate, _found(mended, refining)[1])
        if Status.OK in (estimate.status, chosen.status):
            return chosen
        estimate = chosen
    return _suspected(window, estimate)


def _suspected(window: Window, estimate: PoseEstimate) -> PoseEstimate:
    """An answer that no mended camera makes `OK`, with the fault of the input that explains it, if any."""
    query = window.query
    found = diagnostics_of(estimate)
    own = query.encoder is None and query.shares is None and estimate.status is not Status.OK
    if own and (other := foreign(query.scene, query.frames[-WINDOW:], found.semantic)):
        return add_note(estimate, other)
    wrong = needs_fault_search(estimate)
    here = query.shares is None  # else other scenes of a library may be where it was taken
    searched = query.options.tracked and len(query.frames) <= WINDOW
    if not (wrong and here and searched and estimate.modes):
        return estimate
    with timed(window.seconds, "faults"):
        fault = find_fault(window, found.ratio, np.random.default_rng(query.seed))
    seconds = estimate.stats["seconds"] | {"faults": round(window.seconds["faults"], 4)}
    estimate = replace(estimate, stats=estimate.stats | {"seconds": seconds})
    if not fault:
        return estimate
    covered = f" {COVERED}" if COVERED in estimate.reason else ""
    return explain_by_fault(estimate, f"{fault}{covered}")


def _found(query: PoseQuery, refining: RefineSetup | None) -> tuple[Window, PoseEstimate]:
    """The answer if the camera is as it is said to be, and the frames that it rests on."""
    if len(query.frames) > WINDOW and query.options.tracked:
        tracker = Tracker(query)
        estimate = track_capture(tracker, query.frames)
        if estimate.status is Status.OK:
            fault = find_divided_capture(query, tracker.scorer, estimate.trajectory)
            estimate = doubt_tracked(estimate, fault)
        window = _tail(query, tracker)
        return window, refine_estimate(window, estimate, refining) if refining else estimate
    rng = np.random.default_rng(query.seed)
    window = observe(query)
    fault = find_spoiled(window)
    if fault:  # no search could help
        return window, reject_frames(fault, [s.frame.index for s in window.sightings])
    covered = is_blank(window.sightings)
    if covered:  # depth and labels are better off without such images
        window.sightings = [replace(s, rgb=None) for s in window.sightings]
    seeds = search(window, rng)
    if len(seeds):
        seeds = np.concatenate([locate_by_landmarks(window), seeds])
    passes = run_passes(window, seeds, rng)
    if query.options.answer == "mle":
        fits = heaviest_modes(window.chain, passes.particles, query.options.modes)
    else:
        starts = np.concatenate([passes.modes, seeds])
        fits = correct_drift(window, fit_window(window, starts, rng), rng)
        fits = explore_unobservable(window, fits, rng)
    estimate = estimate_pose(window, fits)
    if covered:
        estimate = add_note(estimate, COVERED)
    seconds = {stage: round(took, 4) for stage, took in window.seconds.items()}
    stats = {"seconds": seconds, "particles": passes.counts} | window.scorer.stats()
    estimate = replace(estimate, stats=estimate.stats | stats, history=passes.history)
    return window, refine_estimate(
        window, estimate, refining, explained=True
    ) if refining else estimate


def _tail(query: PoseQuery, tracker: Tracker) -> Window:
    """The newest frames of a tracked capture, without what an encoder says of them."""
    newest = [sight(frame, None, query.options) for frame in query.frames[-WINDOW:]]
    return Window(query, tracker.scorer, newest)
