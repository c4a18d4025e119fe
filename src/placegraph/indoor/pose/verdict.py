"""From fits to an estimate: probabilities, covariance, and a status that can be trusted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from placegraph.core.estimate import Evidence, PoseEstimate, PoseMode, Status
from placegraph.core.geometry import Floats, between, pose_matrix
from placegraph.indoor.likelihood.depth_unit import hint
from placegraph.indoor.likelihood.observe import FINE
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.pose.evidence import Agreement, agreement, explain
from placegraph.indoor.pose.polish import Fit, covariance_of, probabilities
from placegraph.indoor.pose.prior import Leaning
from placegraph.indoor.pose.slide import least_known
from placegraph.indoor.pose.suspect import divided, spoiled, unmoved
from placegraph.indoor.pose.trust import CLEAR, LOST, SPEAK, SURE, TELLING, TRUST, WITNESSES
from placegraph.indoor.pose.window import Window, timed

LOOSE = 0.2
"""A pose known no better than this [m] in any direction is not `OK`: one in a hundred would err by more
than the 0.5 m that `OK` promises."""
_UPRIGHT = 0.8
"""Cosine from which on a direction is called height."""
_BLIND = 0.2
"""Share of the view that the map has to show."""
ALONE = 0.98
"""Probability among its rivals that a pose needs to be `OK`, whatever agrees with it: places that are
the same differ by as much as their fits were lucky."""
_PATCHES_AGREE, _PATCHES_TELL = 0.5, 15.0
"""Of labels: the share that agrees, and what they tell a frame without depth [nat]."""
_DEPTH_AGREES = 0.85
"""Share of the depth readings from which on they are not what is doubted."""
_HALF, _LENIENT = 0.55, 0.15
"""Share of the newest frame's readings that has to agree, and how much less where other senses do, or
of all frames together."""


def verdict(window: Window, fits: list[Fit]) -> PoseEstimate:
    """Estimate of the last frame from fits, best first."""
    with timed(window.seconds, "verdict"):
        judging, looked = window.judging, window.newest
        told_apart = [judging.views(FINE)[i] for i in looked]

        def agreed_at(fit: Fit) -> Agreement:
            steps = between(fit.pose, fit.poses[looked])
            return agreement(judging.scorer, fit.pose, told_apart, steps)

        fits, shares = _shared(window, fits, window.scorer.model.heat(told_apart))
        count = max(_EXPLAINED, int((shares > _RIVAL).sum()))
        agreed = [agreed_at(fit) for fit in fits[:count]]
        if window.options.likelihood.tempered:
            shares = believed(shares, np.array([TRUST.odds(a) for a in agreed]))
            order = np.argsort(-shares, kind="stable")
            shares, fits = shares[order], [fits[i] for i in order]
            agreed = [agreed[i] for i in order[: len(agreed)]]
        modes = tuple(
            _mode(window, fit, share, agreed[i] if i < len(agreed) else None)
            for i, (fit, share) in enumerate(zip(fits, shares.tolist(), strict=True))
        )
        steps = between(fits[0].pose, fits[0].poses[looked])
        told = judging.scorer.together(fits[0].pose[None], told_apart, steps)[0]
        status, reason, undecided = _status(
            judging, fits[0].poses, modes, agreed[0], float(told) / len(looked)
        )
        return PoseEstimate(
            status=status,
            modes=modes,
            reason=reason,
            trajectory=pose_matrix(fits[0].poses, window.levels),
            frames=np.array([s.frame.index for s in window.sightings]),
            stats={
                "trust": agreed[0].numbers() | {"probability": modes[0].probability},
                "rival": agreed[1].numbers() if len(agreed) > 1 else {},
                "undecided": undecided,
                "fits": status is Status.OK or _fits(judging, fits[0].poses, agreed[0]),
            },
            map=window.scene,
        )


def _shared(window: Window, fits: list[Fit], heat: float) -> tuple[list[Fit], Floats]:
    """Fits, likeliest first, and their probabilities.

    What somebody said of the place is no image: it is a witness of its own, and counts in full.
    Particles have heard it already, and their weights are probabilities.
    """
    logs = np.array([f.log_likelihood for f in fits])
    if window.options.answer == "mle":
        return fits, np.exp(logs)
    shares = probabilities(logs, heat)
    if window.leaning is None:
        return fits, shares
    shares *= np.exp(window.leaning.at(np.stack([f.pose for f in fits])))
    order = np.argsort(-shares, kind="stable")
    return [fits[i] for i in order], shares[order] / shares.sum()


def believed(shares: Floats, odds: Floats) -> Floats:
    """Probabilities (M,) of fits by their shares (M,), falling, and the log odds (K,) of the first.

    A pose is right where frames fit, and no other place fits better: both are multiplied. Depth may
    lie on the surfaces of a wrong place while colours contradict, and outweigh a place half of which
    the map does not show. Those left are no likelier than the least of the first.
    """
    if not np.isfinite(odds).all():
        return shares
    out = shares / (1.0 + np.exp(-odds.max()))
    out[: len(odds)] = shares[: len(odds)] / (1.0 + np.exp(-odds))
    out[len(odds) :] = np.minimum(out[len(odds) :], out[: len(odds)].min())
    return np.asarray(out / out.sum())


def _mode(window: Window, fit: Fit, share: float, agreed: Agreement | None) -> PoseMode:
    scene, matrix = window.scene, pose_matrix(fit.pose, window.levels[-1])
    row = scene.scene_at(fit.pose[:2])
    return PoseMode(
        map_from_camera=matrix,
        pose=fit.pose,
        covariance=covariance_of(fit),
        probability=share,
        scene=scene.scenes[row],
        scene_from_camera=scene.scene_from_map[row] @ matrix,
        explain=tuple
        if agreed is None
        else partial(_explained, window.leaning, scene, agreed, fit.pose),
    )


def _explained(
    leaning: Leaning | None, scene: Scene, agreed: Agreement, pose: Floats
) -> tuple[Evidence, ...]:
    said = () if leaning is None else leaning.evidence(pose)
    return said + explain(scene, agreed)


def evidence_at(window: Window, poses: Floats) -> Callable[[], tuple[Evidence, ...]]:
    """Finds what the newest frames say of poses (T, 4) of all; the frames are let go."""
    judging, looked = window.judging, window.newest
    views = [judging.views(FINE)[i] for i in looked]
    steps = between(poses[-1], poses[looked])
    agreed = agreement(judging.scorer, poses[-1], views, steps)
    return partial(_explained, window.leaning, window.scene, agreed, poses[-1])


_EXPLAINED = 3  # modes that can be explained
_RIVAL = 0.01  # share of a mode that is looked at closely


def _status(
    window: Window, poses: Floats, modes: Sequence[PoseMode], agreed: Agreement, told: float
) -> tuple[Status, str, bool]:
    """Status and reason by all frames at poses (T, 4), by the newest alone, and by what was said.

    And whether all that is missing is that one place stands out.
    """
    fault = spoiled(window)
    if fault:
        return Status.LOST, fault, False
    status, reason = judge(agreed, modes, told)
    undecided = status is Status.AMBIGUOUS
    pose = modes[0].pose
    fault = unmoved(window.sightings) or divided(window, _frames(window, poses, agreed))
    if fault:
        return Status.LOST if status is Status.LOST else Status.AMBIGUOUS, fault, False
    if status is Status.OK and len(window) > 1:
        against = _newest_against(agreed.frames[-1])
        if against:
            status, reason = Status.LOST, f"The newest frame contradicts those before: {against}."
    looks = any(s.patches is not None and not s.patches.named for s in window.sightings)
    otherwise = replace(agreed, semantic=np.nan)
    if status is Status.OK and looks and not _sure(otherwise, modes[0].probability):
        status = Status.AMBIGUOUS
        reason = "One place fits best, but what patches look like says too little of it alone."
    if status is Status.OK and window.leaning is not None:
        against = window.leaning.against(pose)
        if against:
            status, reason = Status.AMBIGUOUS, f"{reason} But that is not what was said: {against}."
    if status is not Status.OK:  # depth may look to be in another unit
        frame = window.sightings[-1].frame
        unit = hint(window.views(FINE), window.table.background, frame)
        reason = f"{reason} {unit}".rstrip()
    return status, reason, undecided


def _fits(window: Window, poses: Floats, agreed: Agreement) -> bool:
    """Whether nothing seen contradicts poses (T, 4), however little it says of them."""
    fault = spoiled(window) or divided(window, _frames(window, poses, agreed))
    if fault or agreed.semantic < _PATCHES_AGREE or _newest_against(agreed.frames[-1]):
        return False
    mute = np.isnan(agreed.depth)
    return agreed.colour > SPEAK / 2.0 if mute else agreed.depth >= _DEPTH_AGREES


def _frames(window: Window, poses: Floats, agreed: Agreement) -> Floats:
    """(T, 3) how far each frame of the window agrees with its pose (T, 4)."""
    older = len(window) - len(agreed.frames)
    if not older:
        return agreed.frames
    steps = between(poses[-1], poses[:older])
    before = agreement(window.scorer, poses[-1], window.views(FINE)[:older], steps)
    return np.concatenate([before.frames, agreed.frames])


def judge(agreed: Agreement, modes: Sequence[PoseMode], told: float) -> tuple[Status, str]:
    """Status and reason: the best mode must agree with what was seen, and beat all others.

    `told`: log-likelihood ratio of the best mode against anywhere, per frame [nat].
    """
    against = disagreement(agreed, told)
    if against:
        return Status.LOST, f"Nowhere on the map fits: {against}."
    best = modes[0]
    loose, axis = least_known(best.covariance)
    if loose > LOOSE:
        what = "its height is" if abs(axis[2]) > _UPRIGHT else "it is"
        return Status.AMBIGUOUS, f"One place fits best, but {what} known only to {loose:.1f} m."
    if _sure(agreed, 1.0) and not _sure(agreed, best.probability):
        rivals = sum(m.probability > _RIVAL for m in modes[1:])
        others = "another place fits" if rivals <= 1 else f"{rivals} other places fit"
        return Status.AMBIGUOUS, f"{others} nearly as well ({best.probability:.0%} for the best)."
    if not _sure(agreed, best.probability):
        return Status.AMBIGUOUS, f"One place fits best, but {_weakest(agreed)}."
    return Status.OK, f"One place fits: {_praise(agreed)}."


def _named_alone(agreed: Agreement) -> bool:
    """Whether labels speak, and no depth."""
    return bool(np.isnan(agreed.depth) and not np.isnan(agreed.semantic))


def _sure(agreed: Agreement, probability: float) -> bool:
    """Whether a pose can be relied on that is the best with a probability."""
    if _named_alone(agreed):
        seen = int((agreed.weights > TELLING).sum()) >= WITNESSES or agreed.colour > SPEAK
        return probability >= ALONE and seen
    if np.isnan(agreed.depth) and not agreed.colour > CLEAR:
        return False
    return probability >= ALONE and TRUST.of(agreed, probability) >= SURE


def _newest_against(frame: Floats) -> str:
    """Why the newest frame by itself, its agreements (3,), contradicts the pose; empty: it does not."""
    semantic, depth, colour = frame.tolist()
    if semantic < _PATCHES_AGREE - _LENIENT:
        return f"only {semantic:.0%} of its labelled patches see their object"
    if depth < (_HALF - _LENIENT if colour > SPEAK else _HALF):
        return f"only {depth:.0%} of its depth readings lie on the map's surfaces"
    return ""


def disagreement(agreed: Agreement, told: float) -> str:
    """Why the best pose cannot be right; empty where it can."""
    if agreed.covered < _BLIND:
        return f"the map shows only {agreed.covered:.0%} of what the frames see"
    if agreed.semantic < _PATCHES_AGREE:
        return f"only {agreed.semantic:.0%} of the labelled patches see their object"
    if _named_alone(agreed):
        poor = told < _PATCHES_TELL
        return "the labels seen fit many places as badly" if poor else ""
    mute = np.isnan(agreed.depth) and not agreed.colour > SPEAK / 2.0
    denied = agreed.depth < _HALF - _LENIENT
    if mute or denied or TRUST.odds(agreed) < LOST:
        return _weakest(agreed)
    return ""


def _weakest(agreed: Agreement) -> str:
    """What keeps a pose from being trusted."""
    if _named_alone(agreed):
        return f"only {int((agreed.weights > TELLING).sum())} of its objects were seen"
    if np.isnan(agreed.depth):
        return "the colours hardly correlate with the map's"
    if agreed.depth < _DEPTH_AGREES:
        return f"only {agreed.depth:.0%} of the depth readings lie on the map's surfaces"
    if np.isnan(agreed.colour) or agreed.colour > SPEAK:
        return "what is seen is too bare to tell where along its surfaces the camera is"
    return "depth alone speaks for it, and the colours do not agree"


def _praise(agreed: Agreement) -> str:
    parts = []
    if not np.isnan(agreed.semantic):
        parts.append(f"{agreed.semantic:.0%} of the labelled patches")
    if not np.isnan(agreed.depth):
        parts.append(f"{agreed.depth:.0%} of the depth readings")
    if agreed.colour > SPEAK:
        parts.append("the colours")
    return f"{', '.join(parts) or 'what was seen'} agree with the map"
