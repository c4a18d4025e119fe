"""Ask back: the question whose answer tells the places that still fit apart best.

Every question is scored by its expected information gain: the entropy of its answer over the modes,
less the entropy that the answer would have if the place were known.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import OptionError
from placegraph.outdoor.description import (
    LISTENER,
    SPEAKER,
    Description,
    Mention,
    Relation,
    Sense,
    Statement,
)
from placegraph.outdoor.index import STRIDE
from placegraph.outdoor.posterior import Posterior, modes

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.estimate import Estimate
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.vocabulary import Vocabulary

YES, NO, UNKNOWN = "yes", "no", "don't know"
NONE = "none of these"
WINDS = {"north": 0.0, "east": np.pi / 2, "south": np.pi, "west": 1.5 * np.pi}
MOST_MODES = 12
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
    """What a question is about: a label in a direction, or a name."""

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
        given = option.strip().lower()
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
        if self.option == UNKNOWN:
            return description
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
    estimate: Estimate, city: CityMap, vocabulary: Vocabulary | None = None
) -> Question | None:
    """Question with the largest expected information gain over the estimate's places, or None."""
    if vocabulary is None:
        from placegraph.outdoor.vocabulary import Vocabulary as Shipped

        vocabulary = Shipped.default()
    places = _places(estimate, city)
    if len(places) < 2:
        return None
    weights = np.array([probability for _, probability in places])
    weights /= weights.sum()
    around = [_around(city, position) for position, _ in places]
    asked = " ".join(s.text for s in estimate.understood.statements) if estimate.understood else ""
    questions = [
        q
        for q in (*_yes_or_no(weights, around, vocabulary), *_which(weights, around))
        if q.gain > WORTH and q.text not in asked
    ]
    return max(questions, key=lambda q: (q.gain, q.text), default=None)


def _places(estimate: Estimate, city: CityMap) -> list[tuple[NDArray[np.float64], float]]:
    """Positions [m] and probabilities of the places that still fit."""
    if not len(estimate.support):
        return []
    found = Posterior(city.plane.to_plane(estimate.support[:, :2]), estimate.support[:, 2], 0.0)
    return [(m.position, m.probability) for m in modes(found, MOST_MODES, 1.0)]


@dataclass(frozen=True)
class _Seen:
    """What is around a place: expected number by (label, wind), and by name."""

    labels: dict[tuple[str, str], float]
    names: dict[str, float]


def _around(city: CityMap, position: NDArray[np.float64]) -> _Seen:
    views, objects = city.views, city.objects
    view = int(next(iter(views.near(position, STRIDE)), -1))
    labels: dict[tuple[str, str], float] = defaultdict(float)
    names: dict[str, float] = defaultdict(float)
    for entry in range(views.starts[view], views.starts[view + 1]) if view >= 0 else ():
        delta = views.positions[view] + views.offsets[entry] - position
        distance = float(np.hypot(*delta))
        sure = 1.0 / (1.0 + np.exp((distance - ASKED_WITHIN) / 6.0))
        row = int(views.objects[entry])
        label = objects.label(row)
        labels[label, ""] += sure
        if distance > 5.0:
            for wind, angle in WINDS.items():
                cosine = (delta[0] * np.sin(angle) + delta[1] * np.cos(angle)) / distance
                labels[label, wind] += sure / (1.0 + np.exp(-(cosine - np.cos(np.pi / 4)) / 0.1))
        if name := objects.name(row):
            names[name] += sure
    return _Seen(labels, names)


def _yes_or_no(
    weights: NDArray[np.float64], around: list[_Seen], vocabulary: Vocabulary
) -> list[Question]:
    questions = []
    for label, wind in sorted({key for seen in around for key in seen.labels}):
        if label.endswith("*"):
            continue
        expected = np.array([seen.labels.get((label, wind), 0.0) for seen in around])
        yes = MISTAKE + (1.0 - 2.0 * MISTAKE) * -np.expm1(-2.0 * expected)
        words = vocabulary.spoken(label)
        article = "an" if words[:1].lower() in "aeiou" else "a"
        where = f"within sight to your {wind}" if wind else "within sight"
        questions.append(
            Question(
                f"Is there {article} {words} {where}?",
                (YES, NO),
                (Thing(words, label, wind),),
                _gain(weights, np.stack([yes, 1.0 - yes])),
            )
        )
    return questions


def _which(weights: NDArray[np.float64], around: list[_Seen]) -> list[Question]:
    """At most one choice question: a telling name for each of the likeliest places."""
    share: dict[str, float] = defaultdict(float)
    for weight, seen in zip(weights, around, strict=True):
        for name, sure in seen.names.items():
            share[name] += weight * min(1.0, sure)
    chosen: list[str] = []
    for seen in around:
        telling = [n for n, sure in seen.names.items() if sure > 0.5 and n not in chosen]
        if telling and not any(n in chosen for n in seen.names):
            chosen.append(min(telling, key=lambda n: (share[n], n)))
    chosen = chosen[:MOST_NAMES]
    if len(chosen) < 2:
        return []
    present = np.array([[min(1.0, seen.names.get(n, 0.0)) for seen in around] for n in chosen])
    none = np.prod(1.0 - 0.95 * present, axis=0)
    said = np.vstack([present / np.maximum(present.sum(axis=0), 1e-9) * (1.0 - none), none])
    said = MISTAKE / len(said) + (1.0 - MISTAKE) * said
    listed = ", ".join(chosen)
    return [
        Question(
            f"Which of these is within sight: {listed}?",
            (*chosen, NONE),
            tuple(Thing(name) for name in chosen),
            _gain(weights, said),
        )
    ]


def _gain(weights: NDArray[np.float64], options: NDArray[np.float64]) -> float:
    """Mutual information [nat] of the place (K,) and the answer (O, K)."""

    def entropy(p: NDArray[np.float64]) -> NDArray[np.float64]:
        return -(p * np.log(np.maximum(p, 1e-12))).sum(axis=0)

    return float(entropy(options @ weights) - weights @ entropy(options))
