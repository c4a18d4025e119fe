"""Text sets that statuses are outcomes on: made by templates, written by people, walks, and traps.

A trap is a text of which nobody may be sure: it names a street or a business that the map lacks, is
about another town, about none, or in words and languages that are not known.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

import placegraph as pg
from placegraph.core.geometry import Floats
from placegraph.errors import PlacegraphError
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.search.locate import search_views
from placegraph.outdoor.search.posterior import MODE_RADIUS, SPACING, find_modes
from placegraph.outdoor.search.request import Hints, Matching, make_request
from placegraph.outdoor.search.status import (
    AT_A_PLACE,
    IN_SIGHT,
    MAX_SHARE,
    Calibration,
    Claim,
    infer_claim,
)
from placegraph.view.draw.canvas import Disc, Frame, Mark, Points, Stroke, Text
from placegraph.view.draw.painter import paint_picture
from placegraph_lab.tables.outdoor.extracts import EXTRACTS, TRAINED
from placegraph_lab.tables.outdoor.metrics import HIT, Protocol, distances, positions
from placegraph_lab.tables.outdoor.places import landmarks, read_notes, read_records, write_osm
from placegraph_lab.tables.outdoor.queries import make_queries
from placegraph_lab.tables.runner import LAB, Quick, Run, Seed, markdown, option, share, table
from placegraph_lab.tables.statistics import Reliability, reliability

if TYPE_CHECKING:
    from PIL.Image import Image

TRAPS = Path(__file__).parents[1] / "data/traps.toml"
MADE = EXTRACTS | {"manhattan": "manhattan_2025.osm.pbf"}  # extracts that templates speak of
TOLD = {
    "pittsburgh": "rvs_pittsburgh.jsonl",
    "manhattan": "rvs_manhattan.jsonl",
    "lower manhattan": "rvs_lower_manhattan.jsonl",
}
"""Files of texts by people, by the map that they are about."""
PROTOCOLS = (
    *(Protocol(6, s) for s in ("none", "replaced", "absent", "synonyms", "names", "speaker")),
    Protocol(10, "none"),
    Protocol(10, "replaced"),
)
ABROAD = {"ankara": "vancouver", "vancouver": "toronto", "monaco": "manhattan"}
"""Templates of one town, asked in another."""
ASTRAY = {"pittsburgh": "manhattan", "manhattan": "pittsburgh"}
"""People's words about one town, asked in another."""
LURED = ("toronto", "monaco", "manhattan")  # maps on which traps with gaps are set
THINGS = ("bank", "cafe", "pharmacy", "bus stop", "bench", "church", "school", "restaurant")
STREET = re.compile(r"\b(street|avenue|road|drive|lane|boulevard)\b", re.IGNORECASE)
RADIUS = {"templates": 50.0, "people": 250.0, "walks": 100.0, "traps": 50.0}
"""Largest distance of a right answer from the truth [m]."""
TUNED, HELD_OUT = "tuned on", "held out"


@dataclass(frozen=True, slots=True)
class LabelledText:
    """A text, and what is true of it."""

    text: str
    goal: tuple[float, float] | None = None
    """Longitude, latitude [deg]; None where no place on the map is right."""
    start: tuple[float, float] | None = None  # where the listener is, if that is told [deg]
    heading: float | None = None  # of the listener, if that is told [rad]


@dataclass(frozen=True)
class TextSet:
    """Texts of one kind for one map."""

    kind: str  # templates, people, walks or traps
    name: str
    city: str
    half: str  # whether it was looked at while statuses were tuned
    texts: tuple[LabelledText, ...]

    @property
    def radius(self) -> float:
        """Largest distance of a right answer from the truth [m]."""
        return RADIUS[self.kind]


def text_sets(
    osm: Path, folder: Path, maps: dict[str, CityMap], n: int, seed: int
) -> Iterator[TextSet]:
    """All sets, `n` texts each but for what people wrote; extracts lie in `osm`, records in `folder`."""
    yield from templates(osm, n, seed)
    yield from people(folder)
    yield from walks(folder)
    yield from traps(osm, folder, maps, n, seed)


def templates(osm: Path, n: int, seed: int) -> Iterator[TextSet]:
    """Every town in every setting."""
    for city, file in MADE.items():
        for protocol in PROTOCOLS:
            yield TextSet(
                "templates", protocol.title, city, TUNED if city in TRAINED else HELD_OUT,
                _made(osm / file, protocol, n, seed),
            )  # fmt: skip


def _made(path: Path, protocol: Protocol, n: int, seed: int) -> tuple[LabelledText, ...]:
    made = make_queries(
        path, statements=protocol.statements, setting=protocol.setting, n=n, seed=seed
    )
    return tuple(LabelledText(q.text, (q.longitude, q.latitude)) for q in made)


def people(folder: Path) -> Iterator[TextSet]:
    """Even records, which were looked at, and odd ones; without the start, and with it."""
    for city, file in TOLD.items():
        records = read_records(folder / file)
        for start in (False, True):
            texts = tuple(LabelledText(r.text, r.goal, r.start if start else None) for r in records)
            name = f"{city.title()}{', start known' if start else ''}"
            for first, half in enumerate((TUNED, HELD_OUT)):
                yield TextSet("people", name, city, half, texts[first::2])
    for kind, sentences in product(("fountain", "art"), (False, True)):
        notes = read_notes(folder / "vancouver_places.jsonl", kind, sentences=sentences)
        texts = tuple(LabelledText(note.text, note.goal) for note in notes)
        name = f"Vancouver, {kind}, {'sentences' if sentences else 'notes'}"
        for first, half in enumerate((TUNED, HELD_OUT)):
            yield TextSet("people", name, "vancouver", half, texts[first::2])


def walks(folder: Path) -> Iterator[TextSet]:
    """Odd walks, which were looked at, and even ones; start and heading are told."""
    lines = (folder / "walks_manhattan.jsonl").read_text("utf-8").splitlines()
    texts = tuple(
        LabelledText(
            w["text"], w["route"][-1][::-1], w["route"][0][::-1], radians(w["start_heading_deg"])
        )
        for w in map(json.loads, lines)
    )
    for first, half in enumerate((TUNED, HELD_OUT)):
        yield TextSet("walks", "Manhattan", "manhattan", half, texts[first::2])


def traps(
    osm: Path, folder: Path, maps: dict[str, CityMap], n: int, seed: int
) -> Iterator[TextSet]:
    """Texts of which nobody may be sure on the map that they are asked of."""
    for home, city in ABROAD.items():
        texts = _made(osm / MADE[home], PROTOCOLS[0], n, seed)
        yield _trap("templates of another town", city, [t.text for t in texts])
    for home, city in ASTRAY.items():
        records = read_records(folder / TOLD[home])[::2][:n]
        yield _trap("people's words about another town", city, [r.text for r in records])
    with TRAPS.open("rb") as file:
        kinds = tomllib.load(file)
    foreign = _names(maps["vancouver"])
    for city in LURED:
        filler = Filler.of(maps[city], foreign, kinds["words"]["made"])
        rng = np.random.default_rng(seed)
        for kind in kinds.values():
            yield _trap(kind["title"], city, [filler.fill(f, rng) for f in _cycle(kind, n)])
        yield TextSet(
            "traps", "half in a language that is not known", city, HELD_OUT,
            _mixed(_made(osm / MADE[city], PROTOCOLS[0], n, seed), kinds["language"]["frames"]),
        )  # fmt: skip


def _trap(name: str, city: str, texts: Sequence[str]) -> TextSet:
    return TextSet("traps", name, city, HELD_OUT, tuple(LabelledText(t) for t in texts))


def _cycle(kind: dict[str, Any], n: int) -> list[str]:
    return [kind["frames"][i % len(kind["frames"])] for i in range(n)]


def _mixed(made: Sequence[LabelledText], frames: Sequence[str]) -> tuple[LabelledText, ...]:
    mixed = []
    for i, text in enumerate(made):
        true = text.text.split(". ")[:2]
        foreign = frames[i % len(frames)].replace("{name}", "Xyzal")
        mixed.append(LabelledText(". ".join([*true, foreign]), text.goal))
    return tuple(mixed)


def _names(city: CityMap) -> list[str]:
    names = sorted(set(city.objects.names))
    return [n for n in names if re.fullmatch(r"[A-Z][A-Za-z']+( [A-Z][A-Za-z']+)+", n)]


@dataclass(frozen=True)
class Filler:
    """Fills the gaps of a frame."""

    gaps: dict[str, Sequence[str]]

    @classmethod
    def of(cls, city: CityMap, foreign: Sequence[str], made: Sequence[str]) -> Filler:
        """Names of the map, and of another town those that it does not know."""
        unknown = [n for n in foreign if not city.name_index.find_rows(n)]
        return cls(
            {
                "name": _names(city),
                "street": [n for n in unknown if STREET.search(n)],
                "business": [n for n in unknown if not STREET.search(n)],
                "thing": THINGS,
                "other": THINGS[::-1],
                "made": made,
            }
        )

    def fill(self, frame: str, rng: Generator) -> str:
        """Fill every gap, the same gap anew each time but for things, which stay what they are."""
        things = {k: str(rng.choice(self.gaps[k])) for k in ("thing", "other")}

        def word(gap: re.Match[str]) -> str:
            return things.get(gap[1]) or str(rng.choice(self.gaps[gap[1]]))

        return re.sub(r"\{(\w+)\}", word, frame)


NAMES = {id(IN_SIGHT): "IN_SIGHT", id(AT_A_PLACE): "AT_A_PLACE"}


def fit_calibrations(sets: Iterable[TextSet], maps: dict[str, CityMap]) -> dict[str, Calibration]:
    """Coefficients by what is claimed, over the texts of known places that may be tuned on."""
    drawn: dict[str, list[tuple[float, bool]]] = defaultdict(list)
    for asked in sets:
        if asked.half != TUNED or asked.kind not in ("templates", "people"):
            continue
        for told in asked.texts:
            for name, claimed, right in shares(maps[asked.city], told):
                drawn[name].append((claimed, right))
    return {
        name: logistic(np.array([s for s, _ in pairs]), np.array([r for _, r in pairs]))
        for name, pairs in drawn.items()
    }


def shares(city: CityMap, text: LabelledText) -> list[tuple[str, float, bool]]:
    """Return name, the best place's share and correctness of each radius that is claimed."""
    try:
        asked = make_request(city, text.text, Hints(listener=text.start), Matching())
        peaks = find_modes(found := search_views(asked), 1, SPACING)
    except PlacegraphError:
        return []
    if not peaks or text.goal is None:
        return []
    claim: Claim = infer_claim(asked.understood)
    at = peaks[0].position
    off = float(np.hypot(*(city.plane.to_plane(text.goal) - at)))
    radii = {MODE_RADIUS: "of_place", claim.radius: "of_radius"}
    return [
        (f"{NAMES[id(claim)]}.{name}", found.mass_within(at, radius), off <= radius)
        for radius, name in radii.items()
    ]


def logistic(share: Floats, right: NDArray[np.bool_]) -> Calibration:
    """Logistic regression (N,) of being right on log odds, by Newton's method."""
    share = np.clip(share, 1.0 - MAX_SHARE, MAX_SHARE)
    columns = np.stack([np.ones(len(share)), np.log(share / (1.0 - share))], axis=1)
    weights = np.zeros(2)
    for _ in range(50):
        p = 1.0 / (1.0 + np.exp(-columns @ weights))
        curvature = (columns * (p * (1.0 - p))[:, None]).T @ columns + 1e-6 * np.eye(2)
        weights = weights + np.linalg.solve(curvature, columns.T @ (right - p))
    return Calibration(float(weights[0]), float(weights[1]))


SIDE = 100.0  # of the square of a diagram, in units of the drawing; a probability of 1 is as long
STEP = 130.0  # from one diagram to the next
PIXELS = 2.2  # A unit, drawn [px]


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
    "walks": "Walks, with start and heading",
    "traps": "Traps: nobody may be sure",
}


@dataclass(frozen=True)
class Verdict:
    status: str  # `OK`, `AMBIGUOUS`, `LOST`, or the name of an error
    probability: float  # of the best place
    off: float  # how far the best place is from the truth [m]; infinite where there is none


def locate_text(city: CityMap, text: LabelledText) -> Verdict:
    """Give a text to a map, and where the listener is, if that is told."""
    try:
        found = city.locate(text.text, listener=text.start, heading=text.heading)
    except PlacegraphError as error:
        return Verdict(type(error).__name__, 0.0, np.inf)
    if found.best is None or text.goal is None:
        return Verdict(found.status.name, found.best.probability if found.best else 0.0, np.inf)
    off = float(distances(positions(found)[:1], *text.goal)[0])
    return Verdict(found.status.name, found.best.probability, off)


@dataclass(frozen=True)
class SetOutcome:
    """A text set, and what became of it."""

    text_set: TextSet
    verdicts: list[Verdict]

    @property
    def key(self) -> tuple[str, str]:
        return self.text_set.kind, self.text_set.name


def rates(verdicts: Sequence[Verdict], radius: float) -> dict[str, float]:
    """Shares of a set; an answer is right up to `radius` [m] from the truth."""
    sure = np.array([v.status == "OK" for v in verdicts])
    lost = np.array([v.status == "LOST" for v in verdicts])
    right = np.array([v.off <= radius for v in verdicts])
    bins = measure_reliability(verdicts)
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


def measure_reliability(verdicts: Sequence[Verdict]) -> Reliability:
    return reliability([v.probability for v in verdicts], [v.off <= HIT for v in verdicts])


def merge_outcomes(
    outcomes: Iterable[SetOutcome],
) -> dict[tuple[str, str], dict[str, list[Verdict]]]:
    rows: dict[tuple[str, str], dict[str, list[Verdict]]] = {}
    for one in outcomes:
        halves = rows.setdefault(one.key, {})
        halves.setdefault(one.text_set.half, []).extend(one.verdicts)
    return rows


def line(name: str, half: str, verdicts: Sequence[Verdict], radius: float) -> list[str]:
    r = rates(verdicts, radius)
    wanted = ("ok", "wrong_of_ok", "ok_and_right", "right_not_ok", "lost", "calibration_error")
    return [name, half, f"{r['texts']:,.0f}", *(share(r[k]) for k in wanted)]


def render_kind(outcomes: Sequence[SetOutcome], kind: str) -> str:
    header = ["", "", "texts", "`OK`", "of these wrong", "`OK` and right", "right, not `OK`"]
    header += ["`LOST`", "calibration error"]
    of_kind = [j for j in outcomes if j.text_set.kind == kind]
    rows = [
        line(name, half, verdicts, RADIUS[kind])
        for (_, name), halves in merge_outcomes(of_kind).items()
        for half, verdicts in halves.items()
    ]
    for half in (TUNED, HELD_OUT):
        every = [v for j in of_kind for v in j.verdicts if j.text_set.half == half]
        if every:
            rows.append(line("**all**", half, every, RADIUS[kind]))
    return markdown(header, rows)


def maps(run: Run) -> dict[str, CityMap]:
    """Every map, made anew: its making is part of what is outcomes."""
    run.cache.mkdir(parents=True, exist_ok=True)
    sources = {name: run.osm / file for name, file in MADE.items()}
    sources["lower manhattan"] = run.osm / "lower_manhattan_2024.osm.pbf"
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
    seed: Seed = 0,
    *,
    fit: Annotated[bool, option("Fit the coefficients of status.py, and print only them.")] = False,
    quick: Quick = False,
) -> None:
    """Precision and recall of `OK` on templates, people's texts and traps."""
    cities = maps(run)
    sets = text_sets(run.osm, run.data / "text", cities, 20 if quick else 100, seed)
    if fit:
        for name, trust in fit_calibrations(run.track(sets, "sets"), cities).items():
            print(f"{name}: Trust({trust.level:.2f}, {trust.slope:.2f})")
        return
    run.one_core()
    outcomes = []
    for asked in run.track(sets, "sets"):
        told = asked.texts[:50] if quick else asked.texts
        outcomes.append(SetOutcome(asked, [locate_text(cities[asked.city], t) for t in told]))
    for kind, title in KINDS.items():
        print(f"### {title}\n\n{render_kind(outcomes, kind)}\n")
    panels = {
        f"{title}, {half}": measure_reliability(verdicts)
        for kind, title in list(KINDS.items())[:2]
        for half in (TUNED, HELD_OUT)
        if (verdicts := [v for j in outcomes if (j.text_set.kind, j.text_set.half) == (kind, half)
                         for v in j.verdicts])
    }  # fmt: skip
    if not quick:
        diagrams(panels).save(PICTURE, optimize=True)
    run.save(
        {"rows": [row(j) for j in outcomes], "diagrams": {k: bins(v) for k, v in panels.items()}}
    )


def row(outcomes: SetOutcome) -> dict[str, Any]:
    asked = outcomes.text_set
    head = {k: getattr(asked, k) for k in ("kind", "name", "city", "half")}
    return head | rates(outcomes.verdicts, asked.radius)


def bins(of: Reliability) -> dict[str, list[float]]:
    names = ("count", "confidence", "accuracy")
    return {name: getattr(of, name).round(4).tolist() for name in names}
