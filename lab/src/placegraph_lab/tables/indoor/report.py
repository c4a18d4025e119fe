"""Rows and tables that the indoor benchmarks share."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

from placegraph_lab.tables.indoor.bench import Bench
from placegraph_lab.tables.indoor.metrics import Answer, score
from placegraph_lab.tables.indoor.windows import COVERED, Window
from placegraph_lab.tables.runner import INDOOR, Run, code_key, markdown, number, shares


def is_covered(answer: Answer) -> bool:
    return answer.coverage is not None and answer.coverage >= COVERED


PARTS: dict[str, Callable[[Answer], bool]] = {
    "unchanged": lambda a: a.changed is False,
    "changed": lambda a: a.changed is True,
    f"covered {COVERED:.0%}": is_covered,
    "not covered": lambda a: a.coverage is not None and not is_covered(a),
}
"""Windows that are also scored apart."""


@dataclass(frozen=True)
class Row:
    """Results of one job for all windows of one length, and how they are summarized."""

    job: Any
    length: int
    results: tuple[Any, ...]  # `Answer`, or what has one as `after`
    summarize: Callable[[Sequence[Any]], Any] = score

    @cached_property
    def score(self) -> Any:
        return self.summarize(self.results)

    def part(self, keep: Callable[[Answer], object]) -> Any:
        """Summarize the results whose answer is kept; None where none is."""
        kept = [r for r in self.results if keep(getattr(r, "after", r))]
        return self.summarize(kept) if kept else None

    @property
    def places(self) -> list[str]:
        return sorted({getattr(r, "after", r).place for r in self.results})

    def at(self, place: str) -> Any:
        return self.part(lambda a: a.place == place)

    def record(self) -> dict[str, Any]:
        """Return the row's name and its scores, of all windows and of parts of them."""
        parts = {name: self.part(keep) for name, keep in PARTS.items()}
        if len(self.places) > 1:
            parts |= {place: self.at(place) for place in self.places}
        scores = {name: score for name, score in parts.items() if score}
        return {"row": self.job.name, "length": self.length, "score": self.score, "parts": scores}


def ask_windows(
    run: Run,
    jobs: Iterable[Any],
    bench: Bench,
    lengths: Callable[[Any], Iterable[int]],
    once: Callable[[Any, Window, int], Any],
    *,
    seed: int,
    device: str,
    fresh: bool,
) -> list[tuple[Any, int, list[dict[str, Any]]]]:
    """Ask every job about its windows of each length; answers of earlier runs are not asked again.

    `once` asks a job about a window with a seed; before the first window of a row it is called once
    to compile. A job has a `name`, a `place` and a `key`.
    """
    code = code_key(INDOOR)  # once: what is loaded now is what answers
    journal, rows = run.journal(fresh=fresh), []
    with run.progress() as bar:
        for job in jobs:
            for n in lengths(job):
                windows = bench.windows(job.place, n)
                keys = [f"{job.key(w, seed, code)} {device}" for w in windows]
                task = bar.add_task(
                    f"{job.name}, {n} frames", total=len(journal.find_missing(keys))
                )
                ask = partial(_ask_window, once, job, windows)
                answers = journal.fill(
                    keys,
                    partial(ask, seed=seed),
                    warm=partial(ask, 0, seed=seed + 1),
                    tick=partial(bar.advance, task),
                )
                bar.remove_task(task)
                rows.append((job, n, answers))
    return rows


def _ask_window(
    once: Callable[[Any, Window, int], Any],
    job: Any,
    windows: Sequence[Window],
    row: int,
    seed: int,
) -> Any:
    return once(job, windows[row], seed)


def errors(pair: Sequence[float | None] | None) -> str:
    """Write `2.1 cm, 0.4°`, metres from one metre on; a dash where there is nothing."""
    metres, degrees = pair or (None, None)
    if metres is None or math.isnan(metres):
        return "–"
    far = metres >= 1
    text = number(metres if far else 100 * metres, 2 if far else 1, "m" if far else "cm")
    if math.isfinite(metres) and metres >= 1e4:
        text = f"{metres:.3g} m"
    return text if degrees is None else f"{text}, {number(degrees, 1)}°"


def by_job(rows: Iterable[Row]) -> list[tuple[Any, dict[int, Row]]]:
    found: dict[Any, dict[int, Row]] = {}
    for row in rows:
        found.setdefault(row.job, {})[row.length] = row
    return list(found.items())


def changes_table(rows: Sequence[Row], recall: Callable[[Any], float]) -> str:
    """Return recall in unchanged and in changed scenes, by length."""
    lengths = sorted({r.length for r in rows})
    lines = []
    for job, of in by_job(rows):
        both = [[of[n].part(PARTS[p]) for p in ("unchanged", "changed")] if n in of else [None] * 2
                for n in lengths]  # fmt: skip
        lines.append([job.name, *(shares(recall(s) if s else None for s in pair) for pair in both)])
    return markdown(["", *(f"{n} frames" for n in lengths)], lines)
