"""Status decisions indoors: `OK`, `AMBIGUOUS` or `LOST`, and the reason, from typed diagnostics.

Stages fill `Diagnostics` and pass it along in `PoseEstimate.diagnostics`. Only functions here set a status.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from placegraph.core.estimate import (
    Calibration,
    Estimate,
    PoseEstimate,
    PoseMode,
    SceneEstimate,
    SceneMode,
    Status,
)
from placegraph.core.geometry import Floats
from placegraph.indoor.pose.agreement import (
    CLEAR,
    CONFIDENCE,
    SPEAK,
    TELLING,
    WITNESSES,
    Agreement,
    both_odds,
    log_odds,
)
from placegraph.indoor.pose.covariance import least_certain

SURE = 0.75
"""Probability of being right from which on a pose is `OK`."""
FAULT = 3.0
"""Log odds of a pose with a fault of the input undone above which the fault counts: faults are rare."""
HOPELESS = -30.0
"""Log odds against places that were not searched below which no fault makes frames fit."""
FITS_NOWHERE = -1.0
"""Log odds below which nothing on the map fits."""
LOOSE = 0.2
"""A pose known no better than this [m] in any direction is not `OK`: one in a hundred would err by more
than the 0.5 m that `OK` promises."""
CLAIMED = 2.5
"""Radius of a claim, in deviations of the least certain direction: with `LOOSE` the 0.5 m of `OK`."""
_CLAIM = re.compile(r"^.*? holds \d+% of the probability within [\d.]+ c?m")
ALONE = 0.98
"""Probability among its rivals that a pose needs to be `OK`, whatever agrees with it: places that are
the same differ by as much as their fits were lucky."""
FEW = 5
"""Largest number of frames that may agree by chance."""
_UNLIKE_OWN = "it agrees much less than the frames that the map was made of"
_MAY_REPEAT = "places that were not searched may look the same"
RIVAL = 0.01
"""Probability of a mode from which on it counts as a rival."""
_UPRIGHT = 0.8
"""Least cosine with the vertical of a direction that is called height."""
_BLIND = 0.2
"""Least share of the view that the map shows."""
_PATCHES_AGREE, _PATCHES_TELL = 0.5, 15.0
"""Least share of labels that agree, and least log-likelihood ratio of a frame without depth [nat]."""
_DEPTH_AGREES = 0.85
"""Least share of depth readings that agree if depth is not in doubt."""
_HALF, _LENIENT = 0.55, 0.15
"""Least share of the newest frame's readings that agree, and reduction if other senses agree, or for all
frames together."""
BENT = 6.0
"""Largest root mean square of odometry's normalized errors."""
_PARTED = (0.25, 5.0)
"""Largest way [m] and turn [deg] by which images alone may move a pose that is `OK`."""
SURE_SCENE = 0.9
"""Least probability of a scene that is `OK`."""
_SEARCH_ERRS = 0.01
"""Share of library searches that are confident and wrong."""
SILENT = 1.0
"""Seconds without odometry after which a live pose is not `OK`."""

UNDECIDED = Status.AMBIGUOUS
"""Status of an estimate that no stage has decided yet."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RefinementDiagnostics:
    """Measurements of one refinement that the status depends on."""

    accepted: bool = False
    "Whether held-out samples confirm the refined pose."
    objection: str = ""
    """Evidence against the coarse pose too, as half a sentence."""
    motion: float = 0.0
    """Root mean square of the odometry's normalised errors on the refined trajectory."""
    has_depth: bool = True
    """Whether depth takes part."""
    landmarks: int | None = None
    """Matches with landmarks of the map; None: landmarks take no part."""
    shift: float = 0.0
    """Way from the coarse to the refined pose [m] ..."""
    turn_deg: float = 0.0
    """... and turn [deg]."""
    scale_error: float = 0.0
    """Logarithm by which the scale of depth looks off, for a closer look."""
    loose: float = 0.0
    """Distance by which a wrong scale of depth may move the pose [m]."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Diagnostics:
    """Measurements of the stages of one localization, from which its status is decided."""

    agreement: Agreement | None = None
    """Agreement of the best mode with the newest frames; None: nothing was compared."""
    frames: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(T, 3) agreement of each frame of the window: semantic and depth [share], colour [nat a sample]."""
    searched: float = np.inf
    """Log odds of the best mode against places that were not searched, by the agreement of the map's own
    frames; infinite: unknown."""
    ratio_per_frame: float = 0.0
    """Log-likelihood ratio of the best mode against anywhere, a frame [nat]."""
    image_fault: str = ""
    """Fault of the images on any map, such as a covered lens, as a sentence; empty: none."""
    contradiction: str = ""
    """Frames that contradict the others, as a sentence; empty: none."""
    unnamed: bool = False
    """Whether patches are compared by looks, without the names of objects."""
    unmet: str = ""
    """Statements of the description that the best mode contradicts; empty: none."""
    undecided: bool = False
    """Whether only a clear winner is missing (`decide_pose` fills it)."""
    consistent: bool = False
    """Whether nothing that was seen contradicts the best mode (`decide_pose` fills it)."""
    refinement: RefinementDiagnostics | None = None
    """Diagnostics of the refinement; None without refinement."""

    @property
    def ratio(self) -> float:
        """Log-likelihood ratio of what is seen against anywhere in the map, a frame [nat]; 0: unknown."""
        known = self.agreement is not None and np.isfinite(self.agreement.ratio)
        return self.agreement.ratio if self.agreement is not None and known else 0.0

    @property
    def semantic(self) -> float | None:
        """Share of the labelled patches that see their object; None: there are none."""
        agreed = self.agreement
        return None if agreed is None or np.isnan(agreed.semantic) else agreed.semantic

    @property
    def odds(self) -> float:
        """Log odds that the frames fit at the best mode; minus infinity without depth and colours."""
        return -np.inf if self.agreement is None else CONFIDENCE.odds(self.agreement)

    @property
    def labels_only(self) -> bool:
        """Whether only labels were compared; they give no log-odds."""
        agreed = self.agreement
        return agreed is None or not np.isfinite(self.odds) or _labels_only(agreed)


def diagnostics_of(estimate: PoseEstimate) -> Diagnostics:
    """Return the diagnostics of an estimate; empty ones where no stage has filled any."""
    found = estimate.diagnostics
    return found if isinstance(found, Diagnostics) else Diagnostics()


def add_note(estimate: PoseEstimate, note: str) -> PoseEstimate:
    """Return the estimate with a sentence added to its reason."""
    return replace(estimate, reason=f"{estimate.reason} {note}".rstrip())


# ------------------------------------------------------------------------------------ one window


def decide_pose(
    diagnostics: Diagnostics, modes: Sequence[PoseMode]
) -> tuple[Status, str, Diagnostics]:
    """Return status, reason and completed diagnostics of the modes (best first) of a window of frames.

    All frames together, the newest frame alone, and the description each have a say.
    """
    agreed = diagnostics.agreement
    assert agreed is not None  # noqa: S101  a window compares something
    consistent = _is_consistent(diagnostics, agreed)
    if diagnostics.image_fault:
        return Status.LOST, diagnostics.image_fault, replace(diagnostics, consistent=consistent)
    share = float(1.0 / (1.0 + np.exp(-diagnostics.searched)))
    status, reason = decide_fit(agreed, modes, diagnostics.ratio_per_frame, share)
    claim = state_claim([share * m.probability for m in modes], modes[0].covariance)
    undecided = status is Status.AMBIGUOUS
    if (
        status is not Status.LOST
        and diagnostics.searched < FITS_NOWHERE
        and len(agreed.frames) > FEW
    ):
        status, reason = Status.LOST, f"No place on the map fits: {_UNLIKE_OWN}."
    elif status is Status.OK and np.isfinite(diagnostics.searched):
        odds = both_odds(CONFIDENCE.odds(agreed), diagnostics.searched)
        if modes[0].probability / (1.0 + np.exp(-odds)) < SURE:
            why = _UNLIKE_OWN if diagnostics.searched < 0.0 else _MAY_REPEAT
            status, reason = Status.AMBIGUOUS, f"{claim}, but {why}."
    if diagnostics.contradiction:
        status = Status.LOST if status is Status.LOST else Status.AMBIGUOUS
        return status, diagnostics.contradiction, replace(diagnostics, consistent=consistent)
    if status is Status.OK and len(diagnostics.frames) > 1:
        against = _contradicts_newest(agreed.frames[-1])
        if against:
            status, reason = Status.LOST, f"The newest frame contradicts those before: {against}."
    without_looks = replace(agreed, semantic=np.nan)
    if (
        status is Status.OK
        and diagnostics.unnamed
        and not _is_sure(without_looks, modes[0].probability)
    ):
        status = Status.AMBIGUOUS
        reason = f"{claim}, but the appearance of patches alone is not sufficient."
    if status is Status.OK and diagnostics.unmet:
        status = Status.AMBIGUOUS
        reason = f"{reason} But the description does not fit there: {diagnostics.unmet}."
    consistent = consistent or status is Status.OK
    return status, reason, replace(diagnostics, undecided=undecided, consistent=consistent)


def decide_fit(
    agreed: Agreement, modes: Sequence[PoseMode], ratio_per_frame: float, share: float = 1.0
) -> tuple[Status, str]:
    """Return status and reason: the best mode must agree with what was seen, and beat all others.

    `ratio_per_frame`: log-likelihood ratio of the best mode against anywhere [nat]; `share`: probability
    of the places that were searched.
    """
    against = _contradicts(agreed, ratio_per_frame)
    if against:
        return Status.LOST, f"No place on the map fits: {against}."
    best = modes[0]
    claim = state_claim([share * m.probability for m in modes], best.covariance)
    loose, axis = least_certain(best.covariance)
    if loose > LOOSE:
        what = ", above all in height" if abs(axis[2]) > _UPRIGHT else ""
        return (
            Status.AMBIGUOUS,
            f"{claim}{what}; a certain pose needs {100 * CLAIMED * LOOSE:.0f} cm.",
        )
    if _is_sure(agreed, 1.0) and not _is_sure(agreed, best.probability):
        return Status.AMBIGUOUS, f"{claim}; others fit as well."
    if not _is_sure(agreed, best.probability):
        return Status.AMBIGUOUS, f"{claim}, but {_describe_weakness(agreed)}."
    return Status.OK, f"{claim}: {_describe_agreement(agreed)}."


def state_claim(shares: Sequence[float], covariance: Floats, where: str = "") -> str:
    """Return the opening of a reason: the best place, its probability, and the radius that holds it.

    `shares`: probabilities of the modes, best first; `covariance`: (6, 6) of the best; `where`: its name.
    """
    radius = CLAIMED * least_certain(covariance)[0]
    held = f"{radius:.1f} m" if radius > 1.0 else f"{np.ceil(100.0 * radius):.0f} cm"
    rivals, first = sum(share > RIVAL for share in shares[1:]), where or "One place"
    if rivals:
        first = f"The first of {rivals + 1} places" + (f", {where}," if where else "")
    return f"{first} holds {shares[0]:.0%} of the probability within {held}"


def restate_claim(reason: str, shares: Sequence[float], covariance: Floats, where: str = "") -> str:
    """Return a reason with the claim of other modes (`state_claim`); one without a claim as it is."""
    return _CLAIM.sub(lambda _: state_claim(shares, covariance, where), reason, count=1)


AnyEstimate = TypeVar("AnyEstimate", bound=Estimate[Any])


def decide_joined(estimate: AnyEstimate, shares: Sequence[float]) -> AnyEstimate:
    """Return the estimate of one image with the shares of its modes by all images of the room, best first.

    An image that only rivals kept from `OK` may become so; one whose best mode the other images contradict
    is not `OK`.
    """
    modes = [replace(m, probability=p) for m, p in zip(estimate.modes, shares, strict=True)]
    modes.sort(key=lambda mode: -mode.probability)
    joined = replace(estimate, modes=tuple(modes))
    if estimate.status is Status.OK and shares[0] < max(SURE, *shares):
        reason = f"The images fit different places ({shares[0]:.0%} for the best of this one)."
        return replace(joined, status=Status.AMBIGUOUS, reason=reason)
    pose = modes[0] if isinstance(modes[0], PoseMode) else modes[0].pose
    if pose is None:
        return joined
    where = "" if pose is modes[0] else modes[0].where
    ordered = [mode.probability for mode in modes]
    reason = restate_claim(estimate.reason, ordered, pose.covariance, where)
    joined = replace(joined, reason=reason)
    if not isinstance(joined, PoseEstimate):
        world: Any = joined
        is_sure = shares[0] == ordered[0] >= SURE_SCENE and world.has_only_rivals
        if joined.status is Status.OK or not is_sure:
            return joined
        alone = world.poses[modes[0].scene]
        reason = restate_claim(alone.reason, ordered, pose.covariance, where)
        return replace(joined, status=Status.OK, reason=f"{reason} The other images confirm it.")
    found = diagnostics_of(joined)
    joined = replace(joined, trajectory=pose.map_from_camera[None])
    if not found.undecided or found.agreement is None or shares[0] < ordered[0]:
        return joined
    alone = tuple(replace(mode, probability=mode.probability / sum(ordered)) for mode in modes)
    status, reason, _ = decide_pose(found, alone)
    if found.refinement is not None:
        decided = replace(joined, status=status, reason=reason, modes=alone)
        status, reason = decide_refined(decided, found.refinement)
    if status is not Status.OK:
        return joined
    reason = restate_claim(reason, ordered, pose.covariance)
    return replace(joined, status=status, reason=f"{reason} The other images confirm it.")


def reject_frames(fault: str, frames: Sequence[int]) -> PoseEstimate:
    """Return a lost estimate of frames (rows in the capture) with a fault that no search could mend."""
    return PoseEstimate(Status.LOST, (), reason=fault, frames=np.array(frames))


def _labels_only(agreed: Agreement) -> bool:
    """Return whether there are labels, and no depth."""
    return bool(np.isnan(agreed.depth) and not np.isnan(agreed.semantic))


def _is_sure(agreed: Agreement, probability: float) -> bool:
    """Return whether a pose with this probability among its rivals can be relied on."""
    if _labels_only(agreed):
        seen = int((agreed.weights > TELLING).sum()) >= WITNESSES or agreed.colour > SPEAK
        return probability >= ALONE and seen
    if np.isnan(agreed.depth) and not agreed.colour > CLEAR:
        return False
    return probability >= ALONE and CONFIDENCE.probability(agreed, probability) >= SURE


def _is_consistent(diagnostics: Diagnostics, agreed: Agreement) -> bool:
    """Return whether nothing seen contradicts the best mode, however little it says of it."""
    fault = diagnostics.image_fault or diagnostics.contradiction
    if fault or agreed.semantic < _PATCHES_AGREE or _contradicts_newest(agreed.frames[-1]):
        return False
    mute = np.isnan(agreed.depth)
    return bool(agreed.colour > SPEAK / 2.0 if mute else agreed.depth >= _DEPTH_AGREES)


def _contradicts_newest(frame: Floats) -> str:
    """Return why the newest frame, by its agreements (3,), contradicts the pose; empty: it does not."""
    semantic, depth, colour = frame.tolist()
    if semantic < _PATCHES_AGREE - _LENIENT:
        return f"only {semantic:.0%} of its labelled patches hit their object"
    if depth < (_HALF - _LENIENT if colour > SPEAK else _HALF):
        return f"only {depth:.0%} of its depth readings lie on the map's surfaces"
    return ""


def _contradicts(agreed: Agreement, ratio_per_frame: float) -> str:
    """Return why the best pose cannot be right; empty where it can."""
    if agreed.covered < _BLIND:
        return f"the map shows only {agreed.covered:.0%} of what the frames see"
    if agreed.semantic < _PATCHES_AGREE:
        return f"only {agreed.semantic:.0%} of the labelled patches hit their object"
    if _labels_only(agreed):
        poor = ratio_per_frame < _PATCHES_TELL
        return "the observed labels fit many places equally badly" if poor else ""
    mute = np.isnan(agreed.depth) and not agreed.colour > SPEAK / 2.0
    denied = agreed.depth < _HALF - _LENIENT
    if mute or denied or CONFIDENCE.odds(agreed) < FITS_NOWHERE:
        return _describe_weakness(agreed)
    return ""


def _describe_weakness(agreed: Agreement) -> str:
    """Return why the confidence in a pose is low."""
    if _labels_only(agreed):
        return f"only {int((agreed.weights > TELLING).sum())} of its objects were seen"
    if np.isnan(agreed.depth):
        return "the colours hardly agree with the map"
    if agreed.depth < _DEPTH_AGREES:
        return f"only {agreed.depth:.0%} of the depth readings lie on the map's surfaces"
    if np.isnan(agreed.colour) or agreed.colour > SPEAK:
        return "the visible surfaces do not constrain the position along them"
    return "only depth supports it, and the colours do not agree"


def _describe_agreement(agreed: Agreement) -> str:
    """Return the senses that agree with the map."""
    parts = []
    if not np.isnan(agreed.semantic):
        parts.append(f"{agreed.semantic:.0%} of the labelled patches")
    if not np.isnan(agreed.depth):
        parts.append(f"{agreed.depth:.0%} of the depth readings")
    if agreed.colour > SPEAK:
        parts.append("the colours")
    return f"{', '.join(parts) or 'what was seen'} agree with the map"


# -------------------------------------------------------------------------- faults of the input


def needs_fault_search(estimate: PoseEstimate) -> bool:
    """Return whether an input fault may explain the status: no pose is certain or fits, no rival does."""
    found = diagnostics_of(estimate)
    if estimate.status is Status.OK or found.odds > 2.0 * FAULT or found.searched < HOPELESS:
        return False
    doubted = np.isfinite(found.odds) and found.odds < log_odds(SURE, 0.0)
    return bool(doubted or not found.undecided)


def confirms_fault(estimate: PoseEstimate) -> bool:
    """Return whether an estimate of frames with a fault undone fits so well that the fault is a fact."""
    found = diagnostics_of(estimate)
    if estimate.status is Status.LOST or found.contradiction or not np.isfinite(found.odds):
        return False
    return both_odds(found.odds, found.searched) > FAULT


def explain_by_fault(estimate: PoseEstimate, fault: str) -> PoseEstimate:
    """Return an estimate that is not `OK` with the fault of the input that explains it."""
    return replace(estimate, reason=f"The frames fit nowhere on the map. {fault}")


# ---------------------------------------------------------------------------------- refinement


def decide_refined(estimate: PoseEstimate, refined: RefinementDiagnostics) -> tuple[Status, str]:
    """Return status and reason after a refinement of an estimate."""
    status, reason, best = estimate.status, estimate.reason, estimate.modes[0]
    claim = state_claim([m.probability for m in estimate.modes], best.covariance)
    objection = _find_objection(refined)
    if status is Status.OK and objection:
        status, reason = Status.AMBIGUOUS, f"{claim}, but {objection}."
    found, one_scene = diagnostics_of(estimate), len({m.scene for m in estimate.modes}) == 1
    undecided = found.undecided and found.searched > log_odds(SURE, 0.0)
    counts = refined.landmarks is not None and refined.accepted and one_scene
    if counts and undecided and least_certain(best.covariance)[0] <= LOOSE:
        # they were looked for in the whole map, and led to where the likelihood is largest
        status = Status.OK
        reason = f"{claim}: {refined.landmarks} landmarks of the map agree on it."
    return status, reason


def _find_objection(refined: RefinementDiagnostics) -> str:
    """Find what makes a pose doubtful after its refinement, as half a sentence; empty: nothing."""
    if refined.motion > BENT:
        return "the frames contradict the odometry or the camera's intrinsics there"
    if refined.objection:
        return refined.objection
    images_alone = refined.accepted and not refined.has_depth and refined.landmarks is None
    if images_alone and any(np.greater((refined.shift, refined.turn_deg), _PARTED)):
        return (
            f"images matched with the map move it by {refined.shift:.1f} m and "
            f"{refined.turn_deg:.0f} degrees: check the camera's intrinsics"
        )
    if refined.loose > LOOSE:
        return (
            f"the scale of depth may be wrong, which moves the pose by up to {refined.loose:.1f} m"
        )
    return ""


def decide_given(estimate: PoseEstimate, window: PoseEstimate) -> PoseEstimate:
    """Return a refined pose that somebody gave, with the status of its `window`; `OK` only if refined."""
    told = estimate.refinement
    if window.status is Status.OK and told is not None and not told.accepted:
        return replace(estimate, status=Status.AMBIGUOUS, reason=told.reason)
    return replace(estimate, status=window.status, reason=window.reason)


def choose_camera(
    before: PoseEstimate, after: PoseEstimate, calibration: Calibration, correction: str,
    *, tilt_only: bool,
) -> PoseEstimate:  # fmt: skip
    """Return the better one of the answers before and after a camera correction.

    The corrected answer is taken where it is `OK` and its refinement confirmed; else the camera is a doubt
    about the other, if there is anything to doubt. Gravity is none, since poses may lean: if it alone is
    corrected, an answer that is `OK` gives way only to one that fits better. `correction`: a sentence that
    says what was wrong.
    """
    ratios = [diagnostics_of(answer).ratio for answer in (before, after)]
    if tilt_only and before.status is Status.OK and ratios[1] <= ratios[0]:
        return before
    told = after.refinement
    if after.status is Status.OK and told is not None and told.accepted:
        return replace(after, reason=f"{after.reason} {correction}", calibration=calibration)
    if tilt_only or before.status is Status.LOST:
        return before
    reason = f"{before.reason} Perhaps: {correction}"
    return replace(before, status=Status.AMBIGUOUS, reason=reason)


# ------------------------------------------------------------------------------------- tracking


def await_confirmation(estimate: PoseEstimate) -> PoseEstimate:
    """Return a place found in the whole map for the first time, which another image must find again."""
    reason = f"{estimate.reason.rstrip('.')}; another image must confirm it."
    return replace(estimate, status=Status.AMBIGUOUS, reason=reason)


def decide_followed(estimate: PoseEstimate, mode: PoseMode) -> PoseEstimate:
    """Return the estimate of a followed pose whose frames fit, but are too bare to tell the place alone.

    `mode`: the best one with the covariance that it has by odometry.
    """
    loose, _ = least_certain(mode.covariance)
    status, known = Status.OK, "tracked from a confirmed pose"
    if loose > LOOSE:
        status, known = Status.AMBIGUOUS, f"odometry gives it only to {loose:.1f} m"
    reason = f"The frames fit, but show too little to identify the place; {known}."
    return replace(estimate, status=status, modes=(mode, *estimate.modes[1:]), reason=reason)


def give_up(estimate: PoseEstimate) -> PoseEstimate:
    """Return the estimate of a pose that frames have contradicted for too long."""
    return replace(estimate, status=Status.LOST, reason=f"Lost: {estimate.reason}")


@dataclass(frozen=True, slots=True, eq=False)
class LiveState:
    """Status of a live pose by the last image or a given pose."""

    status: Status
    reason: str
    estimate: PoseEstimate | None = None

    @classmethod
    def make_lost(cls, reason: str) -> LiveState:
        """Return the state of a pose that nobody knows."""
        return cls(Status.LOST, reason)

    @classmethod
    def make_unconfirmed(cls, reason: str) -> LiveState:
        """Return the state of a pose that no image has confirmed."""
        return cls(Status.AMBIGUOUS, reason)


def decide_live(
    last: LiveState, silent: float, covariance: Floats | None, unplaced: str = ""
) -> tuple[Status, str]:
    """Return status and reason of a live pose.

    `silent`: seconds beyond the newest odometry; `covariance`: (6, 6) of the pose now, None: it is not
    known; `unplaced`: why odometry tells no pose, if so.
    """
    status, reason = last.status, last.reason
    if silent > SILENT and status is Status.OK:
        status = Status.AMBIGUOUS
        reason = f"There was no odometry for {silent:.0f} s, so the camera's motion is unknown."
    if covariance is None:
        return Status.LOST if status is Status.OK else status, unplaced or reason
    loose, _ = least_certain(covariance)
    if status is Status.OK and loose > LOOSE:
        status = Status.AMBIGUOUS
        reason = (
            "The pose is extrapolated by odometry since the last localized image and known only "
            f"to {loose:.1f} m."
        )
    return status, reason


# -------------------------------------------------------------------------------------- library


def decide_scene(modes: Sequence[SceneMode], elsewhere: float) -> tuple[Status, str]:
    """Return status and reason of ranked scenes; `elsewhere`: probability that it is none of them."""
    best = modes[0]
    if elsewhere > best.probability:
        return Status.LOST, (
            f"No scene of the library fits ({elsewhere:.0%}); {best.scene} fits best "
            f"({best.probability:.0%})."
        )
    if best.probability >= SURE_SCENE:
        return Status.OK, f"{best.scene} fits ({best.probability:.0%})."
    rivals = [m.scene for m in modes[1:] if m.probability > 0.1 * best.probability]
    others = f"; so may {', '.join(rivals[:3])}" if rivals else ""
    return Status.AMBIGUOUS, f"{best.scene} fits best ({best.probability:.0%}){others}."


def scene_of(estimate: PoseEstimate) -> str:
    """Return the name of the library's scene that an answer is of; empty where it has no mode."""
    return estimate.best.scene.partition("/")[0] if estimate.best else ""


def fit_odds(estimate: PoseEstimate) -> float:
    """Return the log odds that frames fit where an estimate has them, by which scenes are told apart.

    Labels alone are judged by rules; what passes them is as good as what just passes by odds. What
    tones add is taken away: rooms of one kind have the same.
    """
    found = diagnostics_of(estimate)
    if found.labels_only or found.agreement is None:
        return log_odds(SURE, 0.0)
    tone = found.agreement.tone
    return float(found.odds - (0.0 if np.isnan(tone) else CONFIDENCE.tone_odds(tone)))


def choose_scene(
    answers: Sequence[PoseEstimate], prior: Mapping[str, float] | None = None
) -> PoseEstimate:
    """Return the answer of the scene where frames fit best, `OK` only if they fit nowhere else as well.

    `prior`: what else speaks for each scene, by its name [nat].
    """

    def weight(answer: PoseEstimate) -> float:
        return fit_odds(answer) + (prior or {}).get(scene_of(answer), 0.0)

    best = min(
        answers, key=lambda a: (a.status is Status.LOST, a.status is not Status.OK, -weight(a))
    )
    # labels alone have no odds: what they do not call `OK` is no rival
    by_labels = diagnostics_of(best).labels_only
    rivals = [
        a
        for a in answers
        if a is not best and (a.status is Status.OK if by_labels else a.status is not Status.LOST)
    ]
    probability = 1.0 / (1.0 + sum(float(np.exp(weight(a) - weight(best))) for a in rivals))
    if best.status is not Status.OK or probability >= SURE_SCENE:
        return best
    likeliest, other = sorted([best, *rivals], key=weight, reverse=True)[:2]
    objection = f"another fits nearly as well in {other.modes[0].scene}."
    return _make_ambiguous(likeliest, objection)


def doubt_by_search(estimate: PoseEstimate, search: SceneEstimate, looked: int) -> PoseEstimate:
    """Return the estimate with the doubts of the search that proposed its scene, if they outweigh its odds.

    `looked`: scenes of the search that were looked into.
    """
    if estimate.status is not Status.OK or estimate.best is None:
        return estimate
    lean, left_out = search_odds(scene_of(estimate), search, looked)
    if fit_odds(estimate) + lean >= log_odds(SURE, 0.0):
        return estimate
    if left_out > search.elsewhere:
        objection = f"it may be another scene ({left_out:.0%}) than the {looked} searched."
    else:
        objection = f"it may be in no scene of the library ({search.elsewhere:.0%})."
    return _make_ambiguous(estimate, objection)


def search_odds(name: str, search: SceneEstimate, looked: int) -> tuple[float, float]:
    """Return the log-odds [nat] that a search adds to a scene, at most 0, and the probability left out.

    A search errs: it is believed no further than one in a hundred.
    """
    here = next(m.probability for m in search.modes if m.scene == name)
    left_out = 1.0 - search.elsewhere - sum(m.probability for m in search.modes[:looked])
    lean = np.log((here + _SEARCH_ERRS) / (search.elsewhere + left_out + _SEARCH_ERRS))
    return min(0.0, float(lean)), left_out


def _make_ambiguous(estimate: PoseEstimate, objection: str) -> PoseEstimate:
    """Return the estimate as ambiguous, with the doubt."""
    return replace(estimate, status=Status.AMBIGUOUS, reason=f"{estimate.reason} But {objection}")
