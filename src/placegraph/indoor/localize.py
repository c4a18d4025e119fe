"""Localization of a capture in a scene map: search, local fit, status, refinement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from placegraph.core.estimate import PoseEstimate, Status
from placegraph.errors import OptionError
from placegraph.indoor.encode.labels import explain_foreign_ids
from placegraph.indoor.likelihood.observe import FINE, observe_frame, suspect_unit_factor
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.options import check_device
from placegraph.indoor.pose.agreement import find_image_fault, undo_faults
from placegraph.indoor.pose.covariance import explore_unobservable
from placegraph.indoor.pose.estimate import add_earth_poses, estimate_pose
from placegraph.indoor.pose.local_fit import correct_drift, fit_window
from placegraph.indoor.pose.particle_filter import FilteredPasses, heaviest_modes, run_passes
from placegraph.indoor.pose.search import search
from placegraph.indoor.pose.window import PoseQuery, Window, observe, time_stage
from placegraph.indoor.refine import (
    RefineOptions,
    RefineSetup,
    find_camera_correction,
    refine_estimate,
)
from placegraph.indoor.refine.correspondences import locate_by_landmarks
from placegraph.indoor.refine.matching import Matcher
from placegraph.indoor.status import (
    add_note,
    confirms_fault,
    diagnostics_of,
    explain_by_fault,
    needs_fault_search,
    reject_frames,
)
from placegraph.indoor.track.tracker import Tracker, track_capture
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame

WINDOW = 30
"""Frames that are searched and fitted together; a longer capture is tracked, where it can be."""


def localize_capture(
    scene: Scene,
    capture: Capture | Sequence[Frame],
    *,
    refine: bool | RefineOptions = True,
    matcher: str | Matcher = "auto",
    device: str = "auto",
    **asked: Any,  # noqa: ANN401  # of `PoseQuery.of`
) -> PoseEstimate:
    """Localize a capture by keywords; parameters and errors: `SceneMap.localize`."""
    if not isinstance(refine, bool | RefineOptions):
        raise OptionError(f"refine is {refine!r}; it must be True, False or RefineOptions.")
    query = PoseQuery.of(scene, capture, **asked)
    options = refine if isinstance(refine, RefineOptions) else None
    refining = RefineSetup.of(options, matcher, device) if refine else None
    check_device(device, network=refining is not None and refining.matcher is not None)
    return add_earth_poses(scene, localize(query, refining))


def localize(query: PoseQuery, refining: RefineSetup | None) -> PoseEstimate:
    """Localize the last frame of a query, and every other (SG2Loc, Sec. 3).

    The same query on the same machine gives the same answer. `refining`: refinement of the best mode;
    None: none. Errors: `SceneMap.localize`.
    """
    window, estimate = _localize_as_said(query, refining)
    correction = refining and find_camera_correction(window, estimate, refining)
    if correction:
        mended = replace(query, frames=correction.frames(query.frames))
        answer = correction.choose_answer(query, estimate, _localize_as_said(mended, refining)[1])
        if Status.OK in (estimate.status, answer.status):
            return answer
        estimate = answer
    return _explain_faults(window, estimate)


def _localize_as_said(
    query: PoseQuery, refining: RefineSetup | None
) -> tuple[Window, PoseEstimate]:
    """Localize a query with the camera as given; return window and estimate."""
    if len(query.frames) > WINDOW and query.options.tracked:
        window, estimate = _track(query)
        return window, refine_estimate(window, estimate, refining) if refining else estimate
    rng = np.random.default_rng(query.seed)
    window = observe(query)
    fault = find_image_fault(window)
    if fault:  # no search could help
        return window, reject_frames(fault, [s.frame.index for s in window.observations])
    seeds = search(window, rng)
    landmark_poses = locate_by_landmarks(window) if len(seeds) else seeds
    seeds = np.concatenate([landmark_poses, seeds])
    options = query.options.particle_filter
    filtered = run_passes(window, seeds, rng) if options else None
    if filtered and options and options.answer == "mle":
        candidates = heaviest_modes(window.chain, filtered.particles, options.modes)
    else:
        starts = seeds if filtered is None else np.concatenate([filtered.modes, seeds])
        candidates = fit_window(window, starts, rng, landmark_poses)
        candidates = correct_drift(window, candidates, rng)
        candidates = explore_unobservable(window, candidates, rng)
    estimate = _add_costs(window, estimate_pose(window, candidates), filtered)
    if refining:
        estimate = refine_estimate(window, estimate, refining, explained=True)
    return window, estimate


def _track(query: PoseQuery) -> tuple[Window, PoseEstimate]:
    """Track a long capture frame by frame; return a window of its newest frames and the estimate."""
    tracker = Tracker(query)
    estimate = track_capture(tracker, query.frames)
    # without patches of an encoder
    newest = [observe_frame(frame, None, query.options) for frame in query.frames[-WINDOW:]]
    return Window(query, tracker.scorer, newest), estimate


def _add_costs(
    window: Window, estimate: PoseEstimate, filtered: FilteredPasses | None
) -> PoseEstimate:
    """Add the costs, and recorded particles, to an estimate."""
    seconds = {stage: round(took, 4) for stage, took in window.seconds.items()}
    counts = [] if filtered is None else filtered.counts
    stats = {"seconds": seconds, "particles": counts} | window.scorer.stats()
    history = () if filtered is None else filtered.history
    return replace(estimate, stats=estimate.stats | stats, history=history)


def _explain_faults(window: Window, estimate: PoseEstimate) -> PoseEstimate:
    """Explain an answer that is not `OK` by a fault of the input, if any does."""
    query, found = window.query, diagnostics_of(estimate)
    if query.shares is not None or estimate.status is Status.OK:  # other scenes may be right
        return estimate
    searched = query.options.tracked and len(query.frames) <= WINDOW
    unit = suspect_unit_factor(window.judging.views(FINE), window.table.background)
    if (needs_fault_search(estimate) or unit is not None) and searched and estimate.modes:
        with time_stage(window.seconds, "faults"):
            fault = _find_fault(window)
        seconds = estimate.stats["seconds"] | {"faults": round(window.seconds["faults"], 4)}
        estimate = replace(estimate, stats=estimate.stats | {"seconds": seconds})
        if fault:
            return explain_by_fault(estimate, fault)
    if query.encoder is None:
        other = explain_foreign_ids(query.scene, query.frames[-WINDOW:], found.semantic)
        return add_note(estimate, other) if other else estimate
    return estimate


_FAULT_STARTS = 8
"""Number of seeds that are fitted with a fault undone."""


def _find_fault(window: Window) -> str:
    """Return the fault of the input without which the frames fit the map; empty: none."""
    for corrected, sentence in undo_faults(window):
        if len(corrected.table):
            rng = np.random.default_rng(window.query.seed)
            candidates = fit_window(corrected, search(corrected, rng)[:_FAULT_STARTS], rng)
            if confirms_fault(estimate_pose(corrected, candidates)):
                return sentence
    return ""
