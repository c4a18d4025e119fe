"""Descriptions made from a map, with the noise of real people: what the network is trained on.

A speaker stands somewhere and says how things around lie. They err: a direction is wrong, a thing
is not there. They choose words: tags, everyday words, other languages, numbers, names or none.
What comes out is what `describe` would have understood, since the words go through the vocabulary.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

from placegraph.errors import OptionError
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.language.description import (
    SPEAKER,
    Description,
    Mention,
    Relation,
    Statement,
)
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.likelihood.query import Query, compile_query
from placegraph.outdoor.map.directions_kernels import name_direction
from placegraph.outdoor.map.objects import AREA, LINE
from placegraph.outdoor.network.graphs import TextGraphs, WordWeights, find_word_weights
from placegraph.outdoor.search.posterior import NUM_RERANKED, find_candidates, score_candidates
from placegraph.outdoor.search.request import Request
from placegraph_learn.city.city_kernels import _nearest

TILE = 1000.0
"""Edge of the squares of which every fourth is kept from training [m]."""
SIGHT = 25.0
"""Things within this distance are spoken of [m]."""
FEWEST = 5
"""Things that a speaker must have in sight."""
BEARING = {"north": 0.0, "east": 0.5 * np.pi, "south": np.pi, "west": 1.5 * np.pi}
LANGUAGES = ("de", "fr", "es", "it", "tr", "nl", "pl", "pt", "ja", "ru")
"""Languages that a speaker may use for some of the words."""


def held_out(east: ArrayLike, north: ArrayLike) -> NDArray[np.bool_]:
    """Return whether positions [m] lie in tiles that training never learns from: one in four."""
    return np.asarray(_tile(east, north) % 4 == 0)


def is_evaluation(east: ArrayLike, north: ArrayLike) -> NDArray[np.bool_]:
    """Return whether positions [m] lie in tiles kept for evaluation: every other tile of `held_out`.

    The rest of these serves training's curves and its last two weights (`recalls.best_prior`).
    """
    return np.asarray(_tile(east, north) % 8 == 4)


def _tile(east: ArrayLike, north: ArrayLike) -> NDArray[np.int64]:
    column = np.floor(np.asarray(east) / TILE).astype(np.int64)
    row = np.floor(np.asarray(north) / TILE).astype(np.int64)
    return 7 * column + 13 * row


class Example(NamedTuple):
    """A description and where it was given."""

    description: Description
    position: NDArray[np.float64]
    """(2,) east, north [m]."""


class _Habits(NamedTuple):
    """Habits of one speaker."""

    slip: float
    """Share of directions that are wrong."""
    absent: float
    """Share of statements about a thing that is not there."""
    words: str
    """``tags``, ``everyday`` or ``foreign``."""
    language: str
    names: float
    """Share of named things that are called by their names."""
    about: str
    """``pairs`` of things, ``me`` or ``mixed``."""


PLAIN = _Habits(slip=0.0, absent=0.0, words="tags", language="en", names=0.0, about="pairs")


class _Surroundings(NamedTuple):
    """Things around a speaker."""

    objects: NDArray[np.int64]
    """(n,) rows of the city."""
    at: NDArray[np.float64]
    """(n, 2) where they stand for the speaker [m]."""
    around: NDArray[np.bool_]
    """(n,) areas that the speaker stands in."""
    close: NDArray[np.float64]
    """(n,) distance [m]."""


@dataclass(frozen=True, eq=False)
class Speaker:
    """Gives descriptions of places of a city."""

    city: CityMap
    vocabulary: Vocabulary
    held_out: bool = False
    """Whether it speaks in tiles that are `held_out`, but not `is_evaluation`, or in those that are not."""
    plain: bool = False
    """Whether all speak as in the paper: directions between things, by their tags, without errors."""

    def is_in_own_tiles(self, positions: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return whether positions (n, 2) [m] lie in its tiles."""
        held = held_out(*positions.T)
        return held & ~is_evaluation(*positions.T) if self.held_out else ~held

    def may_see(self, positions: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return whether places at positions (n, 2) [m] may stand beside its own to be told from them."""
        return np.full(len(positions), True) if self.held_out else ~held_out(*positions.T)

    @cached_property
    def places(self) -> NDArray[np.int64]:
        """Viewpoints in its tiles with enough in sight to speak of."""
        views = self.city.views
        surroundings = self.city.in_sight(np.arange(len(views)))
        close = np.hypot(*surroundings.offsets.T) <= SIGHT
        enough = np.add.reduceat(close, surroundings.starts[:-1]) >= FEWEST
        places = np.flatnonzero(enough & self.is_in_own_tiles(views.positions))
        if not len(places):
            raise OptionError(
                f"{self.city!r} has no place with {FEWEST} visible objects for training or "
                "validation; remove it, or use a larger extract."
            )
        return places

    def examples(self, rng: Generator) -> Iterator[Example]:
        """Yield descriptions without end."""
        views = self.city.views
        while True:
            view = int(rng.choice(self.places))
            position = views.positions[view] + rng.uniform(-10.0, 10.0, 2)
            if not self.is_in_own_tiles(position[None])[0]:
                continue
            surroundings = look_around(
                self.city, self.city.in_sight(np.array([view])).objects, position
            )
            description = self.describe(surroundings, position, rng)
            if description is not None:
                yield Example(description, position)

    def describe(
        self, surroundings: _Surroundings, position: NDArray[np.float64], rng: Generator
    ) -> Description | None:
        """Return a description given at a position (2,) [m]; None where too little is visible."""
        habits = PLAIN if self.plain else draw_habits(rng)
        told = _DescriptionBuilder(self, habits, position, rng)
        wanted = int(rng.choice([3, 4, 5, 6, 6, 6, 8, 10]))
        for _ in range(4 * wanted):
            if len(told.statements) == wanted:
                break
            kind = habits.about
            if kind == "mixed":
                kind = str(rng.choice(["pairs", "me", "near", "stand", "visible", "absent"]))
            getattr(told, f"state_{kind}")(surroundings)
        return told.description() if len(told.statements) >= 3 else None

    def word_for(self, label: str, habits: _Habits, rng: Generator) -> str:
        """Return the word that this speaker uses for a label."""
        key, _, value = label.partition("=")
        if habits.words == "foreign":
            return self.vocabulary.name_label(label, language=habits.language)
        if habits.words == "everyday" and rng.random() < 0.8:
            known = self.vocabulary.english.get(label, ())
            if known and rng.random() < 0.7:
                return str(known[int(len(known) * rng.random() ** 2)])
            return self.vocabulary.name_label(label)
        return key if value == "yes" else value


class _DescriptionBuilder:
    """Builder of one description."""

    def __init__(
        self, speaker: Speaker, habits: _Habits, position: NDArray[np.float64], rng: Generator
    ) -> None:
        self.speaker, self.habits, self.position, self.rng = speaker, habits, position, rng
        self.mentions = [Mention(0, "I"), Mention(1, "you")]
        self.statements: list[Statement] = []
        self._ids: dict[str, int] = {}
        self._words: dict[str, str] = {}
        self._said: set[tuple[object, ...]] = set()

    def description(self) -> Description:
        return Description("", tuple(self.mentions), tuple(self.statements))

    def state_pairs(self, surroundings: _Surroundings) -> None:
        """Add a statement about an object, relative to another."""
        near = np.flatnonzero(surroundings.close <= SIGHT)
        if len(near) < 2:
            return
        a, b = self.rng.choice(near, 2, replace=False)
        delta = surroundings.at[a] - surroundings.at[b]
        if not 1.0 <= np.hypot(*delta) <= (50.0 if self.rng.random() < 0.1 else SIGHT):
            return
        self.add(
            Relation.DIRECTION,
            self.node(surroundings, a),
            self.node(surroundings, b),
            self.bearing(delta),
        )

    def state_me(self, surroundings: _Surroundings) -> None:
        """Add a statement about an object, relative to the speaker."""
        a = self.pick(surroundings)
        delta = surroundings.at[a] - self.position
        if np.hypot(*delta) >= 1.0:
            self.add(Relation.DIRECTION, self.node(surroundings, a), SPEAKER, self.bearing(delta))

    def state_near(self, surroundings: _Surroundings) -> None:
        """Add a statement that a thing is close by, or that two things are close to each other."""
        a = int(np.argmin(surroundings.close + self.rng.exponential(6.0, len(surroundings.close))))
        others = np.hypot(*(surroundings.at - surroundings.at[a]).T)
        others[a] = np.inf
        b = int(np.argmin(others + self.rng.exponential(4.0, len(others))))
        if self.rng.random() < 0.5 and others[b] < 15.0:
            self.add(Relation.NEAR, self.node(surroundings, a), self.node(surroundings, b))
        elif surroundings.close[a] < 20.0:
            self.add(Relation.NEAR, SPEAKER, self.node(surroundings, a))

    def state_stand(self, surroundings: _Surroundings) -> None:
        """Add a statement about where the speaker stands: in an area, or on a line."""
        kinds = self.speaker.city.objects.kind[surroundings.objects]
        inside, lines = np.flatnonzero(surroundings.around), np.flatnonzero(
            (kinds == LINE) & (surroundings.close < 8.0)
        )  # fmt: skip
        if len(inside) and (self.rng.random() < 0.5 or not len(lines)):
            self.add(
                Relation.INSIDE, SPEAKER, self.node(surroundings, int(self.rng.choice(inside)))
            )
        elif len(lines):
            self.add(Relation.ALONG, SPEAKER, self.node(surroundings, int(self.rng.choice(lines))))

    def state_visible(self, surroundings: _Surroundings) -> None:
        """Add a statement that one thing, or several, are in sight."""
        self.add(
            Relation.VISIBLE,
            self.node(surroundings, self.pick(surroundings), counted=True),
            SPEAKER,
        )

    def state_absent(self, surroundings: _Surroundings) -> None:
        """Add a statement that a thing is not in sight."""
        city = self.speaker.city
        here = {city.objects.label(i) for i in surroundings.objects}
        label = city.objects.label(int(self.rng.integers(len(city.objects))))
        if label not in here and len(self.statements) > 1:
            self.add(Relation.VISIBLE, self.mention(label, ""), SPEAKER, negated=True)

    def pick(self, surroundings: _Surroundings) -> int:
        near = np.flatnonzero(surroundings.close <= SIGHT)
        return int(self.rng.choice(near if len(near) else len(surroundings.close)))

    def bearing(self, delta: NDArray[np.float64]) -> float:
        """Return bearing [rad] that is said of a vector: mostly one of the four winds, sometimes wrong."""
        if self.rng.random() < self.habits.slip:
            return float(self.rng.choice(list(BEARING.values())))
        if self.habits.about != "pairs" and self.rng.random() < 0.2:
            angle = np.arctan2(delta[0], delta[1])
            return float(np.round(angle / (np.pi / 4)) * (np.pi / 4) % (2 * np.pi))
        return BEARING[name_direction(delta)]

    def node(self, surroundings: _Surroundings, i: int, *, counted: bool = False) -> int:
        """Return mention of thing i, or, of what is not there, of any other."""
        objects, row = self.speaker.city.objects, int(surroundings.objects[i])
        if self.rng.random() < self.habits.absent:
            row = int(self.rng.integers(len(objects)))
        labels = objects.label_values[objects.label_starts[row] : objects.label_starts[row + 1]]
        rank = 1 if len(labels) > 1 and self.rng.random() < 0.12 else 0
        name = objects.name(row) if self.rng.random() < self.habits.names else ""
        label = objects.labels[labels[rank]]
        count = 0
        if counted and not name and self.rng.random() < 0.5:
            count = sum(objects.label(int(o)) == label for o in surroundings.objects)
        return self.mention(label, name, count)

    def mention(self, label: str, name: str, count: int = 0) -> int:
        """Return node of what is called so; the same word is the same node."""
        word = self._words.get(label)
        if word is None:
            word = self._words[label] = self.speaker.word_for(label, self.habits, self.rng)
        id_ = self._ids.get(name or word)
        if id_ is None:
            id_ = self._ids[name or word] = len(self.mentions)
            senses = self.speaker.vocabulary.senses(word)
            self.mentions.append(
                Mention(id_, word, senses, name, count if count > 1 else None, definite=True)
            )
        return id_

    def add(
        self,
        relation: Relation,
        source: int,
        target: int,
        bearing: float | None = None,
        *,
        negated: bool = False,
    ) -> None:
        """Say it, unless it was said already or relates a thing to one of its own kind."""
        said = (relation, source, target, bearing)
        if source != target and said not in self._said:
            self._said.add(said)
            self.statements.append(
                Statement(relation, source, target, bearing=bearing, negated=negated)
            )


def draw_habits(rng: Generator) -> _Habits:
    """Draw the habits of one speaker."""
    return _Habits(
        slip=float(rng.choice([0.0, 0.08, 0.25], p=[0.5, 0.25, 0.25])),
        absent=float(rng.choice([0.0, 0.06, 0.15], p=[0.5, 0.25, 0.25])),
        words=str(rng.choice(["tags", "everyday", "foreign"], p=[0.45, 0.45, 0.1])),
        language=str(rng.choice(LANGUAGES)),
        names=float(rng.choice([0.0, 0.3, 0.9], p=[0.7, 0.15, 0.15])),
        about=str(rng.choice(["pairs", "me", "mixed"], p=[0.45, 0.25, 0.3])),
    )


def look_around(
    city: CityMap, nearby: NDArray[np.int32], position: NDArray[np.float64]
) -> _Surroundings:
    """Return the objects (rows) around a position (2,) [m] as a speaker there sees them."""
    o = city.objects
    off = _nearest(o.kind, o.part_starts, o.point_starts, o.points, nearby, *position)
    close = np.hypot(*off.T)
    around = (o.kind[nearby] == AREA) & (close == 0.0)
    at = position + off
    at[around] = o.center[nearby[around]]
    close = np.where(around, np.hypot(*(at - position).T), close)
    return _Surroundings(nearby.astype(np.int64), at, around, close)


OTHERS = 4
"""Viewpoints from anywhere beside the `NUM_RERANKED` that relational matching finds best."""
AT = 25.0
"""A viewpoint is right where the speaker stands in the square of twice this edge around it [m]."""
NEARBY = 60.0
"""Viewpoints nearer than this and not right are neither right nor wrong [m]."""


@dataclass(frozen=True, eq=False)
class ExamplePool:
    """Q examples of one city, each with K viewpoints."""

    texts: TextGraphs
    word_weights: WordWeights
    positions: NDArray[np.float64]
    """(Q, 2) where the text was given [m]."""
    views: NDArray[np.int64]
    """(Q, K) rows of `city.views`, -1 where there are fewer."""
    scores: NDArray[np.float32]
    """(Q, K) log-likelihood ratio of relational matching; NaN where it was not asked."""
    right: NDArray[np.int8]
    """(Q, K) 1 right, 0 wrong, -1 neither (or no viewpoint)."""

    def __len__(self) -> int:
        return len(self.positions)


def make_pool(
    speaker: Speaker, n: int, rng: Generator, tick: Callable[[], None] = lambda: None
) -> ExamplePool:
    """Make `n` examples of one city."""
    city = speaker.city
    descriptions: list[Description] = []
    positions, views, scores, right, queries = [], [], [], [], []
    for example in speaker.examples(rng):
        query = compile_query(example.description, city)
        if not any(not s.negated for s in query.used):
            continue
        rows, values = _candidates(query, speaker, example.position, rng)
        delta = np.abs(city.views.positions[rows] - example.position).max(axis=1)
        label = np.where(delta <= AT, 1, np.where(delta <= NEARBY, -1, 0))
        label[rows < 0] = -1
        descriptions.append(example.description)
        positions.append(example.position)
        queries.append(query)
        views.append(rows)
        scores.append(values)
        right.append(label)
        tick()
        if len(positions) == n:
            break
    texts = TextGraphs.of(descriptions)
    return ExamplePool(
        texts,
        find_word_weights(texts, queries),
        np.array(positions),
        np.array(views, np.int64),
        np.array(scores, np.float32),
        np.array(right, np.int8),
    )


def _candidates(
    query: Query, speaker: Speaker, position: NDArray[np.float64], rng: Generator
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return viewpoints (K,) to tell apart: the true ones, the best of matching, and any others.

    Who trains does not see the tiles that are held out, not even as wrong places.
    """
    views = speaker.city.views
    asked = Request(speaker.city, query)
    found = score_candidates(asked, find_candidates(asked))
    best = np.argsort(-found.scores, kind="stable")
    best = best[speaker.may_see(views.positions_of(found.rows[best]))][:NUM_RERANKED]
    true = rng.permutation(views.near(position, AT))[:4]  # not the nearest: cells stand apart
    others = rng.integers(len(views), size=OTHERS)
    others = others[speaker.may_see(views.positions[others])]
    rows = np.concatenate([true, found.rows[best], others]).astype(np.int64)
    known = dict(zip(found.rows.tolist(), found.scores.tolist(), strict=True))
    rows = rows[np.sort(np.unique(rows, return_index=True)[1])]
    values = np.array([known.get(int(row), np.nan) for row in rows], np.float32)
    size = NUM_RERANKED + OTHERS + 4
    short = size - len(rows)
    return np.pad(rows, (0, short), constant_values=-1), np.pad(
        values, (0, short), constant_values=np.nan
    )
