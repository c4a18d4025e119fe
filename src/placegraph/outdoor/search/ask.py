"""Ask back: the question whose answer tells the places that still fit apart best.

Every question is scored by its expected information gain: the entropy of its answer over the modes,
less the entropy that the answer would have if the place were known.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import CityEstimate, Status
from placegraph.errors import OptionError
from placegraph.language.text import Ignored
from placegraph.outdoor.language.description import (
    LISTENER,
    SPEAKER,
    Description,
    Mention,
    Relation,
    Sense,
    Statement,
)
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.language.words import tokens

if TYPE_CHECKING:
    from placegraph.outdoor.map.city import City

YES, NO, UNKNOWN = "yes", "no", "don't know"
NONE = "none of these"
WINDS = {"north": 0.0, "east": np.pi / 2, "south": np.pi, "west": 1.5 * np.pi}
MOST_PLACES = 600
"""So many places are told apart at a time."""
ASKED_WITHIN = 35.0
"""What is farther away than this need not be in sight [m]."""
MISTAKE = 0.05
"""Share of answers that are wrong."""
MOST_NAMES = 4
"""A choice question offers at most so many names."""
WORTH = 0.02
"""Questions that promise less information are not asked [nat]."""


@dataclass(frozen=True, slots=True)
class Thing:
    """Subject of a question: a label in a direction, or a name."""

    words: str
    label: str = ""
    wind: str = ""
    """One of the four winds, or empty for any direction."""


@dataclass(frozen=True, slots=True)
class Question:
    """A question to the speaker; `options` are its answers, besides "don't know"."""

    text: str
    options: tuple[str, ...]
    things: tuple[Thing, ...]
    """One thing of a yes/no question; one for each option but the last of a choice."""
    gain: float
    """Expected information gain [nat]."""

    def answer(self, option: str) -> Answer:
        """Answer it; raises `OptionError` for an answer that it does not have."""
        given = str(option).strip().lower()
        for known in (*self.options, UNKNOWN):
            if given == known.lower() or (
                given and given == known[0].lower() and known in (YES, NO)
            ):
                return Answer(self, known)
        raise OptionError(
            f"{option!r} is no answer; say one of: {', '.join((*self.options, UNKNOWN))}."
        )


@dataclass(frozen=True, slots=True)
class Answer:
    """A question and its answer."""

    question: Question
    option: str

    def added_to(self, description: Description) -> Description:
        """Return the description with the answer as further statements."""
        if self.option == UNKNOWN:  # nothing is learnt, but it need not be asked again
            unknown = Ignored(self.question.text, "not known")
            return replace(description, ignored=(*description.ignored, unknown))
        things = self.question.things
        if self.question.options == (YES, NO):
            return _stated(description, things[0], self.question.text, negated=self.option == NO)
        for thing in things:
            if self.option in (NONE, thing.words):
                description = _stated(
                    description, thing, self.question.text, negated=self.option == NONE
                )
        return description


def _stated(description: Description, thing: Thing, text: str, *, negated: bool) -> Description:
    if not description.mentions:
        description = replace(
            description, mentions=(Mention(SPEAKER, "me"), Mention(LISTENER, "you"))
        )
    node = len(description.mentions)
    senses = (Sense(thing.label, 1.0),) if thing.label else ()
    mention = Mention(node, thing.words, senses, "" if thing.label else thing.words, definite=False)
    statement = Statement(
        Relation.DIRECTION if thing.wind else Relation.VISIBLE,
        node,
        SPEAKER,
        bearing=WINDS[thing.wind] if thing.wind else None,
        negated=negated,
        text=f"{text} {NO if negated else YES}",
    )
    return replace(
        description,
        mentions=(*description.mentions, mention),
        statements=(*description.statements, statement),
    )


def next_question(
    estimate: CityEstimate, city: City, vocabulary: Vocabulary | None = None
) -> Question | None:
    """Question with the largest expected information gain over the estimate's places, or None.

    None also where one place is clear: a question would only move it by metres.
    """
    if estimate.status == Status.OK:
        return None
    found = possible_questions(estimate, city, vocabulary)
    first = next(found, None)
    if first is None or first.gain <= WORTH:
        return None
    as_good = itertools.takewhile(lambda q: q.gain == first.gain, found)
    return max((first, *as_good), key=lambda q: q.text)


def possible_questions(
    estimate: CityEstimate, city: City, vocabulary: Vocabulary | None = None
) -> Iterator[Question]:
    """All questions about what is around the estimate's places that were not asked yet, best first."""
    if vocabulary is None:
        from placegraph.outdoor.language.vocabulary import Vocabulary as Shipped

        vocabulary = Shipped.default()
    heaviest = np.argsort(-estimate.support[:, 2], kind="stable")[:MOST_PLACES]
    weights = estimate.support[heaviest, 2]
    if not weights.sum() > 0.0:
        return iter(())
    weights = weights / weights.sum()
    around = _Around.of(city, city.plane.to_plane(estimate.support[heaviest, :2]))
    understood = estimate.understood or Description("")
    asked = {s.text for s in understood.statements} | {i.text for i in understood.ignored}
    every = (_yes_or_no(weights, around, vocabulary), _which(weights, around))
    return (
        q
        for q in heapq.merge(*every, key=lambda q: -q.gain)
        if not asked & {q.text, f"{q.text} {YES}", f"{q.text} {NO}"}
    )


@dataclass(frozen=True)
class _Around:
    """Things around K places: expected numbers by wind and label, and by name."""

    labels: list[str]
    """(L,)"""
    pairs: NDArray[np.int64]
    """(2, M) labels and the places that they are around."""
    expected: NDArray[np.float64]
    """(5, M), for any direction and for each of `WINDS`."""
    names: list[str]
    """(N,)"""
    named: NDArray[np.float64]
    """(N, K)"""

    @classmethod
    def of(cls, city: City, positions: NDArray[np.float64]) -> _Around:
        """Look around positions (K, 2) [m], each from the viewpoint nearest to it."""
        views, objects = city.views, city.objects
        nearest = np.maximum(views.nearest(positions), 0)
        seen = city.in_sight(nearest)
        place, rows = np.repeat(np.arange(len(positions)), np.diff(seen.starts)), seen.objects
        delta = (views.positions_of(nearest) - positions)[place] + seen.offsets
        distance = np.hypot(*delta.T)
        sure = 1.0 / (1.0 + np.exp((distance - ASKED_WITHIN) / 6.0))
        shares = [sure]
        for angle in WINDS.values():
            cosine = (delta @ (np.sin(angle), np.cos(angle))) / np.maximum(distance, 1e-3)
            clear = distance > 5.0  # nearer than that a direction is a guess [m]
            shares.append(sure * clear / (1.0 + np.exp(-(cosine - np.cos(np.pi / 4)) / 0.1)))
        k = len(positions)
        labels, label = _numbered(objects.label_values[objects.label_starts[rows]])
        pairs, pair = _numbered(label * k + place)
        first = objects.name_starts[rows]
        has = first < objects.name_starts[rows + 1]
        names, name = _numbered(objects.name_values[first[has]])
        named = np.bincount(name * k + place[has], sure[has], len(names) * k).astype(np.float64)
        return cls(
            [objects.labels[i] for i in labels],
            np.stack(np.divmod(pairs, k)),
            np.stack([np.bincount(pair, share, len(pairs)) for share in shares]),
            [objects.names[i] for i in names],
            named.reshape(len(names), k),
        )


def _numbered(keys: NDArray[np.integer[Any]]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keys that occur, ascending, and the number of each among them: `np.unique` of small numbers."""
    there = np.flatnonzero(np.bincount(keys))
    number = np.zeros(int(keys.max(initial=-1)) + 1, np.int64)
    number[there] = np.arange(len(there))
    return there, number[keys]


def _yes_or_no(
    weights: NDArray[np.float64], around: _Around, vocabulary: Vocabulary
) -> Iterator[Question]:
    """Questions whether a thing is around, best first."""
    label, place = around.pairs
    yes = MISTAKE + (1.0 - 2.0 * MISTAKE) * -np.expm1(-2.0 * around.expected)
    # where nothing is expected, yes is said by mistake alone
    more = yes - MISTAKE, _entropy(yes) - _entropy(MISTAKE)
    said, known = (
        [np.bincount(label, weights[place] * m, len(around.labels)) for m in of_wind]
        for of_wind in more
    )
    gains = _entropy(MISTAKE + np.stack(said)) - _entropy(MISTAKE) - np.stack(known)
    there = np.stack([np.bincount(label, e, len(around.labels)) > 0.0 for e in around.expected])
    there &= [not name.endswith("*") for name in around.labels]
    winds = ("", *WINDS)
    for j, i in zip(*np.unravel_index(np.argsort(-gains, axis=None), gains.shape), strict=True):
        if there[j, i]:
            words, wind = vocabulary.spoken(around.labels[i]), winds[j]
            article = "an" if words[:1].lower() in "aeiou" else "a"
            where = f"within sight to your {wind}" if wind else "within sight"
            text = f"Is there {article} {words} {where}?"
            thing = Thing(words, around.labels[i], wind)
            yield Question(text, (YES, NO), (thing,), float(gains[j, i]))


def _entropy(yes: Any) -> Any:  # noqa: ANN401  # a number, or an array
    """Entropy [nat] of an answer that is yes with a probability."""
    return -(yes * np.log(yes) + (1.0 - yes) * np.log1p(-yes))


def _which(weights: NDArray[np.float64], around: _Around) -> list[Question]:
    """At most one choice question: names that together cover the likeliest places."""
    left = weights.copy()
    sure = np.minimum(around.named, 1.0)
    spelt: dict[str, int] = {}  # by their words: "McDonald's" and "McDonalds" are one
    while len(spelt) < MOST_NAMES and around.names:
        share = sure @ left
        telling = max(np.flatnonzero(share == share.max()).tolist(), key=lambda i: around.names[i])
        if share[telling] < 0.02:  # the rest is too unlikely to be asked about
            break
        first = spelt.setdefault(" ".join(tokens(around.names[telling])), telling)
        left = left * (1.0 - sure[telling])
        if first != telling:
            sure[first] = np.minimum(sure[first] + sure[telling], 1.0)
    chosen = list(spelt.values())
    if len(chosen) < 2:  # that would be a yes/no question
        return []
    present = sure[chosen]
    none = np.prod(1.0 - 0.95 * present, axis=0)
    said = np.vstack([present / np.maximum(present.sum(axis=0), 1e-9) * (1.0 - none), none])
    said = MISTAKE / len(said) + (1.0 - MISTAKE) * said
    names = tuple(around.names[i] for i in chosen)
    return [
        Question(
            f"Which of these is within sight: {', '.join(names)}?",
            (*names, NONE),
            tuple(Thing(name) for name in names),
            _gain(weights, said),
        )
    ]


def _gain(weights: NDArray[np.float64], options: NDArray[np.float64]) -> float:
    """Mutual information [nat] of the place (K,) and the answer (O, K)."""

    def entropy(p: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(-(p * np.log(np.maximum(p, 1e-12))).sum(axis=0))

    return float(entropy(options @ weights) - entropy(options) @ weights)
