"""Whether a refined trajectory is to be believed: it must explain what it was not fitted to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.geometry import vector_from_rotation
from placegraph.indoor.clock import timed
from placegraph.indoor.refine.check import Gain, depth_gain, image_gain
from placegraph.indoor.refine.joint import odometry_errors

if TYPE_CHECKING:
    from placegraph.geometry import Floats
    from placegraph.indoor.refine.refiner import Fitted, Refiner

FARTHEST = (1.0, 0.6)
"""A refinement that moves the pose farther than this [m], [rad] has found another place."""
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


def judged(refiner: Refiner, coarse: Floats, fitted: Fitted) -> Judgement:
    """Compare a refined trajectory with the coarse one (T, 4, 4)."""
    options = refiner.options
    inliers = sum(map(len, fitted.sights))
    shift, turn = moved(coarse[-1], fitted.poses[-1])
    stats: dict[str, Any] = {
        "inliers": inliers,
        "shift_m": round(shift, 4),
        "turn_deg": round(float(np.degrees(turn)), 3),
    }
    if fitted.solution is None or (not refiner.has_depth and inliers < options.least):
        said = f"only {inliers} matches of images with the map agree" if inliers else NOTHING
        return Judgement(False, f"Not refined: {said}.", stats)
    bent = _bent(refiner, fitted.poses)
    stats["motion"] = round(bent, 2)
    if shift > FARTHEST[0] or turn > FARTHEST[1]:
        said = f"it ended {shift:.1f} m and {np.degrees(turn):.0f} degrees away"
        return Judgement(False, f"Not refined: {said}, which is another place.", stats)
    if bent > BENT:
        return Judgement(False, "Not refined: it contradicts the odometry.", stats)
    if not options.check:
        return Judgement(True, f"Refined by {_by(refiner, inliers)}, unchecked.", stats)
    with timed(refiner.seconds, "check"):
        gains = _gains(refiner, coarse, fitted.poses)
    stats["held_back"] = {
        name: {"before": _rounded(g.before), "after": _rounded(g.after), "z": round(g.z, 2)}
        for name, g in gains.items()
    }
    zs = [g.z for g in gains.values() if not np.isnan(g.before)]
    if not zs:
        return Judgement(False, "Not refined: no held-back pixel tells whether it helped.", stats)
    if min(zs) < AGAINST or sum(zs) / np.sqrt(len(zs)) < (SURE if refiner.has_depth else SURER):
        said = "held-back pixels are not explained better than by the coarse pose"
        return Judgement(False, f"Not refined: {said}.", stats)
    return Judgement(True, f"Refined by {_by(refiner, inliers)}.", stats)


NOTHING = "the frames show nothing that could be matched with the map"


def moved(before: Floats, after: Floats) -> tuple[float, float]:
    """Way [m] and turn [rad] from one pose (4, 4) to another."""
    turn = vector_from_rotation(after[:3, :3] @ before[:3, :3].T)
    return float(np.linalg.norm(after[:3, 3] - before[:3, 3])), float(np.linalg.norm(turn))


def _gains(refiner: Refiner, coarse: Floats, refined: Floats) -> dict[str, Gain]:
    gains = {}
    if refiner.has_depth:
        gains["depth"] = depth_gain(refiner.surfaces, refiner.readings(1), coarse, refined)
    rows = [t for t in refiner.looked() if refiner.queries[t] is not None]
    if rows and refiner.scene.coloured:
        queries = [q for q in (refiner.queries[t] for t in rows) if q is not None]
        frames = [refiner.frames[t] for t in rows]
        gains["images"] = image_gain(refiner.renderer, frames, queries, coarse[rows], refined[rows])
    return gains


def _bent(refiner: Refiner, poses: Floats) -> float:
    """Root mean square of the normalised errors of odometry; 0 of a single frame."""
    if len(poses) < 2:
        return 0.0
    errors, deviations = odometry_errors(refiner.problem(), poses)
    return float(np.sqrt(np.mean((errors / deviations) ** 2)))


def _by(refiner: Refiner, inliers: int) -> str:
    parts = ["depth"] if refiner.has_depth else []
    if inliers:
        parts.append(f"{inliers} matches of images")
    return " and ".join(parts)


def _rounded(value: float) -> float | None:
    return None if np.isnan(value) else round(value, 4)
