"""Whether a refined trajectory is to be believed: it must explain what it was not fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.core.geometry import Floats, vector_from_rotation
from placegraph.indoor.pose.window import timed
from placegraph.indoor.refine.camera import DULL, OFF, SUSPECT, scale_off
from placegraph.indoor.refine.check import Evidence, depth_evidence, image_evidence, surely
from placegraph.indoor.refine.fit import odometry_errors
from placegraph.indoor.refine.landmarks import kept_scores
from placegraph.indoor.status import BENT

if TYPE_CHECKING:
    from placegraph.indoor.refine.refiner import Fitted, Refiner

FARTHEST = (1.0, 0.6)
"""A refinement that moves the pose farther than this [m], [rad] has found another place ..."""
FARTHEST_BLIND = (0.6, 0.4)
"""... and so has one without depth."""
SURE = 1.0
"""Standard errors by which held-back samples must be more likely on the refined trajectory ..."""
SURER = 3.0
"""... and where images alone speak: they are wrong together more easily (benchmark)."""

FELT = (0.005, float(np.radians(0.2)))
"""Way [m] and turn [rad] from which on it is told that a sensor keeps no stamps."""


@dataclass(frozen=True, slots=True)
class Judgement:
    """Whether to believe it, and why."""

    accepted: bool
    reason: str
    """One sentence."""
    fitted: Fitted
    """What was judged: where images took part, maybe what depth alone says."""
    stats: dict[str, Any]
    doubt: str = ""
    """What speaks against the coarse pose too, as half a sentence."""
    shift: float = 0.0
    """Way from the coarse pose [m] ..."""
    turn_deg: float = 0.0
    """... and turn [deg]."""
    motion: float = 0.0
    """Root mean square of the odometry's normalised errors."""
    correlation: float | None = None
    """Of held-back parts of the images with the map; None: they were not compared."""
    camera: str = ""
    """Hint that the camera is wrong; empty: none."""


def judged(refiner: Refiner, coarse: Floats, fitted: Fitted) -> Judgement:
    """Compare a refined trajectory, and what depth alone makes of it, with the coarse one (T, 4, 4)."""
    judgement = _looked_at(refiner, coarse, fitted)
    ways = [judgement]
    if fitted.by_depth is not None:
        alone = _looked_at(refiner, coarse, fitted.by_depth)
        ways = [way for way in (alone, judgement) if way.accepted]
        judgement = ways[-1] if ways else alone
    if not judgement.accepted:
        return judgement
    if not refiner.options.check:
        by = judgement.reason.removesuffix(".")
        return replace(judgement, reason=f"{by}, unchecked.")
    with timed(refiner.seconds, "check"):
        way, against = _confirmed(refiner, coarse, ways)
        doubt, camera = _suspect_camera(refiner, way)
        way = replace(way, camera=camera, stats=way.stats | ({"camera": camera} if camera else {}))
    against = doubt or against
    if against:
        return replace(way, accepted=False, reason=f"Not refined: {against}.", doubt=doubt)
    reason = f"{way.reason}{_late(refiner, way.fitted)}"
    return replace(way, reason=reason, fitted=refiner.completed(way.fitted))


def _looked_at(refiner: Refiner, coarse: Floats, fitted: Fitted) -> Judgement:
    """A trajectory by itself: whether anything holds it, and it is near and like the odometry."""
    inliers = sum(map(len, fitted.sights))
    shift, turn = moved(coarse[-1], fitted.poses[-1])
    stats: dict[str, Any] = {
        "inliers": inliers,
        "shift_m": round(shift, 4),
        "turn_deg": round(float(np.degrees(turn)), 3),
    }
    against, doubt, motion = _unfounded(refiner, fitted, inliers), "", 0.0
    if not against and refiner.options.joint:
        doubt = against = _elsewhere(refiner, shift, turn)
        if not against:
            motion = stats["motion"] = _motion_error(refiner, fitted.poses)
            against = "it contradicts the odometry" if motion > BENT else ""
    # what depth backs, images alone do not shake
    doubt = "" if refiner.has_depth else doubt
    by = f"Not refined: {against}." if against else f"Refined by {_by(refiner, inliers)}."
    return Judgement(
        not against, by, fitted, stats, doubt,
        shift=stats["shift_m"], turn_deg=stats["turn_deg"], motion=motion,
    )  # fmt: skip


def _late(refiner: Refiner, fitted: Fitted) -> str:
    """What is told of stamps that sensors do not keep, where it moves a pose enough to matter."""
    if fitted.lags is None:
        return ""
    stamps = np.array([f.stamp for f in refiner.frames], np.float64)
    steps = np.diff(stamps)
    counted = bool(((steps >= 1.0) & (steps == np.rint(steps))).all())
    told = ""
    for what, lag in fitted.lags.clear().items():
        way, turn = (
            abs(lag) * np.linalg.norm(part, axis=1).max()
            for part in (fitted.lags.twist[:, :3], fitted.lags.twist[:, 3:])
        )
        if way > FELT[0] or turn > FELT[1]:
            taken = "images were" if what == "images" else "depth was"
            by = f"{abs(lag):.2g} {'frames' if counted else 's'}"
            side = "after" if lag > 0 else "before"
            its = "their stamps" if what == "images" else "its stamp"
            told += f" Note that {taken} taken {by} {side} {its}; that was allowed for."
    return told


def _unfounded(refiner: Refiner, fitted: Fitted, inliers: int) -> str:
    """Whether there was nothing to go by."""
    if fitted.solution is None or (not refiner.has_depth and inliers < refiner.options.least):
        return f"only {inliers} matches of images with the map agree" if inliers else NOTHING
    return ""


def _elsewhere(refiner: Refiner, shift: float, turn: float) -> str:
    """Whether the fit ended at another place."""
    way, angle = FARTHEST if refiner.has_depth else FARTHEST_BLIND
    if shift <= way and turn <= angle:
        return ""
    return f"the fit ended {shift:.1f} m and {np.degrees(turn):.0f} degrees away, at another place"


NOTHING = "the frames show nothing that could be matched with the map"


def _confirmed(
    refiner: Refiner, coarse: Floats, ways: Sequence[Judgement]
) -> tuple[Judgement, str]:
    """The way that held-back samples make likeliest, and what speaks against it all the same.

    The log-likelihoods of the senses add up: none has a veto, and what says little weighs little.
    """
    senses = _evidence(refiner, coarse, [way.fitted for way in ways])
    if not any(e.samples for e in senses.values()):
        return ways[-1], "no held-back pixel tells whether it helped"
    gains = [np.sum([e.gain(k + 1) for e in senses.values()], axis=0) for k in range(len(ways))]
    row = int(np.argmax([np.sum(gain) for gain in gains]))
    way, z = ways[row], surely(gains[row])
    way.stats["held_back"] = {
        name: {
            "samples": e.samples,
            "gain": round(float(e.gain(row + 1).sum()), 2),
            "z": round(surely(e.gain(row + 1)), 2),
        }
        for name, e in senses.items()
    }
    if "images" in senses and senses["images"].samples:
        alike = np.sqrt(-np.expm1(-2.0 * senses["images"].scores[row + 1]))
        way = replace(way, correlation=round(float(alike.mean()), 3))
        way.stats["held_back"]["images"]["alike"] = way.correlation
    # landmarks were found in the whole map: unlike renderings they are not wrong together
    needed = SURE if refiner.has_depth or refiner.landmark_matches is not None else SURER
    if z < needed:
        return way, "held-back pixels are not explained better than by the coarse pose"
    return way, ""


def _evidence(refiner: Refiner, coarse: Floats, fits: Sequence[Fitted]) -> dict[str, Evidence]:
    """What each sense says of the coarse trajectory and of fits, in that order."""
    found, looked = {}, set(refiner.looked().tolist())
    measured, pictured = [coarse], [coarse]
    for fit in fits:
        lags = fit.lags
        measured.append(fit.poses if lags is None else lags.of_depth(fit.poses))
        pictured.append(fit.poses if lags is None else lags.of_images(fit.poses))
    if refiner.has_depth:
        held = [r if t in looked else None for t, r in enumerate(refiner.readings(1))]
        found["depth"] = depth_evidence(refiner.surfaces, held, measured)
    landmarks = Evidence.of(kept_scores(refiner, pictured))
    if landmarks.samples >= refiner.options.least:
        found["landmarks"] = landmarks
    queries = [q if t in looked else None for t, q in enumerate(refiner.queries)]
    if refiner.scene.coloured and any(query is not None for query in queries):
        found["images"] = image_evidence(refiner.renderer, refiner.frames, queries, pictured)
    return found


def _suspect_camera(refiner: Refiner, way: Judgement) -> tuple[str, str]:
    """Return what is wrong with the camera, and a hint where `wrong_camera` should look closer."""
    factor, hint = scale_off(refiner, way.fitted), ""
    if abs(factor) > SUSPECT:
        hint = f"a scale looks {factor:+.1%} off"
    elif refiner.has_depth and way.correlation is not None and way.correlation < DULL:
        hint = "images do not show what depth does"
    if abs(factor) <= OFF:
        return "", hint
    what = "depth readings or their image" if refiner.has_depth else "images"
    how = "larger" if factor > 0 else "smaller"
    return (
        f"the map fits clearly better if the {what} are some {abs(factor):.0%} {how}; check scale and "
        "intrinsics in camera.json"
    ), hint


def moved(before: Floats, after: Floats) -> tuple[float, float]:
    """Way [m] and turn [rad] from one pose (4, 4) to another."""
    turn = vector_from_rotation(after[:3, :3] @ before[:3, :3].T)
    return float(np.linalg.norm(after[:3, 3] - before[:3, 3])), float(np.linalg.norm(turn))


def _motion_error(refiner: Refiner, poses: Floats) -> float:
    """Return the root mean square of the odometry's normalised errors."""
    if len(poses) < 2:
        return 0.0
    errors, deviations = odometry_errors(refiner.problem(), poses)
    return round(float(np.sqrt(np.mean((errors / deviations) ** 2))), 2)


def _by(refiner: Refiner, inliers: int) -> str:
    parts = ["depth"] if refiner.has_depth else []
    if inliers:
        parts.append(f"{inliers} matches of images")
    return " and ".join(parts)
