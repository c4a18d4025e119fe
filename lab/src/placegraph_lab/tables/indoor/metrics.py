"""Measures of indoor answers: errors of the pose, recall, status, calibration and time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import PoseEstimate
from placegraph.core.geometry import Floats, vector_from_rotation
from placegraph.errors import OptionError
from placegraph_lab.tables.statistics import Reliability, reliability

THRESHOLDS = ((0.10, 5.0), (0.25, 2.0), (0.25, 10.0), (1.00, 10.0))
"""Position [m] and rotation [deg] that a recall allows."""
NEAR = (
    0.5,
    10.0,
)  # what `OK` promises, and what a mode's probability speaks of: this near to the truth
AXES = ("x", "y", "z", "turn x", "turn y", "turn z")
"""Names of the six numbers of a pose's error, in the order of `PoseMode.covariance`."""
WITHIN_95 = 12.5916
"""95 % of the squared normalised errors of six degrees of freedom are smaller (chi-squared)."""


def position_error(map_from_camera: Floats, truth: Floats) -> float:
    """Distance [m] of two poses (4, 4)."""
    return float(np.linalg.norm(map_from_camera[:3, 3] - truth[:3, 3]))


def rotation_error(map_from_camera: Floats, truth: Floats) -> float:
    """Geodesic angle [deg, 0 to 180] between the rotations of two poses (4, 4).

    arccos((tr(R^T R') - 1) / 2) as in the paper (Sec. 5), by a formula that keeps its digits near
    0 and 180 degrees.
    """
    turn = map_from_camera[:3, :3].T @ truth[:3, :3]
    sine = math.sqrt(
        (turn[2, 1] - turn[1, 2]) ** 2
        + (turn[0, 2] - turn[2, 0]) ** 2
        + (turn[1, 0] - turn[0, 1]) ** 2
    )
    return math.degrees(math.atan2(sine, float(np.trace(turn)) - 1.0))


def near(map_from_camera: Floats, truth: Floats, limits: tuple[float, float] = NEAR) -> bool:
    """Whether a pose (4, 4) lies within limits [m], [deg] of the truth (4, 4)."""
    return (
        position_error(map_from_camera, truth) <= limits[0]
        and rotation_error(map_from_camera, truth) <= limits[1]
    )


def pose_error(map_from_camera: Floats, truth: Floats) -> Floats:
    """Return the error (6,) of a pose (4, 4) to the truth (4, 4): shift [m], turn [rad], map axes.

    The shift is added to the position; the turn is the vector of the rotation that comes after the
    pose's own: log(R_true R^T), as `PoseMode.covariance` has it.
    """
    turn = truth[:3, :3] @ map_from_camera[:3, :3].T
    return np.concatenate([truth[:3, 3] - map_from_camera[:3, 3], vector_from_rotation(turn)])


def normalised_error(covariance: Floats, map_from_camera: Floats, truth: Floats) -> Floats:
    """`pose_error` (6,), whitened by the covariance (6, 6): of unit variance if that is honest.

    The squares sum to the squared Mahalanobis distance. NaN where the covariance is not positive
    definite.
    """
    try:
        whole: Floats = np.linalg.solve(
            np.linalg.cholesky(covariance), pose_error(map_from_camera, truth)
        )
    except np.linalg.LinAlgError:
        return np.full(6, np.nan)
    return whole


@dataclass(frozen=True)
class Answer:
    """One estimate, measured against the truth."""

    window: str  # which frames were asked about: `seq01 5:10`
    place: str  # which sequence, or which half
    changed: bool | None  # whether the scene differs from its map; None where nobody knows
    coverage: float | None
    """Share of the last frame's surface that the map holds; None where nobody looked."""
    position: float  # error of the best pose [m]; infinite where there is none
    rotation: float  # error of the best pose [deg]; 180 where there is none
    status: str
    probability: float  # of the best mode; 0 where there is none
    among_modes: bool  # whether the truth is near one of the modes
    whitened: tuple[
        float, ...
    ]  # (6,) `normalised_error` of the best mode; empty where there is none
    frames: int
    seconds: float  # wall time of the whole estimate
    particles: float = math.nan  # mean number of particles over frames and passes

    @property
    def has_pose(self) -> bool:
        return math.isfinite(self.position)

    def within(self, metres: float, degrees: float) -> bool:
        return self.position <= metres and self.rotation <= degrees


def measure(
    estimate: PoseEstimate,
    truth: Floats,
    *,
    seconds: float,
    frames: int,
    window: str = "",
    place: str = "",
    changed: bool | None = None,
    coverage: float | None = None,
) -> Answer:
    """Measure an estimate against the true map_from_camera (4, 4) of its last frame."""
    best = estimate.best
    pose = best.map_from_camera if best else None
    return Answer(
        window, place, changed, coverage,
        position=math.inf if pose is None else position_error(pose, truth),
        rotation=180.0 if pose is None else rotation_error(pose, truth),
        status=estimate.status.name,
        probability=float(best.probability) if best else 0.0,
        among_modes=any(near(m.map_from_camera, truth) for m in estimate.modes),
        whitened=tuple(normalised_error(best.covariance, best.map_from_camera, truth).tolist())
        if best
        else (),
        frames=frames,
        seconds=seconds,
        particles=mean_particles(estimate.stats),
    )  # fmt: skip


def mean_particles(stats: dict[str, Any]) -> float:
    """Mean number of particles over passes and frames, from an estimate's `stats`; NaN if unsaid."""
    counts = [n for of_pass in stats.get("particles", ()) for n in of_pass]
    return float(np.mean(counts)) if counts else math.nan


@dataclass(frozen=True)
class Score:
    """Row of a table."""

    windows: int
    mean: tuple[float, float]
    """Mean error of the answers that have a pose [m], [deg]; NaN where none has."""
    median: tuple[float, float]
    """Median error of all answers [m], [deg]; infinite where most have no pose."""
    recall: tuple[float, ...]  # share of answers within each of `THRESHOLDS`
    status: dict[str, float]  # share of every status
    right: float  # share of `OK` answers that are near the truth; NaN where none is `OK`
    false_ok: float  # share of all answers that are `OK` and not near the truth
    among_modes: float  # share of answers with the truth among their modes
    honest: float
    """Share of answers that are right and `OK`, `AMBIGUOUS` with the truth among the modes, or
    `LOST` where the best pose, if any, is wrong."""
    calibration: Reliability  # of the best mode's probability to be near the truth
    spread: tuple[float, ...]
    """(6,) root mean square of the whitened errors of right answers: 1 if honest, above 1 if
    the covariance is too small."""
    inside: float  # share of right answers within the 95 % ellipsoid of their covariance
    frame_seconds: float  # mean time per frame [s]
    particles: float  # mean over answers
    worst: tuple[str, ...] = field(default=())
    """Windows whose answers are wrong, farthest first: `seq01 13:18 OK 14.1 m 179 deg`."""


def score(answers: Sequence[Answer]) -> Score:
    """Summarize answers; `OptionError` where there are none."""
    if not answers:
        raise OptionError("There are no answers to score.")
    n = len(answers)
    errors = np.array([(a.position, a.rotation) for a in answers])
    posed = errors[[a.has_pose for a in answers]]
    right = np.array([a.within(*NEAR) for a in answers])
    statuses = [a.status for a in answers]
    ok = np.array([s == "OK" for s in statuses])
    white = [a.whitened for a, r in zip(answers, right, strict=True) if r]
    particles = [a.particles for a in answers if not math.isnan(a.particles)]
    return Score(
        windows=n,
        mean=pair(posed.mean(axis=0)) if len(posed) else (math.nan, math.nan),
        median=pair(np.median(errors, axis=0)),
        recall=tuple(sum(a.within(*limits) for a in answers) / n for limits in THRESHOLDS),
        status={s: statuses.count(s) / n for s in sorted(set(statuses))},
        right=float(right[ok].mean()) if ok.any() else math.nan,
        false_ok=float((ok & ~right).mean()),
        among_modes=sum(a.among_modes for a in answers) / n,
        honest=sum(map(is_honest, answers)) / n,
        calibration=reliability([a.probability for a in answers], right, bins=min(5, n)),
        spread=root_mean_square(white),
        inside=share_inside(white),
        frame_seconds=float(np.mean([a.seconds / a.frames for a in answers])),
        particles=float(np.mean(particles)) if particles else math.nan,
        worst=tuple(wrong_ones(answers)),
    )


def is_honest(answer: Answer) -> bool:
    right = answer.within(*NEAR)
    if answer.status == "OK":
        return right
    return answer.among_modes if answer.status == "AMBIGUOUS" else not right


def wrong_ones(answers: Iterable[Answer]) -> list[str]:
    wrong = [a for a in answers if a.has_pose and not a.within(*NEAR)]
    return [
        f"{a.window} {a.status} {a.position:.2f} m {a.rotation:.0f} deg"
        for a in sorted(wrong, key=lambda a: -a.position)
    ]


def root_mean_square(whitened: Sequence[Sequence[float]]) -> tuple[float, ...]:
    """Root mean square (6,) of whitened errors, those without a sound covariance left out."""
    sound = _sound(whitened)
    if not len(sound):
        return (math.nan,) * 6
    return tuple(np.sqrt((sound**2).mean(axis=0)).tolist())


def share_inside(whitened: Sequence[Sequence[float]]) -> float:
    """Share of whitened errors within the 95 % ellipsoid; an unsound covariance holds nothing."""
    if not whitened:
        return math.nan
    return float(((_sound(whitened) ** 2).sum(axis=1) <= WITHIN_95).sum() / len(whitened))


def pair(values: NDArray[np.float64]) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _sound(whitened: Sequence[Sequence[float]]) -> Floats:
    table = np.array(whitened, np.float64).reshape(-1, 6)
    return table[np.isfinite(table).all(axis=1)]
