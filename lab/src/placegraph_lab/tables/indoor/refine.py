"""Rows of the refinement's benchmark: from where and by what a pose is refined, and what came of it.

From where: from the pose that localizing finds ("found"), or from one 0.2 m and 10 degrees off the
true one ("disturbed"), which shows the refiner alone. By what: `auto`, the default; the word for a
matcher, whose matches then always take part; `none`, depth alone; a matcher with the paper's recipe;
or small_gicp, which aligns depth alone, knows no verdict, and has to be beaten by our own.

The depth of a sequence is one cloud, carried together by odometry. It is aligned to the cloud of
points that the map would show the same cameras: where their rays hit the mesh from the pose so far.
(Against the whole map as one cloud it did worse in the house: backs of walls and things pull too.)
Needs small_gicp, which only this comparison uses.
"""

from __future__ import annotations

import math
import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from placegraph.core.estimate import PoseEstimate, PoseMode
from placegraph.core.geometry import Floats
from placegraph.errors import MissingExtraError, OptionError
from placegraph.indoor.options import PoseSearchOptions, RefineOptions
from placegraph.indoor.pose.covariance import least_certain
from placegraph.indoor.refine.matching import Matcher
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.frame import Frame
from placegraph_lab.tables.indoor.bench import BARE, OFFICE, SEMANTIC, Job, encoder_of
from placegraph_lab.tables.indoor.followers import NEIGHBOURS, STEP, VOXEL, depth_points
from placegraph_lab.tables.indoor.metrics import (
    AXES,
    WITHIN_95,
    Answer,
    measure,
    pair,
    pose_error,
    position_error,
    rotation_error,
)
from placegraph_lab.tables.indoor.windows import Window, disturb_pose, without_depth

Kind = Literal["PLANE_ICP", "GICP"]

REACHES = ((1.0, 0.3), (0.3, 0.1))
"""For each time the rays are cast: how far a point may be from its partner [m], one alignment each.
small_gicp's Python has no robust kernel: shorter reaches take its place."""
ITERATIONS = 30


def align(
    scene: SceneMap, frames: Sequence[Frame], start: Floats, *, kind: Kind = "PLANE_ICP"
) -> tuple[Floats, bool, float]:
    """Align the depth of frames to the map by small_gicp, from `start` (4, 4), of the last frame.

    Returns map_from_camera (4, 4) of the last frame, whether it converged, and the share of points
    with a partner in reach; `start` where the map shows the cameras nothing. `OptionError` where no
    frame has depth, `MissingExtraError` without small_gicp.
    """
    try:
        import small_gicp
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            "The comparison with small_gicp needs it: pip install small_gicp."
        ) from error
    clouds = [np.zeros((0, 3))]
    for frame, last_from_frame in zip(frames, _steps(frames), strict=True):
        points = depth_points(frame)
        clouds.append(points @ last_from_frame[:3, :3].T + last_from_frame[:3, 3])
    cloud = np.concatenate(clouds)
    if not len(cloud):
        raise OptionError("frames: none has a depth reading, so there is nothing to align.")
    thin = {"downsampling_resolution": VOXEL, "num_neighbors": NEIGHBOURS, "num_threads": 1}
    source, _ = small_gicp.preprocess_points(cloud, **thin)
    pose, converged, inliers = start, False, 0
    for reaches in REACHES:
        seen = visible_cloud(scene, frames, pose)
        if len(seen) <= NEIGHBOURS:
            return pose, False, 0.0
        target, tree = small_gicp.preprocess_points(seen, **thin)
        for reach in reaches:
            found = small_gicp.align(
                target, source, tree, pose, registration_type=kind, num_threads=1,
                max_correspondence_distance=reach, max_iterations=ITERATIONS,
            )  # fmt: skip
            pose, converged, inliers = found.T_target_source, found.converged, found.num_inliers
    return np.asarray(pose), bool(converged), inliers / source.size()


def visible_cloud(scene: SceneMap, frames: Sequence[Frame], pose: Floats) -> Floats:
    """Points (N, 3) of the map [m] that the frames' depth cameras would see, the last at `pose`."""
    clouds = [np.zeros((0, 3))]
    for frame, last_from_frame in zip(frames, _steps(frames), strict=True):
        camera = frame.depth_camera
        if camera is None:
            continue
        v, u = np.mgrid[STEP // 2 : camera.height : STEP, STEP // 2 : camera.width : STEP]
        map_from_frame = pose @ last_from_frame
        rays = camera.directions(np.stack([u.ravel(), v.ravel()], axis=-1) + 0.5)
        directions = rays @ map_from_frame[:3, :3].T
        origins = np.broadcast_to(map_from_frame[:3, 3], directions.shape)
        hits = scene.caster.cast(origins, directions)
        hit = hits.triangle >= 0
        clouds.append(origins[hit] + directions[hit] * hits.distance[hit][:, None])
    return np.concatenate(clouds)


def _steps(frames: Sequence[Frame]) -> list[Floats]:
    """last_from_frame (4, 4) of each frame, by odometry."""
    last_from_odometry = np.linalg.inv(frames[-1].odometry)
    return [last_from_odometry @ frame.odometry for frame in frames]


LIMITS = ((0.10, 5.0), (0.25, 2.0), (0.25, 5.0), (0.25, 10.0))
"""Position [m] and rotation [deg] that a recall allows."""
WORSE = (0.02, 0.5)  # an error counts as larger, or as smaller, from this difference on [m], [deg]
CANDIDATE = "candidate"
"""Key of a refinement's `stats` under which a refused pose may stand: (4, 4) map_from_camera."""

Errors = tuple[float, float]  # of position [m] and rotation [deg]


@dataclass(frozen=True)
class RefineOutcome:
    """One refined estimate, measured against the truth, and where it began."""

    before: Errors  # of the pose before; infinite and 180 where there was none
    after: Answer
    """The estimate as the user gets it; `seconds` are those of everything that was asked for."""
    accepted: bool | None  # none: nothing was there to accept, or who refined does not say
    reason: str = ""
    candidate: Errors | None = None  # of the refused pose, where it was kept
    sigmas: tuple[float, ...] = ()
    """(6,) error of each of `AXES` over the standard deviation that the covariance gives it."""
    free: float = math.nan
    """Error of the position over the standard deviation, along the direction that is least certain."""
    stages: dict[str, float] = field(
        default_factory=dict
    )  # seconds of each stage of the refinement

    @property
    def refine_seconds(self) -> float:
        """Time of the refinement alone [s]; NaN where it does not say."""
        return sum(self.stages.values()) if self.stages else math.nan

    @property
    def harmful(self) -> bool:
        return worse((self.after.position, self.after.rotation), self.before)

    @property
    def wrongly_refused(self) -> bool:
        if self.accepted is not False or self.candidate is None:
            return False
        return worse(self.before, self.candidate) and not worse(self.candidate, self.before)

    def within(self, metres: float, degrees: float) -> bool:
        return self.before[0] <= metres and self.before[1] <= degrees

    @classmethod
    def from_dict(cls, row: dict[str, Any]) -> RefineOutcome:
        """Read what a `Journal` wrote."""
        return cls(**row | {"after": Answer(**row["after"])})


def worse(one: Errors, other: Errors) -> bool:
    return one[0] > other[0] + WORSE[0] or one[1] > other[1] + WORSE[1]


def errors_of(map_from_camera: Any, truth: Floats) -> Errors:
    """Return errors of a pose (4, 4) against the truth (4, 4)."""
    pose = np.asarray(map_from_camera, np.float64)
    return position_error(pose, truth), rotation_error(pose, truth)


def measure_refined(
    estimate: PoseEstimate, window: Window, *, seconds: float, start: Floats | None = None
) -> RefineOutcome:
    """Measure an estimate of a window's last frame.

    `start`: the pose (4, 4) that was to be refined; if not given, the coarse one it speaks of.
    """
    after = measure(estimate, window.truth, seconds=seconds, **window.fields)
    said, best = estimate.refinement, estimate.best
    before = (after.position, after.rotation)
    if start is not None:
        before = errors_of(start, window.truth)
    elif said is not None:
        before = errors_of(said.coarse.map_from_camera, window.truth)
    stats = said.stats if said else {}
    refused = stats.get(CANDIDATE)
    return RefineOutcome(
        before=before,
        after=after,
        accepted=said.accepted if said else None,
        reason=said.reason if said else "",
        candidate=None if refused is None else errors_of(refused, window.truth),
        sigmas=sigmas_of(best, window.truth) if best else (),
        free=free_sigma(best, window.truth) if best else math.nan,
        stages=dict(stats.get("seconds", {})),
    )


def sigmas_of(mode: PoseMode, truth: Floats) -> tuple[float, ...]:
    """Return the error of each of `AXES` (6,) over its standard deviation; NaN where that is none."""
    variance = np.diagonal(mode.covariance)
    error = pose_error(mode.map_from_camera, truth)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(variance > 0, error / np.sqrt(np.abs(variance)), np.nan)
    return tuple(ratio.tolist())


def free_sigma(mode: PoseMode, truth: Floats) -> float:
    """Return the error along the least certain direction of the position, over its standard deviation."""
    deviation, axis = least_certain(mode.covariance)
    return float(axis @ (truth[:3, 3] - mode.map_from_camera[:3, 3]) / deviation)


@dataclass(frozen=True)
class Side:
    """Errors of many poses, before or after."""

    mean: Errors  # of those that have a pose; NaN where none has
    median: Errors  # of all; infinite where most have no pose
    recall: tuple[float, ...]  # share within each of `LIMITS`

    @classmethod
    def of(cls, errors: Sequence[Errors]) -> Side:
        """Summarize errors (N, 2)."""
        table = np.array(errors, np.float64).reshape(-1, 2)
        posed = table[np.isfinite(table[:, 0])]
        return cls(
            mean=pair(posed.mean(axis=0)) if len(posed) else (math.nan, math.nan),
            median=pair(np.median(table, axis=0)),
            recall=tuple(float((table <= limits).all(axis=1).mean()) for limits in LIMITS),
        )


@dataclass(frozen=True)
class RefineScore:
    """Row of a table."""

    windows: int
    before: Side
    after: Side
    accepted: float  # share of accepted refinements among those judged; NaN where none was
    harmful: float  # share of all windows: accepted, or never judged, and harmful
    wrongly_refused: float  # share of all windows; NaN where no refused pose was kept
    seconds: float  # mean time of everything asked for [s]
    refine_seconds: float  # mean time of the refinement alone [s]; NaN where none says
    stages: dict[str, float]  # mean seconds of each stage of the refinement, where it says
    worst: tuple[str, ...]  # harmful ones, farthest first


def refine_score(results: Sequence[RefineOutcome]) -> RefineScore:
    """Summarize results; `OptionError` where there are none."""
    if not results:
        raise OptionError("There are no results to score.")
    judged = [r.accepted for r in results if r.accepted is not None]
    harmful = [r for r in results if r.harmful and r.accepted is not False]
    refused = [r for r in results if r.accepted is False]
    unknown = not judged or (bool(refused) and all(r.candidate is None for r in refused))
    timed = [r for r in results if r.stages]
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
        stages={
            k: sum(r.stages.get(k, 0.0) for r in timed) / len(timed)
            for k in sorted({name for r in timed for name in r.stages})
        },
        worst=tuple(
            f"{r.after.window} {r.after.status} {r.before[0]:.2f} m {r.before[1]:.1f} deg -> "
            f"{r.after.position:.2f} m {r.after.rotation:.1f} deg".replace("  ", " ")
            for r in sorted(harmful, key=lambda r: -r.after.position)
        ),
    )


def spread(results: Sequence[RefineOutcome]) -> dict[str, Any]:
    """Compare errors with the covariances that were to announce them.

    `rms` (6,) of `sigmas` is 1 if honest, above 1 if covariances are too small; `within_sigma` are the
    shares of each of `AXES` within 1, 2 and 3 standard deviations (.68, .95, .997),
    `within_95_percent` that in the ellipsoid of all six: an unsound covariance holds nothing. `nees`,
    the mean squared error whitened by the covariance, is 6 if honest, and `free`, that along the least
    certain direction of the position alone, 1.
    """
    posed = [r for r in results if len(r.sigmas) == len(AXES)]
    table = np.array([r.sigmas for r in posed], np.float64).reshape(-1, len(AXES))
    white = np.array([r.after.whitened for r in posed], np.float64).reshape(-1, len(AXES))
    sound = np.isfinite(table).all(axis=1) & np.isfinite(white).all(axis=1)
    errors, nothing = table[sound], [None] * len(AXES)
    inside = float(((white[sound] ** 2).sum(axis=1) <= WITHIN_95).sum())
    return {
        "count": len(errors),
        "rms": np.sqrt((errors**2).mean(axis=0)).tolist() if len(errors) else nothing,
        "within_sigma": {
            k: (np.abs(errors) <= k).mean(axis=0).tolist() if len(errors) else nothing
            for k in (1, 2, 3)
        },
        "within_95_percent": inside / len(posed) if posed else None,
        "nees": float((white[sound] ** 2).sum(axis=1).mean()) if len(errors) else None,
        "free": float(np.mean([r.free**2 for r in posed])) if posed else None,
    }


Start = Literal["found", "disturbed"]

MATCHERS = ("auto", "none", "guided", "sift", "xfeat")
"""Matchers that refine by default; `none` is depth alone."""
PAPER = ", paper's recipe"
"""Suffix of a matcher's name for `RefineOptions.paper()`: images alone."""
GICP: dict[str, Kind] = {"small_gicp, plane": "PLANE_ICP", "small_gicp, GICP": "GICP"}
PLACES = {"house": "House", **OFFICE}
STARTS: dict[Start, str] = {
    "found": "from the pose found",
    "disturbed": "from 0.2 m and 10 degrees off",
}


@dataclass(frozen=True)
class RefineJob:
    """One row of a table, for windows of any length."""

    place: str  # key of `PLACES`
    start: Start
    senses: (
        str  # evidence that localization uses: `all`; from a disturbed start `depth` or `no depth`
    )
    by: str
    """`auto`, `none`, the word for a matcher, the same with `PAPER` behind it, or a key of `GICP`."""
    coarse: Job | None = None  # how the pose is found; None from a disturbed start

    @property
    def name(self) -> str:
        return f"{self.place} {self.start}: {self.row}"

    @property
    def row(self) -> str:
        return f"{self.senses}, {self.by}"

    @property
    def depth(self) -> bool:
        return self.coarse.options.depth if self.coarse else self.senses == "depth"

    @property
    def matcher(self) -> str:
        return "auto" if self.by == "none" else self.by.removesuffix(PAPER)

    @property
    def options(self) -> RefineOptions:
        if self.by.endswith(PAPER):
            return RefineOptions.paper()
        return RefineOptions(images="auto" if self.by == "auto" else self.by != "none")

    def key(self, window: Window, seed: int, code: str) -> str:
        coarse = self.coarse.key(window, seed, code) if self.coarse else f"{code} {window.name}"
        return f"{coarse} seed {seed} {self.name} depth {self.depth} {self.options}"


def refine_jobs(matchers: Sequence[str] = MATCHERS) -> list[RefineJob]:
    """Return all rows: each way to find a pose, or disturbed start, by each matcher that it allows.

    A sense that localizing does without is not refined by either: colours are always on.
    """
    bare = [m for m in matchers if m not in {"auto", "none", "guided"}]
    without = [*(m for m in matchers if m == "auto"), *bare, *(f"{m}{PAPER}" for m in bare)]
    jobs = []
    for place in PLACES:
        ways: list[tuple[Job, bool]] = []
        for row in ("all", "semantic + colour") if place == "house" else ():
            options = PoseSearchOptions().only(**SEMANTIC[row])
            ways.append((Job("instances", row, options, place, "instances"), True))
        for row in ("depth + colour", "colour"):
            job = Job(
                "none", f"no labels: {row}", PoseSearchOptions().only(**BARE[row]), place, "none"
            )
            ways.append((job, place != "house"))
        for job, by_all in ways:
            these = matchers if job.options.depth else without
            if not by_all:  # by the first matcher alone
                these = [m for m in these if m.removesuffix(PAPER) == matchers[0]]
            jobs += [RefineJob(place, "found", job.row, by, job) for by in these]
        jobs += [RefineJob(place, "disturbed", "depth", by) for by in (*matchers, *GICP)]
        jobs += [RefineJob(place, "disturbed", "no depth", by) for by in without]
    return jobs


QUICK = (
    "house found: all, auto", "house found: semantic + colour, auto",
    "house disturbed: *", "b in a disturbed: depth, *",
)  # fmt: skip
"""Rows of a first impression."""


def ask(
    job: RefineJob,
    scene: SceneMap,
    window: Window,
    *,
    matcher: str | Matcher,
    seed: int = 0,
    device: str = "auto",
) -> RefineOutcome:
    """Refine the pose of a window's last frame and measure it.

    The true pose is used to make a disturbed start and to measure, for nothing else. From a found
    pose one run gives both sides: the coarse pose stands in the estimate beside the refined one.
    `matcher` is what `job.matcher` names: the word, or the matcher itself where it has weights.
    """
    capture = window.capture if job.depth else without_depth(window.capture)
    # The same start for all who ask about a window
    rng = np.random.default_rng([seed, zlib.crc32(window.name.encode())])
    start = disturb_pose(window.truth, rng)
    encoder = encoder_of(job.coarse, scene, window, seed) if job.coarse else None
    began = time.perf_counter()
    if job.coarse is not None:
        estimate = scene.localize(
            capture, encoder=encoder, options=job.coarse.options, seed=seed, device=device,
            refine=job.options, matcher=matcher,
        )  # fmt: skip
    elif job.by in GICP:  # a pose without a covariance or a verdict
        pose, *_ = align(scene, list(capture), start, kind=GICP[job.by])
        took = time.perf_counter() - began
        position, rotation = errors_of(pose, window.truth)
        after = Answer(
            **window.fields, position=position, rotation=rotation, status="", probability=0.0,
            among_modes=False, whitened=(), seconds=took,
        )  # fmt: skip
        return RefineOutcome(errors_of(start, window.truth), after, accepted=None)
    else:
        estimate = scene.refine(capture, start, matcher=matcher, options=job.options, seed=seed)
    seconds, own = time.perf_counter() - began, None if job.coarse else start
    return measure_refined(estimate, window, seconds=seconds, start=own)
