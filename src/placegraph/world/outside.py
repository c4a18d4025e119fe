"""What the outside of a sentence says of places: of a town as a whole, and of where scenes stand."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.locate import search
from placegraph.outdoor.search.answer import TELLING, answer, evidence_at
from placegraph.outdoor.search.posterior import ELSEWHERE
from placegraph.outdoor.search.request import (
    Hints,
    LocationPrior,
    Matching,
    TextContext,
    hint_swapped,
    make_request,
)
from placegraph.outdoor.search.status import find_obstacle, infer_claim
from placegraph.world.buildings import Buildings
from placegraph.world.streets import roads_called

if TYPE_CHECKING:
    from placegraph.core.estimate import CityEstimate, Evidence
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.language.description import Description
    from placegraph.outdoor.likelihood.query import Query
    from placegraph.outdoor.search.ask import Question
    from placegraph.outdoor.search.posterior import Posterior
    from placegraph.outdoor.search.request import Request
    from placegraph.world.buildings import Judged
    from placegraph.world.known import Known


class Words(TextContext, Protocol):
    """What words mean in a town."""

    @property
    def label_index(self) -> Mapping[str, Sequence[int]]:
        """Tokens by label and by ``key=*``."""


class Town(Protocol):
    """What a world asks of what lies outdoors: a city, or a world in shards."""

    @property
    def words(self) -> Words:
        """What words mean in it."""

    def is_street(self, name: str) -> bool:
        """Whether a name means streets, and nothing else."""

    def hear(self, said: Description, known: Known) -> Outside | str:
        """What was said, looked for in it; or why nothing of it can be."""

    def off(self, near: Sequence[float], radius: float) -> str | None:
        """Where a fix is on none of its maps a sentence if it is so when swapped, or an empty one."""

    def ask(self, part: str, found: CityEstimate) -> Question | None:
        """Question that tells places apart, of a part of what it answered (`Outside.parts`)."""


@dataclass(frozen=True, eq=False)
class Told:
    """What the outside of a sentence says of one building."""

    judged: Judged
    explain: Callable[[], tuple[Evidence, ...]]
    """What statements say of the middle of it."""

    @property
    def evidence(self) -> tuple[Evidence, ...]:
        """What each statement says of the building."""
        found = self.explain()
        told = [
            e if abs(e.weight - w) < TELLING else replace(
                e, weight=w, verdict="for" if w > TELLING else "against" if w < -TELLING else "silent",
                note="" if w > TELLING else e.note,
            )
            for e, w in zip(found, self.judged.weights, strict=False)
        ]  # fmt: skip
        return (*told, *found[len(told) :])


@dataclass(frozen=True, eq=False)
class Outside:
    """What was said of streets and buildings, in a town."""

    query: Query
    posterior: Posterior
    estimate: CityEstimate
    parts: dict[str, CityEstimate]
    """Its answer, or parts of it of which can be asked back, by name of the map."""
    gap: str
    """What of the town was not searched, and why; empty where all that matters was."""

    @cached_property
    def gain(self) -> float:
        """Log-likelihood ratio of this town, wherever in it, against anywhere else [nat]."""
        here, off = float(self.posterior.probabilities.sum()), self.posterior.elsewhere
        ratio = (here + 1e-9) / (off + 1e-9) * ELSEWHERE / (1.0 - ELSEWHERE)
        return infer_claim(self.query.description).of_radius.slope * float(np.log(ratio))

    @property
    def cost(self) -> str:
        """What was looked into."""
        return ""

    @property
    def notes(self) -> tuple[str, ...]:
        """Maps that did not answer."""
        return ()

    def of_buildings(self, corners: Sequence[NDArray[np.float64]]) -> list[Told | None]:
        """What was said of buildings, by their corners (4, 2) [deg]; None of those in other towns."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class InCity(Outside):
    """The same in one city."""

    city: CityMap
    asked: Request

    def of_buildings(self, corners: Sequence[NDArray[np.float64]]) -> list[Told | None]:
        """As `Outside.of_buildings`."""
        buildings = Buildings(self.city, self.asked)
        out: list[Told | None] = []
        for each in corners:
            judged = buildings.around(each)
            middle = self.city.plane.to_plane(each).mean(axis=0)
            explain = partial(evidence_at, middle, self.city, self.query)
            out.append(None if judged is None else Told(judged, explain))
        return out


@dataclass(frozen=True, eq=False)
class OneCity:
    """A `Town` of one map."""

    name: str
    words: CityMap

    def is_street(self, name: str) -> bool:
        """As `Town.is_street`."""
        return len(roads_called(self.words, name)) > 0

    def hear(self, said: Description, known: Known) -> Outside | str:
        """As `Town.hear`."""
        city, hints = (
            self.words,
            Hints(known.near, known.radius, known.heading, answers=known.answers),
        )
        asked = make_request(city, said, hints, Matching())
        if not asked.is_positive:
            return find_obstacle(asked.query, asked.understood)
        near = asked.prior.near
        if near is not None and not len(city.views.near(near, 4.0 * asked.prior.radius)):
            return ""
        found = search(asked)
        told = answer(asked, found, known.top)
        return InCity(asked.query, found, told, {self.name: told}, "", city, asked)

    def off(self, near: Sequence[float], radius: float) -> str | None:
        """As `Town.off`."""
        off = LocationPrior.around(self.words, near, radius).is_off(self.words)
        return hint_swapped(self.words, near) if off else None

    def ask(self, part: str, found: CityEstimate) -> Question | None:
        """As `Town.ask`."""
        del part
        return self.words.ask(found)
