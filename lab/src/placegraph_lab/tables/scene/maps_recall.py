"""What a smaller map costs: the same windows and seeds asked on every size of a map, in pairs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from placegraph_lab.tables.indoor import refine as indoor_refine
from placegraph_lab.tables.indoor.jobs import ANSWERING, Job, ask, house_jobs, office_jobs
from placegraph_lab.tables.indoor.metrics import Answer, rounded, score
from placegraph_lab.tables.indoor.refine import RefineJob, refine_jobs
from placegraph_lab.tables.indoor.refine_metrics import Refined, refine_score
from placegraph_lab.tables.indoor.windows import (
    COVERED,
    HALVES,
    OFFICE_LENGTH,
    Window,
    covered,
    house_windows,
    office_windows,
)
from placegraph_lab.tables.runner import fingerprint
from placegraph_lab.tables.scene.maps import FULL, Maps, Size

ROWS = (
    "instances: semantic", "instances: semantic + depth", "none: depth + colour",
    "b in a: depth + colour", "a in b: depth + colour",
)  # fmt: skip
"""Of the protocol of `indoor_filter`."""
REFINED_ROWS = (
    "house found: all, auto", "house disturbed: no depth, auto",
    "b in a disturbed: no depth, auto", "a in b disturbed: no depth, auto",
)  # fmt: skip
"""Of the protocol of `indoor_refine`: where textures matter, images refine alone."""
REFINED_SIZES = ("full", "default", "small")
LENGTHS = (5, 10)
"""Frames of the house's windows; refining gets the longer ones."""
LIMITS = {"house": ((0.10, 5.0), (0.25, 2.0)), "office": ((0.10, 5.0), (0.25, 10.0))}
"""Position [m] and rotation [deg] that a recall allows; the second is what the aims count."""


@dataclass(frozen=True)
class Finding:
    """A row of `indoor_filter`, for windows of one length."""

    job: Job
    length: int

    @property
    def name(self) -> str:
        """`instances: semantic, 5 frames`."""
        return f"{self.job.name}, {self.length} frames"

    @property
    def place(self) -> str:
        """Where it asks."""
        return self.job.map


@dataclass(frozen=True)
class Refining:
    """A row of `indoor_refine`, for windows of one length."""

    job: RefineJob
    length: int = LENGTHS[-1]

    @property
    def name(self) -> str:
        """`house disturbed: no depth, auto, 10 frames`."""
        return f"{self.job.name}, {self.length} frames"

    @property
    def place(self) -> str:
        """Where it asks."""
        return self.job.place


def findings() -> list[Finding]:
    """All rows of recall."""
    jobs = [j for j in (*house_jobs(), *office_jobs()) if j.name in ROWS]
    return [
        Finding(j, n) for j in jobs for n in ((OFFICE_LENGTH,) if j.table in HALVES else LENGTHS)
    ]


def refinings() -> list[Refining]:
    """All rows of refinement."""
    return [Refining(j) for j in refine_jobs(("auto",)) if j.name in REFINED_ROWS]


class Asking:
    """Asks about windows on maps of any size, what was answered before not again.

    Parameters
    ----------
    maps
        The maps; their journal holds the answers, too.
    every, office_every
        Frames from the start of a window to the next, in the house and in the office.
    seed
        Of the filter, the label noise and disturbed starts.
    device
        For the filter.

    """

    def __init__(
        self, maps: Maps, every: int, office_every: int, *, seed: int = 0, device: str = "auto"
    ) -> None:
        self.maps, self.every, self.office_every = maps, every, office_every
        self.seed, self.device = seed, device
        self._codes = (fingerprint(ANSWERING),) * 2
        self._windows: dict[tuple[str, int], list[Window]] = {}

    def windows(self, place: str, length: int) -> list[Window]:
        """Windows of a place; of the office those that its full map covers, for all sizes."""
        if (place, length) not in self._windows:
            data = self.maps.data
            if place in HALVES:
                full = self.maps.scene(place, FULL)
                made = office_windows(
                    data / "office", place, length=length, every=self.office_every
                )
                made = [covered(full, w) for w in made]
                made = [w for w in made if w.coverage is not None and w.coverage >= COVERED]
            else:
                made = house_windows(data / "house", length, every=self.every)
            self._windows[place, length] = made
        return self._windows[place, length]

    def found(self, row: Finding, size: Size) -> list[Answer]:
        """Answers of a row on a map."""
        windows = self.windows(row.place, row.length)
        keys = [row.job.key(w, self.seed, self._codes[0]) for w in windows]

        def once(window: Window, seed: int) -> dict[str, Any]:
            scene = self.maps.scene(row.place, size)
            return ask(row.job, scene, window, seed=seed, device=self.device).to_dict()

        rows = self._asked(row, size, windows, keys, once)
        return [Answer.from_dict(r) for r in rows]

    def refined(self, row: Refining, size: Size) -> list[Refined]:
        """Refined poses of a row on a map."""
        windows = self.windows(row.place, row.length)
        keys = [row.job.key(w, self.seed, self._codes[1]) for w in windows]

        def once(window: Window, seed: int) -> dict[str, Any]:
            scene = self.maps.scene(row.place, size)
            return indoor_refine.ask(
                row.job, scene, window, matcher=row.job.matcher, seed=seed, device=self.device
            ).to_dict()

        return [Refined.from_dict(r) for r in self._asked(row, size, windows, keys, once)]

    def _asked(
        self,
        row: Finding | Refining,
        size: Size,
        windows: Sequence[Window],
        keys: Sequence[str],
        once: Callable[[Window, int], dict[str, Any]],
    ) -> list[dict[str, Any]]:
        """Plain answers to all windows; `once` asks about one, with a seed."""
        journal = self.maps.journal
        digest = self.maps.made(row.place, size).digest
        keys = [f"{digest} {key} {self.device}" for key in keys]
        asked = len(journal.missing(keys))
        if asked:
            self.maps.tell(f"{size.name}: {row.name}, {asked} windows")
        return journal.filled(
            keys,
            lambda i: once(windows[i], self.seed),
            warm=lambda: once(windows[0], self.seed + 1),
        )


@dataclass(frozen=True)
class Paired:
    """Answers on a map beside those on the full one, to the same windows."""

    row: str
    size: str
    answers: tuple[Answer, ...]
    full: tuple[Answer, ...]
    limits: tuple[tuple[float, float], ...]

    @property
    def recalls(self) -> tuple[float, ...]:
        """Share of answers within each of `limits`."""
        return tuple(
            sum(a.within(*w) for a in self.answers) / len(self.answers) for w in self.limits
        )

    @property
    def steps(self) -> tuple[int, ...]:
        """Of each window 1: gained, -1: lost, 0: as on the full map; by the last of `limits`."""
        limits = self.limits[-1]
        return tuple(
            a.within(*limits) - b.within(*limits)
            for a, b in zip(self.answers, self.full, strict=True)
        )

    @property
    def lost(self) -> list[str]:
        """Windows that are right on the full map only: `seq01 13:18 0.41 m 3.2 deg`."""
        return [
            f"{a.window} {a.position:.2f} m {a.rotation:.1f} deg"
            for a, step in zip(self.answers, self.steps, strict=True)
            if step < 0
        ]

    @property
    def gained(self) -> list[str]:
        """Windows that are right on this map only."""
        return [a.window for a, step in zip(self.answers, self.steps, strict=True) if step > 0]

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings, ready for `json.dumps`."""
        return {
            "row": self.row,
            "size": self.size,
            "gained": self.gained,
            "lost": self.lost,
            "score": score(self.answers).to_dict(),
        }


def difference(steps: Sequence[int]) -> tuple[float, float]:
    """Points of recall that a map gains over the full one, and their standard error.

    The error is that of paired answers: what both maps find or miss has no part in it.
    """
    if not steps:
        return math.nan, math.nan
    points = 100.0 * np.array(steps, np.float64)
    return float(points.mean()), float(points.std() / math.sqrt(len(points)))


def study(asking: Asking, rows: Sequence[Finding], sizes: dict[str, list[Size]]) -> list[Paired]:
    """All rows on all sizes of their places, map by map."""
    found = []
    for place in dict.fromkeys(r.place for r in rows):
        own = [r for r in rows if r.place == place]
        for size in (FULL, *(s for s in sizes[place] if s != FULL)):
            found += [
                Paired(
                    row.name,
                    size.name,
                    tuple(asking.found(row, size)),
                    tuple(asking.found(row, FULL)),
                    LIMITS["office" if place in HALVES else "house"],
                )
                for row in own
                if asking.windows(place, row.length)
            ]
    return found


def refinement(
    asking: Asking, rows: Sequence[Refining], sizes: dict[str, list[Size]]
) -> list[dict[str, Any]]:
    """Refined poses of all rows on the sizes that `REFINED_SIZES` names, summarized."""
    found = []
    for row in rows:
        for size in (s for s in sizes[row.place] if s.name in REFINED_SIZES):
            if results := asking.refined(row, size):
                summary = refine_score(results).to_dict()
                found.append({"row": row.name, "size": size.name} | summary)
    return found


def recall_of(pairs: Sequence[Paired]) -> float | None:
    """Recall by the last of the limits, all rows pooled."""
    answers = [(a, p.limits[-1]) for p in pairs for a in p.answers]
    if not answers:
        return None
    return rounded(sum(a.within(*limits) for a, limits in answers) / len(answers), 4)
