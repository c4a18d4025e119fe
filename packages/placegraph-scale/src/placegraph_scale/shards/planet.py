"""A world in shards, searched as one map: one town to the world that it is part of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import chain
from os import PathLike
from time import monotonic
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import CityEstimate, Evidence, Place, Status
from placegraph.core.geometry import LocalPlane
from placegraph.errors import MapError, OptionError
from placegraph.outdoor.language.description import LISTENER, Description, ends
from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.map.objects import LINE
from placegraph.outdoor.search.locate import MAX_SUPPORT
from placegraph.outdoor.search.posterior import (
    FINE_OFFSETS,
    SPACING,
    Mode,
    Posterior,
    apply_bayes,
    find_modes,
)
from placegraph.outdoor.search.status import (
    decide,
    diagnose,
    find_contradiction,
    find_misfit,
    find_obstacle,
    infer_claim,
    shrink,
)
from placegraph.world.towns import MAX_CITY_DISTANCE, BuildingMatch, TownMatch
from placegraph_scale.folder import WORDS, WorldFile, check_digest
from placegraph_scale.shards.search import CandidatePool, Search
from placegraph_scale.shards.steps import (
    Fix,
    QueryLexicon,
    RareObject,
    RareObjects,
    ShardQuery,
    ShardSource,
    WorldWords,
    distance,
)
from placegraph_scale.shards.words import WordTable
from placegraph_scale.shards.workers import (
    MEMORY,
    Cluster,
    ShardCache,
    WorkerPool,
    parse_memory,
)

if TYPE_CHECKING:
    from placegraph.outdoor.search.ask import Question
    from placegraph.world.estimate import WorldQuery

Floats = NDArray[np.float64]

MOST_STREETS = 8
"""Shards that are looked into at most to see whether a name means streets."""
WIDE = 1.35
"""Shards whose planes begin so near to each other share one [deg of a great circle]: 150 km."""
APART = 1e8
"""Planes lie so far from each other that nothing of one is near anything of another [m]."""


@dataclass(eq=False)
class PlaneStack:
    """Planes of shards as one, each `APART` north of the one before; the heaviest shards come first."""

    planes: list[LocalPlane] = field(default_factory=list)

    def add(self, origin: tuple[float, float], positions: Floats) -> Floats:
        """Return positions (K, 2) [m] of a shard whose plane begins at `origin` [deg]."""
        own = LocalPlane(*origin)
        at = next((i for i, p in enumerate(self.planes) if _angle(p, own) < WIDE), len(self.planes))
        if at == len(self.planes):
            self.planes.append(own)
        if self.planes[at] != own:
            positions = self.planes[at].to_plane(own.to_lonlat(positions))
        return np.add(positions, (0.0, APART * at))

    def lonlat(self, position: Floats) -> tuple[float, float]:
        """Return longitude and latitude [deg] of a position (2,)."""
        at = round(float(position[1]) / APART)
        own = np.subtract(position, (0.0, APART * at))
        longitude, latitude = self.planes[at].to_lonlat(own).tolist()
        return longitude, latitude


def _angle(one: LocalPlane, other: LocalPlane) -> float:
    """Return about how far apart two planes begin [deg of a great circle]."""
    aside = abs((one.longitude - other.longitude + 180.0) % 360.0 - 180.0)
    lower = min(abs(one.latitude), abs(other.latitude))
    return float(np.hypot(aside * np.cos(np.radians(lower)), one.latitude - other.latitude))


@dataclass(frozen=True, eq=False)
class ShardPosterior:
    """A posterior over viewpoints of many shards."""

    posterior: Posterior
    """In the planes of `stack`."""
    shards: NDArray[np.int64]
    """(K,) row of the shard of each position."""
    stack: PlaneStack

    def support(self, row: int) -> Floats:
        """Return the heaviest points in a shard, as of `CityEstimate.support`."""
        chances, mine = self.posterior.probabilities, np.flatnonzero(self.shards == row)
        heaviest = mine[np.argsort(-chances[mine], kind="stable")][:MAX_SUPPORT]
        points = [(*self.stack.lonlat(self.posterior.positions[k]), chances[k]) for k in heaviest]
        return np.array(points, np.float64).reshape(-1, 3)


def compute_posterior(pool: CandidatePool, beyond: float, searched: float) -> ShardPosterior:
    """Apply Bayes to all that was scored and looked at; as `viewpoints.closer`.

    `beyond` is the log weight of shards that were not looked into; `searched` the share of the world
    that probabilities can speak of.
    """
    ranked, scores = pool.ranked, pool.values()
    weights = scores + ranked.log_prior
    order = np.argsort(-weights, kind="stable")
    stack = PlaneStack()
    parts = [(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0, np.int64))]
    # the heaviest shard's plane is the first
    for row in dict.fromkeys(ranked.shard[order[weights[order] > -np.inf]].tolist()):
        stack.add(pool.proposals[row].origin, np.zeros((0, 2)))
    for row, proposal in sorted(pool.proposals.items()):
        mine = np.flatnonzero((ranked.shard == row) & (weights > -np.inf))
        look = pool.refinements.get(row)
        if look is not None:
            mine = mine[~np.isin(ranked.at[mine], look.at)]
            share = np.repeat(
                proposal.log_prior[look.at] - np.log(len(FINE_OFFSETS)), len(FINE_OFFSETS)
            )
            at = stack.add(proposal.origin, look.positions.reshape(-1, 2))
            parts.append((at, look.scores.ravel(), share, np.full(len(share), row)))
        at = stack.add(proposal.origin, pool.positions[row][ranked.at[mine]])
        parts.append((at, scores[mine], ranked.log_prior[mine], np.full(len(mine), row)))
    positions, scored, priors, rows = map(np.concatenate, zip(*parts, strict=True))
    rest = float(np.logaddexp(pool.unscored_weight(), beyond))
    made = apply_bayes(positions, scored, priors, rest)
    if searched < 1.0:
        shares = made.probabilities * searched
        lost = float(made.probabilities.sum() - shares.sum())
        made = replace(made, probabilities=shares, elsewhere=made.elsewhere + lost)
    return ShardPosterior(made, rows, stack)


@dataclass(frozen=True, eq=False)
class ShardsMatch(TownMatch):
    """Result of a search in the shards of a world."""

    search: Search
    shard_query: ShardQuery
    cores: Floats
    """(N, 4) of all shards [deg]."""

    @property
    def cost(self) -> str:
        """Sentence with the number of shards that were searched."""
        touched, n = len(self.search.touched), len(self.search.sources)
        return f"Searched {touched:,} of {n:,} shards."

    @property
    def notes(self) -> tuple[str, ...]:
        """Shards that did not answer."""
        return tuple(self.search.lost[row] for row in sorted(self.search.lost))

    def match_buildings(self, corners: Sequence[Floats]) -> list[BuildingMatch | None]:
        """Score buildings, each in the shard that it stands in; None for those in other towns."""
        middles = [each.mean(axis=0) for each in corners]
        of_shard: dict[int, list[int]] = {}
        for k, middle in enumerate(middles):
            away = distance(np.broadcast_to(middle, (len(self.cores), 2)), self.cores)
            if away.min() <= MAX_CITY_DISTANCE:
                of_shard.setdefault(int(away.argmin()), []).append(k)
        tasks = [
            (row, (self.shard_query, [corners[k] for k in of]))
            for row, of in sorted(of_shard.items())
        ]
        out: list[BuildingMatch | None] = [None] * len(corners)
        for row, scores in self.search.run_step("judge", tasks):
            for k, score in zip(of_shard[row], scores, strict=True):
                explain = partial(self._explain, row, tuple(middles[k].tolist()))
                out[k] = None if score is None else BuildingMatch(score, explain)
        return out

    def _explain(self, row: int, lonlat: tuple[float, float]) -> tuple[Evidence, ...]:
        """Return the evidence for a place, from its shard."""
        found = self.search.restart().run_step("explain", [(row, (self.shard_query, [lonlat]))])
        return next((evidence for _, (evidence,) in found), ())


def make_estimate(
    search: Search, shard_query: ShardQuery, posterior: ShardPosterior, top: int
) -> tuple[CityEstimate, dict[str, CityEstimate]]:
    """Make the estimate over all shards, and the part of each shard that has a mode, to be asked about."""
    peaks = find_modes(posterior.posterior, top, SPACING)
    query = shard_query.query
    description = query.description
    diagnostics = diagnose(posterior.posterior, peaks, infer_claim(description), query)
    post, peaks = shrink(posterior.posterior, peaks, diagnostics)
    posterior = replace(posterior, posterior=post)
    places = _make_places(search, shard_query, posterior, peaks)
    best = places[0][1] if places else None
    contradiction = find_contradiction(best, query)
    uncertainty = find_misfit(best, query, diagnostics) if diagnostics.is_probable else ""
    status, reason = decide(
        replace(diagnostics, contradiction=contradiction, uncertainty=uncertainty)
    )
    parts = {}
    for row in dict.fromkeys(row for row, _ in places):
        mine = tuple(place for r, place in places if r == row)
        parts[search.sources[row].key] = CityEstimate(
            Status.AMBIGUOUS, mine, "Part of the answer of a world in shards.", description,
            posterior.support(row),
        )  # fmt: skip
    return CityEstimate(
        status, tuple(place for _, place in places), reason, description,
        radius=diagnostics.claim.radius,
    ), parts  # fmt: skip


def _make_places(
    search: Search, shard_query: ShardQuery, posterior: ShardPosterior, peaks: Sequence[Mode]
) -> list[tuple[int, Place]]:
    """Make places of modes, each with the row of its shard."""
    at = [posterior.stack.lonlat(peak.position) for peak in peaks]
    positions = posterior.posterior.positions
    shards = [
        int(posterior.shards[np.argmin(((positions - p.position) ** 2).sum(axis=1))]) for p in peaks
    ]
    of = {row: [k for k, mine in enumerate(shards) if mine == row] for row in dict.fromkeys(shards)}
    tasks = [(row, ([at[k] for k in mine],)) for row, mine in of.items()]
    cells = {
        k: f"{search.sources[row].key}/{name}"
        for row, names in search.run_step("name", tasks)
        for k, name in zip(of[row], names, strict=True)
    }

    @cache
    def explain() -> dict[int, tuple[Evidence, ...]]:  # of all of them in one go
        answers = search.restart().run_step(
            "explain", [(row, (shard_query, *args)) for row, args in tasks]
        )
        return dict(chain(*(zip(of[row], e, strict=True) for row, e in answers)))

    return [
        (row, Place(*at[k], p.probability, cells.get(k, search.sources[row].key), p.covariance,
                    explain=partial(lambda k: explain().get(k, ()), k)))
        for k, (p, row) in enumerate(zip(peaks, shards, strict=True))
    ]  # fmt: skip


class Planet:
    """A folder of shards, asked as one map; a `Town` of the world that `open_world` makes.

    Raises `InputError` or `MapError`: `words.table` is missing, damaged, newer, or not the one that
    the world was finished with.

    `file`: contents of its `world.json`.
    `pool`: workers that look into shards; this process where not given.
    """

    def __init__(self, file: WorldFile, pool: WorkerPool | None = None) -> None:
        self.file = file
        self.pool: WorkerPool = pool or ShardCache()
        check_digest(file.folder / WORDS, file.words)
        self.words = WorldWords(WordTable.open(file.folder / WORDS))
        if len(self.words.table) != len(file.shards):
            raise MapError(
                f"{file.folder / WORDS} is for {len(self.words.table)} shards, but world.json for "
                f"{len(file.shards)}; finish the world with `placegraph world build`."
            )
        self.cores: Floats = np.array([s.core for s in file.shards])
        self.sources = _list_sources(file)

    @classmethod
    def open(
        cls,
        folder: str | PathLike[str],
        scheduler: str | None = None,
        memory: str | float | None = None,
    ) -> Planet:
        """Open a folder, to be searched in the `memory` of this process, or by workers of a scheduler.

        Raises `OptionError`: `memory` is no size, or a scheduler is given as well.
        """
        if memory is not None and scheduler is not None:
            raise OptionError(
                "memory: it applies to this process, but the workers of a scheduler search the "
                "shards; start them with `dask worker --memory-limit`."
            )
        size = MEMORY if memory is None else parse_memory(memory)
        file = WorldFile.read(folder)
        if scheduler is not None:
            return cls(file, Cluster.at(scheduler, _list_sources(file)))
        return cls(file, ShardCache(size))

    @staticmethod
    def summarize(folder: str | PathLike[str]) -> dict[str, int]:
        """Return the numbers of objects and bytes of a folder by its `world.json`; raises like `open`."""
        shards = WorldFile.read(folder).shards
        return {"objects": sum(s.objects for s in shards), "bytes": sum(s.bytes for s in shards)}

    def is_street(self, name: str) -> bool:
        """Return whether a name means streets only, by a few of the shards that have the name."""
        table = self.words.table
        tokens = [len(table.labels) + token for token in self.words.name_index.find_rows(name)]
        things = self._gather(self._search(), np.array(tokens, np.int64), MOST_STREETS)
        return bool(things) and all(
            t.kind == LINE and t.label.startswith("highway") for t in things
        )

    def match(self, parsed: Description, query: WorldQuery) -> TownMatch | str:
        """Search for a description; shards that do not answer are named in the `notes` of the match."""
        table = self.words.table
        table.watch.check()
        search, description = self._search(query.budget), parsed
        for answer in query.answers:
            description = answer.added_to(description)
        things = RareObjects(table.labels, [])
        lexicon = QueryLexicon(self.words, partial(self._gather, search), things)
        tells_way = any(LISTENER in ends(s) for s in description.statements)
        compiled = compile_query(description, lexicon, tells_way=tells_way)
        if reason := find_obstacle(compiled, description):
            return reason
        near, fix = query.near, None
        if near is not None:
            fix = Fix(float(near[0]), float(near[1]), float(query.radius))
        log_mass, fixed = search.masses(fix, self.cores)
        if fix is not None and fixed is None:
            return ""
        words = tuple(table.text(int(token)) for token in compiled.mentions.tokens)
        size = int(table.viewpoints.sum())
        shard_query = ShardQuery(compiled, words, tuple(things.rows), size, fixed)
        pool = search.run(shard_query, log_mass, self.cores)
        missing = search.estimate_missing(pool, log_mass)
        gap = search.explain_gap(missing)
        search.deadline = None
        beyond = -np.inf if missing > 0.0 else search.remaining()
        found = compute_posterior(pool, beyond, 1.0 - missing)
        made, parts = make_estimate(search, shard_query, found, query.top)
        name = self.file.folder.resolve().name
        named = {f"{name}//{key}": part for key, part in parts.items()}
        return ShardsMatch(
            compiled, found.posterior, made, named, gap, search, shard_query, self.cores
        )

    def explain_prior(self, near: Sequence[float], radius: float) -> str | None:
        """Return None where the location prior is on the map; else a hint, which may be empty."""
        longitude, latitude = map(float, near)
        place = np.array([[longitude, latitude]])
        if (distance(place, self.cores) <= 4.0 * radius).any():
            return None
        if abs(longitude) > 90.0 or not (distance(place[:, ::-1], self.cores) == 0.0).any():
            return ""
        return f" Swapped, it lies on the map: longitude comes first, {latitude},{longitude}."

    def ask(self, part: str, estimate: CityEstimate) -> Question | None:
        """Return the question that tells the places of a part apart."""
        key = part.partition("//")[2]
        rows = [row for row, source in enumerate(self.sources) if source.key == key]
        questions = self._search().run_step("ask", [(row, (estimate,)) for row in rows])
        return next((question for _, question in questions), None)

    def _search(self, budget: float | None = None) -> Search:
        deadline = None if budget is None else monotonic() + budget
        return Search(self.sources, self.words.table, self.pool, deadline)

    def _gather(
        self, search: Search, tokens: NDArray[np.int64], most: int | None = None
    ) -> list[RareObject]:
        """Return the objects that bear tokens, from the shards that hold them."""
        table = self.words.table
        wanted: dict[int, list[str]] = {}
        for token in tokens.tolist():
            found = table.entries(token)
            for row in found.shards[found.objects > 0].tolist():
                wanted.setdefault(row, []).append(table.text(token))
        tasks = [(row, (tuple(words),)) for row, words in sorted(wanted.items())]
        return [thing for _, found in search.run_step("gather", tasks[:most]) for thing in found]

    def close(self) -> None:
        """Close the shards, and leave the cluster that searches them."""
        self.pool.close()

    def __repr__(self) -> str:
        shards, viewpoints = len(self.file.shards), self.words.table.viewpoints.sum()
        return f"Planet({shards:,} shards, {viewpoints:,} viewpoints)"


def _list_sources(file: WorldFile) -> tuple[ShardSource, ...]:
    return tuple(ShardSource(s.key, file.path(s), s.digest, s.bytes) for s in file.shards)
