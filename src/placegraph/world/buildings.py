"""What the outside of a sentence says of buildings, such as those that scenes stand in."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geojson import inside
from placegraph.outdoor.language.description import SPEAKER, WITHIN, Relation
from placegraph.outdoor.map.geometry_kernels import nearest_on_parts
from placegraph.outdoor.map.objects import AREA, POINT
from placegraph.outdoor.search.answer import looked_at
from placegraph.outdoor.search.status import infer_claim
from placegraph.world.streets import AROUND_IT, on_street, roads_called

if TYPE_CHECKING:
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.map.objects import CityObjects
    from placegraph.outdoor.search.request import Request


AROUND = (12.0, 24.0)
"""What stands around a building is seen from its doors and windows, so far from its walls [m]."""
BESIDE = 100.0
"""A scene so far off a city's map [m] is in another town."""
THERE = 30.0
"""A building is the one that somebody is said to be in where its point is this near its middle [m]."""
MISSED = -2.0
"""Log-likelihood ratio, at most, of a building that somebody is not in by what was said [nat]."""


class Judged(NamedTuple):
    """What was said of one building."""

    ratio: float
    """Log-likelihood ratio of being there, against anywhere [nat]."""
    meant: bool
    """Whether the speaker was said to be in this building."""
    weights: tuple[float, ...]
    """The same as `ratio` of each statement that was used."""


@dataclass(frozen=True, eq=False)
class Buildings:
    """The buildings of a city, and what was said."""

    home: CityMap
    asked: Request
    """Its city may hold more things than `home`, which are spoken of from afar."""

    @cached_property
    def streets(self) -> dict[int, NDArray[np.int64]]:
        """Of each statement that names the street one is on: rows of that street."""
        query = self.asked.query
        named = {
            i: roads_called(self.home, query.description.mentions[s.target].name)
            for i, s in enumerate(query.used)
            if s.relation is Relation.ALONG and s.source == SPEAKER
        }
        return {i: rows for i, rows in named.items() if len(rows)}

    def around(self, corners: NDArray[np.float64]) -> Judged | None:
        """The same of the building around corners (4, 2) [deg]; None where that is off the map."""
        footprint = self.home.plane.to_plane(corners)
        held = len(self.home.views.near(footprint.mean(axis=0), BESIDE)) > 0
        return self.of(footprint) if held else None

    def of(self, footprint: NDArray[np.float64]) -> Judged:
        """What was said of a building, by its corners (4, 2) east and north [m].

        What one is said to be *in* is told of the building itself, on which street one is said to be
        of its address, all else of what lies around it, too.
        """
        middle = footprint.mean(axis=0)
        inner = np.concatenate([middle[None], (footprint + middle) / 2.0])
        rays = (
            np.concatenate([footprint, (footprint + np.roll(footprint, 1, axis=0)) / 2.0]) - middle
        )
        far = np.linalg.norm(rays, axis=1, keepdims=True)
        outer = np.concatenate([middle + rays * (1.0 + d / np.maximum(far, 1.0)) for d in AROUND])
        ratios, served = looked_at(
            np.concatenate([inner, outer]), self.asked.city, self.asked.query
        )
        weights, meant = [], False
        for i, s in enumerate(self.asked.query.used):
            own = s.relation in WITHIN and s.source == SPEAKER
            told = float((ratios[: len(inner)] if own else ratios)[:, i].max())
            if i in self.streets:
                told = self._of_street(i, footprint)
            if own and not s.negated:
                held, own = self._holds(served[: len(inner), i], footprint)
                meant |= own
                told = told if held else min(told, MISSED)
            weights.append(told)
        slope = infer_claim(self.asked.query.description).of_radius.slope
        return Judged(slope * sum(weights), meant, tuple(weights))

    def _of_street(self, i: int, footprint: NDArray[np.float64]) -> float:
        """Log-likelihood ratio of a statement about the street that one is on, for who is in a building.

        Against the other streets around; and so far as it is on that street, as for who stands there.
        """
        asked = self.asked.query
        noise, negated = asked.statements.noise[i], asked.used[i].negated
        on = on_street(self.home, self.streets[i], footprint)
        p = on.probability if on is not None else 0.0
        odds = 1.0 - p if negated else p / AROUND_IT
        gain = float(np.log((1.0 - noise) * odds + noise))
        if on is None or negated:
            return gain
        there, _ = looked_at(on.position[None], self.asked.city, asked)
        return gain + p * max(0.0, float(there[0, i]) - gain)

    def _holds(self, rows: NDArray[np.int32], footprint: NDArray[np.float64]) -> tuple[bool, bool]:
        """Whether one of what serves a statement holds a building (4, 2), and whether it is a building.

        A shop is where its point is; a square or a park may hold a building, and is none; a promenade
        holds nothing.
        """
        o, middle = self.asked.city.objects, footprint.mean(axis=0)
        ring = np.concatenate([footprint, footprint[:1]])
        held = meant = False
        for r in np.unique(rows[rows >= 0]).tolist():
            part = o.part_starts, o.point_starts, o.points, o.kind[r], r
            away = float(np.hypot(*nearest_on_parts(*part, *middle)[:2]))
            if o.kind[r] == AREA:
                central = inside(o.center[r], ring)
                holds, built = away == 0.0 or central, central or _is_building(o, r)
            else:
                holds = built = o.kind[r] == POINT and away < THERE
            held, meant = held or holds, meant or (holds and built)
        return held, meant


def _is_building(o: CityObjects, row: int) -> bool:
    labels = o.label_values[o.label_starts[row] : o.label_starts[row + 1]].tolist()
    return any(o.labels[k].startswith("building") for k in labels)
