"""The rows of the refinement's benchmark: from where, by what, and asking for them.

From where: from the pose that localizing finds ("found"), or from one 0.2 m and 10 degrees off the
true one ("disturbed"), which shows the refiner alone. By what: `auto`, the default; the word for a
matcher, whose matches then always take part; `none`, depth alone; a matcher with the paper's recipe;
or small_gicp, which aligns depth alone and knows no verdict.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from placegraph.indoor.options import FilterOptions
from placegraph.indoor.refine.matching import Matcher
from placegraph.indoor.refine.options import RefineOptions
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables.indoor.gicp import Kind, align
from placegraph_lab.tables.indoor.jobs import BARE, SEMANTIC, Job, encoder_of
from placegraph_lab.tables.indoor.refine_metrics import Refined, measure_pose, measure_refined
from placegraph_lab.tables.indoor.starts import start_of, without_depth
from placegraph_lab.tables.indoor.windows import Window

Start = Literal["found", "disturbed"]

MATCHERS = ("auto", "none", "guided", "sift", "xfeat")
"""What refines, if nothing else is asked for; `none` is depth alone."""
PAPER = ", paper's recipe"
"""What follows the word for a matcher where `RefineOptions.paper()` is meant: images alone."""
GICP: dict[str, Kind] = {"small_gicp, plane": "PLANE_ICP", "small_gicp, GICP": "GICP"}
PLACES = {
    "house": "House",
    "b in a": "Office, map of frames 0-185, asked about 186-372",
    "a in b": "Office, map of frames 186-372, asked about 0-185",
}
STARTS: dict[Start, str] = {
    "found": "from the pose found",
    "disturbed": "from 0.2 m and 10 degrees off",
}


@dataclass(frozen=True)
class RefineJob:
    """One row of a table, for windows of any length."""

    place: str
    """Key of `PLACES`."""
    start: Start
    seen: str
    """What localizing looks at: `all`; from a disturbed start `depth` or `no depth`."""
    by: str
    """`auto`, `none`, the word for a matcher, the same with `PAPER` behind it, or a key of `GICP`."""
    coarse: Job | None = None
    """How the pose is found; None from a disturbed start."""

    @property
    def name(self) -> str:
        """`house found: all, sift`."""
        return f"{self.place} {self.start}: {self.row}"

    @property
    def row(self) -> str:
        """`all, sift`."""
        return f"{self.seen}, {self.by}"

    @property
    def depth(self) -> bool:
        """Whether the capture has depth."""
        return self.coarse.options.depth if self.coarse else self.seen == "depth"

    @property
    def matcher(self) -> str:
        """Word for the matcher."""
        return "auto" if self.by == "none" else self.by.removesuffix(PAPER)

    @property
    def options(self) -> RefineOptions:
        """How to refine: a matcher that is named takes part even where depth would do."""
        if self.by.endswith(PAPER):
            return RefineOptions.paper()
        return RefineOptions(images="auto" if self.by == "auto" else self.by != "none")

    def key(self, window: Window, seed: int, code: str) -> str:
        """What an answer depends on."""
        coarse = self.coarse.key(window, seed, code) if self.coarse else f"{code} {window.name}"
        return f"{coarse} seed {seed} {self.name} depth {self.depth} {self.options}"


def refine_jobs(matchers: Sequence[str] = MATCHERS) -> list[RefineJob]:
    """All rows: each way to find a pose, or each disturbed start, by each matcher that it allows."""
    return [
        job
        for place in PLACES
        for job in (*_found_jobs(place, matchers), *_disturbed_jobs(place, matchers))
    ]


def _found_jobs(place: str, matchers: Sequence[str]) -> list[RefineJob]:
    """By all matchers where most is known, with depth and without; else by the first.

    A sense that localizing does without is not refined by either: colours are always on.
    """
    ways: list[tuple[Job, Sequence[str]]] = []
    if place == "house":
        for row in ("all", "semantic + colour"):
            options = FilterOptions().only(**SEMANTIC[row])
            ways.append((Job("instances", row, options, place, "instances"), matchers))
    for row in ("depth + colour", "colour"):
        job = Job("none", f"no labels: {row}", FilterOptions().only(**BARE[row]), place, "none")
        ways.append((job, matchers[:1] if place == "house" else matchers))
    return [
        RefineJob(place, "found", job.row, by, job)
        for job, by_these in ways
        for by in _allowed(by_these, depth=job.options.depth)
    ]


def _disturbed_jobs(place: str, matchers: Sequence[str]) -> list[RefineJob]:
    with_depth = [*_allowed(matchers, depth=True), *GICP]
    return [
        *(RefineJob(place, "disturbed", "depth", by) for by in with_depth),
        *(RefineJob(place, "disturbed", "no depth", by) for by in _allowed(matchers, depth=False)),
    ]


def _allowed(matchers: Sequence[str], *, depth: bool) -> list[str]:
    """What can refine: without depth also by the paper's recipe, and never by nothing."""
    if depth:
        return list(matchers)
    named = [m for m in matchers if m not in {"auto", "none", "guided"}]
    default = [m for m in matchers if m == "auto"]  # without depth the same as `guided`
    return [*default, *named, *(f"{m}{PAPER}" for m in named)]


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
) -> Refined:
    """Refine the pose of a window's last frame and measure it.

    The true pose is used to make a disturbed start and to measure, for nothing else. From a found
    pose one run gives both sides: the coarse pose stands in the estimate beside the refined one.

    Parameters
    ----------
    job
        From where and by what.
    scene
        The map.
    window
        Frames, and the truth.
    matcher
        What `job.matcher` names: the word, or the matcher itself where it has weights.
    seed
        Of the filter, of the label noise, of the disturbed starts and of the search there.
    device
        For the filter.

    """
    capture = window.capture if job.depth else without_depth(window.capture)
    if job.coarse is not None:
        encoder = encoder_of(job.coarse, scene, window, seed)
        began = time.perf_counter()
        estimate = scene.localize(
            capture,
            encoder=encoder,
            options=job.coarse.options,
            seed=seed,
            device=device,
            refine=job.options,
            matcher=matcher,
        )
        return measure_refined(estimate, window, seconds=time.perf_counter() - began)
    start = start_of(window, seed)
    began = time.perf_counter()
    if job.by in GICP:
        pose = align(scene, list(capture), start, kind=GICP[job.by]).map_from_camera
        return measure_pose(pose, window, seconds=time.perf_counter() - began, start=start)
    estimate = scene.refine(capture, start, matcher=matcher, options=job.options, seed=seed)
    return measure_refined(estimate, window, seconds=time.perf_counter() - began, start=start)
