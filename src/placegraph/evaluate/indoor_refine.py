"""The rows of the refinement's benchmark: from where, by what, and asking for them.

From where: from the pose that localizing finds ("found"), or from one 0.2 m and 10 degrees off the
true one ("disturbed"), which shows the refiner alone. By what: the word for a matcher, `auto`,
`none` (depth alone), or small_gicp, which aligns depth alone and knows no verdict.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from placegraph.evaluate.indoor_gicp import align
from placegraph.evaluate.indoor_jobs import ANSWERING, BARE, SEMANTIC, Job, encoder_of
from placegraph.evaluate.indoor_refine_metrics import Refined, measure_pose, measure_refined
from placegraph.evaluate.indoor_starts import start_of, without_depth
from placegraph.evaluate.indoor_windows import HALVES
from placegraph.indoor.options import FilterOptions

if TYPE_CHECKING:
    from collections.abc import Sequence

    from placegraph.evaluate.indoor_gicp import Kind
    from placegraph.evaluate.indoor_windows import Window
    from placegraph.indoor.matching import Matcher
    from placegraph.indoor.scene_map import SceneMap

Start = Literal["found", "disturbed"]

REFINING = (
    *ANSWERING, "evaluate/indoor_refine.py", "evaluate/indoor_refine_metrics.py",
    "evaluate/indoor_starts.py", "evaluate/indoor_gicp.py", "evaluate/indoor_jobs.py",
)  # fmt: skip
"""Code that decides what the answers are."""
MATCHERS = ("auto", "none", "sift", "xfeat")
"""What refines, if nothing else is asked for; `none` is depth alone."""
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
    """What localizing looks at: `semantic + depth`; from a disturbed start `depth` or `no depth`."""
    by: str
    """Word for a matcher, or a key of `GICP`."""
    coarse: Job | None = None
    """How the pose is found; None from a disturbed start."""

    @property
    def name(self) -> str:
        """`house found: semantic + depth, sift`."""
        return f"{self.place} {self.start}: {self.row}"

    @property
    def row(self) -> str:
        """`semantic + depth, sift`."""
        return f"{self.seen}, {self.by}"

    @property
    def depth(self) -> bool:
        """Whether the capture has depth."""
        return self.coarse.options.depth if self.coarse else self.seen == "depth"

    def key(self, window: Window, seed: int, code: str) -> str:
        """What an answer depends on."""
        coarse = self.coarse.key(window, seed, code) if self.coarse else f"{code} {window.name}"
        return f"{coarse} seed {seed} {self.name} depth {self.depth}"


def refine_jobs(matchers: Sequence[str] = MATCHERS) -> list[RefineJob]:
    """All rows: each way to find a pose, or each disturbed start, by each matcher that it allows."""
    return [
        job
        for place in PLACES
        for job in (*_found_jobs(place, matchers), *_disturbed_jobs(place, matchers))
    ]


def _found_jobs(place: str, matchers: Sequence[str]) -> list[RefineJob]:
    """Labels only, and with depth, by all matchers; without labels, by the default."""
    if place in HALVES:
        ways = [(f"no labels: {row}", Job(place, row, _only(**BARE[row]), place, "none"))
                for row in ("depth + colour", "colour")]  # fmt: skip
        every = 1
    else:
        ways = [(row, Job("instances", row, _only(**SEMANTIC[row]), "house", "instances"))
                for row in ("semantic", "semantic + depth")]  # fmt: skip
        ways += [(f"no labels: {row}", Job("none", row, _only(**BARE[row]), "house", "none"))
                 for row in ("depth + colour", "colour")]  # fmt: skip
        every = 2
    return [
        RefineJob(place, "found", seen, by, coarse)
        for i, (seen, coarse) in enumerate(ways)
        for by in _allowed(matchers if i < every else matchers[:1], depth=coarse.options.depth)
    ]


def _disturbed_jobs(place: str, matchers: Sequence[str]) -> list[RefineJob]:
    with_depth = [*_allowed(matchers, depth=True), *GICP]
    return [
        *(RefineJob(place, "disturbed", "depth", by) for by in with_depth),
        *(RefineJob(place, "disturbed", "no depth", by) for by in _allowed(matchers, depth=False)),
    ]


def _allowed(matchers: Sequence[str], *, depth: bool) -> list[str]:
    """Without depth and without matches nothing is left to refine by."""
    return [m for m in matchers if depth or m != "none"]


def _only(**terms: bool) -> FilterOptions:
    return FilterOptions().only(**terms)


QUICK = (
    "house found: semantic, auto", "house found: semantic + depth, auto",
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
        The matcher that `job.by` names: a word, or the matcher itself where it needs weights.
    seed
        Of the filter, of the label noise and of the disturbed starts.
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
            refine=True,
            matcher=matcher,
        )
        return measure_refined(estimate, window, seconds=time.perf_counter() - began)
    start = start_of(window, seed)
    began = time.perf_counter()
    if job.by in GICP:
        pose = align(scene, list(capture), start, kind=GICP[job.by]).map_from_camera
        return measure_pose(pose, window, seconds=time.perf_counter() - began, start=start)
    estimate = scene.refine(capture, start, matcher=matcher)
    return measure_refined(estimate, window, seconds=time.perf_counter() - began, start=start)
