"""Text sets that statuses are judged on: made by templates, written by people, and traps.

A trap is a text of which nobody may be sure: it names a street or a business that the map lacks, is
about another town, about none, or in words and languages that are not known.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

from placegraph.outdoor.city import CityMap
from placegraph_lab.tables.outdoor.extracts import EXTRACTS, TRAINED
from placegraph_lab.tables.outdoor.human_text import read_records
from placegraph_lab.tables.outdoor.queries import make_queries
from placegraph_lab.tables.outdoor.report import Protocol

TRAPS = Path(__file__).parent / "traps.toml"
MADE = EXTRACTS | {"manhattan": "manhattan_2025.osm.pbf"}
"""Extracts that templates speak of."""
TOLD = {"pittsburgh": "rvs_pittsburgh.jsonl", "manhattan": "rvs_manhattan.jsonl"}
"""What people wrote, by the map it is about."""
PROTOCOLS = (
    *(Protocol(6, s) for s in ("none", "replaced", "absent", "synonyms", "names", "speaker")),
    Protocol(10, "none"),
    Protocol(10, "replaced"),
)
ABROAD = {"ankara": "vancouver", "vancouver": "toronto", "monaco": "manhattan"}
"""Templates of one town, asked in another."""
ASTRAY = {"pittsburgh": "manhattan", "manhattan": "pittsburgh"}
"""People's words about one town, asked in another."""
LURED = ("toronto", "monaco", "manhattan")
"""Maps on which traps with gaps are set."""
THINGS = ("bank", "cafe", "pharmacy", "bus stop", "bench", "church", "school", "restaurant")
STREET = re.compile(r"\b(street|avenue|road|drive|lane|boulevard)\b", re.IGNORECASE)
RADIUS = {"templates": 50.0, "people": 250.0, "traps": 50.0}
"""How far off an answer may be and still be right [m]."""
TUNED, HELD_OUT = "tuned on", "held out"


@dataclass(frozen=True, slots=True)
class Told:
    """A text, and what is true of it."""

    text: str
    goal: tuple[float, float] | None = None
    """Longitude, latitude [deg]; None where no place on the map is right."""
    start: tuple[float, float] | None = None
    """Where the listener is, if that is told [deg]."""


@dataclass(frozen=True)
class TextSet:
    """Texts of one kind for one map."""

    kind: str
    """templates, people or traps."""
    name: str
    city: str
    half: str
    """Whether it was looked at while statuses were tuned."""
    texts: tuple[Told, ...]

    @property
    def radius(self) -> float:
        """How far off an answer may be and still be right [m]."""
        return RADIUS[self.kind]


def text_sets(
    osm: Path, told: Path, maps: dict[str, CityMap], n: int, seed: int
) -> Iterator[TextSet]:
    """All sets, `n` texts each but for what people wrote; extracts lie in `osm`, records in `told`."""
    yield from templates(osm, n, seed)
    yield from people(told)
    yield from traps(osm, told, maps, n, seed)


def templates(osm: Path, n: int, seed: int) -> Iterator[TextSet]:
    """Every town in every setting."""
    for city, file in MADE.items():
        for protocol in PROTOCOLS:
            yield TextSet(
                "templates", protocol.title, city, TUNED if city in TRAINED else HELD_OUT,
                _made(osm / file, protocol, n, seed),
            )  # fmt: skip


def _made(path: Path, protocol: Protocol, n: int, seed: int) -> tuple[Told, ...]:
    made = make_queries(
        path, statements=protocol.statements, setting=protocol.setting, n=n, seed=seed
    )
    return tuple(Told(q.text, (q.longitude, q.latitude)) for q in made)


def people(folder: Path) -> Iterator[TextSet]:
    """Even records, which were looked at, and odd ones; without the start, and with it."""
    for city, file in TOLD.items():
        records = read_records(folder / file)
        for start in (False, True):
            texts = tuple(Told(r.text, r.goal, r.start if start else None) for r in records)
            name = f"{city.title()}{', start known' if start else ''}"
            for first, half in enumerate((TUNED, HELD_OUT)):
                yield TextSet("people", name, city, half, texts[first::2])


def traps(osm: Path, told: Path, maps: dict[str, CityMap], n: int, seed: int) -> Iterator[TextSet]:
    """Texts of which nobody may be sure on the map that they are asked of."""
    for home, city in ABROAD.items():
        texts = _made(osm / MADE[home], PROTOCOLS[0], n, seed)
        yield _trap("templates of another town", city, [t.text for t in texts])
    for home, city in ASTRAY.items():
        records = read_records(told / TOLD[home])[::2][:n]
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
    return TextSet("traps", name, city, HELD_OUT, tuple(Told(t) for t in texts))


def _cycle(kind: dict[str, Any], n: int) -> list[str]:
    return [kind["frames"][i % len(kind["frames"])] for i in range(n)]


def _mixed(made: Sequence[Told], frames: Sequence[str]) -> tuple[Told, ...]:
    """Two true sentences, and two that are not understood; where they are true is known."""
    mixed = []
    for i, told in enumerate(made):
        true = told.text.split(". ")[:2]
        foreign = frames[i % len(frames)].replace("{name}", "Xyzal")
        mixed.append(Told(". ".join([*true, foreign]), told.goal))
    return tuple(mixed)


def _names(city: CityMap) -> list[str]:
    """Names of a map that a text may hold: two words and more, of plain letters."""
    names = sorted(set(city.objects.names))
    return [n for n in names if re.fullmatch(r"[A-Z][A-Za-z']+( [A-Z][A-Za-z']+)+", n)]


@dataclass(frozen=True)
class Filler:
    """Fills the gaps of a frame."""

    gaps: dict[str, Sequence[str]]

    @classmethod
    def of(cls, city: CityMap, foreign: Sequence[str], made: Sequence[str]) -> Filler:
        """Names of the map, and of another town those that it does not know."""
        unknown = [n for n in foreign if not city.name_index.named(n)]
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
