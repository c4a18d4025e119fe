"""Tables of the refinement's benchmark."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from placegraph.indoor.refine.matching import Matcher
from placegraph_lab.tables.indoor.bench import QUICK_EVERY, Asker, Bench, chosen
from placegraph_lab.tables.indoor.metrics import AXES
from placegraph_lab.tables.indoor.refine import (
    EDGES,
    GICP,
    LIMITS,
    MATCHERS,
    PAPER,
    PLACES,
    QUICK,
    STARTS,
    Refined,
    RefineJob,
    RefineScore,
    Spread,
    Start,
    ask,
    refine_jobs,
    refine_score,
    spread,
)
from placegraph_lab.tables.indoor.report import errors
from placegraph_lab.tables.indoor.windows import (
    COVERED,
    EVERY,
    HALVES,
    LENGTHS,
    OFFICE_EVERY,
    Window,
)
from placegraph_lab.tables.runner import (
    INDOOR,
    Device,
    Every,
    Fresh,
    OfficeEvery,
    Quick,
    Run,
    Seed,
    code_key,
    markdown,
    number,
    option,
    parts,
    share,
    shares,
    table,
)

NEAREST = LIMITS.index((0.10, 5.0))
OFFICE = LIMITS.index((0.25, 5.0))
RECALLS = " / ".join(f"{100 * m:.0f} cm {d:.0f}°" for m, d in LIMITS)
HEADER = [
    "", "windows", "mean before", "after", "median before", "after", f"{RECALLS} before", "after",
    "accepted", "harmful", "wrongly refused", "s refining", "s in all",
]  # fmt: skip


@dataclass(frozen=True)
class RefineRow:
    """Results of one job for all windows of one length."""

    job: RefineJob
    length: int
    results: tuple[Refined, ...]
    score: RefineScore = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "score", refine_score(self.results))

    def part(self, keep: Callable[[Refined], object]) -> RefineScore | None:
        """Score of the results that are kept; None where none is."""
        kept = [r for r in self.results if keep(r)]
        return refine_score(kept) if kept else None

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings, ready for `json.dumps`."""
        places = sorted({r.after.place for r in self.results})
        parts = {
            "unchanged": self.part(unchanged),
            "changed": self.part(changed),
            f"covered {COVERED:.0%}": self.part(covered),
            "not covered": self.part(lambda r: r.after.coverage is not None and not covered(r)),
        }
        if len(places) > 1:
            parts |= {p: self.part(lambda r, p=p: r.after.place == p) for p in places}  # type: ignore[misc]
        return {
            "place": self.job.place,
            "start": self.job.start,
            "row": self.job.row,
            "depth": self.job.depth,
            "by": self.job.by,
            "length": self.length,
            "score": self.score.to_dict(),
            "parts": {name: s.to_dict() for name, s in parts.items() if s},
            "normalised_errors": {
                "refined": spread([r for r in self.results if r.accepted]).to_dict(),
                "kept": spread([r for r in self.results if r.accepted is False]).to_dict(),
            },
        }


def unchanged(result: Refined) -> bool:
    """Whether the scene is as its map has it."""
    return result.after.changed is False


def changed(result: Refined) -> bool:
    """Whether things were moved since the map was made."""
    return result.after.changed is True


def covered(result: Refined) -> bool:
    """Whether the map holds enough of the window's last frame."""
    return result.after.coverage is not None and result.after.coverage >= COVERED


def refine_report(rows: Sequence[RefineRow]) -> str:
    """All tables that the rows allow."""
    parts: list[str] = []
    for place, place_title in PLACES.items():
        for start, start_title in STARTS.items():
            mine = [r for r in rows if (r.job.place, r.job.start) == (place, start)]
            for length in sorted({r.length for r in mine}):
                lines = [x for r in mine if r.length == length for x in lines_of(r)]
                heading = f"#### {place_title}, {start_title}, {length} frames"
                parts += [heading, markdown(HEADER, lines)]
    house = [r for r in rows if r.job.place not in HALVES]
    if house:
        parts += ["#### House, unchanged / changed scenes, 10 cm 5° after", changes_table(house)]
        parts += ["#### House, by sequence, 10 cm 5° after", sequences_table(house)]
    own = [r for r in rows if is_ours(r.job)]
    if own:
        parts += ["#### Errors over standard deviations", spread_table(own)]
        parts += histograms(own)
    aims = aims_table(rows)
    if aims:
        parts += ["#### Aims", aims]
    harmful = "\n".join(
        f"- {row.job.name}, {row.length} frames: {'; '.join(row.score.worst)}"
        for row in rows
        if row.score.worst and is_ours(row.job)
    )
    if harmful:
        parts += ["#### Accepted, and worse than before", harmful]
    return "\n\n".join(parts)


# ------------------------------------------------------------------------------------ the tables


def lines_of(row: RefineRow) -> list[list[str]]:
    """A row, and of the office the windows that the map covers."""
    lines = [score_line(row.job.row, row.score)]
    inside = row.part(covered)
    if inside and inside.windows < row.score.windows:
        lines.append(score_line(f"{row.job.row}: covered to {COVERED:.0%} or more", inside))
    return lines


def score_line(head: str, s: RefineScore) -> list[str]:
    """Cells of `HEADER`."""
    return [
        head,
        str(s.windows),
        errors(s.before.mean),
        errors(s.after.mean),
        errors(s.before.median),
        errors(s.after.median),
        shares(s.before.recall),
        shares(s.after.recall),
        share(s.accepted),
        share(s.harmful),
        share(s.wrongly_refused),
        number(s.refine_seconds, 2),
        number(s.seconds, 2),
    ]


def changes_table(rows: Sequence[RefineRow]) -> str:
    """Recall in unchanged and in changed scenes, by length."""
    lengths = sorted({r.length for r in rows})
    lines = []
    for job, of in by_job(rows):
        cells = []
        for n in lengths:
            both = [of[n].part(keep) if n in of else None for keep in (unchanged, changed)]
            cells.append(shares(s.after.recall[NEAREST] if s else None for s in both))
        lines.append([job.name, *cells])
    return markdown(["", *(f"{n} frames" for n in lengths)], lines)


def sequences_table(rows: Sequence[RefineRow]) -> str:
    """Recall by sequence, lengths set off by slashes."""
    places = sorted({r.after.place for row in rows for r in row.results})
    lengths = sorted({r.length for r in rows})
    lines = []
    for job, of in by_job(rows):
        cells = []
        for place in places:
            found = [
                of[n].part(lambda r, p=place: r.after.place == p) if n in of else None  # type: ignore[misc]
                for n in lengths
            ]
            cells.append(shares(s.after.recall[NEAREST] if s else None for s in found))
        lines.append([job.name, *cells])
    return markdown([f"{'/'.join(map(str, lengths))} frames", *places], lines)


def by_job(rows: Iterable[RefineRow]) -> list[tuple[RefineJob, dict[int, RefineRow]]]:
    """Rows by job and length, in order."""
    found: dict[RefineJob, dict[int, RefineRow]] = {}
    for row in rows:
        found.setdefault(row.job, {})[row.length] = row
    return list(found.items())


# --------------------------------------------------------------------------- normalised errors


def spread_table(rows: Sequence[RefineRow]) -> str:
    """Whether covariances are honest, all lengths pooled: poses refined, and poses left coarse."""
    header = ["", "poses", *(f"rms {axis}" for axis in AXES)]
    header += ["within 1 / 2 / 3 σ", "within the 95 % ellipsoid"]
    lines = []
    for job, of in by_job(rows):
        results = [r for row in of.values() for r in row.results]
        for what, accepted in (("refined", True), ("left coarse", False)):
            s = spread([r for r in results if r.accepted is accepted])
            if s.count:
                lines.append(spread_line(f"{job.name}: {what}", s))
    lines.append(["*a normal distribution*", "–", *["1.00"] * len(AXES), ".68/.95/1.00", ".95"])
    return markdown(header, lines)


def spread_line(head: str, s: Spread) -> list[str]:
    """Cells of the table of normalised errors."""
    within = shares(sum(row) / len(row) for row in s.within)
    return [head, str(s.count), *(number(x, 2) for x in s.rms), within, share(s.inside)]


def histograms(rows: Sequence[RefineRow]) -> list[str]:
    """Headings and bars of refined poses.

    By the first matcher and from one start alone, so that a window counts once a length.
    """
    by = rows[0].job.by
    parts = []
    for title, office in (("House", False), ("Office", True)):
        for words, depth in (("with depth", True), ("without depth", False)):
            mine = [
                row
                for row in rows
                if row.job.by == by
                and (row.job.place in HALVES) is office
                and row.job.depth is depth
            ]
            start: Start = "found" if any(row.job.start == "found" for row in mine) else "disturbed"
            seen = [row.job.seen for row in mine if row.job.start == start][:1]
            pooled = [
                r
                for row in mine
                if row.job.start == start and row.job.seen in seen
                for r in row.results
                if r.accepted
            ]
            s = spread(pooled)
            if s.count:
                what = f"{title}, {seen[0]} ({words}), {STARTS[start]}, {by}"
                total = sum(s.histogram)
                bounds = [-math.inf, *EDGES, math.inf]
                lines = ["```text", f"{'sigma':>12} {'errors':>7} {'share':>6} {'normal':>6}"]
                for low, high, count in zip(bounds[:-1], bounds[1:], s.histogram, strict=True):
                    part = count / total
                    normal = (math.erf(high / math.sqrt(2)) - math.erf(low / math.sqrt(2))) / 2
                    bar = "█" * round(part * BAR)
                    line = f"{bin_name(low, high):>12} {count:7} {part:6.3f} {normal:6.3f} {bar}"
                    lines.append(line.rstrip())
                parts += [
                    f"#### Errors over standard deviations: {what}",
                    "\n".join([*lines, "```"]),
                ]
    return parts


BAR = 200  # characters of a bar for a share of 1; a bin of half a sigma rarely holds more than .2


def bin_name(low: float, high: float) -> str:
    """`-1.5 to -1`, `below -3`, `3 and more`."""
    if math.isinf(low):
        return f"below {high:g}"
    return f"{low:g} and more" if math.isinf(high) else f"{low:g} to {high:g}"


# ----------------------------------------------------------------------------------------- aims


def aims_table(rows: Sequence[RefineRow]) -> str:
    """Aims beside what was reached; an empty string where nothing was asked."""
    lines: list[list[str]] = []
    for row in rows:
        if row.job.start != "disturbed" or not is_ours(row.job):
            continue
        head = f"{row.job.name}, {row.length} frames"
        if row.job.place in HALVES:
            reached = row.score.after.recall[OFFICE]
            lines.append([f"{head}: 25 cm 5°", "≥ .70", share(reached)])
            continue
        for word, keep, least in (("unchanged", unchanged, 0.9), ("changed", changed, 0.8)):
            s = row.part(keep)
            if s:
                reached = s.after.recall[NEAREST]
                lines.append([f"{head}, {word}: 10 cm 5°", f"≥ {share(least)}", share(reached)])
    lines += [x for row in rows for x in seconds_line(row)]
    return markdown(["", "aim", "reached"], lines) if lines else ""


def seconds_line(row: RefineRow) -> list[list[str]]:
    """The aim for the time of ten frames, where it applies."""
    learned = row.job.by == "xfeat"
    with_depth = row.job.depth and row.job.by in {"auto", "none"}
    if row.length != 10 or row.job.start != "disturbed" or not (learned or with_depth):
        return []
    text = f"{row.job.name}, 10 frames: seconds"
    return [[text, "≤ 3" if learned else "≤ 1", number(row.score.seconds, 2)]]


def is_ours(job: RefineJob) -> bool:
    """Whether it is neither small_gicp nor the paper's recipe."""
    return job.by not in GICP and not job.by.endswith(PAPER)


WORDS = ("auto", "guided", *GICP)  # what refines without a matcher of its own being made


class Matchers:
    """Matchers by name, each made once."""

    def __init__(self, weights: Path | None) -> None:
        self.weights = weights
        self._made: dict[str, Matcher] = {}

    def __getitem__(self, name: str) -> str | Matcher:
        if name in WORDS:
            return name
        if name not in self._made:
            from placegraph.indoor.refine.matching import matcher

            weights = self.weights if name == "xfeat" else None
            self._made[name] = matcher(name, weights=weights)
        return self._made[name]


@table("SG2Loc, Tables 1, 2, 4, 7, 9, 10")
def indoor_refine(
    run: Run,
    only: Annotated[
        str, option("Rows, with semicolons between: 'house found: *; b in a disturbed: *'.")
    ] = "",
    windows: Annotated[str, option("Frames of a window.")] = ",".join(map(str, LENGTHS)),
    matchers: Annotated[str, option("What refines, with commas.")] = ",".join(MATCHERS),
    every: Every = EVERY,
    office_every: OfficeEvery = OFFICE_EVERY,
    seed: Seed = 0,
    device: Device = "auto",
    *,
    quick: Quick = False,
    fresh: Fresh = False,
) -> None:
    """Does refining bring a pose to centimetres? Errors before and after, harm, covariances, time."""
    names = parts(only, ";")
    if quick:
        windows, every, office_every = "5,10", QUICK_EVERY, 2 * OFFICE_EVERY
        names = names or list(QUICK)
    jobs = chosen(refine_jobs(parts(matchers)), names)
    bench = Bench(run.data, run.cache, every, office_every)
    weights = run.shared / "weights/xfeat.pt"
    refining = Matchers(weights if weights.exists() else None)
    code = code_key(INDOOR)  # once: what is loaded now is what answers
    rows = []
    with Asker(run, fresh=fresh) as asker:
        for job in jobs:
            for n in map(int, windows.split(",")):

                def once(window: Window, seed: int, job: RefineJob = job) -> dict[str, Any]:
                    scene, its = bench.scene(job.place), refining[job.matcher]
                    found = ask(job, scene, window, matcher=its, seed=seed, device=device)
                    return found.to_dict()

                asked = bench.windows(job.place, n)
                keys = [f"{job.key(w, seed, code)} {device}" for w in asked]
                told = asker.answers(f"{job.name}, {n} frames", asked, keys, once, seed)
                rows.append(RefineRow(job, n, tuple(map(Refined.from_dict, told))))
    print(refine_report(rows))
    run.save({"rows": [r.to_dict() for r in rows]}, whole=not names)
