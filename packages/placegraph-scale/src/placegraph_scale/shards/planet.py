"""A world in shards, searched as one map."""

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

from placegraph.core.estimate import CityEstimate, Place, Status
from placegraph.core.geometry import LocalPlane
from placegraph.errors import MapError
from placegraph.outdoor.language.description import LISTENER
from placegraph.outdoor.likelihood.query import compile_query, ends
from placegraph.outdoor.map.objects import LINE
from placegraph.outdoor.search.answer import MOST_SUPPORT
from placegraph.outdoor.search.posterior import FINE, SPACING, Posterior, modes, posterior
from placegraph.outdoor.search.status import (
    decide,
    diagnose,
    find_contradiction,
    find_obstacle,
    infer_claim,
    shrink,
)
from placegraph.world.outside import BESIDE, BuildingMatch, TownMatch
from placegraph_scale.folder import WORDS, WorldFile, same
from placegraph_scale.shards.search import Search
from placegraph_scale.shards.steps import Asked, Fix, Gathering, Things, Words, distance
from placegraph_scale.shards.words import WordTable
from placegraph_scale.shards.workers import Alone, Source

if TYPE_CHECKING:
    from placegraph.core.estimate import Evidence
    from placegraph.outdoor.language.description import Description
    from placegraph.outdoor.search.ask import Question
    from placegraph.outdoor.search.posterior import Mode
    from placegraph.world.estimate import WorldQuery
    from placegraph_scale.shards.search import Merged
    from placegraph_scale.shards.steps import Thing
    from placegraph_scale.shards.workers import Crew

WIDE = 1.35
"""Shards whose planes begin so near to each other share one [deg of a great circle]: 150 km."""
APART = 1e8
"""Planes lie so far from each other that nothing of one is near anything of another [m]."""


@dataclass(eq=False)
class Frames:
    """Planes, each `APART` north of the one before; the heaviest shards come first."""

    planes: list[LocalPlane] = field(default_factory=list)

    def placed(
        self, origin: tuple[float, float], positions: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Positions (K, 2) [m] of a shard whose plane begins at `origin` [deg]."""
        own = LocalPlane(*origin)
        at = next((i for i, p in enumerate(self.planes) if _angle(p, own) < WIDE), len(self.planes))
        if at == len(self.planes):
            self.planes.append(own)
        if self.planes[at] != own:
            positions = self.planes[at].to_plane(own.to_lonlat(positions))
        return np.add(positions, (0.0, APART * at))

    def lonlat(self, position: NDArray[np.float64]) -> tuple[float, float]:
        """Longitude and latitude [deg] of a position (2,)."""
        at = round(float(position[1]) / APART)
        longitude, latitude = (
            self.planes[at].to_lonlat(np.subtract(position, (0.0, APART * at))).tolist()
        )
        return longitude, latitude


def _angle(one: LocalPlane, other: LocalPlane) -> float:
    """About how far apart two planes begin [deg of a great circle]."""
    aside = abs((one.longitude - other.longitude + 180.0) % 360.0 - 180.0)
    lower = min(abs(one.latitude), abs(other.latitude))
    return float(np.hypot(aside * np.cos(np.radians(lower)), one.latitude - other.latitude))


@dataclass(frozen=True, eq=False)
class Weighed:
    """A posterior over viewpoints of many shards."""

    posterior: Posterior
    """In `frames`."""
    shards: NDArray[np.int64]
    """(K,) row of the shard of each position."""
    frames: Frames

    def support(self, row: int) -> NDArray[np.float64]:
        """The heaviest points in a shard, as of `CityEstimate.support`."""
        chances, mine = self.posterior.probabilities, np.flatnonzero(self.shards == row)
        heaviest = mine[np.argsort(-chances[mine], kind="stable")][:MOST_SUPPORT]
        points = [(*self.frames.lonlat(self.posterior.positions[k]), chances[k]) for k in heaviest]
        return np.array(points, np.float64).reshape(-1, 3)


def weigh(found: Merged, beyond: float, searched: float) -> Weighed:
    """Apply Bayes to all that was scored and looked at; as `viewpoints.closer`.

    `beyond` is the log of what shards weigh that were not looked into; `searched` the share of the
    world that probabilities can speak of.
    """
    ranked, scores = found.ranked, found.values()
    weights = scores + ranked.log_prior
    order = np.argsort(-weights, kind="stable")
    frames = Frames()
    parts = [(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0, np.int64))]
    # the heaviest shard's plane is the first
    for row in dict.fromkeys(ranked.shard[order[weights[order] > -np.inf]].tolist()):
        frames.placed(found.proposals[row].origin, np.zeros((0, 2)))
    for row, proposed in sorted(found.proposals.items()):
        mine = np.flatnonzero((ranked.shard == row) & (weights > -np.inf))
        look = found.looks.get(row)
        if look is not None:
            mine = mine[~np.isin(ranked.at[mine], look.at)]
            share = np.repeat(proposed.log_prior[look.at] - np.log(len(FINE)), len(FINE))
            at = frames.placed(proposed.origin, look.positions.reshape(-1, 2))
            parts.append((at, look.scores.ravel(), share, np.full(len(share), row)))
        at = frames.placed(proposed.origin, found.positions[row][ranked.at[mine]])
        parts.append((at, scores[mine], ranked.log_prior[mine], np.full(len(mine), row)))
    positions, scored, priors, rows = map(np.concatenate, zip(*parts, strict=True))
    rest = float(np.logaddexp(found.rest(), beyond))
    made = posterior(positions, scored, priors, rest)
    if searched < 1.0:
        shares = made.probabilities * searched
        lost = float(made.probabilities.sum() - shares.sum())
        made = replace(made, probabilities=shares, elsewhere=made.elsewhere + lost)
    return Weighed(made, rows, frames)


@dataclass(frozen=True, eq=False)
class ShardsMatch(TownMatch):
    """What was said of streets and buildings, in the shards of a world."""

    search: Search
    asked: Asked
    cores: NDArray[np.float64]
    """(N, 4) of all shards [deg]."""

    @property
    def cost(self) -> str:
        """How many shards were looked into."""
        touched, n = len(self.search.touched), len(self.search.sources)
        return f"Looked into {touched:,} of {n:,} shards."

    @property
    def notes(self) -> tuple[str, ...]:
        """Shards that did not answer."""
        return tuple(self.search.lost[row] for row in sorted(self.search.lost))

    def match_buildings(self, corners: Sequence[NDArray[np.float64]]) -> list[BuildingMatch | None]:
        """As `Outside.match_buildings`, each in the shard that it stands in."""
        middles = [each.mean(axis=0) for each in corners]
        away = [distance(np.broadcast_to(m, (len(self.cores), 2)), self.cores) for m in middles]
        of_shard: dict[int, list[int]] = {}
        for k, off in enumerate(away):
            if off.min() <= BESIDE:
                of_shard.setdefault(int(off.argmin()), []).append(k)
        told = [
            (row, (self.asked, [corners[k] for k in of])) for row, of in sorted(of_shard.items())
        ]
        out: list[BuildingMatch | None] = [None] * len(corners)
        for row, judged in self.search.each("judge", told):
            for k, each in zip(of_shard[row], judged, strict=True):
                at = (float(middles[k][0]), float(middles[k][1]))
                explain = partial(_explained, self.search, self.asked, row, at)
                out[k] = None if each is None else BuildingMatch(each, explain)
        return out


def estimate(
    search: Search, asked: Asked, weighed: Weighed, top: int
) -> tuple[CityEstimate, dict[str, CityEstimate]]:
    """Modes over all shards; and the part of each shard that has one, of which can be asked back."""
    peaks = modes(weighed.posterior, top, SPACING)
    query = asked.query
    description = query.description
    diagnostics = diagnose(weighed.posterior, peaks, infer_claim(description), query)
    post, peaks = shrink(weighed.posterior, peaks, diagnostics)
    weighed = replace(weighed, posterior=post)
    places = _places(search, asked, weighed, peaks)
    contradiction = find_contradiction(places[0][1] if places else None, query)
    status, reason = decide(replace(diagnostics, contradiction=contradiction))
    parts = {}
    for row in dict.fromkeys(row for row, _ in places):
        mine = tuple(place for r, place in places if r == row)
        parts[search.sources[row].key] = CityEstimate(
            Status.AMBIGUOUS, mine, "A part of the answer of a world in shards.", description,
            weighed.support(row),
        )  # fmt: skip
    return CityEstimate(status, tuple(place for _, place in places), reason, description), parts


def _places(
    search: Search, asked: Asked, weighed: Weighed, peaks: Sequence[Mode]
) -> list[tuple[int, Place]]:
    """Places of modes, each with the row of its shard."""
    at = [weighed.frames.lonlat(peak.position) for peak in peaks]
    shards = [
        int(
            weighed.shards[np.argmin(((weighed.posterior.positions - p.position) ** 2).sum(axis=1))]
        )
        for p in peaks
    ]
    of = {row: [k for k, mine in enumerate(shards) if mine == row] for row in dict.fromkeys(shards)}
    told = [(row, ([at[k] for k in mine],)) for row, mine in of.items()]
    cells = {
        k: f"{search.sources[row].key}/{name}"
        for row, names in search.each("name", told)
        for k, name in zip(of[row], names, strict=True)
    }

    @cache
    def explained() -> dict[int, tuple[Evidence, ...]]:  # of all of them in one go
        asked_of = [(row, (asked, *places)) for row, places in told]
        answers = search.again().each("explain", asked_of)
        return dict(chain(*(zip(of[row], e, strict=True) for row, e in answers)))

    return [
        (row, Place(*at[k], p.probability, cells.get(k, search.sources[row].key), p.covariance,
                    explain=partial(lambda k: explained().get(k, ()), k)))
        for k, (p, row) in enumerate(zip(peaks, shards, strict=True))
    ]  # fmt: skip


def _explained(
    search: Search, asked: Asked, row: int, lonlat: tuple[float, float]
) -> tuple[Evidence, ...]:
    """Evidence for a place, from its shard."""
    told = search.again().each("explain", [(row, (asked, [lonlat]))])
    return next((found for _, (found,) in told), ())


MOST_STREETS = 8
"""Shards that are looked into at most to see whether a name means streets."""


class Planet:
    """A folder of shards, asked as one map; a `Town` of the world that `open_world` makes.

    Parameters
    ----------
    file
        What its `world.json` says.
    crew
        Who looks into shards; this process where not given.

    Raises
    ------
    InputError, MapError
        `words.table` is missing, damaged, newer, or not the one that the world was finished with.

    """

    def __init__(self, file: WorldFile, crew: Crew | None = None) -> None:
        self.file = file
        self.crew: Crew = crew or Alone()
        same(file.folder / WORDS, file.words)
        self.words = Words(WordTable.open(file.folder / WORDS))
        if len(self.words.table.viewpoints) != len(file.shards):
            raise MapError(
                f"{file.folder / WORDS} is of {len(self.words.table.viewpoints)} shards, world.json of "
                f"{len(file.shards)}; finish the world again with `placegraph world build`."
            )
        self.cores: NDArray[np.float64] = np.array([s.core for s in file.shards])
        self.sources = sources_of(file)

    @classmethod
    def open(cls, folder: str | PathLike[str], scheduler: str | None = None) -> Planet:
        """Open a folder, to be searched by this process or by the workers of a Dask scheduler."""
        file = WorldFile.read(folder)
        if scheduler is None:
            return cls(file)
        from placegraph_scale.shards.workers import Cluster

        return cls(file, Cluster.at(scheduler, sources_of(file)))

    @staticmethod
    def summarize(folder: str | PathLike[str]) -> dict[str, int]:
        """Return how many objects and bytes a folder holds, by its `world.json`; raises as `open`."""
        shards = WorldFile.read(folder).shards
        return {"objects": sum(s.objects for s in shards), "bytes": sum(s.bytes for s in shards)}

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.file.folder.resolve().name

    def is_street(self, name: str) -> bool:
        """As `Town.is_street`, by what a few of the shards hold that have the name."""
        table = self.words.table
        tokens = [len(table.labels) + token for token in self.words.name_index.named(name)]
        things = self._gathered(self._search(), np.array(tokens, np.int64), MOST_STREETS)
        return bool(things) and all(
            t.kind == LINE and t.label.startswith("highway") for t in things
        )

    def match(self, said: Description, query: WorldQuery) -> TownMatch | str:
        """Search for a description; shards that do not answer are named in the `notes` of the match."""
        self.words.table.watch.check()
        search, description = self._search(query.budget), said
        for answer in query.answers:
            description = answer.added_to(description)
        things = Things(self.words.table.labels, [])
        lexicon = Gathering(self.words, partial(self._gathered, search), things)
        on_a_way = any(LISTENER in ends(s) for s in description.statements)
        compiled = compile_query(description, lexicon, on_a_way=on_a_way)
        if reason := find_obstacle(compiled, description):
            return reason
        near, fix = query.near, None
        if near is not None:
            fix = Fix(float(near[0]), float(near[1]), float(query.radius))
        log_mass, fixed = search.masses(fix, self.cores)
        if fix is not None and fixed is None:
            return ""
        words = tuple(self.words.table.reads(int(token)) for token in compiled.mentions.tokens)
        size = int(self.words.table.viewpoints.sum())
        asked = Asked(compiled, words, tuple(things.rows), size, fixed)
        found = search.run(asked, log_mass, self.cores)
        missing = search.missing(found, log_mass)
        gap = search.gap(missing)
        search.deadline = None
        beyond = -np.inf if missing > 0.0 else search.remaining()
        weighed = weigh(found, beyond, 1.0 - missing)
        made, parts = estimate(search, asked, weighed, query.top)
        named = {f"{self.name}//{key}": part for key, part in parts.items()}
        return ShardsMatch(compiled, weighed.posterior, made, named, gap, search, asked, self.cores)

    def explain_prior(self, near: Sequence[float], radius: float) -> str | None:
        """As `Town.explain_prior`."""
        longitude, latitude = map(float, near)
        place = np.array([[longitude, latitude]])
        if (distance(place, self.cores) <= 4.0 * radius).any():
            return None
        if abs(longitude) > 90.0 or not (distance(place[:, ::-1], self.cores) == 0.0).any():
            return ""
        return f" Swapped, it lies on the map: longitude comes first, {latitude},{longitude}."

    def ask(self, part: str, found: CityEstimate) -> Question | None:
        """As `Town.ask`."""
        key = part.partition("//")[2]
        rows = [row for row, source in enumerate(self.sources) if source.key == key]
        asked = self._search().each("ask", [(row, (found,)) for row in rows])
        return next((question for _, question in asked), None)

    def _search(self, budget: float | None = None) -> Search:
        deadline = None if budget is None else monotonic() + budget
        return Search(self.sources, self.words.table, self.crew, deadline)

    def _gathered(
        self, search: Search, tokens: NDArray[np.int64], most: int | None = None
    ) -> list[Thing]:
        """Things that bear tokens, from the shards that hold them."""
        table = self.words.table
        wanted: dict[int, list[str]] = {}
        for token in tokens.tolist():
            held = table.of(token)
            for row in held.shards[held.objects > 0].tolist():
                wanted.setdefault(row, []).append(table.reads(token))
        told = [(row, (tuple(words),)) for row, words in sorted(wanted.items())]
        return [thing for _, found in search.each("gather", told[:most]) for thing in found]

    def close(self) -> None:
        """Let go of shards and of the cluster."""
        self.crew.close()

    def __repr__(self) -> str:
        shards, viewpoints = len(self.file.shards), self.words.table.viewpoints.sum()
        return f"Planet({shards:,} shards, {viewpoints:,} viewpoints)"


def sources_of(file: WorldFile) -> tuple[Source, ...]:
    """Where the shards of a world lie."""
    return tuple(Source(s.key, file.path(s), s.digest, s.bytes) for s in file.shards)
