"""From scored candidates of many shards to what they say of places, and of buildings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import CityEstimate, Place, Status
from placegraph.core.geometry import LocalPlane
from placegraph.outdoor.search.answer import MOST_SUPPORT
from placegraph.outdoor.search.posterior import FINE, SPACING, Posterior, modes, posterior
from placegraph.outdoor.search.status import (
    decide,
    diagnose,
    find_contradiction,
    infer_claim,
    shrink,
)
from placegraph.world.buildings import BESIDE
from placegraph.world.outside import Outside, Told
from placegraph_scale.shards.lexicon import distance

if TYPE_CHECKING:
    from placegraph.core.estimate import Evidence
    from placegraph.outdoor.search.posterior import Mode
    from placegraph_scale.shards.merged import Merged
    from placegraph_scale.shards.search import Search
    from placegraph_scale.shards.steps import Asked


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
class InShards(Outside):
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

    def of_buildings(self, corners: Sequence[NDArray[np.float64]]) -> list[Told | None]:
        """As `Outside.of_buildings`, each in the shard that it stands in."""
        middles = [each.mean(axis=0) for each in corners]
        away = [distance(np.broadcast_to(m, (len(self.cores), 2)), self.cores) for m in middles]
        of_shard: dict[int, list[int]] = {}
        for k, off in enumerate(away):
            if off.min() <= BESIDE:
                of_shard.setdefault(int(off.argmin()), []).append(k)
        told = [
            (row, (self.asked, [corners[k] for k in of])) for row, of in sorted(of_shard.items())
        ]
        out: list[Told | None] = [None] * len(corners)
        for row, judged in self.search.each("judge", told):
            for k, each in zip(of_shard[row], judged, strict=True):
                at = (float(middles[k][0]), float(middles[k][1]))
                explain = partial(_explained, self.search, self.asked, row, at)
                out[k] = None if each is None else Told(each, explain)
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
