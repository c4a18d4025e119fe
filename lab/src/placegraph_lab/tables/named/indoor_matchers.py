"""How many matches of a photograph with renderings of the map are right; the true pose tells.

Queries are single frames of the house and of the office. Views are rendered at the true pose, at a
pose off by `OFF` and turned by `OFF_TURN`, and at the true position turned about the vertical.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera, Floats, rotation_z
from placegraph.errors import MissingExtraError
from placegraph.indoor.encode import spoken
from placegraph.indoor.refine.matching import Matcher, matcher
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables.indoor.bench import Bench
from placegraph_lab.tables.indoor.metrics import position_error, rotation_error
from placegraph_lab.tables.indoor.report import errors
from placegraph_lab.tables.indoor.windows import COVERED, HALVES
from placegraph_lab.tables.runner import (
    Device,
    OfficeEvery,
    Quick,
    Run,
    Seed,
    markdown,
    number,
    option,
    parts,
    shares,
    table,
)

if TYPE_CHECKING:
    from placegraph.indoor.refine.matching import Matches
    from placegraph.indoor.render import Rendering
    from placegraph_lab.tables.indoor.windows import Window

PIXELS = (3.0, 5.0, 10.0)  # A match is right to within so many pixels of the query
TURNS_DEG = (15.0, 30.0, 45.0)  # views are turned by so much, to the left and to the right
KINDS = ("true", "disturbed", *(f"turned {degrees:.0f}" for degrees in TURNS_DEG))
"""Where views are rendered from."""
OFF = 0.2  # how far a disturbed pose is from the true one [m]
OFF_TURN_DEG = 10.0  # and by how much it is turned about the vertical, to either side
OFF_TILT_DEG = 0.5
"""And about the level axes, normally distributed: gravity is known, but not better than this."""
NEAREST = 0.03
"""The surface of a match is visible to the query where no other is nearer by more than this [m],
and `SLOPE` of its depth."""
SLOPE = 0.02
LIMITS = ((0.10, 5.0), (0.25, 2.0))  # recall of the single view: within [m] and [deg]
REPROJECTION = 8.0  # RANSAC's threshold [px]
FEWEST = 6  # A pose is not sought from fewer matches


@dataclass(frozen=True, eq=False)
class Start:
    """A pose to render from."""

    kind: str  # `true`, `disturbed`, or `turned 15` (degrees, to either side)
    map_from_camera: Floats


def starts(truth: Floats, rng: np.random.Generator) -> list[Start]:
    """True, disturbed and turned poses of a query whose true pose (4, 4) is known."""
    found = [Start("true", truth), Start("disturbed", disturbed(truth, rng))]
    for degrees in TURNS_DEG:
        for side in (-1, 1):
            pose = turned(truth, side * np.radians(degrees))
            found.append(Start(f"turned {degrees:.0f}", pose))
    return found


def disturbed(truth: Floats, rng: np.random.Generator) -> Floats:
    """Pose (4, 4) that is `OFF` away in any direction and turned by `OFF_TURN_DEG` to one side."""
    direction = rng.normal(size=3)
    pose = turned(truth, np.radians(OFF_TURN_DEG) * rng.choice([-1.0, 1.0]))
    x, y = np.radians(OFF_TILT_DEG) * rng.normal(size=2)
    # small turns about the map's level axes, to first order and made orthogonal again
    tilt = np.array([[1.0, 0.0, y], [0.0, 1.0, -x], [-y, x, 1.0]])
    u, _, v = np.linalg.svd(tilt @ pose[:3, :3])
    pose[:3, :3] = u @ v
    pose[:3, 3] += OFF * direction / np.linalg.norm(direction)
    return pose


def turned(pose: Floats, yaw: float) -> Floats:
    """Pose (4, 4) turned on its place about the vertical by `yaw` [rad]."""
    out = pose.copy()
    out[:3, :3] = rotation_z(yaw) @ pose[:3, :3]
    return out


@dataclass(frozen=True, eq=False)
class Query:
    """One frame, its truth and what the map looks like around it."""

    window: Window  # of one frame
    scene: SceneMap
    starts: tuple[Start, ...]

    @property
    def camera(self) -> Camera:
        """Of the frame's colours."""
        return self.window.capture.camera

    @property
    def rgb(self) -> NDArray[np.uint8]:
        """(H, W, 3) uint8."""
        return self.window.capture[-1].rgb()

    @cached_property
    def renderings(self) -> list[Rendering]:
        """The map from each start."""
        from placegraph.indoor.render import render

        return [render(self.scene, s.map_from_camera, self.camera) for s in self.starts]

    def forget(self) -> None:
        """Drop the renderings, 10 MB each."""
        self.__dict__.pop("renderings", None)


def lift(scene: SceneMap, map_from_camera: Floats, camera: Camera, pixels: Floats) -> Floats:
    """Points (N, 3) [m, map] that a camera sees at image points (N, 2) [px]; NaN: nothing."""
    rays = camera.directions(pixels) @ map_from_camera[:3, :3].T
    origins = np.broadcast_to(map_from_camera[:3, 3], rays.shape)
    hits = scene.caster.cast(origins, rays)
    far = np.where(hits.triangle >= 0, hits.distance, np.nan)
    points: Floats = origins + far[:, None] * rays
    return points


def pixel_errors(query: Query, start: Start, matches: Matches) -> tuple[Floats, Floats]:
    """How far matches are from the truth (N,) [px], inf: not visible there; and their points.

    The rendered point is lifted to the map's surface (N, 3), and that is projected with the true
    pose of the query. Where another surface hides it there, no match can be right.
    """
    truth, camera = query.window.truth, query.camera
    points = lift(query.scene, start.map_from_camera, camera, matches.rendered)
    seen = (points - truth[:3, 3]) @ truth[:3, :3]
    at = camera.project(seen)
    errors = np.linalg.norm(at - matches.query, axis=1)
    inside = ((at >= 0) & (at <= [camera.width, camera.height])).all(axis=1)
    visible = np.zeros(len(points), np.bool_)
    if inside.any():
        there = lift(query.scene, truth, camera, at[inside])
        depth = ((there - truth[:3, 3]) @ truth[:3, :3])[:, 2]
        visible[inside] = depth > seen[inside, 2] * (1.0 - SLOPE) - NEAREST
    return np.where(visible, errors, np.inf), points


@dataclass(frozen=True)
class Found:
    """What one matcher found between one query and one view."""

    query: str
    place: str
    changed: bool | None
    covered: float | None
    kind: str
    matches: int
    right: tuple[int, ...]  # matches within each of `PIXELS`
    inliers: int
    metres: float  # error of the single view's pose; inf: none was found
    degrees: float

    def within(self, metres: float, degrees: float) -> bool:
        """Whether the single view's pose is right."""
        return self.metres <= metres and self.degrees <= degrees


def judged(query: Query, start: Start, matches: Matches, seed: int) -> Found:
    """Count what is right, and solve for the pose from this view alone."""
    errors, points = pixel_errors(query, start, matches)
    pose, inliers = solve(query.camera, matches.query, points, seed)
    truth = query.window.truth
    return Found(
        query=query.window.name,
        place=query.window.place,
        changed=query.window.changed,
        covered=query.window.coverage,
        kind=start.kind,
        matches=len(matches),
        right=tuple(int((errors <= limit).sum()) for limit in PIXELS),
        inliers=inliers,
        metres=np.inf if pose is None else position_error(pose, truth),
        degrees=np.inf if pose is None else rotation_error(pose, truth),
    )


def solve(camera: Camera, pixels: Floats, points: Floats, seed: int) -> tuple[Floats | None, int]:
    """map_from_camera (4, 4) from image points (N, 2) [px] and map points (N, 3), by PnP in RANSAC.

    Returns
    -------
    tuple
        The pose, or None where there are too few matches or they agree on none, and its inliers.

    Raises
    ------
    MissingExtraError
        PoseLib is not installed: it comes with placegraph where it has a wheel.

    """
    try:
        import poselib
    except ImportError as error:
        raise MissingExtraError(
            "Poses from matches need PoseLib, which has no wheel here: pip install poselib."
        ) from error
    known = np.isfinite(points).all(axis=1)
    if known.sum() < FEWEST:
        return None, 0
    rays = camera.directions(pixels[known])  # undistorted: PoseLib sees a plain camera
    plain = rays[:, :2] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    found, info = poselib.estimate_absolute_pose(
        plain,
        points[known],
        {
            "model": "PINHOLE",
            "width": camera.width,
            "height": camera.height,
            "params": [camera.fx, camera.fy, camera.cx, camera.cy],
        },
        {"max_reproj_error": REPROJECTION, "seed": seed, "max_iterations": 10_000},
        {"loss_type": "CAUCHY"},
    )
    inliers = int(info["num_inliers"])
    if inliers < FEWEST:
        return None, inliers
    pose = np.eye(4)
    pose[:3, :3] = found.R.T
    pose[:3, 3] = -found.R.T @ found.t
    return pose, inliers


@dataclass(frozen=True)
class Trial:
    """A matcher with options, asked about queries."""

    name: str
    found: tuple[Found, ...]
    seconds: tuple[float, ...]  # of each query with one view, features of both included
    view_seconds: tuple[float, ...] = field(default=())  # of each further view

    @classmethod
    def joined(cls, name: str, parts: Sequence[Trial]) -> Trial:
        """One trial of several."""
        return cls(
            name,
            tuple(f for p in parts for f in p.found),
            tuple(s for p in parts for s in p.seconds),
            tuple(s for p in parts for s in p.view_seconds),
        )


def ask(name: str, matcher: Matcher, queries: Sequence[Query], *, seed: int = 0) -> Trial:
    """Match every query with all its views."""
    found: list[Found] = []
    seconds: list[float] = []
    further: list[float] = []
    for query in queries:
        drawn, rgb = query.renderings, query.rgb
        views, masks = [d.colour for d in drawn], [d.mask for d in drawn]
        began = time.perf_counter()
        matcher.match(rgb, views[:1], masks=masks[:1])
        seconds.append(time.perf_counter() - began)
        began = time.perf_counter()
        results = matcher.match(rgb, views, masks=masks)
        whole = time.perf_counter() - began
        further.append((whole - seconds[-1]) / max(len(views) - 1, 1))
        pairs = zip(query.starts, results, strict=True)
        found += [judged(query, start, matches, seed) for start, matches in pairs]
    return Trial(name, tuple(found), tuple(seconds), tuple(further))


def summary(found: Sequence[Found]) -> dict[str, Any]:
    """Plain numbers of answers to some queries, ready for `json.dumps`."""
    total = sum(f.matches for f in found)
    right = np.sum([f.right for f in found], axis=0)
    errors = np.array([(f.metres, f.degrees) for f in found])
    middle = np.median(errors, axis=0)
    return {
        "pairs": len(found),
        "matches": float(np.median([f.matches for f in found])),
        "right": [float(r) / total if total else None for r in right],
        "right_matches": float(np.median([f.right[1] for f in found])),
        "recall": [float(np.mean([f.within(*limit) for f in found])) for limit in LIMITS],
        "median_error": [float(e) if np.isfinite(e) else None for e in middle],
        "inliers": float(np.median([f.inliers for f in found])),
    }


PARTS: dict[str, Callable[[Found], object]] = {
    "house, unchanged": lambda f: f.changed is False,
    "house, changed": lambda f: f.changed is True,
    f"office, covered to {COVERED:.0%} or more": lambda f: (f.covered or 0.0) >= COVERED,
    "office, the others": lambda f: f.covered is not None and f.covered < COVERED,
}
"""Queries told apart."""
HEADER = [
    "", "matches",
    f"right to {'/'.join(f'{p:.0f}' for p in PIXELS)} px",
    f"right to {PIXELS[1]:.0f} px, number", "inliers",
    " / ".join(f"{100 * m:.0f} cm {d:.0f}°" for m, d in LIMITS), "median error",
]  # fmt: skip


def report(trials: Sequence[Trial]) -> str:
    """A table for each part and start, a row for each matcher; last what they cost."""
    parts = []
    for part, keep in PARTS.items():
        for kind in KINDS:
            lines, pairs = [], 0
            for trial in trials:
                found = [f for f in trial.found if f.kind == kind and keep(f)]
                if found:
                    pairs = len(found)
                    s = summary(found)
                    lines.append(
                        [
                            trial.name,
                            number(s["matches"]),
                            shares(s["right"]),
                            number(s["right_matches"]),
                            number(s["inliers"]),
                            shares(s["recall"]),
                            errors(s["median_error"]),
                        ]
                    )
            if lines:
                parts += [f"#### {part}, view {kind}, {pairs} pairs", markdown(HEADER, lines)]
    cost = [
        [t.name, number(np.median(t.seconds), 3), number(np.median(t.view_seconds), 3)]
        for t in trials
    ]
    parts += ["#### Seconds", markdown(["", "query and one view", "each further view"], cost)]
    return "\n\n".join(parts)


def to_dict(trial: Trial) -> dict[str, Any]:
    """Plain numbers of every part and start, ready for `json.dumps`."""
    rows = {
        f"{part}, {kind}": summary(found)
        for part, keep in PARTS.items()
        for kind in KINDS
        if (found := [f for f in trial.found if f.kind == kind and keep(f)])
    }
    return {
        "matcher": trial.name,
        "seconds": float(np.median(trial.seconds)),
        "view_seconds": float(np.median(trial.view_seconds)),
        "parts": rows,
    }


MATCHERS = "sift; sift upright=False; xfeat; xfeat least=0.82; xfeat dense=True"
EVERY, OFFICE_EVERY = 5, 6


class Part(StrEnum):
    """Which queries of each place are asked."""

    ALL = "all"
    EVEN = "even"
    ODD = "odd"

    @property
    def rows(self) -> slice:
        """Of the place's queries."""
        return {"all": slice(None), "even": slice(0, None, 2), "odd": slice(1, None, 2)}[self.value]


def made(spec: str, weights: Path, device: str) -> Matcher:
    """Matcher of a name and options: `sift ratio=0.8`."""
    name, chosen = spoken(spec)
    if name == "xfeat":
        chosen["weights"] = weights
    return matcher(name, device=device, **chosen)


def queries(bench: Bench, place: str, seed: int) -> list[Query]:
    """Single frames of a place, with the poses to render from."""
    rng = np.random.default_rng(seed)
    scene = bench.scene(place)
    return [Query(w, scene, tuple(starts(w.truth, rng))) for w in bench.windows(place, 1)]


@table()
def indoor_matchers(
    run: Run,
    only: Annotated[str, option("Matchers, with semicolons between.")] = MATCHERS,
    every: Annotated[int, option("Frames of the house from query to query.")] = EVERY,
    office_every: OfficeEvery = OFFICE_EVERY,
    seed: Seed = 0,
    device: Device = "cpu",
    *,
    part: Annotated[Part, option("Queries: even ones tune, odd ones test.")] = Part.ALL,
    quick: Quick = False,
) -> None:
    """Which matches of photographs with renderings of the map are right? House and office."""
    specs = parts(only, ";")
    if quick:
        specs, every, office_every = specs[:2], 50, 60
    weights = run.shared / "weights/xfeat.pt"
    matchers = {spec: made(spec, weights, device) for spec in specs}
    bench = Bench(run.data, run.cache, every, office_every)
    told: dict[str, list[Trial]] = {spec: [] for spec in specs}
    for place in ("house", *HALVES):
        for query in run.track(queries(bench, place, seed)[part.rows], place):
            for spec, its in matchers.items():
                told[spec].append(ask(spec, its, [query], seed=seed))
            query.forget()
    trials = [Trial.joined(spec, found) for spec, found in told.items()]
    print(report(trials))
    whole = only == MATCHERS and part is Part.ALL
    run.save({"part": part.value, "rows": [to_dict(t) for t in trials]}, whole=whole)
