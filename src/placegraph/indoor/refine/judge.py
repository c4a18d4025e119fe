"""Whether a refined trajectory is to be believed: it must explain what it was not fitted to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.geometry import vector_from_rotation
from placegraph.indoor.pose.window import timed
from placegraph.indoor.refine.camera import DULL, OFF, SUSPECT, suspected
from placegraph.indoor.refine.check import Gain, depth_gain, image_gain
from placegraph.indoor.refine.landmarks import kept_scores
from placegraph.indoor.refine.solve import odometry_errors

if TYPE_CHECKING:
    from placegraph.geometry import Floats
    from placegraph.indoor.refine.refiner import Fitted, Refiner

FARTHEST = (1.0, 0.6)
"""A refinement that moves the pose farther than this [m], [rad] has found another place ..."""
FARTHEST_BLIND = (0.6, 0.4)
"""... and so has one without depth."""
BENT = 3.0
"""Root mean square of odometry's normalised errors beyond which the motion was not like that."""
SURE = 1.0
"""Standard errors by which the refined trajectory must explain held-back samples better ..."""
SURER = 3.0
"""... and where images alone speak: they are wrong together more easily (benchmark)."""
AGAINST = -2.5
"""Standard errors by which one sense may speak against it while the other speaks for it."""


@dataclass(frozen=True, slots=True)
class Judgement:
    """Whether to believe it, and why."""

    accepted: bool
    reason: str
    """One sentence."""
    stats: dict[str, Any]
    doubt: str = ""
    """What speaks against the coarse pose too, as half a sentence."""


def judged(refiner: Refiner, coarse: Floats, fitted: Fitted) -> Judgement:
    """Compare a refined trajectory with the coarse one (T, 4, 4)."""
    inliers = sum(map(len, fitted.sights))
    shift, turn = moved(coarse[-1], fitted.poses[-1])
    stats: dict[str, Any] = {
        "inliers": inliers,
        "shift_m": round(shift, 4),
        "turn_deg": round(float(np.degrees(turn)), 3),
    }
    against, doubt = _unfounded(refiner, fitted, inliers), ""
    if not against and refiner.options.joint:
        doubt = _elsewhere(refiner, shift, turn)
        against = doubt or _bent(refiner, fitted.poses, stats)
    if against:
        # what depth backs, images alone do not shake
        return Judgement(
            False, f"Not refined: {against}.", stats, "" if refiner.has_depth else doubt
        )
    by = _by(refiner, inliers)
    if not refiner.options.check:
        return Judgement(True, f"Refined by {by}, unchecked.", stats)
    with timed(refiner.seconds, "check"):
        against = _unconfirmed(refiner, coarse, fitted, stats)
        doubt = _suspect_camera(refiner, fitted, stats)
    if against or doubt:
        return Judgement(False, f"Not refined: {doubt or against}.", stats, doubt)
    return Judgement(True, f"Refined by {by}.{_late(fitted)}", stats)


def _late(fitted: Fitted) -> str:
    """What is told of stamps that sensors do not keep."""
    found = {} if fitted.lags is None else fitted.lags.clear()
    told = (
        f"{what} {'lag' if what == 'images' else 'lags'} {lag:.2g} behind the stamps"
        for what, lag in found.items()
    )
    return "".join(f" Note that {said}; that was allowed for." for said in told)


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


def _unconfirmed(refiner: Refiner, coarse: Floats, fitted: Fitted, stats: dict[str, Any]) -> str:
    """Whether held-back samples fail to speak for the refined trajectory."""
    gains = _gains(refiner, coarse, fitted)
    stats["held_back"] = {
        name: {"before": _rounded(g.before), "after": _rounded(g.after), "z": round(g.z, 2)}
        for name, g in gains.items()
    }
    zs = [g.z for g in gains.values() if not np.isnan(g.before)]
    if not zs:
        return "no held-back pixel tells whether it helped"
    # landmarks were found in the whole map: unlike renderings they are not wrong together
    needed = SURE if refiner.has_depth or "landmarks" in refiner.stats else SURER
    if min(zs) < AGAINST or sum(zs) / np.sqrt(len(zs)) < needed:
        return "held-back pixels are not explained better than by the coarse pose"
    return ""


def _suspect_camera(refiner: Refiner, fitted: Fitted, stats: dict[str, Any]) -> str:
    """What seems wrong with the camera; noted, too, where `wrong_camera` should look closer."""
    factor = suspected(refiner, fitted)
    images = stats["held_back"].get("images", {}).get("after")
    if abs(factor) > SUSPECT:
        stats["camera"] = f"a scale looks {factor:+.1%} off"
    elif refiner.has_depth and images is not None and images < DULL:
        stats["camera"] = "images do not show what depth does"
    if abs(factor) <= OFF:
        return ""
    what = "depth readings or their image" if refiner.has_depth else "images"
    how = "larger" if factor > 0 else "smaller"
    return (
        f"the map fits clearly better if the {what} are some {abs(factor):.0%} {how}; check scale and "
        "intrinsics in camera.json"
    )


def moved(before: Floats, after: Floats) -> tuple[float, float]:
    """Way [m] and turn [rad] from one pose (4, 4) to another."""
    turn = vector_from_rotation(after[:3, :3] @ before[:3, :3].T)
    return float(np.linalg.norm(after[:3, 3] - before[:3, 3])), float(np.linalg.norm(turn))


def _gains(refiner: Refiner, coarse: Floats, fitted: Fitted) -> dict[str, Gain]:
    gains, lags = {}, fitted.lags
    measured, pictured = fitted.poses, fitted.poses
    if lags is not None:
        measured, pictured = lags.of_depth(measured), lags.of_images(pictured)
    if refiner.has_depth:
        gains["depth"] = depth_gain(refiner.surfaces, refiner.readings(1), coarse, measured)
    before, after = kept_scores(refiner, coarse, pictured)
    if len(before) >= refiner.options.least:
        gains["landmarks"] = Gain.of(before, after)
    rows = [t for t in refiner.looked() if refiner.queries[t] is not None]
    if rows and refiner.scene.coloured:
        queries = [q for q in (refiner.queries[t] for t in rows) if q is not None]
        frames = [refiner.frames[t] for t in rows]
        gains["images"] = image_gain(
            refiner.renderer, frames, queries, coarse[rows], pictured[rows]
        )
    return gains


def _bent(refiner: Refiner, poses: Floats, stats: dict[str, Any]) -> str:
    """Whether the frames would have moved otherwise than odometry says."""
    stats["motion"] = 0.0
    if len(poses) > 1:
        errors, deviations = odometry_errors(refiner.problem(), poses)
        stats["motion"] = round(float(np.sqrt(np.mean((errors / deviations) ** 2))), 2)
    return "it contradicts the odometry" if stats["motion"] > BENT else ""


def _by(refiner: Refiner, inliers: int) -> str:
    parts = ["depth"] if refiner.has_depth else []
    if inliers:
        parts.append(f"{inliers} matches of images")
    return " and ".join(parts)


def _rounded(value: float) -> float | None:
    return None if np.isnan(value) else round(value, 4)
