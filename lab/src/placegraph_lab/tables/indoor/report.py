"""Rows and tables that the indoor benchmarks share."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from placegraph_lab.tables.indoor.bench import Asker, Bench
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
    def score(self) -> Any:  # noqa: ANN401  # what `summarize` returns
        return self.summarize(self.results)

    def part(self, keep: Callable[[Answer], object]) -> Any:  # noqa: ANN401
        """Summarize the results whose answer is kept; None where none is."""
        kept = [r for r in self.results if keep(getattr(r, "after", r))]
        return self.summarize(kept) if kept else None

    @property
    def places(self) -> list[str]:
        return sorted({getattr(r, "after", r).place for r in self.results})

    def at(self, place: str) -> Any:  # noqa: ANN401
        return self.part(lambda a: a.place == place)

    def to_dict(self) -> dict[str, Any]:
        parts = {name: self.part(keep) for name, keep in PARTS.items()}
        if len(self.places) > 1:
            parts |= {place: self.at(place) for place in self.places}
        return {
            **self.job.fields(),
            "length": self.length,
            "score": self.score.to_dict(),
            "parts": {name: s.to_dict() for name, s in parts.items() if s},
        }


def ask_windows(
    run: Run,
    jobs: Iterable[Any],
    bench: Bench,
    lengths: Callable[[Any], Iterable[int]],
    once: Callable[[Any, Window, int], dict[str, Any]],
    *,
    seed: int,
    device: str,
    fresh: bool,
) -> list[tuple[Any, int, list[dict[str, Any]]]]:
    """Ask every job about its windows of each length; answers of earlier runs are not asked again.

    `once` asks a job about a window with a seed. A job has a `name`, a `place` and a `key`.
    """
    code = code_key(INDOOR)  # once: what is loaded now is what answers
    rows = []
    with Asker(run, fresh=fresh) as asker:
        for job in jobs:
            for n in lengths(job):
                windows = bench.windows(job.place, n)
                keys = [f"{job.key(w, seed, code)} {device}" for w in windows]

                def ask(window: Window, seed: int, job: Any = job) -> dict[str, Any]:  # noqa: ANN401
                    return once(job, window, seed)

                told = asker.answers(f"{job.name}, {n} frames", windows, keys, ask, seed)
                rows.append((job, n, told))
    return rows


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


def sequences_table(rows: Sequence[Row], recall: Callable[[Any], float]) -> str:
    """Return recall by sequence, lengths set off by slashes."""
    places = sorted({place for row in rows for place in row.places})
    lengths = sorted({r.length for r in rows})
    lines = []
    for job, of in by_job(rows):
        found = [[of[n].at(place) if n in of else None for n in lengths] for place in places]
        lines.append([job.name, *(shares(recall(s) if s else None for s in by) for by in found)])
    return markdown([f"{'/'.join(map(str, lengths))} frames", *places], lines)
