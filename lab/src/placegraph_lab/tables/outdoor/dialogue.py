"""A simulated speaker who answers questions, and how many it takes until the place is found.

The speaker knows the true viewpoint and looks at the raw extract, not at the map.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.random import Generator

from placegraph.estimate import CityEstimate
from placegraph.geometry import Floats
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.search.ask import (
    NO,
    NONE,
    UNKNOWN,
    YES,
    Answer,
    Question,
    next_question,
    possible_questions,
)
from placegraph_lab.tables.outdoor.nearby import Bins
from placegraph_lab.tables.outdoor.nearby_kernels import holds
from placegraph_lab.tables.outdoor.queries import Query
from placegraph_lab.tables.outdoor.raw import AREA, KEYS, RawCity
from placegraph_lab.tables.outdoor.triples import DIRECTIONS, relations

SIGHT = 35.0
"""The speaker sees things up to this far [m]."""
RIGHT = 50.0
"""An answer is right within this distance of the truth [m]."""

Asking = Literal["best", "random"]
"""The most informative question, or any question about what is around the places that fit."""


@dataclass(frozen=True)
class Speaker:
    """Somebody at a viewpoint, who sees what the raw extract has there."""

    bins: Bins
    viewpoint: Floats
    """(2,) east, north [m] in the plane of `bins`."""

    def answer(self, question: Question) -> Answer:
        """Answer truthfully from the raw data; "don't know" where the question has no such answer."""
        city = self.bins.city
        around = self.bins.around(self.viewpoint[None], SIGHT)
        inside = standing_in(city, self.viewpoint)
        seen = [
            (
                f"{KEYS[city.key[i]]}={self._value(int(i))}",
                city.labels[city.named[i]].replace("_", " "),
                self._wind(point - self.viewpoint),
            )
            for i, point in zip(
                [*around.objects, *inside],
                [*around.points, *[self.viewpoint] * len(inside)],
                strict=True,
            )
        ]
        if question.options == (YES, NO):
            thing = question.things[0]
            found = any(
                tag == thing.label and (not thing.wind or wind == thing.wind)
                for tag, _, wind in seen
            )
            return question.answer(YES if found else NO)
        names = {name for _, name, _ in seen}
        chosen = [thing.words for thing in question.things if thing.words in names]
        options = chosen or [NONE]
        return question.answer(options[0] if options[0] in question.options else UNKNOWN)

    def _value(self, i: int) -> str:
        label = self.bins.city.labels[self.bins.city.label[i]]
        return "yes" if label == KEYS[self.bins.city.key[i]] else label

    @staticmethod
    def _wind(delta: Floats) -> str:
        return DIRECTIONS[int(relations(delta))] if np.hypot(*delta) >= 1.0 else ""


def standing_in(city: RawCity, viewpoint: Floats) -> list[int]:
    """Areas (rows) that hold a viewpoint (2,): whoever stands in a park sees the park."""
    ends = np.concatenate([city.segments[:, :2], city.segments[:, 2:]], axis=1).reshape(-1, 2, 2)
    low = np.minimum.reduceat(ends.min(axis=1), city.segment_starts[:-1])
    high = np.maximum.reduceat(ends.max(axis=1), city.segment_starts[:-1])
    around = (city.kind == AREA) & (low <= viewpoint).all(axis=1) & (viewpoint <= high).all(axis=1)
    x, y = viewpoint
    return [
        int(i)
        for i in np.flatnonzero(around)
        if holds(x, y, city.segments[city.segment_starts[i] : city.segment_starts[i + 1]])
    ]


def dialogue(
    city: CityMap, query: Query, speaker: Speaker, asking: Asking, rng: Generator, *, most: int
) -> list[CityEstimate]:
    """Estimates after 0, 1, 2 ... questions; stops when the estimate is OK or nothing is left to ask."""
    choose: Callable[[CityEstimate], Question | None] = (
        (lambda estimate: next_question(estimate, city))
        if asking == "best"
        else (lambda estimate: _any_question(estimate, city, rng))
    )
    answers: list[Answer] = []
    estimates = [city.locate(query.text)]
    while len(answers) < most and estimates[-1].status.name != "OK":
        question = choose(estimates[-1])
        if question is None:
            break
        answers.append(speaker.answer(question))
        estimates.append(city.locate(query.text, answers=answers))
    return estimates


def _any_question(estimate: CityEstimate, city: CityMap, rng: Generator) -> Question | None:
    questions = list(possible_questions(estimate, city))
    return questions[int(rng.integers(len(questions)))] if questions else None


def distance(estimate: CityEstimate, query: Query, city: CityMap) -> float:
    """Distance [m] of the best mode from the truth; infinite where there is none."""
    if estimate.best is None:
        return float("inf")
    here = city.plane.to_plane((estimate.best.longitude, estimate.best.latitude))
    return float(np.hypot(*(here - city.plane.to_plane((query.longitude, query.latitude)))))
