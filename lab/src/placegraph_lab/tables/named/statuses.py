"""Is `OK` right, and is it said often enough? Every text set, and traps that nobody may fall into.

    placegraph-lab table statuses

Prints Markdown tables, writes JSON and the reliability diagrams of the docs. Tuned on four towns and
on the even records of what people wrote; all else is reported beside it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from placegraph.errors import PlacegraphError
from placegraph.outdoor.city import CityMap
from placegraph.view.draw.canvas import Disc, Frame, Mark, Points, Stroke, Text
from placegraph.view.draw.painter import paint_picture
from placegraph_lab.tables.outdoor.human_text import landmarks, read_records, write_osm
from placegraph_lab.tables.outdoor.metrics import HIT, distances, positions
from placegraph_lab.tables.outdoor.text_sets import (
    HELD_OUT,
    MADE,
    RADIUS,
    TOLD,
    TUNED,
    TextSet,
    Told,
    text_sets,
)
from placegraph_lab.tables.outdoor.trust import fitted
from placegraph_lab.tables.runner import LAB, Quick, Run, Seed, markdown, option, share, table
from placegraph_lab.tables.statistics import Reliability, reliability

if TYPE_CHECKING:
    from PIL.Image import Image


SIDE = 100.0
"""Of the square of a diagram, in units of the drawing; a probability of 1 is as long."""
STEP = 130.0
"""From one diagram to the next."""
PIXELS = 2.2
"""A unit, drawn [px]."""


def diagrams(panels: dict[str, Reliability]) -> Image:
    """Draw diagrams side by side, by title: stated probability to the right, share that is right up."""
    center, half = (STEP * len(panels) / 2 - 15.0, SIDE / 2), STEP / 2
    frame = Frame(center, PIXELS, round(PIXELS * STEP * len(panels)), round(PIXELS * 2 * half))
    items = [m for k, (title, of) in enumerate(panels.items()) for m in _panel(k * STEP, title, of)]
    return paint_picture(items, frame)


def _panel(left: float, title: str, of: Reliability) -> list[Mark]:
    def at(x: float, y: float) -> Points:
        return np.array([left + SIDE * x, SIDE * y])

    corners = [at(x, y) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1), (0, 0))]
    marks: list[Mark] = [
        Stroke(np.array(corners), "ink", 1.0),
        Stroke(np.array([at(0, 0), at(1, 1)]), "ink", 1.0, dash=(4.0, 4.0)),
        Text(at(0.5, 1.05), title, 11.0, "ink"),
    ]
    for tick in (0.0, 0.5, 1.0):
        marks.append(Text(at(tick, -0.05), f"{tick:g}", 10.0, "ink"))
        marks.append(Text(at(-0.03, tick), f"{tick:g}", 10.0, "ink", anchor="r"))
    points = [at(x, y) for x, y in zip(of.confidence, of.accuracy, strict=True)]
    marks.append(Stroke(np.array(points), "for", 2.0))
    return marks + [Disc(p, 3.5, "for") for p in points]


PICTURE = LAB.parent / "docs/pictures/reliability.png"
KINDS = {
    "templates": "Texts made by templates",
    "people": "What people wrote",
    "traps": "Traps: nobody may be sure",
}


@dataclass(frozen=True)
class Verdict:
    """What became of one text."""

    status: str
    """`OK`, `AMBIGUOUS`, `LOST`, or the name of an error."""
    probability: float
    """Of the best place."""
    off: float
    """How far the best place is from the truth [m]; infinite where there is none."""


def judge(city: CityMap, told: Told) -> Verdict:
    """Give a text to a map, and where the listener is, if that is told."""
    try:
        found = city.locate(told.text, listener=told.start)
    except PlacegraphError as error:
        return Verdict(type(error).__name__, 0.0, np.inf)
    if found.best is None or told.goal is None:
        return Verdict(found.status.name, found.best.probability if found.best else 0.0, np.inf)
    off = float(distances(positions(found)[:1], *told.goal)[0])
    return Verdict(found.status.name, found.best.probability, off)


@dataclass(frozen=True)
class Judged:
    """A text set, and what became of it."""

    asked: TextSet
    verdicts: list[Verdict]

    @property
    def key(self) -> tuple[str, str]:
        """Row of the printed table: its towns stand together."""
        return self.asked.kind, self.asked.name


def rates(verdicts: Sequence[Verdict], radius: float) -> dict[str, float]:
    """Shares of a set; an answer is right up to `radius` [m] from the truth."""
    sure = np.array([v.status == "OK" for v in verdicts])
    lost = np.array([v.status == "LOST" for v in verdicts])
    right = np.array([v.off <= radius for v in verdicts])
    bins = calibrated(verdicts)
    found = {
        "texts": len(verdicts),
        "ok": sure.mean(),
        "wrong_of_ok": float(np.mean(~right[sure])) if sure.any() else 0.0,
        "ok_and_right": (sure & right).mean(),
        "right_not_ok": (right & ~sure).mean(),
        "lost": lost.mean(),
        "right": right.mean(),
        "calibration_error": bins.error,
        "calibration_error_of_perfect": bins.floor,
    }
    return {k: round(float(v), 4) for k, v in found.items()}


def calibrated(verdicts: Sequence[Verdict]) -> Reliability:
    """Whether a place's probability is how often the truth lies within 50 m of it."""
    return reliability([v.probability for v in verdicts], [v.off <= HIT for v in verdicts])


def merged(judged: Iterable[Judged]) -> dict[tuple[str, str], dict[str, list[Verdict]]]:
    """Verdicts by row and half, whatever the town."""
    rows: dict[tuple[str, str], dict[str, list[Verdict]]] = {}
    for one in judged:
        halves = rows.setdefault(one.key, {})
        halves.setdefault(one.asked.half, []).extend(one.verdicts)
    return rows


def line(name: str, half: str, verdicts: Sequence[Verdict], radius: float) -> list[str]:
    """Row of the printed table."""
    r = rates(verdicts, radius)
    wanted = ("ok", "wrong_of_ok", "ok_and_right", "right_not_ok", "lost", "calibration_error")
    return [name, half, f"{r['texts']:,.0f}", *(share(r[k]) for k in wanted)]


def shown(judged: Sequence[Judged], kind: str) -> str:
    """Printed table of one kind: every set, and all of them together."""
    header = ["", "", "texts", "`OK`", "of these wrong", "`OK` and right", "right, not `OK`"]
    header += ["`LOST`", "calibration error"]
    of_kind = [j for j in judged if j.asked.kind == kind]
    rows = [
        line(name, half, verdicts, RADIUS[kind])
        for (_, name), halves in merged(of_kind).items()
        for half, verdicts in halves.items()
    ]
    for half in (TUNED, HELD_OUT):
        every = [v for j in of_kind for v in j.verdicts if j.asked.half == half]
        if every:
            rows.append(line("**all**", half, every, RADIUS[kind]))
    return markdown(header, rows)


def maps(run: Run) -> dict[str, CityMap]:
    """Every map, made anew: its making is part of what is judged."""
    import placegraph as pg

    run.cache.mkdir(parents=True, exist_ok=True)
    sources = {name: run.osm / file for name, file in MADE.items()}
    sources["pittsburgh"] = run.cache / "pittsburgh.osm"
    write_osm(
        landmarks(read_records(run.data / "text" / TOLD["pittsburgh"])), sources["pittsburgh"]
    )
    made = {}
    for name, source in sources.items():
        pg.build_city(source, run.cache / f"{name}.city")
        made[name] = pg.CityMap.open(run.cache / f"{name}.city")
    return made


@table()
def statuses(
    run: Run,
    texts: Annotated[int, option("Texts a town and setting.")] = 100,
    seed: Seed = 0,
    *,
    fit: Annotated[bool, option("Fit the coefficients of status.py, and print only them.")] = False,
    quick: Quick = False,
) -> None:
    """Is `OK` right, and said often enough? Templates, people's words, and traps."""
    cities = maps(run)
    sets = text_sets(run.osm, run.data / "text", cities, 20 if quick else texts, seed)
    if fit:
        for name, trust in fitted(run.track(sets, "sets"), cities).items():
            print(f"{name}: Trust({trust.level:.2f}, {trust.slope:.2f})")
        return
    run.one_core()
    judged = []
    for asked in run.track(sets, "sets"):
        told = asked.texts[:50] if quick else asked.texts
        judged.append(Judged(asked, [judge(cities[asked.city], t) for t in told]))
    for kind, title in KINDS.items():
        print(f"### {title}\n\n{shown(judged, kind)}\n")
    panels = {
        f"{title}, {half}": calibrated(verdicts)
        for kind, title in list(KINDS.items())[:2]
        for half in (TUNED, HELD_OUT)
        if (verdicts := [v for j in judged if (j.asked.kind, j.asked.half) == (kind, half)
                         for v in j.verdicts])
    }  # fmt: skip
    if not quick:
        diagrams(panels).save(PICTURE, optimize=True)
    run.save(
        {"rows": [row(j) for j in judged], "diagrams": {k: bins(v) for k, v in panels.items()}}
    )


def row(judged: Judged) -> dict[str, Any]:
    """Numbers of a set in one town."""
    asked = judged.asked
    head = {k: getattr(asked, k) for k in ("kind", "name", "city", "half")}
    return head | rates(judged.verdicts, asked.radius)


def bins(of: Reliability) -> dict[str, list[float]]:
    """Numbers of a diagram."""
    names = ("count", "confidence", "accuracy")
    return {name: getattr(of, name).round(4).tolist() for name in names}
