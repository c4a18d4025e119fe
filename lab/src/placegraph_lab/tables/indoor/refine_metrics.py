"""What a refinement is worth: errors before and after, and whether it knew when not to."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.core.estimate import PoseEstimate, PoseMode
from placegraph.core.geometry import Floats
from placegraph.errors import OptionError
from placegraph_lab.tables.indoor.metrics import (
    AXES,
    WITHIN_95,
    Answer,
    measure,
    pair,
    pose_error,
    position_error,
    rotation_error,
    rounded,
)

if TYPE_CHECKING:
    from placegraph_lab.tables.indoor.windows import Window

LIMITS = ((0.10, 5.0), (0.25, 2.0), (0.25, 5.0), (0.25, 10.0))
"""Position [m] and rotation [deg] that a recall allows."""
WORSE = (0.02, 0.5)
"""An error counts as larger, or as smaller, from this difference on [m], [deg]."""
CANDIDATE = "candidate"
"""Key of a refinement's `stats` under which a refused pose may stand: (4, 4) map_from_camera."""

Errors = tuple[float, float]
"""Of position [m] and rotation [deg]."""


@dataclass(frozen=True)
class Refined:
    """One refined estimate, measured against the truth, and where it began."""

    before: Errors
    """Of the pose before; infinite and 180 where there was none."""
    after: Answer
    """The estimate as the user gets it; `seconds` are those of everything that was asked for."""
    accepted: bool | None
    """None: nothing was there to accept, or who refined does not say."""
    reason: str = ""
    candidate: Errors | None = None
    """Of the refused pose, where it was kept."""
    sigmas: tuple[float, ...] = ()
    """(6,) error of each of `AXES` over the standard deviation that the covariance gives it."""
    stages: dict[str, float] = field(default_factory=dict)
    """Seconds of each stage of the refinement."""

    @property
    def refine_seconds(self) -> float:
        """Time of the refinement alone [s]; NaN where it does not say."""
        return sum(self.stages.values()) if self.stages else math.nan

    @property
    def harmful(self) -> bool:
        """Whether the pose is worse than it was, by more than `WORSE` in either error."""
        return worse((self.after.position, self.after.rotation), self.before)

    @property
    def wrongly_refused(self) -> bool:
        """Whether the refused pose was better, in one error by more than `WORSE`, in none worse."""
        if self.accepted is not False or self.candidate is None:
            return False
        return worse(self.before, self.candidate) and not worse(self.candidate, self.before)

    def within(self, metres: float, degrees: float) -> bool:
        """Whether the pose before was that near to the truth."""
        return self.before[0] <= metres and self.before[1] <= degrees

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, ready for `json.dumps`; infinity and nan become None."""
        return {
            "before": _plain(self.before),
            "after": self.after.to_dict(),
            "accepted": self.accepted,
            "reason": self.reason,
            "candidate": None if self.candidate is None else _plain(self.candidate),
            "sigmas": [rounded(s, 3) for s in self.sigmas],
            "stages": {name: rounded(s, 4) for name, s in self.stages.items()},
        }

    @classmethod
    def from_dict(cls, row: dict[str, Any]) -> Refined:
        """What `to_dict` wrote."""
        return cls(
            **row
            | {
                "before": _errors(row["before"]),
                "after": Answer.from_dict(row["after"]),
                "candidate": None if row["candidate"] is None else _errors(row["candidate"]),
                "sigmas": tuple(math.nan if s is None else s for s in row["sigmas"]),
            }
        )


def worse(one: Errors, other: Errors) -> bool:
    """Whether errors are larger than others by more than `WORSE`, in position or rotation."""
    return one[0] > other[0] + WORSE[0] or one[1] > other[1] + WORSE[1]


def errors_of(map_from_camera: Floats, truth: Floats) -> Errors:
    """Errors of a pose (4, 4) against the truth (4, 4)."""
    return position_error(map_from_camera, truth), rotation_error(map_from_camera, truth)


def measure_refined(
    estimate: PoseEstimate, window: Window, *, seconds: float, start: Floats | None = None
) -> Refined:
    """Measure an estimate of a window's last frame.

    `start`: the pose (4, 4) that was to be refined; if not given, the coarse one it speaks of.
    """
    after = measure(
        estimate,
        window.truth,
        seconds=seconds,
        frames=len(window.capture),
        window=window.name,
        place=window.place,
        changed=window.changed,
        coverage=window.coverage,
    )
    said, best = estimate.refinement, estimate.best
    before = (after.position, after.rotation)
    if start is not None:
        before = errors_of(start, window.truth)
    elif said is not None:
        before = errors_of(said.coarse.map_from_camera, window.truth)
    stats = said.stats if said else {}
    pose = stats.get(CANDIDATE)
    refused = None if pose is None else errors_of(np.array(pose, np.float64), window.truth)
    return Refined(
        before=before,
        after=after,
        accepted=said.accepted if said else None,
        reason=said.reason if said else "",
        candidate=refused,
        sigmas=sigmas_of(best, window.truth) if best else (),
        stages=dict(stats.get("seconds", {})),
    )


def measure_pose(
    map_from_camera: Floats, window: Window, *, seconds: float, start: Floats
) -> Refined:
    """Measure a pose (4, 4) that comes without a covariance or a verdict."""
    position, rotation = errors_of(map_from_camera, window.truth)
    after = Answer(
        window=window.name,
        place=window.place,
        changed=window.changed,
        coverage=window.coverage,
        position=position,
        rotation=rotation,
        status="",
        probability=0.0,
        held=False,
        whitened=(),
        frames=len(window.capture),
        seconds=seconds,
    )
    return Refined(errors_of(start, window.truth), after, accepted=None)


def sigmas_of(mode: PoseMode, truth: Floats) -> tuple[float, ...]:
    """Error of each of `AXES` (6,) over its standard deviation; NaN where that is none."""
    variance = np.diagonal(mode.covariance)
    error = pose_error(mode.map_from_camera, truth)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(variance > 0, error / np.sqrt(np.abs(variance)), np.nan)
    return tuple(ratio.tolist())


# ------------------------------------------------------------------------------------ summaries


@dataclass(frozen=True)
class Side:
    """Errors of many poses, before or after."""

    mean: Errors
    """Of those that have a pose; NaN where none has."""
    median: Errors
    """Of all; infinite where most have no pose."""
    recall: tuple[float, ...]
    """Share within each of `LIMITS`."""

    @classmethod
    def of(cls, errors: Sequence[Errors]) -> Side:
        """Side of errors (N, 2)."""
        table = np.array(errors, np.float64).reshape(-1, 2)
        posed = table[np.isfinite(table[:, 0])]
        return cls(
            mean=pair(posed.mean(axis=0)) if len(posed) else (math.nan, math.nan),
            median=pair(np.median(table, axis=0)),
            recall=tuple(float((table <= limits).all(axis=1).mean()) for limits in LIMITS),
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, ready for `json.dumps`."""
        return {
            "mean_position_m": rounded(self.mean[0], 4),
            "mean_rotation_deg": rounded(self.mean[1], 3),
            "median_position_m": rounded(self.median[0], 4),
            "median_rotation_deg": rounded(self.median[1], 3),
            "recall": {
                f"{m:g} m, {d:g} deg": rounded(r, 4)
                for (m, d), r in zip(LIMITS, self.recall, strict=True)
            },
        }


@dataclass(frozen=True)
class RefineScore:
    """Row of a table."""

    windows: int
    before: Side
    after: Side
    accepted: float
    """Share of accepted refinements among those that were judged; NaN where none was."""
    harmful: float
    """Share of all windows whose refinement was accepted, or never judged, and harmful."""
    wrongly_refused: float
    """Share of all windows; NaN where nothing was judged, or no refused pose was kept."""
    seconds: float
    """Mean time of everything asked for [s]."""
    refine_seconds: float
    """Mean time of the refinement alone [s]; NaN where none says."""
    stages: dict[str, float]
    """Mean seconds of each stage of the refinement, where it says."""
    worst: tuple[str, ...]
    """Harmful ones, farthest first."""

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings, ready for `json.dumps`; infinity and nan become None."""
        return {
            "windows": self.windows,
            "before": self.before.to_dict(),
            "after": self.after.to_dict(),
            "accepted": rounded(self.accepted, 4),
            "harmful": rounded(self.harmful, 4),
            "wrongly_refused": rounded(self.wrongly_refused, 4),
            "seconds": rounded(self.seconds, 4),
            "refine_seconds": rounded(self.refine_seconds, 4),
            "stage_seconds": {name: rounded(s, 4) for name, s in self.stages.items()},
            "harmful_ones": list(self.worst),
        }


def refine_score(results: Sequence[Refined]) -> RefineScore:
    """Summarize results; `OptionError` where there are none."""
    if not results:
        raise OptionError("There are no results to score.")
    judged = [r.accepted for r in results if r.accepted is not None]
    harmful = [r for r in results if r.harmful and r.accepted is not False]
    refused = [r for r in results if r.accepted is False]
    unknown = not judged or (bool(refused) and all(r.candidate is None for r in refused))
    timed = [r for r in results if r.stages]
    names = sorted({name for r in timed for name in r.stages})
    n = len(results)
    return RefineScore(
        windows=n,
        before=Side.of([r.before for r in results]),
        after=Side.of([(r.after.position, r.after.rotation) for r in results]),
        accepted=sum(judged) / len(judged) if judged else math.nan,
        harmful=len(harmful) / n,
        wrongly_refused=math.nan if unknown else sum(r.wrongly_refused for r in results) / n,
        seconds=float(np.mean([r.after.seconds for r in results])),
        refine_seconds=float(np.mean([r.refine_seconds for r in timed])) if timed else math.nan,
        stages={k: sum(r.stages.get(k, 0.0) for r in timed) / len(timed) for k in names},
        worst=tuple(_line(r) for r in sorted(harmful, key=lambda r: -r.after.position)),
    )


EDGES = (-3.0, -2.5, -2.0, -1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
"""Of the histogram's inner bins, in standard deviations; two more lie outside."""


@dataclass(frozen=True)
class Spread:
    """How errors compare with the covariances that were to announce them."""

    count: int
    """Results with a sound covariance."""
    rms: tuple[float, ...]
    """(6,) root mean square of `sigmas`: 1 if honest, above 1 if the covariance is too small."""
    within: tuple[tuple[float, ...], ...]
    """(3, 6) share of each of `AXES` within 1, 2 and 3 standard deviations (.68, .95, .997)."""
    inside: float
    """Share within the 95 % ellipsoid of all six; an unsound covariance holds nothing."""
    histogram: tuple[int, ...]
    """(14,) errors of all axes by `EDGES`, those beyond at both ends."""

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, ready for `json.dumps`; nan becomes None."""
        return {
            "count": self.count,
            "axes": list(AXES),
            "rms": [rounded(x, 3) for x in self.rms],
            "within_sigma": {
                str(k): [rounded(x, 4) for x in row] for k, row in enumerate(self.within, 1)
            },
            "within_95_percent": rounded(self.inside, 4),
            "edges": list(EDGES),
            "histogram": list(self.histogram),
        }


def spread(results: Sequence[Refined]) -> Spread:
    """Spread of the results that have a pose."""
    posed = [r for r in results if len(r.sigmas) == len(AXES)]
    table = np.array([r.sigmas for r in posed], np.float64).reshape(-1, len(AXES))
    whole = np.array([r.after.whitened for r in posed], np.float64).reshape(-1, len(AXES))
    sound = np.isfinite(table).all(axis=1) & np.isfinite(whole).all(axis=1)
    kept = table[sound]
    nothing = (math.nan,) * len(AXES)
    bins = np.searchsorted(EDGES, kept.ravel(), side="right")
    return Spread(
        count=len(kept),
        rms=tuple(np.sqrt((kept**2).mean(axis=0)).tolist()) if len(kept) else nothing,
        within=tuple(
            tuple((np.abs(kept) <= k).mean(axis=0).tolist()) if len(kept) else nothing
            for k in (1, 2, 3)
        ),
        inside=float(((whole[sound] ** 2).sum(axis=1) <= WITHIN_95).sum() / len(posed))
        if posed
        else math.nan,
        histogram=tuple(np.bincount(bins, minlength=len(EDGES) + 1).tolist()),
    )


def _line(r: Refined) -> str:
    """`seq01 13:18 OK 0.02 m 0.1 deg -> 0.31 m 2.0 deg`."""
    a = r.after
    before = f"{r.before[0]:.2f} m {r.before[1]:.1f} deg"
    return f"{a.window} {a.status} {before} -> {a.position:.2f} m {a.rotation:.1f} deg".replace(
        "  ", " "
    )


def _plain(errors: Errors) -> list[float | None]:
    return [rounded(errors[0], 4), rounded(errors[1], 3)]


def _errors(row: Sequence[float | None]) -> Errors:
    metres, degrees = row
    return (
        math.inf if metres is None else metres,
        180.0 if degrees is None else degrees,
    )
