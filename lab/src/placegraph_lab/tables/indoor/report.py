"""Tables of the indoor benchmark."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from placegraph_lab.tables.indoor.bench import TITLES, Job
from placegraph_lab.tables.indoor.metrics import AXES, THRESHOLDS, Answer, Score, score
from placegraph_lab.tables.indoor.windows import COVERED, HALVES
from placegraph_lab.tables.runner import markdown, number, share, shares

AIM = (0.25, 2.0)  # limits [m], [deg] of most aims
AIM_ROW = THRESHOLDS.index(AIM)
OFFICE_ROW = THRESHOLDS.index((0.25, 10.0))
RECALLS = " / ".join(
    f"{100 * m:.0f} cm {d:.0f}°" if m < 1 else f"{m:.0f} m {d:.0f}°" for m, d in THRESHOLDS
)


@dataclass(frozen=True)
class Row:
    """Answers of one job to all windows of one length."""

    job: Job
    length: int
    answers: tuple[Answer, ...]
    score: Score = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "score", score(self.answers))

    def part(self, keep: Callable[[Answer], object]) -> Score | None:
        """Score of the answers that are kept; None where none is."""
        kept = [a for a in self.answers if keep(a)]
        return score(kept) if kept else None

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings, ready for `json.dumps`."""
        places = sorted({a.place for a in self.answers})
        parts = {
            "unchanged": self.part(lambda a: a.changed is False),
            "changed": self.part(lambda a: a.changed is True),
            f"covered {COVERED:.0%}": self.part(is_covered),
            "not covered": self.part(lambda a: a.coverage is not None and not is_covered(a)),
        }
        if len(places) > 1:
            parts |= {place: self.part(lambda a, p=place: a.place == p) for place in places}  # type: ignore[misc]
        return {
            "table": self.job.table,
            "row": self.job.row,
            "map": self.job.map,
            "labels": self.job.labels,
            "length": self.length,
            "options": repr(self.job.options),
            "score": self.score.to_dict(),
            "parts": {name: s.to_dict() for name, s in parts.items() if s},
        }


def is_covered(answer: Answer) -> bool:
    """Whether the map holds enough of the window's last frame."""
    return answer.coverage is not None and answer.coverage >= COVERED


HEADER = [
    "", "windows", "mean", "median", RECALLS, "OK", "OK right", "truth in modes", "honest",
    "particles", "s/frame",
]  # fmt: skip


def report(rows: Sequence[Row]) -> str:
    """All tables that the rows allow."""
    parts: list[str] = []
    for table, title in TITLES.items():
        lengths = sorted({r.length for r in rows if r.job.table == table})
        for length in lengths:
            mine = [r for r in rows if r.job.table == table and r.length == length]
            heading = f"#### {title}, {length} frames"
            if table in HALVES:
                parts += [heading, office_table(mine)]
            else:
                parts += [heading, markdown(HEADER, [score_line(r.job.row, r.score) for r in mine])]
    house = [r for r in rows if r.job.table not in HALVES]
    if house:
        parts += ["#### House, unchanged / changed scenes, 25 cm 2°", changes_table(house)]
        parts += ["#### House, by sequence, 25 cm 2°", sequences_table(house)]
    parts += ["#### Calibration of right answers, and of the probability", calibration_table(rows)]
    aims = aims_table(rows)
    if aims:
        parts += ["#### Aims", aims]
    lines = []
    for row in rows:
        false = [w for w in row.score.worst if " OK " in w]
        if false:
            lines.append(f"- {row.job.name}, {row.length} frames: {'; '.join(false)}")
    wrong = "\n".join(lines)
    if wrong:
        parts += ["#### Answers said to be OK that are not", wrong]
    return "\n\n".join(parts)


def score_line(head: str, s: Score) -> list[str]:
    """Cells of `HEADER`."""
    return [
        head,
        str(s.windows),
        errors(s.mean),
        errors(s.median),
        shares(s.recall),
        share(s.status.get("OK", 0.0)),
        share(s.right),
        share(s.held),
        share(s.honest),
        number(s.particles),
        number(s.frame_seconds, 3),
    ]


def errors(pair: Sequence[float | None]) -> str:
    """`2.1 cm, 0.4°`, metres from one metre on; a dash where there is nothing."""
    metres, degrees = pair
    if metres is None or math.isnan(metres):
        return "–"
    far = metres >= 1
    text = number(metres if far else 100 * metres, 2 if far else 1, "m" if far else "cm")
    if math.isfinite(metres) and metres >= 1e4:
        text = f"{metres:.3g} m"
    return text if degrees is None else f"{text}, {number(degrees, 1)}°"


def office_table(rows: Sequence[Row]) -> str:
    """Rows of one half and length: the covered windows first, then the others."""
    header = HEADER[:]
    header[0] = "windows"
    lines = []
    for row in rows:
        covered = row.part(is_covered)
        rest = row.part(lambda a: not is_covered(a))
        lines.append(score_line(row.job.row, row.score))
        if covered and rest:
            lines.append(score_line(f"{row.job.row}: covered to {COVERED:.0%} or more", covered))
            lines.append(score_line(f"{row.job.row}: the others", rest))
    return markdown(["", *header[1:]], lines)


def changes_table(rows: Sequence[Row]) -> str:
    """Recall in unchanged and in changed scenes, by length."""
    lengths = sorted({r.length for r in rows})
    lines = []
    for job, of in by_job(rows):
        cells = []
        for length in lengths:
            row = of.get(length)
            both = (
                [row.part(lambda a: a.changed is False), row.part(lambda a: a.changed is True)]
                if row
                else [None, None]
            )
            cells.append(shares(s.recall[AIM_ROW] if s else None for s in both))
        lines.append([job.name, *cells])
    return markdown(["", *(f"{n} frames" for n in lengths)], lines)


def sequences_table(rows: Sequence[Row]) -> str:
    """Recall by sequence, lengths set off by slashes."""
    places = sorted({a.place for r in rows for a in r.answers})
    lengths = sorted({r.length for r in rows})
    lines = []
    for job, of in by_job(rows):
        cells = []
        for place in places:
            found = [
                of[n].part(lambda a, p=place: a.place == p) if n in of else None  # type: ignore[misc]
                for n in lengths
            ]
            cells.append(shares(s.recall[AIM_ROW] if s else None for s in found))
        lines.append([job.name, *cells])
    head = f"{'/'.join(str(n) for n in lengths)} frames"
    return markdown([head, *places], lines)


def by_job(rows: Iterable[Row]) -> list[tuple[Job, dict[int, Row]]]:
    """Rows by job and length, in order."""
    found: dict[Job, dict[int, Row]] = {}
    for row in rows:
        found.setdefault(row.job, {})[row.length] = row
    return list(found.items())


def calibration_table(rows: Sequence[Row]) -> str:
    """Whether probabilities and covariances are honest, all lengths pooled."""
    header = ["", "answers", "calibration error", "of perfect"]
    header += [f"error / sigma: {AXES[0]}", *AXES[1:], "within the 95 % ellipsoid"]
    lines = []
    for job, of in by_job(rows):
        s = score([a for row in of.values() for a in row.answers])
        lines.append(
            [
                job.name,
                str(s.windows),
                share(s.calibration.error),
                share(s.calibration.floor),
                *(number(x, 2) for x in s.spread),
                share(s.inside),
            ]
        )
    return markdown(header, lines)


@dataclass(frozen=True)
class Aim:
    """One aim."""

    text: str
    name: str
    length: int
    least: float
    limits: int = AIM_ROW
    covered: bool = False


AIMS = (
    Aim("semantic only, 5 frames, 25 cm 2°", "instances: semantic", 5, 0.85),
    Aim("semantic only, 10 frames, 25 cm 2°", "instances: semantic", 10, 0.95),
    Aim("colour + depth, no labels, 10 frames, 25 cm 2°", "none: depth + colour", 10, 0.90),
    Aim("colour alone, 25 frames, 25 cm 2°", "none: colour", 25, 0.60),
    Aim("office, covered windows, 25 cm 10°", "b in a: depth + colour", 10, 0.8, OFFICE_ROW, True),
    Aim("office, covered windows, 25 cm 10°", "a in b: depth + colour", 10, 0.8, OFFICE_ROW, True),
)


def aims_table(rows: Sequence[Row]) -> str:
    """Aims beside what was reached; an empty string where nothing was asked."""
    at = {(r.job.name, r.length): r for r in rows}
    lines = []
    for aim in AIMS:
        row = at.get((aim.name, aim.length))
        if row is None:
            continue
        s = row.part(is_covered) if aim.covered else row.score
        reached = s.recall[aim.limits] if s else math.nan
        where = aim.name.partition(":")[0] if aim.covered else ""
        lines.append([f"{aim.text} {where}".strip(), f"≥ {share(aim.least)}", share(reached)])
    for length in sorted({r.length for r in rows}):
        lines += compared(at, length)
    sure = [a for r in rows for a in r.answers]
    if sure:
        s = score(sure)
        lines.append(["OK answers near the truth, all our rows", "≥ .95", share(s.right)])
        false = max((r.score.false_ok for r in rows), default=math.nan)
        lines.append(["OK and wrong, share of a row's windows, worst row", "≤ .05", share(false)])
    return markdown(["", "aim", "reached"], lines) if lines else ""


def compared(at: dict[tuple[str, int], Row], length: int) -> list[list[str]]:
    """Aims that compare two rows, and the one about depth, for one length."""
    lines = []
    depth = at.get(("instances: semantic + depth", length))
    if depth:
        kept = sum(a.within(*AIM) or (a.status == "AMBIGUOUS" and a.held) for a in depth.answers)
        lines.append(
            [
                f"with depth, {length} frames: right, or AMBIGUOUS with the truth in the modes",
                "1.00",
                share(kept / len(depth.answers)),
            ]
        )
        classes = at.get(("classes: semantic + depth", length))
        if classes:
            loss = depth.score.recall[AIM_ROW] - classes.score.recall[AIM_ROW]
            text = f"class labels with depth, {length} frames: points below instance labels"
            lines.append([text, "≤ 5", number(100 * loss, 1)])
    for name in ("instances: semantic", "instances: semantic + depth", "instances: all"):
        fine, coarse = at.get((name, length)), at.get((f"{name}, 20k triangles", length))
        if fine and coarse:
            loss = fine.score.recall[AIM_ROW] - coarse.score.recall[AIM_ROW]
            text = f"20k triangles, {name.partition(': ')[2]}, {length} frames: points lost"
            lines.append([text, "≤ 1", number(100 * loss, 1)])
    return lines
