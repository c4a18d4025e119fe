"""Texts about places of an extract, made without the package's own reader and words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.errors import OptionError
from placegraph_lab.tables.outdoor.nearby import DIRECTIONS, Bins, Triples, relations
from placegraph_lab.tables.outdoor.outdoor_kernels import SHORTEST
from placegraph_lab.tables.outdoor.places import KEYS, RawCity, read_raw

PLURAL = frozenset({"steps", "traffic_signals", "toilets", "allotments", "garages", "apartments"})
"""Tag values that are said in the plural: "there are steps to my north"."""


@cache
def everyday_words() -> dict[str, tuple[str, ...]]:
    """Read what people call a ``key=value``."""
    text = Path(__file__).with_name("everyday.tsv").read_text("utf-8")
    rows = (line.split("\t") for line in text.splitlines() if not line.startswith("#"))
    return {tag: tuple(words) for tag, *words in rows}


def everyday(key: str, label: str) -> tuple[str, ...]:
    """Everyday words for a tag, where `label` is its value (or its key, for ``yes``)."""
    value = "yes" if label == key else label
    return everyday_words().get(f"{key}={value}", (label.replace("_", " "),))


def with_article(label: str) -> str:
    words = label.replace("_", " ")
    if label in PLURAL:
        return f"are {words}"
    return f"is {'an' if words[:1].lower() in 'aeiou' else 'a'} {words}"


Setting = Literal["none", "replaced", "absent", "synonyms", "names", "speaker"]
"""none; 20 % of relations replaced; 20 % of statements about things that are not there; everyday
words for tag values; names kept (everywhere else they are removed); sentences about the speaker.
"""
SETTINGS: tuple[Setting, ...] = get_args(Setting)

CELL = 50.0  # edge of the grid that viewpoints are drawn from [m]
JITTER = 10.0  # A viewpoint's largest distance from the centre of its cell [m]
SIGHT = 25.0  # objects within this distance of the viewpoint are spoken of [m]
FEWEST = 6  # objects that a cell must hold for a viewpoint in it
NOWHERE = 60.0  # A thing "that is not there" is at least this far from the viewpoint [m]
NOISE = 0.2  # share of statements that noise changes


@dataclass(frozen=True, slots=True)
class SpokenStatement:
    """One statement of a query: the source lies in a direction, seen from the target."""

    source: str  # label, as the raw data have it
    direction: str  # one of `DIRECTIONS`
    target: str  # label; empty where it is the speaker
    source_osm: str
    target_osm: str
    """The objects it was made from; empty for the speaker and for things that are not there."""
    noisy: bool = False  # changed by the noise setting


@dataclass(frozen=True, slots=True)
class Query:
    """A text and the place that it describes."""

    text: str
    longitude: float
    latitude: float  # the true viewpoint [deg]
    statements: tuple[SpokenStatement, ...]


@lru_cache(maxsize=8)
def load(path: str | Path) -> Bins:
    """Raw objects of an extract, sorted into bins; read once a process."""
    return Bins.of(read_raw(path))


def make_queries(
    osm_path: str | Path,
    *,
    statements: int = 6,
    setting: Setting = "none",
    n: int = 500,
    seed: int = 0,
    anywhere: bool = False,
    where: Callable[[Floats], NDArray[np.bool_]] | None = None,
    cells: Floats | None = None,
) -> list[Query]:
    """Make `n` queries of `statements` sentences each from an OpenStreetMap extract.

    The same seed gives the same viewpoints in every setting in which they have enough to say, and
    without ``names`` and ``speaker`` the same true statements under the noise.

    `anywhere`: draw viewpoints from the whole of a cell instead of within 10 m of its centre: a grid
    of cells is then no longer told where to look; `where`: longitude and latitude (n, 2) [deg] to
    whether viewpoints may stand there (n,); `cells`: centres of cells (C, 2) [deg], of the extract's own
    grid where not given.
    """
    bins = load(osm_path)
    city = bins.city
    centers = bins.centers(CELL) if cells is None else city.plane.to_plane(cells)
    full = np.diff(bins.around(centers, SIGHT).starts) >= FEWEST
    if not full.any():
        raise OptionError(f"{osm_path} has no 50 m cell with {FEWEST} objects; give a larger one.")
    place, speech = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(2))
    teller, queries = Teller(bins, setting, statements), list[Query]()
    for _ in range(100 if where is None else 1000):
        viewpoints = centers[place.choice(np.flatnonzero(full), n)]
        if anywhere:
            viewpoints += CELL * (place.random((n, 2)) - 0.5)
        else:  # uniform over a disk
            radius, angle = JITTER * np.sqrt(place.random(n)), 2.0 * np.pi * place.random(n)
            viewpoints += np.stack([radius * np.sin(angle), radius * np.cos(angle)], 1)
        streams = speech.spawn(n)
        allowed = np.ones(n, np.bool_) if where is None else where(city.plane.to_lonlat(viewpoints))
        for i in np.flatnonzero(allowed):
            query = teller.describe(viewpoints[i], streams[i])
            if query is not None:
                queries.append(query)
            if len(queries) == n:
                return queries
    raise OptionError(
        f"{osm_path} has too few places for {n} queries of {statements} statements; ask for fewer."
    )


@dataclass(frozen=True)
class Teller:
    """Describes viewpoints in one setting."""

    bins: Bins
    setting: Setting
    statements: int

    @property
    def city(self) -> RawCity:
        return self.bins.city

    @property
    def label(self) -> NDArray[np.int32]:
        """Labels of the objects (N,), names where the setting keeps them."""
        return self.city.named if self.setting == "names" else self.city.label

    def describe(self, viewpoint: Floats, rng: Generator) -> Query | None:
        """Text for a viewpoint (2,), or None where there is too little to say."""
        told = (
            self.from_here(viewpoint) if self.setting == "speaker" else self.relate_pairs(viewpoint)
        )
        # no sentence is said twice, whichever objects it is true of
        told = list({(s.source, s.direction, s.target): s for s in told}.values())
        if len(told) < self.statements:
            return None
        chosen = rng.choice(len(told), self.statements, replace=False)
        statements = tuple(self.disturb(told[i], viewpoint, rng) for i in chosen)
        longitude, latitude = self.city.plane.to_lonlat(viewpoint).tolist()
        return Query(self.write(statements, rng), longitude, latitude, statements)

    def relate_pairs(self, viewpoint: Floats) -> list[SpokenStatement]:
        """All true statements about two objects of different labels in sight of a viewpoint (2,)."""
        around = self.bins.around(viewpoint[None], SIGHT)
        triples = Triples.of(around)
        city, label = self.city, self.label
        sources, targets = around.objects[triples.source], around.objects[triples.target]
        rows = zip(sources.tolist(), targets.tolist(), triples.relation.tolist(), strict=True)
        return [
            SpokenStatement(
                city.labels[label[a]],
                DIRECTIONS[r],
                city.labels[label[b]],
                city.osm[a],
                city.osm[b],
            )
            for a, b, r in rows
            if label[a] != label[b]
        ]

    def from_here(self, viewpoint: Floats) -> list[SpokenStatement]:
        """All true statements about an object in sight and the speaker at a viewpoint (2,)."""
        around = self.bins.around(viewpoint[None], SIGHT)
        city, told = self.city, []
        for i, point in zip(around.objects.tolist(), around.points, strict=True):
            delta = point - viewpoint
            if np.hypot(*delta) >= SHORTEST:
                label = city.labels[self.label[i]]
                told.append(
                    SpokenStatement(label, DIRECTIONS[int(relations(delta))], "", city.osm[i], "")
                )
        return told

    def disturb(
        self, statement: SpokenStatement, viewpoint: Floats, rng: Generator
    ) -> SpokenStatement:
        """Change the statement with probability `NOISE`, where the setting asks for it."""
        if self.setting not in ("replaced", "absent") or rng.random() >= NOISE:
            return statement
        if self.setting == "replaced":
            direction = str(rng.choice([d for d in DIRECTIONS if d != statement.direction]))
            return replace(statement, direction=direction, noisy=True)
        if rng.random() < 0.5:
            source = self.draw_absent(viewpoint, rng, statement.target)
            return replace(statement, source=source, source_osm="", noisy=True)
        target = self.draw_absent(viewpoint, rng, statement.source)
        return replace(statement, target=target, target_osm="", noisy=True)

    def draw_absent(self, viewpoint: Floats, rng: Generator, other: str) -> str:
        """Draw a label as often as the city has it, but none that is near a viewpoint (2,)."""
        around = self.bins.around(viewpoint[None], NOWHERE)
        near = set(self.label[around.objects].tolist())
        for _ in range(1000):
            label = int(rng.choice(self.label))
            if label not in near and self.city.labels[label] != other:
                return self.city.labels[label]
        raise OptionError("Nothing in this extract is absent from a place; give a larger one.")

    def write(self, statements: tuple[SpokenStatement, ...], rng: Generator) -> str:
        """Put the statements into words."""
        if self.setting == "speaker":
            return " ".join(
                f"There {with_article(s.source)} to my {s.direction}." for s in statements
            )
        words = {label: label for s in statements for label in (s.source, s.target)}
        if self.setting == "synonyms":
            keys = self.keys(statements)
            words = {label: str(rng.choice(everyday(keys[label], label))) for label in words}
        return " ".join(
            f"The {words[s.source]} is on the {s.direction} of the {words[s.target]}."
            for s in statements
        )

    def keys(self, statements: tuple[SpokenStatement, ...]) -> dict[str, str]:
        """OSM key of every label, of the first object that the text means by it."""
        row = self.city.rows
        keys: dict[str, str] = {}
        for s in statements:
            for label, osm in ((s.source, s.source_osm), (s.target, s.target_osm)):
                keys.setdefault(label, KEYS[self.city.key[row[osm]]])
        return keys
