"""Steps of a search in one shard, in the words and with the prior of the world."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geo import bounds, held
from placegraph.core.geometry import LocalPlane
from placegraph.outdoor.likelihood.query import Far, MentionTokens
from placegraph.outdoor.map.index import REACH
from placegraph.outdoor.map.index_write import STRIDE
from placegraph.outdoor.map.objects import Blocks, CityObjects, columns_of
from placegraph.outdoor.search.answer import evidence_at
from placegraph.outdoor.search.candidates import MOST_CANDIDATES, Candidates, find_candidates
from placegraph.outdoor.search.posterior import ALL, look_around
from placegraph.outdoor.search.posterior import score as score_of
from placegraph.outdoor.search.request import LocationPrior, Request
from placegraph.world.outside import BuildingScorer

if TYPE_CHECKING:
    from placegraph.core.estimate import CityEstimate, Evidence
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.language.vocabulary import Vocabulary
    from placegraph.outdoor.likelihood.query import Query
    from placegraph.outdoor.map.city import City
    from placegraph.outdoor.map.index import ViewIndex
    from placegraph.outdoor.map.names import NameIndex
    from placegraph.outdoor.search.ask import Question
    from placegraph.world.outside import BuildingScore
    from placegraph_scale.shards.words import WordTable

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


class Fix(NamedTuple):
    """Where the speaker is known to be near."""

    longitude: float
    latitude: float
    radius: float
    """[m]"""
    norm: float = 0.0
    """Log of what all viewpoints of the world weigh together, before it is known how far off it is."""


@dataclass(frozen=True, eq=False)
class Asked:
    """A query against the whole world, as every shard gets it."""

    query: Query
    """Its tokens are those of the world, its rare objects rows of `things`."""
    words: tuple[str, ...]
    """What each of its tokens reads (`WordTable.reads`)."""
    things: tuple[Thing, ...]
    viewpoints: int
    """Of the world."""
    fix: Fix | None
    key: str = field(default_factory=lambda: uuid4().hex)
    """Tells it from other questions."""


class Proposed(NamedTuple):
    """Candidates of a shard, the most promising first."""

    rows: NDArray[np.int32]
    """(K,) viewpoints of the shard."""
    bounds: NDArray[np.float64]
    """(K,) on the likelihood ratio, times the prior against `highest`."""
    far: NDArray[np.float32]
    """(K, S) what things out of sight add; (K, 0) where it is nothing."""
    log_prior: NDArray[np.float64]
    """(K,)"""
    stands: NDArray[np.float64]
    """(K,) as of `Candidates`."""
    highest: float
    """Largest log prior of the shard."""
    origin: tuple[float, float]
    """Of the shard's plane [deg]."""
    least: float
    """Log of what a bound times the prior must be at least to count."""
    scored: tuple[NDArray[np.int64], Compared] | None = None
    """Which of them (J,) were compared already, and what came of it."""

    def part(self, kept: NDArray[np.int64]) -> Proposed:
        """Some of the candidates."""
        return self._replace(
            rows=self.rows[kept], bounds=self.bounds[kept], far=self.far[kept],
            log_prior=self.log_prior[kept], stands=self.stands[kept], scored=None,
        )  # fmt: skip

    def candidates(self, statements: int) -> Candidates:
        """As those of a city, each for itself."""
        far = self.far if self.far.shape[1] else np.zeros((len(self.rows), statements), np.float32)
        return Candidates(self.rows, self.bounds, far, np.zeros(len(self.rows)))


class Compared(NamedTuple):
    """Scores of candidates."""

    scores: NDArray[np.float64]
    """(K,) log-likelihood ratios."""
    positions: NDArray[np.float64]
    """(K, 2) east, north in the shard's plane [m]."""


@dataclass(frozen=True, eq=False)
class Shard:
    """A shard that is open."""

    key: str
    city: CityMap
    requests: dict[str, Request] = field(default_factory=dict)
    """What it made of the question that it was asked last, by its key: other steps begin with that."""

    @cached_property
    def inside(self) -> NDArray[np.bool_]:
        """Which viewpoints (W,) lie in the core."""
        places = self.city.plane.to_lonlat(self.city.views.positions.astype(np.float64))
        return held(places, self.key)

    @cached_property
    def tokens(self) -> dict[str, int]:
        """Tokens by what they read, as of `WordTable.reads`."""
        o = self.city.objects
        return {word: i for i, word in enumerate([*o.labels, *(f"~{name}" for name in o.names)])}

    @property
    def origin(self) -> tuple[float, float]:
        """Of its plane [deg]."""
        return self.city.plane.longitude, self.city.plane.latitude


@dataclass(frozen=True, eq=False)
class _Within(LocationPrior):
    """A prior that is known of every viewpoint: the world's, and none outside the core."""

    given: NDArray[np.float64] | None = None
    """(W,)"""

    @property
    def is_informative(self) -> bool:
        """It always is: viewpoints outside the core are not meant."""
        return True

    def log_of_views(self, views: ViewIndex) -> NDArray[np.float64]:
        """Log prior (W,) of the shard's viewpoints among all of the world."""
        del views
        assert self.given is not None  # noqa: S101  # it is made with one
        return self.given


def gathered(shard: Shard, words: tuple[str, ...]) -> list[Thing]:
    """Things that bear any of these words and have their centre in the core."""
    city, tokens = shard.city, [shard.tokens[w] for w in words if w in shard.tokens]
    rows = np.unique(np.concatenate([np.zeros(0, np.int64), *city.bearers(np.array(tokens, int))]))
    centers = city.plane.to_lonlat(city.objects.center[rows].astype(np.float64))
    starts, values, _ = city.tokens
    known = [*city.objects.labels, *(f"~{name}" for name in city.objects.names)]
    o = city.objects
    return [
        Thing(
            int(o.osm_type[i]), int(o.osm_id[i]), int(o.kind[i]), o.label(i), o.name(i),
            tuple(known[t] for t in values[starts[i] : starts[i + 1]]),
            tuple(city.plane.to_lonlat(part.astype(np.float64)) for part in o.parts(i)), center,
            min(1000.0, float(np.hypot(*(np.concatenate(o.parts(i)) - o.center[i]).T).max())),
        )
        for i, center in zip(rows.tolist(), centers, strict=True)
        if held(center[None], shard.key)[0]
    ]  # fmt: skip


def weighed(shard: Shard, fix: Fix) -> tuple[float, float, bool]:
    """Largest and total log weight of a fix over the core, and whether it reaches any viewpoint."""
    off = _off(shard, fix)
    if not len(off):
        return -np.inf, -np.inf, False
    east_north = shard.city.plane.to_plane((fix.longitude, fix.latitude))
    delta = np.abs(shard.city.views.positions[shard.inside] - east_north).max(axis=1)
    reached = bool((delta <= 4.0 * fix.radius + REACH).any())
    return float(off.max()), float(np.logaddexp.reduce(off)), reached


def _off(shard: Shard, fix: Fix) -> NDArray[np.float64]:
    """Log weight (V,) of a fix at the viewpoints of the core, as `LocationPrior.log_of` has it."""
    near = shard.city.plane.to_plane((fix.longitude, fix.latitude))
    sigma = np.hypot(fix.radius / 1.1774, STRIDE / 2)
    positions = shard.city.views.positions[shard.inside].astype(np.float64)
    return np.asarray(-0.5 * (((positions - near) / sigma) ** 2).sum(axis=1))


def requested(shard: Shard, asked: Asked) -> Request:
    """The query in the tokens and rows of a shard, and the prior of its viewpoints."""
    if asked.key not in shard.requests:
        shard.requests.clear()
        shard.requests[asked.key] = _requested(shard, asked)
    return shard.requests[asked.key]


def _requested(shard: Shard, asked: Asked) -> Request:
    prior = np.full(len(shard.inside), -np.inf)
    if asked.fix is None:
        prior[shard.inside] = -np.log(asked.viewpoints)
    else:
        prior[shard.inside] = _off(shard, asked.fix) - asked.fix.norm
    inside = partial(_holds, shard.city.plane, shard.key)  # not the shard, which holds this
    city, query = _translated(shard, asked)
    return Request(city, query, _Within(inside=inside, given=prior))


def _holds(plane: LocalPlane, key: str, positions: NDArray[np.float64]) -> NDArray[np.bool_]:
    return held(plane.to_lonlat(positions), key)


def _translated(shard: Shard, asked: Asked) -> tuple[City, Query]:
    """City and query with one another's tokens and objects."""
    query = asked.query
    rows = np.array([shard.tokens.get(word, -1) for word in asked.words], np.int32)
    known = rows >= 0
    before = np.concatenate(([0], np.cumsum(known))).astype(np.int64)
    mentions = MentionTokens(
        before[query.mentions.starts], rows[known], query.mentions.weights[known]
    )
    far = query.far
    city: City = shard.city
    if far is not None:
        reach = 4.0 * float(far.scale.max(initial=0.0))
        city, at = joined(city, asked.things, shard.key, reach)
        there = at[far.objects] >= 0
        before = np.concatenate(([0], np.cumsum(there))).astype(np.int64)
        anchors = at[far.anchors]
        far = Far(
            before[far.starts], at[far.objects][there], far.fits[there], far.scale, far.share,
            anchors[anchors >= 0],
        )  # fmt: skip
    return city, replace(query, mentions=mentions, far=far)


def proposed(shard: Shard, asked: Asked, least: float, drawn: int) -> Proposed:
    """The most promising viewpoints of the core; `least` is the log of what is to count.

    `drawn` stand for all others.
    """
    request = requested(shard, asked)
    prior = request.log_prior
    highest, n = float(prior.max(initial=-np.inf)), len(asked.query.used)
    none = np.zeros(0)
    found = Candidates(none.astype(np.int32), none, np.zeros((0, n), np.float32), none)
    if highest > -np.inf:
        found = find_candidates(request, drawn, float(np.exp(min(least - highest, 690.0))))
    rows, far = found.rows, found.far
    if asked.query.far is None:
        far = far[:, :0]
    return Proposed(
        rows, found.bounds, far, prior[rows], found.stands, highest, shard.origin, least
    )


def compared(shard: Shard, asked: Asked, chosen: Proposed) -> Compared:
    """Scores of candidates."""
    some = chosen.candidates(len(asked.query.used))
    scores = score_of(requested(shard, asked), some, ALL).scores.astype(np.float64)
    return Compared(scores, shard.city.views.positions[chosen.rows].astype(np.float64))


def looked(
    shard: Shard, asked: Asked, chosen: Proposed
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A closer look around candidates; as `look_around`."""
    some = chosen.candidates(len(asked.query.used))
    return look_around(requested(shard, asked), some.rows, some.far)


def explained(
    shard: Shard, asked: Asked, lonlats: list[tuple[float, float]]
) -> list[tuple[Evidence, ...]]:
    """What speaks for and against places [deg]."""
    request = requested(shard, asked)
    places = map(shard.city.plane.to_plane, lonlats)
    return [evidence_at(at, request.city, request.query) for at in places]


def judged(
    shard: Shard, asked: Asked, buildings: list[NDArray[np.float64]]
) -> list[BuildingScore | None]:
    """What was said of buildings, by their corners (4, 2) [deg]; None of what is off the map."""
    scorer = BuildingScorer(shard.city, requested(shard, asked))
    return [scorer.score(corners) for corners in buildings]


def asked_back(shard: Shard, found: CityEstimate) -> Question | None:
    """Question that tells the modes of an estimate apart."""
    return shard.city.ask(found)


def named(shard: Shard, lonlats: list[tuple[float, float]]) -> list[str]:
    """Cells that places [deg] lie in."""
    return [shard.city.cells.nearest(shard.city.plane.to_plane(at)) for at in lonlats]


def counting(proposals: Sequence[Proposed]) -> list[tuple[int, NDArray[np.int64]]]:
    """Which proposals, and rows of each, count for themselves among all of these.

    Among more proposals no others count.
    """
    told = joined_columns([own_bounds(p) for p in proposals])
    which = joined_columns([np.full(len(p.rows), i) for i, p in enumerate(proposals)], np.int64)
    least = max((p.least for p in proposals), default=-np.inf)
    best = np.argsort(-told, kind="stable")[:MOST_CANDIDATES]
    best = best[(told[best] >= least) & (told[best] > -np.inf)]
    first = np.concatenate(([0], np.cumsum([len(p.rows) for p in proposals]))).astype(np.int64)
    return [
        (i, np.sort(best[which[best] == i]) - first[i]) for i in np.unique(which[best]).tolist()
    ]


def own_bounds(proposed: Proposed) -> NDArray[np.float64]:
    """Log of bounds times the prior (K,), -inf of what stands for others."""
    with np.errstate(divide="ignore"):
        told = np.log(proposed.bounds) + proposed.highest
    return np.where(proposed.stands == 0.0, told, -np.inf)


def joined_columns(parts: list[NDArray[Any]], kind: type = np.float64) -> NDArray[Any]:
    """Concatenate parts of a column; of none an empty one of a kind."""
    return np.concatenate([np.zeros(0, kind), *parts])
