"""Words of a world, read once against the whole; and its rare things, put beside those of a shard."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geo import bounds
from placegraph.outdoor.map.objects import Blocks, CityObjects, columns_of

if TYPE_CHECKING:
    from placegraph.outdoor.language.vocabulary import Vocabulary
    from placegraph.outdoor.map.city import City
    from placegraph.outdoor.map.names import NameIndex
    from placegraph_scale.shards.table import WordTable


Gather = Callable[[NDArray[np.int64]], "list[Thing]"]


@dataclass(frozen=True, eq=False)
class Thing:
    """An object that is rare enough to be spoken of from out of sight, wherever its shard is."""

    osm_type: int
    osm_id: int
    kind: int
    label: str
    name: str
    words: tuple[str, ...]
    """Labels, and names behind a tilde, that it bears."""
    parts: tuple[NDArray[np.float64], ...]
    """Lines or rings, each (n, 2) longitude, latitude [deg]."""
    center: NDArray[np.float64]
    """(2,) longitude, latitude [deg]."""
    extent: float
    """How far it reaches from its centre [m]; what reaches beyond 1 km is walked in sight."""


@dataclass(eq=False)
class Things:
    """Things that were gathered for one query, by row."""

    labels: tuple[str, ...]
    """All labels of the world."""
    rows: list[Thing]

    @property
    def kind(self) -> NDArray[np.uint8]:
        """(N,) POINT, LINE or AREA."""
        return np.array([thing.kind for thing in self.rows], np.uint8)

    def label(self, i: int) -> str:
        """Most specific label of a thing."""
        return self.rows[i].label


@dataclass(frozen=True, eq=False)
class Words:
    """The vocabulary of a world, made once."""

    table: WordTable

    @cached_property
    def vocabulary(self) -> Vocabulary:
        """What words mean: the shipped vocabulary, and every tag value of the world."""
        from placegraph.outdoor.language.vocabulary import Vocabulary

        return Vocabulary.default().of_map(self.table.labels)

    @property
    def name_index(self) -> NameIndex:
        """Proper names of the world."""
        return self.table.names

    @cached_property
    def label_index(self) -> dict[str, list[int]]:
        """Tokens by label and by ``key=*``."""
        from placegraph.outdoor.map.objects import index_of

        return index_of(self.table.labels)

    def block_length(self, bearing: float | None) -> float:
        """How long a block is [m]: as anywhere, since it differs from town to town."""
        return Blocks().length(bearing)


@dataclass(frozen=True, eq=False)
class Gathering:
    """A `Lexicon` of one query: words of the world, and the rare things that it speaks of."""

    words: Words
    gather: Gather
    """Fetches the things that bear tokens from the shards that hold them."""
    objects: Things

    @property
    def label_index(self) -> dict[str, list[int]]:
        """Tokens by label."""
        return self.words.label_index

    @property
    def name_index(self) -> NameIndex:
        """Proper names."""
        return self.words.name_index

    def frequency(self, tokens: NDArray[np.int32], weights: NDArray[np.float32]) -> float:
        """Share of all things in sight, over all viewpoints of the world."""
        return float(weights @ self.words.table.shares(tokens.tolist()))

    def borne(self, tokens: NDArray[np.int32]) -> NDArray[np.int64]:
        """How many things (K,) bear each of these tokens."""
        return self.words.table.counts(tokens.tolist())

    def bearers(self, tokens: NDArray[np.int32]) -> list[NDArray[np.int64]]:
        """Rows of `objects`, which grows by those that were not asked for before."""
        known = {(t.osm_type, t.osm_id): i for i, t in enumerate(self.objects.rows)}
        found: dict[str, set[int]] = {self.words.table.reads(int(token)): set() for token in tokens}
        for thing in self.gather(np.asarray(tokens, np.int64)):
            row = known.setdefault((thing.osm_type, thing.osm_id), len(known))
            if row == len(self.objects.rows):
                self.objects.rows.append(thing)
            for word in thing.words:
                if word in found:
                    found[word].add(row)
        return [np.array(sorted(found[self.words.table.reads(int(t))]), np.int64) for t in tokens]


def rows_of(things: Sequence[Thing], objects: CityObjects) -> NDArray[np.int64]:
    """Rows (K,) of things among objects, -1 where they are not."""
    rows = np.full(len(things), -1, np.int64)
    where = {(t.osm_type, t.osm_id): k for k, t in enumerate(things)}
    wanted = np.array([t.osm_id for t in things], np.int64)
    for row in np.flatnonzero(np.isin(objects.osm_id, wanted)).tolist():
        k = where.get((int(objects.osm_type[row]), int(objects.osm_id[row])))
        if k is not None and rows[k] < 0:
            rows[k] = row
    return rows


def joined(
    city: City, things: Sequence[Thing], key: str, reach: float
) -> tuple[City, NDArray[np.int64]]:
    """A city with the things that it lacks, where any lies within `reach` [m] of its core.

    Returns it, and rows (K,) of all things in it: all -1 where all are too far off. Otherwise all are
    there, since how many a mention has decides how it is understood. What is added is in nobody's
    sight; one speaks of it from afar.
    """
    rows = rows_of(things, city.objects)
    lacks = np.flatnonzero(rows < 0)
    near = any(away(things[k], key) <= reach + things[k].extent for k in lacks.tolist())
    if not len(lacks) or not (near or len(lacks) < len(things)):
        return city, rows
    rows[lacks] = len(city.objects) + np.arange(len(lacks))
    return _with(city, [things[k] for k in lacks.tolist()]), rows


def away(thing: Thing, key: str) -> float:
    """About how far a thing's centre lies from a core [m]; 0 inside."""
    return float(distance(thing.center[None], np.array([bounds(key)]))[0])


def distance(lonlat: NDArray[np.float64], cores: NDArray[np.float64]) -> NDArray[np.float64]:
    """About how far places (N, 2) [deg] lie from cores (N, 4), west to north [deg], in metres."""
    longitude, latitude = lonlat.T
    west, south, east, north = cores.T
    aside = np.maximum((west - longitude) % 360.0, 0.0)
    aside = np.minimum(aside, (longitude - east) % 360.0)
    within = (longitude - west) % 360.0 <= (east - west)
    aside = np.where(within, 0.0, aside)
    up = np.maximum(np.maximum(south - latitude, latitude - north), 0.0)
    # the nearer to the pole, the shorter a degree: never too far
    top = np.minimum(np.maximum(np.abs(latitude), np.maximum(np.abs(south), np.abs(north))), 89.9)
    found: NDArray[np.float64] = np.hypot(aside * np.cos(np.radians(top)), up) * 111_000.0
    return found


def _with(city: City, things: Sequence[Thing]) -> City:
    """City with more objects, which none of its viewpoints has in sight."""
    o = city.objects
    parts = [city.plane.to_plane(part) for thing in things for part in thing.parts]
    points = np.concatenate([o.points, *parts]).astype(np.float32)
    centers = city.plane.to_plane(np.array([thing.center for thing in things]))
    named = np.array([bool(thing.name) for thing in things])
    n = len(things)
    objects = replace(
        o,
        osm_type=np.append(o.osm_type, [t.osm_type for t in things]).astype(o.osm_type.dtype),
        osm_id=np.append(o.osm_id, [t.osm_id for t in things]),
        kind=np.append(o.kind, [t.kind for t in things]).astype(o.kind.dtype),
        label_starts=_on(o.label_starts, np.ones(n, np.int32)),
        label_values=np.append(o.label_values, len(o.labels) + np.arange(n)).astype(np.int32),
        name_starts=_on(o.name_starts, named),
        name_values=np.append(o.name_values, len(o.names) + np.arange(named.sum())).astype(np.int32),
        part_starts=_on(o.part_starts, np.array([len(thing.parts) for thing in things])),
        point_starts=_on(o.point_starts, np.array([len(part) for part in parts])),
        points=points, center=np.concatenate([o.center, centers]).astype(np.float32),
        labels=(*o.labels, *(t.label for t in things)),
        names=(*o.names, *(t.name for t in things if t.name)),
    )  # fmt: skip
    made = replace(city, objects=objects)
    made.__dict__["_views"] = city.views
    made.__dict__["columns"] = columns_of(objects, city.tokens)
    return made


def _on(starts: NDArray[np.int32], counts: NDArray[np.generic]) -> NDArray[np.int32]:
    """Starts of a CSR with more rows."""
    return np.append(starts, starts[-1] + np.cumsum(counts)).astype(starts.dtype)
