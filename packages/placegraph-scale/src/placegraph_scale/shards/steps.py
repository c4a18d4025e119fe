"""Steps of a search in one shard: the stages of a city's search, with the words and prior of the world."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geo import are_in_tile, tile_bounds
from placegraph.core.geometry import LocalPlane
from placegraph.outdoor.likelihood.query import DistantObjects, MentionTokens, Query
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.index import REACH, STRIDE, ViewIndex
from placegraph.outdoor.map.objects import CityObjects, columns_of, index_of
from placegraph.outdoor.map.street_graph import Blocks
from placegraph.outdoor.search.locate import find_evidence
from placegraph.outdoor.search.posterior import (
    MAX_CANDIDATES,
    NO_MARGIN,
    Candidates,
    find_candidates,
    score_around,
)
from placegraph.outdoor.search.posterior import score_candidates as score_of
from placegraph.outdoor.search.request import LocationPrior, Matching, Request
from placegraph.world.towns import BuildingScore, BuildingScorer
from placegraph_scale.folder import check_digest
from placegraph_scale.shards.words import core_of

if TYPE_CHECKING:
    from placegraph.core.estimate import CityEstimate, Evidence
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.language.vocabulary import Vocabulary
    from placegraph.outdoor.map.names import NameIndex
    from placegraph.outdoor.search.ask import Question
    from placegraph_scale.shards.words import WordTable

Floats = NDArray[np.float64]
Gather = Callable[[NDArray[np.int64]], "list[RareObject]"]
DERIVED = 1.75
"""Bytes that open objects take for a byte of their columns, with texts and what is derived."""
MATCHING = Matching()
"""Options of the search in each shard."""


@dataclass(frozen=True, eq=False)
class RareObject:
    """An object rare enough to be mentioned from out of sight, wherever its shard is."""

    osm_type: int
    osm_id: int
    kind: int
    label: str
    name: str
    words: tuple[str, ...]
    """Its labels, and its names behind a tilde."""
    parts: tuple[Floats, ...]
    """Lines or rings, each (n, 2) longitude, latitude [deg]."""
    center: Floats
    """(2,) longitude, latitude [deg]."""
    extent: float
    """Distance from its centre to its farthest point [m]."""


@dataclass(eq=False)
class RareObjects:
    """Rare objects that one query mentions, by row."""

    labels: tuple[str, ...]
    """All labels of the world."""
    rows: list[RareObject]

    @property
    def kind(self) -> NDArray[np.uint8]:
        """(N,) POINT, LINE or AREA."""
        return np.array([thing.kind for thing in self.rows], np.uint8)

    def label(self, i: int) -> str:
        """Return the most specific label of an object."""
        return self.rows[i].label


@dataclass(frozen=True, eq=False)
class WorldWords:
    """Vocabulary of a world, made once."""

    table: WordTable

    @cached_property
    def vocabulary(self) -> Vocabulary:
        """Meanings of words: the shipped vocabulary, and every tag value of the world."""
        from placegraph.outdoor.language.vocabulary import Vocabulary

        return Vocabulary.default().of_map(self.table.labels)

    @property
    def name_index(self) -> NameIndex:
        """Proper names of the world."""
        return self.table.names

    @cached_property
    def label_index(self) -> dict[str, list[int]]:
        """Tokens by label and by ``key=*``."""
        return index_of(self.table.labels)

    def block_length(self, bearing: float | None) -> float:
        """Return the length of a block [m]: as anywhere, since it differs from town to town."""
        return Blocks().length(bearing)


@dataclass(frozen=True, eq=False)
class QueryLexicon:
    """A `Lexicon` of one query: words of the world, and the rare objects that it mentions."""

    words: WorldWords
    gather: Gather
    """Fetches the objects that bear tokens from the shards that hold them."""
    objects: RareObjects

    @property
    def label_index(self) -> dict[str, list[int]]:
        """Tokens by label."""
        return self.words.label_index

    @property
    def name_index(self) -> NameIndex:
        """Proper names."""
        return self.words.name_index

    def frequency(self, tokens: NDArray[np.int32], weights: NDArray[np.float32]) -> float:
        """Return the share of all objects in sight, over all viewpoints of the world."""
        return float(weights @ self.words.table.shares(tokens.tolist()))

    def count_bearers(self, tokens: NDArray[np.int32]) -> NDArray[np.int64]:
        """Return the number of objects (K,) that bear each of these tokens."""
        return self.words.table.counts(tokens.tolist())

    def bearers(self, tokens: NDArray[np.int32]) -> list[NDArray[np.int64]]:
        """Return rows of `objects`, which grows by those that were not asked for before."""
        known = {(t.osm_type, t.osm_id): i for i, t in enumerate(self.objects.rows)}
        texts = [self.words.table.text(int(token)) for token in tokens]
        found: dict[str, set[int]] = {text: set() for text in texts}
        for thing in self.gather(np.asarray(tokens, np.int64)):
            row = known.setdefault((thing.osm_type, thing.osm_id), len(known))
            if row == len(self.objects.rows):
                self.objects.rows.append(thing)
            for word in thing.words:
                if word in found:
                    found[word].add(row)
        return [np.array(sorted(found[text]), np.int64) for text in texts]


class Fix(NamedTuple):
    """Location prior of a query."""

    longitude: float
    latitude: float
    radius: float
    """[m]"""
    norm: float = 0.0
    """Log of the weight of all viewpoints of the world, before it is known how far off the prior is."""


@dataclass(frozen=True, eq=False)
class ShardQuery:
    """A query against the whole world, as every shard gets it."""

    query: Query
    """Its tokens are those of the world, its rare objects rows of `rare_objects`."""
    words: tuple[str, ...]
    """Text of each of its tokens (`WordTable.text`)."""
    rare_objects: tuple[RareObject, ...]
    viewpoints: int
    """Number of viewpoints of the world."""
    fix: Fix | None
    key: str = field(default_factory=lambda: uuid4().hex)
    """Tells it from other queries."""


class CandidateScores(NamedTuple):
    """Scores of candidates of a shard."""

    scores: Floats
    """(K,) log-likelihood ratios."""
    positions: Floats
    """(K, 2) east, north in the shard's plane [m]."""


class Proposal(NamedTuple):
    """Candidates of a shard, the most promising first."""

    rows: NDArray[np.int32]
    """(K,) viewpoints of the shard."""
    bounds: Floats
    """(K,) on the likelihood ratio, times the prior against `highest`."""
    far: NDArray[np.float32]
    """(K, S) contribution of objects out of sight; (K, 0) where it is nothing."""
    log_prior: Floats
    """(K,)"""
    multiplicity: Floats
    """(K,) 0, or the number of viewpoints that a sample represents (`Candidates`)."""
    highest: float
    """Largest log prior of the shard."""
    origin: tuple[float, float]
    """Origin of the shard's plane [deg]."""
    least: float
    """Log of a bound times the prior below which candidates do not count."""
    scored: tuple[NDArray[np.int64], CandidateScores] | None = None
    """Rows of candidates (J,) that were scored already, and their scores."""

    def part(self, rows: NDArray[np.int64]) -> Proposal:
        """Return some of the candidates."""
        return self._replace(
            rows=self.rows[rows], bounds=self.bounds[rows], far=self.far[rows],
            log_prior=self.log_prior[rows], multiplicity=self.multiplicity[rows], scored=None,
        )  # fmt: skip

    def candidates(self, statements: int) -> Candidates:
        """Return the candidates as those of a city, each for itself."""
        far = self.far if self.far.shape[1] else np.zeros((len(self.rows), statements), np.float32)
        return Candidates(self.rows, self.bounds, far, np.zeros(len(self.rows)))

    @property
    def log_bounds(self) -> Floats:
        """Log of bounds times the prior (K,), -inf for candidates that stand for others."""
        with np.errstate(divide="ignore"):
            logs = np.log(self.bounds) + self.highest
        return np.where(self.multiplicity == 0.0, logs, -np.inf)


def choose_best(proposals: Sequence[Proposal]) -> list[tuple[int, NDArray[np.int64]]]:
    """Return which proposals, and rows of each, count for themselves among all of these.

    Among more proposals no others count.
    """
    logs = join_columns([p.log_bounds for p in proposals])
    which = join_columns([np.full(len(p.rows), i) for i, p in enumerate(proposals)], np.int64)
    least = max((p.least for p in proposals), default=-np.inf)
    best = np.argsort(-logs, kind="stable")[:MAX_CANDIDATES]
    best = best[(logs[best] >= least) & (logs[best] > -np.inf)]
    first = np.concatenate(([0], np.cumsum([len(p.rows) for p in proposals]))).astype(np.int64)
    return [
        (i, np.sort(best[which[best] == i]) - first[i]) for i in np.unique(which[best]).tolist()
    ]


def join_columns(parts: list[NDArray[Any]], kind: type = np.float64) -> NDArray[Any]:
    """Concatenate parts of a column; return an empty one of a kind where there is no part."""
    return np.concatenate([np.zeros(0, kind), *parts])


class ShardSource(NamedTuple):
    """Core and file of a shard."""

    key: str
    path: Path
    digest: str
    size: int
    """[bytes]"""


@dataclass(eq=False)
class Shard:
    """A shard that is open: its viewpoints, and its objects as long as they are needed.

    Viewpoints take a quarter of the memory. They tell which places a text may be about; few of these are
    then compared with objects.
    """

    source: ShardSource
    sight: City
    """Its viewpoints, without objects."""
    hashes: NDArray[np.int64]
    """(T,) hashes of the texts of tokens (`WordTable.text`), sorted; they hold in this process alone."""
    tokens: NDArray[np.int32]
    """(T,) tokens, in the order of `hashes`."""
    ids: NDArray[np.uint32]
    """(N,) last 32 bits of the ids of objects."""
    core: NDArray[np.uint8]
    """Bits of the viewpoints that lie in the core."""
    city_map: CityMap | None
    """The city with its objects; None while these are closed."""
    requests: dict[str, Request] = field(default_factory=dict)
    """Request of the last query, by its key: other steps begin with that."""

    @classmethod
    def open(cls, source: ShardSource) -> Self:
        """Open a shard; raises `InputError` or `MapError`."""
        city = _open_city(source)
        if city.index is None:
            city.look_around(core_of(source.key, city.plane))
        o, views = city.objects, city.views
        hashes = np.array([hash(text) for text in list_texts(city)])
        order, places = np.argsort(hashes), views.positions_of(np.arange(len(views)))
        core = are_in_tile(city.plane.to_lonlat(places.astype(np.float64)), source.key)
        none: Any = {f.name: getattr(o, f.name)[: f.name.endswith("starts")] for f in fields(o)}
        cells = replace(city.cells, points=city.cells.points[:0].copy())
        # a copy, which does not hold what it was cut from
        sight = City(city.plane, deepcopy(CityObjects(**none)), cells, city.source, {})
        object.__setattr__(sight, "index", views)
        ids = o.osm_id.astype(np.uint32)
        return cls(
            source, sight, hashes[order], order.astype(np.int32), ids, np.packbits(core), city
        )

    @property
    def key(self) -> str:
        """Path of its core in the quadtree."""
        return self.source.key

    @property
    def city(self) -> CityMap:
        """The city with its objects, which are opened again where they are closed."""
        if self.city_map is None:
            self.city_map = _open_city(self.source, self.sight.views)
        return self.city_map

    @property
    def size(self) -> float:
        """Approximate memory of the shard [bytes]."""
        own = [*self.sight.views.columns, self.hashes, self.tokens, self.ids, self.core]
        objects = [] if self.city_map is None else vars(self.city_map.objects).values()
        return sum(
            share * sum(c.nbytes for c in columns if isinstance(c, np.ndarray))
            for share, columns in ((1.0, own), (DERIVED, objects))
        )

    @property
    def places(self) -> Floats:
        """(W, 2) east, north of all viewpoints [m]; not cached, since a process holds many shards."""
        views = self.sight.views
        return views.positions_of(np.arange(len(views))).astype(np.float64)

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Which viewpoints (W,) lie in the core."""
        return np.unpackbits(self.core, count=len(self.sight.views)).view(np.bool_)

    def find_tokens(self, texts: Sequence[str]) -> NDArray[np.int32]:
        """Return the tokens (K,) of texts, as of `WordTable.text`; -1 for none."""
        wanted = np.array([hash(text) for text in texts], np.int64)
        at = np.minimum(np.searchsorted(self.hashes, wanted), len(self.hashes) - 1)
        return np.where(self.hashes[at] == wanted, self.tokens[at], -1).astype(np.int32)

    def request(self, shard_query: ShardQuery, *, objects: bool = True) -> Request:
        """Translate a query into the tokens and rows of the shard, with the prior of its viewpoints.

        Its city may lack `objects` where the query mentions none that is out of sight.
        """
        found = self.requests.get(shard_query.key)
        if found is None:
            weights: Any = -np.log(shard_query.viewpoints)
            if shard_query.fix is not None:
                weights = _log_prior(self, shard_query.fix) - shard_query.fix.norm
            holds = partial(_holds, self.sight.plane, self.key)  # not the shard, which holds this
            city, query = _translate(self, shard_query)
            found = Request(
                city, query, _GivenPrior(inside=holds, core=self.core, weights=weights), MATCHING
            )
            self.requests.clear()
            self.requests[shard_query.key] = found
        # a copy: what is derived of viewpoints would take as much as they do
        return replace(
            found, city=self.city if objects and found.city is self.sight else found.city
        )


def list_texts(city: City) -> list[str]:
    """List the texts of all tokens, as of `WordTable.text`."""
    return [*city.objects.labels, *(f"~{name}" for name in city.objects.names)]


def _open_city(source: ShardSource, views: ViewIndex | None = None) -> CityMap:
    """Open the city of a shard; raises `InputError` or `MapError`."""
    from placegraph.outdoor.city import CityMap

    check_digest(source.path, source.digest)
    return CityMap.open(source.path, views)


@dataclass(frozen=True, eq=False)
class _GivenPrior(LocationPrior):
    """A prior that is known of every viewpoint: the world's, and none outside the core."""

    core: NDArray[np.uint8] = field(kw_only=True)
    """Bits of the viewpoints that lie in the core."""
    weights: Any = field(kw_only=True)
    """Log prior of each of these, or of any."""

    @property
    def is_informative(self) -> bool:
        """Always true: viewpoints outside the core are not meant."""
        return True

    def evaluate_views(self, views: ViewIndex) -> Floats:
        """Return the log prior (W,) of the shard's viewpoints among all of the world."""
        prior: Any = np.full(len(views), -np.inf, np.float32)
        prior[np.unpackbits(self.core, count=len(views)).view(np.bool_)] = self.weights
        return prior


def _holds(plane: LocalPlane, key: str, positions: Floats) -> NDArray[np.bool_]:
    return are_in_tile(plane.to_lonlat(positions), key)


def _log_prior(shard: Shard, fix: Fix) -> Floats:
    """Return the log weight (V,) of a fix at the viewpoints of the core; see `LocationPrior.evaluate`."""
    near = shard.sight.plane.to_plane((fix.longitude, fix.latitude))
    sigma = np.hypot(fix.radius / 1.1774, STRIDE / 2)
    return np.asarray(-0.5 * (((shard.places[shard.inside] - near) / sigma) ** 2).sum(axis=1))


def _translate(shard: Shard, shard_query: ShardQuery) -> tuple[City, Query]:
    """Return city and query with one another's tokens and objects."""
    query = shard_query.query
    rows = shard.find_tokens(shard_query.words)
    known = rows >= 0
    before = np.concatenate(([0], np.cumsum(known))).astype(np.int64)
    mentions = MentionTokens(
        before[query.mentions.starts], rows[known], query.mentions.weights[known]
    )
    far = query.distant
    city: City = shard.sight
    if far is not None:
        reach = 4.0 * float(far.scale.max(initial=0.0))
        city, at = add_objects(shard, shard_query.rare_objects, reach)
        there = at[far.objects] >= 0
        before = np.concatenate(([0], np.cumsum(there))).astype(np.int64)
        anchors = at[far.anchors]
        far = DistantObjects(
            before[far.starts], at[far.objects][there], far.weights[there], far.sites, far.scale,
            far.share, anchors[anchors >= 0],
        )  # fmt: skip
    return city, replace(query, mentions=mentions, distant=far)


def add_objects(
    shard: Shard, rare_objects: Sequence[RareObject], reach: float
) -> tuple[City, NDArray[np.int64]]:
    """Add the objects that a shard lacks, where any lies within `reach` [m] of its core.

    Returns the city, and rows (K,) of all objects in it: all -1 where all are too far off. Otherwise all
    are there, since how many a mention has decides how it is understood. Added objects are in nobody's
    sight; one speaks of them from afar.
    """
    rows, core = np.full(len(rare_objects), -1, np.int64), np.array([tile_bounds(shard.key)])
    near = np.array([
        float(distance(t.center[None], core)[0]) <= reach + t.extent for t in rare_objects
    ], np.bool_)  # fmt: skip
    wanted = np.array([t.osm_id for t in rare_objects], np.int64)
    if not near.any() and not np.isin(shard.ids, wanted.astype(np.uint32)).any():
        return shard.sight, rows
    city, o = shard.city, shard.city.objects
    where = {(t.osm_type, t.osm_id): k for k, t in enumerate(rare_objects)}
    for row in np.flatnonzero(np.isin(o.osm_id, wanted)).tolist():
        k = where.get((int(o.osm_type[row]), int(o.osm_id[row])))
        if k is not None and rows[k] < 0:
            rows[k] = row
    lacks = np.flatnonzero(rows < 0)
    if not len(lacks) or not (near[lacks].any() or len(lacks) < len(rare_objects)):
        return city, rows
    rows[lacks] = len(o) + np.arange(len(lacks))
    objects = _append(o, [rare_objects[k] for k in lacks.tolist()], city.plane)
    made = replace(city, objects=objects)
    made.__dict__["_views"] = city.views
    made.__dict__["columns"] = columns_of(objects, city.tokens)
    return made, rows


def distance(lonlat: Floats, cores: Floats) -> Floats:
    """Return about how far [m] places (N, 2) [deg] lie from cores (N, 4), west to north [deg]; 0 inside."""
    longitude, latitude = lonlat.T
    west, south, east, north = cores.T
    aside = np.maximum((west - longitude) % 360.0, 0.0)
    aside = np.minimum(aside, (longitude - east) % 360.0)
    within = (longitude - west) % 360.0 <= (east - west)
    aside = np.where(within, 0.0, aside)
    up = np.maximum(np.maximum(south - latitude, latitude - north), 0.0)
    # the nearer to the pole, the shorter a degree: never too far
    top = np.minimum(np.maximum(np.abs(latitude), np.maximum(np.abs(south), np.abs(north))), 89.9)
    found: Floats = np.hypot(aside * np.cos(np.radians(top)), up) * 111_000.0
    return found


def _append(o: CityObjects, rare_objects: Sequence[RareObject], plane: LocalPlane) -> CityObjects:
    """Return objects of a city with more of them."""

    def extend(starts: NDArray[np.int32], counts: NDArray[np.generic]) -> NDArray[np.int32]:
        return np.append(starts, starts[-1] + np.cumsum(counts)).astype(starts.dtype)

    parts = [plane.to_plane(part) for thing in rare_objects for part in thing.parts]
    named = np.array([bool(thing.name) for thing in rare_objects])
    n = len(rare_objects)
    return replace(
        o,
        osm_type=np.append(o.osm_type, [t.osm_type for t in rare_objects]).astype(o.osm_type.dtype),
        osm_id=np.append(o.osm_id, [t.osm_id for t in rare_objects]),
        kind=np.append(o.kind, [t.kind for t in rare_objects]).astype(o.kind.dtype),
        label_starts=extend(o.label_starts, np.ones(n, np.int32)),
        label_values=np.append(o.label_values, len(o.labels) + np.arange(n)).astype(np.int32),
        name_starts=extend(o.name_starts, named),
        name_values=np.append(o.name_values, len(o.names) + np.arange(named.sum())).astype(np.int32),
        part_starts=extend(o.part_starts, np.array([len(thing.parts) for thing in rare_objects])),
        point_starts=extend(o.point_starts, np.array([len(part) for part in parts])),
        points=np.concatenate([o.points, *parts]).astype(np.float32),
        labels=(*o.labels, *(t.label for t in rare_objects)),
        names=(*o.names, *(t.name for t in rare_objects if t.name)),
    )  # fmt: skip


def gather(shard: Shard, words: tuple[str, ...]) -> list[RareObject]:
    """Return the objects that bear any of these words and have their centre in the core."""
    city, tokens = shard.city, shard.find_tokens(words)
    rows = np.unique(np.concatenate([np.zeros(0, np.int64), *city.bearers(tokens[tokens >= 0])]))
    centers = city.plane.to_lonlat(city.objects.center[rows].astype(np.float64))
    starts, values, _ = city.tokens
    o = city.objects
    texts = list_texts(city)
    return [
        RareObject(
            int(o.osm_type[i]), int(o.osm_id[i]), int(o.kind[i]), o.label(i), o.name(i),
            tuple(texts[v] for v in values[starts[i] : starts[i + 1]].tolist()),
            tuple(city.plane.to_lonlat(part.astype(np.float64)) for part in o.parts(i)), center,
            min(1000.0, float(np.hypot(*(np.concatenate(o.parts(i)) - o.center[i]).T).max())),
        )
        for i, center in zip(rows.tolist(), centers, strict=True)
        if are_in_tile(center[None], shard.key)[0]
    ]  # fmt: skip


def weigh_fix(shard: Shard, fix: Fix) -> tuple[float, float, bool]:
    """Return the largest and total log weight of a fix in the core, and whether it reaches any viewpoint."""
    off = _log_prior(shard, fix)
    if not len(off):
        return -np.inf, -np.inf, False
    east_north = shard.sight.plane.to_plane((fix.longitude, fix.latitude))
    delta = np.abs(shard.places[shard.inside] - east_north).max(axis=1)
    reached = bool((delta <= 4.0 * fix.radius + REACH).any())
    return float(off.max()), float(np.logaddexp.reduce(off)), reached


def propose(shard: Shard, shard_query: ShardQuery, least: float, drawn: int) -> Proposal:
    """Propose the most promising viewpoints of the core.

    `least` is the log of a bound times the prior from which on they count; `drawn` stand for all others.
    """
    request = shard.request(shard_query, objects=False)
    prior = request.log_prior
    highest, n = float(prior.max(initial=-np.inf)), len(shard_query.query.used)
    none = np.zeros(0)
    found = Candidates(none.astype(np.int32), none, np.zeros((0, n), np.float32), none)
    if highest > -np.inf:
        found = find_candidates(request, drawn, float(np.exp(min(least - highest, 690.0))))
    rows, far = found.rows, found.distant
    if shard_query.query.distant is None:
        far = far[:, :0]
    origin = shard.sight.plane.longitude, shard.sight.plane.latitude
    return Proposal(
        rows, found.bounds, far, prior[rows], found.multiplicity, highest, origin, least
    )


def compare(shard: Shard, shard_query: ShardQuery, chosen: Proposal) -> CandidateScores:
    """Score candidates."""
    some = chosen.candidates(len(shard_query.query.used))
    scores = score_of(shard.request(shard_query), some, NO_MARGIN).scores.astype(np.float64)
    return CandidateScores(scores, shard.sight.views.positions_of(chosen.rows).astype(np.float64))


def refine_positions(
    shard: Shard, shard_query: ShardQuery, chosen: Proposal
) -> tuple[Floats, Floats]:
    """Look more closely around candidates; as `score_around`."""
    some = chosen.candidates(len(shard_query.query.used))
    return score_around(shard.request(shard_query), some.rows, some.distant)


def explain(
    shard: Shard, shard_query: ShardQuery, lonlats: list[tuple[float, float]]
) -> list[tuple[Evidence, ...]]:
    """Return the evidence for and against places [deg]."""
    request = shard.request(shard_query)
    places = map(shard.sight.plane.to_plane, lonlats)
    return [find_evidence(at, request.city, request.query) for at in places]


def score_buildings(
    shard: Shard, shard_query: ShardQuery, buildings: list[Floats]
) -> list[BuildingScore | None]:
    """Score buildings by their corners (4, 2) [deg]; None for those off the map."""
    scorer = BuildingScorer(shard.city, shard.request(shard_query))
    return [scorer.score(corners) for corners in buildings]


def ask(shard: Shard, estimate: CityEstimate) -> Question | None:
    """Return the question that tells the modes of an estimate apart."""
    return shard.city.ask(estimate)


def name_cells(shard: Shard, lonlats: list[tuple[float, float]]) -> list[str]:
    """Return the cells that places [deg] lie in."""
    return [shard.city.cells.nearest(shard.city.plane.to_plane(at)) for at in lonlats]


STEPS: dict[str, Callable[..., Any]] = {
    "gather": gather, "weigh": weigh_fix, "propose": propose, "compare": compare, "look": refine_positions,
    "explain": explain, "name": name_cells, "judge": score_buildings, "ask": ask,
}  # fmt: skip
"""Steps that can be asked for, by name."""
