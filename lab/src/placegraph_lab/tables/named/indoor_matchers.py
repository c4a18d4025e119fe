"""Which matches of photographs with renderings of the map are right? House and office.

    placegraph-lab table indoor_matchers
    placegraph-lab table indoor_matchers --only "sift; xfeat scale=1.5" --part odd

Prints Markdown tables and writes every row as JSON. A matcher is a name and options, such as
`xfeat dense=True`. The matchers' defaults were chosen on even queries; all are reported, and
`--part odd` asks those that nobody tuned on. `docs/benchmarks.md` explains the protocol.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from placegraph.indoor.encode import spoken
from placegraph.indoor.refine.matching import Matcher, matcher
from placegraph_lab.tables.indoor.bench import Bench
from placegraph_lab.tables.indoor.matches import (
    KINDS,
    LIMITS,
    PIXELS,
    Found,
    Query,
    Trial,
    ask,
    starts,
    summary,
)
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
                    lines.append(line(trial.name, found))
            if lines:
                parts += [f"#### {part}, view {kind}, {pairs} pairs", markdown(HEADER, lines)]
    cost = [
        [t.name, number(np.median(t.seconds), 3), number(np.median(t.view_seconds), 3)]
        for t in trials
    ]
    parts += ["#### Seconds", markdown(["", "query and one view", "each further view"], cost)]
    return "\n\n".join(parts)


def line(name: str, found: Sequence[Found]) -> list[str]:
    """Cells of `HEADER`."""
    s = summary(found)
    return [
        name,
        number(s["matches"]),
        shares(s["right"]),
        number(s["right_matches"]),
        number(s["inliers"]),
        shares(s["recall"]),
        errors(s["median_error"]),
    ]


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
