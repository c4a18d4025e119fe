"""What is each encoder worth to the particle filter? Alone, and with depth and colour beside it.

    placegraph-lab table indoor_semantics --every 13
    placegraph-lab table indoor_semantics --only "house: labels: *" --windows 5,10

Prints Markdown in the shape of the paper's Tables 7 and 8, and writes every row as JSON. Nothing is
refined. Every answer is written down at once: run it again and it goes on where it was cut.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

from placegraph_lab.tables.indoor.bench import Asker
from placegraph_lab.tables.indoor.jobs import ANSWERING, QUICK_EVERY, chosen
from placegraph_lab.tables.indoor.metrics import THRESHOLDS, Answer, Score, score
from placegraph_lab.tables.indoor.semantics import NONE, Case, SemanticBench, ask, available, cases
from placegraph_lab.tables.indoor.windows import EVERY, OFFICE_EVERY, Window
from placegraph_lab.tables.runner import (
    Device,
    Every,
    Fresh,
    OfficeEvery,
    Quick,
    Run,
    Seed,
    fingerprint,
    markdown,
    number,
    option,
    parts,
    share,
    table,
)

LIMITS = ((0.10, 5.0), (0.25, 10.0), (0.25, 2.0))
"""Recalls that are shown; the first two are the paper's."""
TITLES = {
    "house": "House, 30 % of the labelled patches wrong",
    "b in a": "Office, map of frames 0-185, asked about 186-372",
    "a in b": "Office, map of frames 186-372, asked about 0-185",
}
HEADER = [
    "encoder", "terms", "windows", "mean", "median", *(f"R@{100 * m:.0f}cm {d:.0f}°" for m, d in LIMITS),
    "OK", "OK right", "s/frame",
]  # fmt: skip


@dataclass(frozen=True)
class Published:
    """A row of the paper: 3RScan, 5 frames."""

    terms: str
    mean: tuple[float, float] | None
    median: tuple[float, float] | None
    recall: tuple[float, float]
    source: str


PUBLISHED = (
    Published("semantic", (1.20, 21.44), (0.66, 8.77), (0.08, 0.26), "Table 8, 3RScan"),
    Published("depth", (1.44, 39.01), (0.96, 6.42), (0.09, 0.32), "Table 8, 3RScan"),
    Published("colour", (1.79, 44.78), (1.51, 17.37), (0.14, 0.20), "Table 8, 3RScan"),
    Published("semantic", None, None, (0.11, 0.35), "Table 7, 3RScan"),
    Published("semantic + depth", None, None, (0.20, 0.54), "Table 7, 3RScan"),
    Published("semantic + depth + colour", None, None, (0.35, 0.61), "Table 7, 3RScan"),
)


@dataclass(frozen=True)
class Row:
    """Answers to all windows of one case."""

    case: Case
    length: int
    answers: tuple[Answer, ...]
    score: Score = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "score", score(self.answers))

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings, ready for `json.dumps`."""
        return {
            "place": self.case.place,
            "encoder": self.case.encoder,
            "terms": self.case.terms,
            "length": self.length,
            "score": self.score.to_dict(),
        }


def report(rows: Sequence[Row]) -> str:
    """A table for each place and length, and the paper's."""
    parts = []
    for place, title in TITLES.items():
        for length in sorted({r.length for r in rows if r.case.place == place}):
            mine = [r for r in rows if r.case.place == place and r.length == length]
            parts += [f"#### {title}, {length} frames", markdown(HEADER, map(line, mine))]
    parts += ["#### Published (SG2Loc, 5 frames)", markdown(HEADER, map(published, PUBLISHED))]
    return "\n\n".join(parts)


def line(row: Row) -> list[str]:
    """Cells of `HEADER`."""
    s = row.score
    return [
        "–" if row.case.encoder == NONE else row.case.encoder,
        row.case.terms,
        str(s.windows),
        error(s.mean),
        error(s.median),
        *(share(s.recall[THRESHOLDS.index(limits)]) for limits in LIMITS),
        share(s.status.get("OK", 0.0)),
        share(s.right),
        number(s.frame_seconds, 3),
    ]


def published(row: Published) -> list[str]:
    """Cells of `HEADER`, as far as they were published."""
    recall = [share(r) for r in row.recall]
    return [
        f"*{row.source}*", row.terms, "–", error(row.mean), error(row.median), *recall, *["–"] * 4,
    ]  # fmt: skip


def error(pair: tuple[float, float] | None) -> str:
    """`0.066 m 8.8°`, or a dash."""
    return f"{number(pair[0], 3, 'm')} {number(pair[1], 1)}°" if pair else "–"


@table("SG2Loc, Tables 7, 8")
def indoor_semantics(
    run: Run,
    only: Annotated[str, option("Rows, with semicolons between: 'house: labels: *'.")] = "",
    windows: Annotated[str, option("Frames of a window.")] = "5",
    every: Every = EVERY,
    office_every: OfficeEvery = OFFICE_EVERY,
    seed: Seed = 0,
    device: Device = "auto",
    *,
    quick: Quick = False,
    fresh: Fresh = False,
) -> None:
    """What is each encoder worth to the particle filter? Alone, and with depth and colour."""
    if quick:
        every, office_every = QUICK_EVERY, 2 * office_every
    bench = SemanticBench(run.data, run.cache, every, office_every)
    code = fingerprint(ANSWERING)
    done = []
    with Asker(run, fresh=fresh) as asker:
        for case in chosen(cases(available()), parts(only, ";")):
            for n in map(int, windows.split(",")):

                def once(window: Window, seed: int, case: Case = case) -> dict[str, Any]:
                    scene = bench.scene(case.place)
                    return ask(case, scene, window, seed=seed, device=device).to_dict()

                asked = bench.windows(case.place, n)
                keys = [f"{case.key(w, seed, code)} {device}" for w in asked]
                told = asker.answers(f"{case.name}, {n} frames", asked, keys, once, seed)
                done.append(Row(case, n, tuple(map(Answer.from_dict, told))))
    print(report(done))
    run.save({"rows": [row.to_dict() for row in done]}, whole=not only)
