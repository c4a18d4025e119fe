"""Does refining bring a pose to centimetres? Errors before and after, harm, covariances and time.

Every answer is written down at once: run it again and it goes on where it was cut.
`docs/benchmarks/indoor.md#refinement` explains the protocol.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any

from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.refine.matching import Matcher, matcher
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables import runner as lab
from placegraph_lab.tables.indoor import refine as rows_of
from placegraph_lab.tables.indoor.bench import BARE, QUICK_EVERY, Bench, Job, choose_jobs
from placegraph_lab.tables.indoor.metrics import AXES
from placegraph_lab.tables.indoor.refine import (
    GICP,
    LIMITS,
    MATCHERS,
    PAPER,
    STARTS,
    RefineJob,
    RefineOutcome,
    refine_jobs,
    refine_score,
    spread,
)
from placegraph_lab.tables.indoor.report import (
    Row,
    ask_windows,
    by_job,
    changes_table,
    errors,
    is_covered,
)
from placegraph_lab.tables.indoor.windows import (
    COVERED,
    EVERY,
    LENGTHS,
    OFFICE_EVERY,
    Window,
)
from placegraph_lab.tables.named.indoor_few import SETS, Maps
from placegraph_lab.tables.runner import Column as Col

ask = rows_of.ask
HALVES = {f"{name}, other half": name for name in ("freiburg1_rpy", "patio")}
"""Windows of the second half of a recording, in a map of the first; `office b in a` is another."""
RECORDED = {**{name: f"{name}, even frames mapped" for name in SETS}, **{n: n for n in HALVES}}
PLACES = rows_of.PLACES | RECORDED
NEAREST = LIMITS.index((0.10, 5.0))
RECALLS = " / ".join(f"{100 * m:.0f} cm {d:.0f}°" for m, d in LIMITS)
SCORES = (
    Col("", "0"), Col("windows", "1.windows"),
    Col("mean before", "1.before.mean", errors),
    Col("after", "1.after.mean", errors),
    Col("median before", "1.before.median", errors),
    Col("after", "1.after.median", errors),
    Col(f"{RECALLS} before", "1.before.recall", lab.shares),
    Col("after", "1.after.recall", lab.shares),
    Col("accepted", "1.accepted", lab.share), Col("harmful", "1.harmful", lab.share),
    Col("wrongly refused", "1.wrongly_refused", lab.share),
    Col("s refining", "1.refine_seconds", 2), Col("s in all", "1.seconds", 2),
)  # fmt: skip
SPREADS = (
    Col("", "0"), Col("poses", "1.count"),
    *(Col(f"rms {axis}", f"1.rms.{i}", 2) for i, axis in enumerate(AXES)),
    Col("within 1 / 2 / 3 σ",
        lambda r: lab.shares(sum(w) / len(w) for w in r[1]["within_sigma"].values())),
    Col("within the 95 % ellipsoid", "1.within_95_percent", lab.share),
    Col("squared: all six", "1.nees", 1), Col("least certain direction", "1.free", 2),
)  # fmt: skip
NORMAL = [
    "*a normal distribution*",
    "–",
    *["1.00"] * len(AXES),
    ".68/.95/1.00",
    ".95",
    "6.0",
    "1.00",
]


def report(rows: Sequence[Row]) -> str:
    text: list[str] = []
    for place, place_title in PLACES.items():
        for start, start_title in STARTS.items():
            mine = [r for r in rows if (r.job.place, r.job.start) == (place, start)]
            for length in sorted({r.length for r in mine}):
                lines = [line for r in mine if r.length == length for line in _lines(r)]
                text += [f"#### {place_title}, {start_title}, {length} frames"]
                text += [lab.render(SCORES, lines)]
    house = [r for r in rows if r.job.place == "house"]
    if house:
        recall = lambda s: s.after.recall[NEAREST]  # noqa: E731
        text += [
            "#### House, unchanged / changed scenes, 10 cm 5° after",
            changes_table(house, recall),
        ]
    own = [r for r in rows if r.job.by not in GICP and not r.job.by.endswith(PAPER)]
    if own:
        spread_rows: list[Any] = [
            (f"{job.name}: {kind}", found)
            for job, of in by_job(own)
            for kind, found in spreads(*of.values()).items()
            if found["count"]
        ]
        text += [
            "#### Errors over standard deviations",
            lab.render(SPREADS, [*spread_rows, NORMAL]),
        ]
    harmful = [
        f"- {r.job.name}, {r.length} frames: {'; '.join(r.score.worst)}"
        for r in own
        if r.score.worst
    ]
    if harmful:
        text += ["#### Accepted, and worse than before", "\n".join(harmful)]
    return "\n\n".join(text)


def _lines(row: Row) -> list[tuple[str, Any]]:
    inside = row.part(is_covered)
    lines = [(row.job.row, row.score)]
    if inside and inside.windows < row.score.windows:
        lines.append((f"{row.job.row}: covered to {COVERED:.0%} or more", inside))
    return lines


def spreads(*rows: Row) -> dict[str, dict[str, Any]]:
    """Errors over standard deviations of refined poses, and of those left coarse."""
    results = [r for row in rows for r in row.results]
    kinds = {"refined": True, "left coarse": False}
    return {k: spread([r for r in results if r.accepted is v]) for k, v in kinds.items()}


class Recordings(Bench):
    """Maps and windows of the benchmark, and of the recordings of `indoor_few`."""

    few: Maps

    def scene(self, name: str) -> SceneMap:
        if name in HALVES:
            count = len(self.few.source(HALVES[name]).capture)
            made = self.few.scene(HALVES[name], 0, count // 2, max(1, count // 240))
            return replace(made, landmarks=None)
        if name not in SETS:
            return super().scene(name)
        return replace(self.few.scene(name, 0, None, 2), landmarks=None)

    def windows(self, place: str, length: int) -> list[Window]:
        """Return windows as `Bench` does, and of a recording every second one, at most 24."""
        if place in HALVES:
            source = self.few.source(HALVES[place])
            asked = slice(len(source.capture) // 2 + 1, None)
            return source.windows(asked, length, 48)[::2]
        if place not in SETS:
            return super().windows(place, length)
        return self.few.source(place).windows(slice(1, None, 2), length, 48)[::2]


def recording_jobs() -> list[RefineJob]:
    """Return a row for each recording of `indoor_few`: from the pose found by depth and colour."""
    options, row = PoseSearchOptions().only(**BARE["depth + colour"]), "depth + colour"
    return [
        RefineJob(name, "found", row, "auto", Job("none", row, options, name, "none"))
        for name in RECORDED
    ]


@lab.table("SG2Loc, Tables 1, 2, 4, 7, 9, 10")
def indoor_refine(
    run: lab.Run,
    only: Annotated[
        str, lab.option("Rows, with semicolons between: 'house found: *; b in a disturbed: *'.")
    ] = "",
    windows: Annotated[str, lab.option("Frames of a window.")] = ",".join(map(str, LENGTHS)),
    matchers: Annotated[str, lab.option("What refines, with commas.")] = ",".join(MATCHERS),
    every: lab.Every = EVERY,
    office_every: lab.OfficeEvery = OFFICE_EVERY,
    seed: lab.Seed = 0,
    device: lab.Device = "auto",
    *,
    quick: lab.Quick = False,
    fresh: lab.Fresh = False,
) -> None:
    """Errors of poses before and after refinement, harm, covariances and time."""
    names = lab.parts(only, ";")
    if quick:
        windows, every, office_every = "5,10", QUICK_EVERY, 2 * OFFICE_EVERY
        names = names or list(rows_of.QUICK)
    jobs = choose_jobs([*refine_jobs(lab.parts(matchers)), *recording_jobs()], names)
    bench = Recordings(run.data, run.cache, every, office_every)
    bench.few = Maps(run, fresh=False)
    weights = run.shared / "weights/xfeat.pt"
    made: dict[str, str | Matcher] = {word: word for word in ("auto", "guided", *GICP)}

    def once(job: RefineJob, window: Window, seed: int) -> RefineOutcome:
        name = job.matcher
        if name not in made:
            own = weights if name == "xfeat" and weights.exists() else None
            made[name] = matcher(name, weights=own)
        scene = bench.scene(job.place)
        return ask(job, scene, window, matcher=made[name], seed=seed, device=device)

    lengths = [int(n) for n in windows.split(",")]
    asked = ask_windows(
        run, jobs, bench, lambda _: lengths, once, seed=seed, device=device, fresh=fresh
    )
    rows = [
        Row(job, n, tuple(map(RefineOutcome.from_dict, told)), refine_score)
        for job, n, told in asked
    ]
    print(report(rows))
    run.save(
        {"rows": [row.record() | {"normalised_errors": spreads(row)} for row in rows]},
        complete=not names,
    )
