"""Table `outdoor_dialogue`: questions until the place is found, informative against random ones.

Texts of six statements without names leave many places; a simulated speaker, who sees the raw
extract, answers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.random import Generator

from placegraph.core.estimate import CityEstimate
from placegraph.core.geometry import Floats
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.search.ask import (
    NO,
    NONE,
    UNKNOWN,
    YES,
    Answer,
    Question,
    next_question,
    rank_questions,
)
from placegraph_lab.tables.outdoor.extracts import EXTRACTS, names_of, open_city
from placegraph_lab.tables.outdoor.nearby import DIRECTIONS, Bins, relations
from placegraph_lab.tables.outdoor.outdoor_kernels import holds
from placegraph_lab.tables.outdoor.places import AREA, KEYS, RawCity
from placegraph_lab.tables.outdoor.queries import Query, load, make_queries
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.runner import Quick, Run, Seed, option, render, share, table

SIGHT = 35.0  # the speaker sees things up to this far [m]
RIGHT = 50.0  # an answer is right within this distance of the truth [m]

Asking = Literal["best", "random"]
"""The most informative question, or any question about what is around the places that fit."""


@dataclass(frozen=True)
class Speaker:
    """Somebody at a viewpoint, who sees what the raw extract has there."""

    bins: Bins
    viewpoint: Floats  # (2,) east, north [m] in the plane of `bins`

    def answer(self, question: Question) -> Answer:
        """Answer truthfully from the raw data; "don't know" where the question has no such answer."""
        visible = list(self._visible())
        if question.options == (YES, NO):
            thing = question.subjects[0]
            found = any(t == thing.label and thing.wind in ("", wind) for t, _, wind in visible)
            return question.answer(YES if found else NO)
        names = {name for _, name, _ in visible}
        option = next((thing.words for thing in question.subjects if thing.words in names), NONE)
        return question.answer(option if option in question.options else UNKNOWN)

    def _visible(self) -> Iterator[tuple[str, str, str]]:
        """Yield tag, name and direction of each object in sight, and of the areas around."""
        city, around = self.bins.city, self.bins.around(self.viewpoint[None], SIGHT)
        inside = standing_in(city, self.viewpoint)
        points = [*around.points, *[self.viewpoint] * len(inside)]
        for i, point in zip([*around.objects.tolist(), *inside], points, strict=True):
            key, label = KEYS[city.key[i]], city.labels[city.label[i]]
            delta = point - self.viewpoint
            wind = DIRECTIONS[int(relations(delta))] if np.hypot(*delta) >= 1.0 else ""
            tag = f"{key}={'yes' if label == key else label}"
            yield tag, city.labels[city.named[i]].replace("_", " "), wind


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
    questions = list(rank_questions(estimate, city))
    return questions[int(rng.integers(len(questions)))] if questions else None


def distance(estimate: CityEstimate, query: Query, city: CityMap) -> float:
    """Distance [m] of the best mode from the truth; infinite where there is none."""
    if estimate.best is None:
        return float("inf")
    here = city.plane.to_plane((estimate.best.longitude, estimate.best.latitude))
    return float(np.hypot(*(here - city.plane.to_plane((query.longitude, query.latitude)))))


AFTER = (0, 1, 2, 3, 5, 8)


@table()
def outdoor_dialogue(
    run: Run,
    cities: Annotated[str, option("Names with commas.")] = "vancouver,ankara,liechtenstein,andorra",
    queries: Annotated[int, option("Dialogues a city.")] = 100,
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """Questions until the place is found: informative against random ones."""
    rows: list[dict[str, Any]] = []
    ways: tuple[Asking, Asking] = ("best", "random")
    names = names_of(cities)
    if quick:
        names, queries = names[-1:], 5
    with run.progress() as progress:
        task = progress.add_task("asking", total=len(names) * len(ways) * queries)
        for name in names:
            city = open_city(name, run.osm, run.cache)
            bins = load(run.osm / EXTRACTS[name])
            told = make_queries(run.osm / EXTRACTS[name], statements=6, n=queries, seed=seed)
            for asking in ways:
                rng = np.random.default_rng(seed)
                right, asked = [], []
                for query in told:
                    viewpoint = bins.city.plane.to_plane((query.longitude, query.latitude))
                    course = dialogue(city, query, Speaker(bins, viewpoint), asking, rng, most=8)
                    hits = [distance(e, query, city) <= RIGHT for e in course]
                    right.append([hits[min(k, len(hits) - 1)] for k in AFTER])
                    asked.append(len(course) - 1)
                    progress.advance(task)
                row = {"city": name, "asking": asking, "right_after": np.mean(right, axis=0)}
                rows.append(row | {"questions": float(np.mean(asked))})
    columns = (
        Col("city", "city"), Col("questions", "asking"),
        *(Col(f"right after {k}", f"right_after.{i}", share) for i, k in enumerate(AFTER)),
        Col("asked on average", "questions", 1),
    )  # fmt: skip
    print(render(columns, rows))
    run.save({"rows": rows})
