"""Questions whose answers tell the places apart that still fit a description.

Questions are ranked by expected information gain: the entropy of the answer over the modes, less the
entropy that the answer would have if the place were known.
"""

from __future__ import annotations

import heapq
import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import CityEstimate, Status
from placegraph.core.geometry import Floats
from placegraph.errors import OptionError
from placegraph.language.text import IgnoredText
from placegraph.outdoor.language.description import (
    LISTENER,
    SPEAKER,
    Description,
    Mention,
    Relation,
    Sense,
    Statement,
)
from placegraph.outdoor.language.languages import read_answers, translate, translate_option
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.language.words import tokens
from placegraph.outdoor.likelihood.match_kernels import score_exact
from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.map.cells import VisibleObjects
from placegraph.outdoor.map.city import City

YES, NO, UNKNOWN = "yes", "no", "don't know"
NONE = "none of these"
COMPASS = {"north": 0.0, "east": np.pi / 2, "south": np.pi, "west": 1.5 * np.pi}
MAX_PLACES = 600
"""Largest number of places that a question tells apart."""
SIGHT = 35.0
"""Distance at which half of the objects are in sight [m]."""
ERROR_RATE = 0.05
"""Share of answers that are wrong."""
MAX_NAMES = 4
"""Largest number of names in a choice question."""
MIN_GAIN = 0.02
"""Smallest expected information gain of a question that is asked [nat]."""
MIN_CHANGE, MAX_TRIED, MAX_MOVED = 0.1, 8, 64
"""Smallest share of the probability that the answers to a question move, in the mean; largest numbers of
questions and of places that this is computed for."""


UNTOLD = re.compile(
    r"\*$|landuse=|highway=(service|track|unclassified|secondary|tertiary)|building=(commercial|retail)"
)
"""Labels that people on the street cannot tell from others."""


@dataclass(frozen=True, slots=True)
class Subject:
    """Map object that a question is about: a label in a direction, or a name."""

    words: str
    label: str = ""
    wind: str = ""
    """One of `COMPASS`, or empty for any direction."""


@dataclass(frozen=True, slots=True)
class Question:
    """A question to the speaker; `options` are its answers, besides "don't know"."""

    text: str
    options: tuple[str, ...]
    subjects: tuple[Subject, ...]
    """One of a yes/no question; one for each option but the last of a choice question."""
    gain: float
    """Expected information gain [nat]."""
    language: str = "en"
    """Code of the language in which it is asked."""

    @property
    def choices(self) -> tuple[str, ...]:
        """Options and "don't know" as a person reads them, in the language of the question."""
        return tuple(translate_option(known, self.language) for known in (*self.options, UNKNOWN))

    def answer(self, option: str) -> Answer:
        """Choose an answer; raises `OptionError` where the question does not offer it.

        "y" and "n" are short for yes and no; no to a list is `NONE`.
        """
        given = str(option).strip().lower()
        short = {"y": YES, "n": NO}.get(given, given)
        if NONE in self.options and short in (NO, "none"):
            short = NONE
        for known, shown in zip((*self.options, UNKNOWN), self.choices, strict=True):
            if short == known.lower() or given == shown.lower():
                return Answer(self, known)
        options = ", ".join(self.choices)
        raise OptionError(f"{option!r} is not a valid answer; choose one of: {options}.")


@dataclass(frozen=True, slots=True)
class Answer:
    """A question and its answer."""

    question: Question
    option: str

    def added_to(self, description: Description) -> Description:
        """Return the description with the answer as further statements."""
        if self.option == UNKNOWN:  # so that the question is not asked again
            unknown = IgnoredText(self.question.text, "not known")
            return replace(description, ignored=(*description.ignored, unknown))
        is_choice = self.question.options != (YES, NO)
        for subject in self.question.subjects:
            if not is_choice or self.option in (NONE, subject.words):
                is_negated = self.option == (NONE if is_choice else NO)
                text = f"{self.question.text} {NO if is_negated else YES}"
                description = _add_statement(description, subject, text, negated=is_negated)
        return description


def _add_statement(
    description: Description, subject: Subject, text: str, *, negated: bool
) -> Description:
    if not description.mentions:
        description = replace(
            description, mentions=(Mention(SPEAKER, "me"), Mention(LISTENER, "you"))
        )
    node = len(description.mentions)
    senses = (Sense(subject.label, 1.0),) if subject.label else ()
    name = "" if subject.label else subject.words
    mention = Mention(node, subject.words, senses, name, definite=False)
    statement = Statement(
        Relation.DIRECTION if subject.wind else Relation.VISIBLE, node, SPEAKER,
        bearing=COMPASS.get(subject.wind), negated=negated, text=text,
    )  # fmt: skip
    return replace(
        description,
        mentions=(*description.mentions, mention),
        statements=(*description.statements, statement),
    )


def next_question(estimate: CityEstimate, city: City) -> Question | None:
    """Choose the question of largest expected information gain over an estimate's places.

    Returns None where no question helps, or one place is clear: a question would only move it by metres.
    """
    if estimate.status == Status.OK:
        return None
    places = Places.of_estimate(estimate, city)
    found = list(itertools.islice(rank_questions(estimate, city, places), MAX_TRIED))
    found.sort(key=lambda q: (q.gain, q.text), reverse=True)
    good = itertools.takewhile(lambda q: q.gain > MIN_GAIN, found)
    return next((q for q in good if moves_posterior(places, city, q)), None)


class Places(NamedTuple):
    """Places (K, 2) [m] of an estimate, heaviest first, and what viewpoints nearest to them have in sight."""

    weights: Floats
    positions: Floats
    visible: VisibleObjects

    @classmethod
    def of_estimate(cls, estimate: CityEstimate, city: City) -> Places:
        """Take the `MAX_PLACES` heaviest places of an estimate."""
        heaviest = np.argsort(-estimate.support[:, 2], kind="stable")[:MAX_PLACES]
        positions = city.plane.to_plane(estimate.support[heaviest, :2])
        visible = city.in_sight(np.maximum(city.views.nearest(positions), 0))
        return cls(estimate.support[heaviest, 2], positions, visible)


def moves_posterior(places: Places, city: City, question: Question) -> bool:
    """Return whether an answer moves `MIN_CHANGE` of the probability between the likeliest places.

    In the mean of the answers, as total variation distance between the posterior and that given the answer,
    by the likelihood of the search.
    """
    from placegraph.outdoor.search.posterior import PRIOR_COHERENT  # which imports answers

    weights = places.weights[:MAX_MOVED] / places.weights[:MAX_MOVED].sum()
    positions, starts = places.positions[:MAX_MOVED], places.visible.starts[: MAX_MOVED + 1]
    change = 0.0
    for option in question.options:
        query = compile_query(Answer(question, option).added_to(Description("")), city)
        added = np.zeros((len(positions), 1, len(query.used)), np.float32)
        ratios, _, _ = score_exact(
            query.statements, city.columns, query.token_weights(len(city.views.share)),
            positions[:, None], (starts, places.visible.objects), added, PRIOR_COHERENT, False,
        )  # fmt: skip
        posterior = weights * np.exp(ratios[:, 0] - ratios.max())
        change += 0.5 * np.abs(posterior / posterior.sum() - weights).sum()
        if change >= MIN_CHANGE * len(question.options):
            return True
    return False


def rank_questions(
    estimate: CityEstimate, city: City, places: Places | None = None
) -> Iterator[Question]:
    """Rank the questions about objects around an estimate's places that were not asked yet."""
    places = places or Places.of_estimate(estimate, city)
    if not places.weights.sum() > 0.0:
        return iter(())
    weights = places.weights / places.weights.sum()
    understood = estimate.understood or Description("")
    text = f" {' '.join(tokens(understood.text))} "
    around = _Surroundings.of_places(city, places)
    code = understood.language if understood.language in read_answers() else "en"
    asked = {s.text for s in understood.statements} | {i.text for i in understood.ignored}
    ranked = heapq.merge(
        _rank_yes_no_questions(weights, around, code), _make_choice_question(weights, around, text),
        key=lambda q: -q.gain,
    )  # fmt: skip
    spoken = (replace(q, text=translate(q.text, code), language=code) for q in ranked)
    said = _find_said(understood)
    return (
        q for q in spoken
        if not asked & {q.text, f"{q.text} {YES}", f"{q.text} {NO}"}
        and said.isdisjoint((s.label, s.wind) for s in q.subjects)
    )  # fmt: skip


def _find_said(understood: Description) -> set[tuple[str, str]]:
    """Find the labels, and labels in a direction, that a text mentions."""
    labels = [{s.label for s in m.senses if s.weight >= 0.5} for m in understood.mentions]
    said = {(label, "") for known in labels for label in known}
    for s in understood.statements:
        if s.bearing is not None and s.source < len(labels):
            winds = [w for w, angle in COMPASS.items() if np.cos(s.bearing - angle) > 0.9]
            said |= {(label, wind) for label in labels[s.source] for wind in winds}
    return said


@dataclass(frozen=True)
class _Surroundings:
    """Objects around K places: expected numbers by direction and label, and by name."""

    labels: list[str]
    """(L,)"""
    pairs: NDArray[np.int64]
    """(2, M) labels, ascending, and the places that have such objects around."""
    expected: Floats
    """(5, M) numbers, in any direction and in each of `COMPASS`."""
    names: list[str]
    """(N,)"""
    named: Floats
    """(N, K)"""

    @classmethod
    def of_places(cls, city: City, places: Places) -> _Surroundings:
        """Look around places (K), each from the viewpoint nearest to it."""
        (_, positions, visible), objects = places, city.objects
        shown = np.flatnonzero(~city.hidden[visible.objects])
        place = np.repeat(np.arange(len(positions)), np.diff(visible.starts))[shown]
        rows = visible.objects[shown]
        delta = (city.views.positions_of(visible.points) - positions)[place] + visible.offsets[
            shown
        ]
        east, north = delta.T
        distance = np.hypot(east, north)
        # a cell's centre may be kilometres from the nearest viewpoint
        sure = 1.0 / (1.0 + np.exp(np.minimum((distance - SIGHT) / 6.0, 80.0)))
        clear = sure * (distance > 5.0)  # nearer than that a direction is a guess [m]
        # in the order of `COMPASS`
        cosines = np.stack([north, east, -north, -east]) / np.maximum(distance, 1e-3)
        shares = [sure, *(clear / (1.0 + np.exp((np.cos(np.pi / 4) - cosines) / 0.1)))]
        k = len(positions)
        labels, label = _renumber(objects.label_values[objects.label_starts[rows]])
        pairs, pair = _renumber(label * k + place)
        first = objects.name_starts[rows]
        has = first < objects.name_starts[rows + 1]
        names, name = _renumber(objects.name_values[first[has]])
        named = np.bincount(name * k + place[has], sure[has], len(names) * k).astype(np.float64)
        return cls(
            [objects.labels[i] for i in labels],
            np.stack(np.divmod(pairs, k)),
            np.stack([np.bincount(pair, share, len(pairs)) for share in shares]),
            [objects.names[i] for i in names],
            named.reshape(len(names), k),
        )


def _renumber(keys: NDArray[np.integer[Any]]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the keys that occur, ascending, and the row of each key: `np.unique` of small numbers."""
    there = np.flatnonzero(np.bincount(keys))
    number = np.zeros(int(keys.max(initial=-1)) + 1, np.int64)
    number[there] = np.arange(len(there))
    return there, number[keys]


def _rank_yes_no_questions(weights: Floats, around: _Surroundings, code: str) -> Iterator[Question]:
    """Rank questions whether an object is around, called in the language of a code."""
    vocabulary, tongue = Vocabulary.default(), {"zh": "zh-CN"}.get(code, code)
    label, place = around.pairs
    first = np.searchsorted(label, np.arange(len(around.labels)))
    yes = ERROR_RATE + (1.0 - 2.0 * ERROR_RATE) * -np.expm1(-2.0 * around.expected)
    # where nothing is expected, yes is answered by mistake alone
    more = np.stack([yes - ERROR_RATE, _entropy(yes) - _entropy(ERROR_RATE)]) * weights[place]
    answered, known = np.add.reduceat(more, first, axis=2)
    gains = _entropy(ERROR_RATE + answered) - _entropy(ERROR_RATE) - known
    there = np.add.reduceat(around.expected, first, axis=1) > 0.0
    there &= [UNTOLD.search(name) is None for name in around.labels]
    winds = ("", *COMPASS)
    for j, i in zip(*np.unravel_index(np.argsort(-gains, axis=None), gains.shape), strict=True):
        if there[j, i]:
            words, wind = vocabulary.name_label(around.labels[i], language=tongue), winds[j]
            words = words[:1].upper() + words[1:] if code == "de" else words
            article = "an" if words[:1].lower() in "aeiou" else "a"
            called = f"{article} {words}" if code == "en" else words
            where = f"within sight to your {wind}" if wind else "within sight"
            is_plural = code == "en" and re.search("[^siu]s$", words)
            text = f"Are there {words} {where}?" if is_plural else f"Is there {called} {where}?"
            subject = Subject(words, around.labels[i], wind)
            yield Question(text, (YES, NO), (subject,), float(gains[j, i]))


def _entropy(yes: Any) -> Any:  # noqa: ANN401  # a number, or an array
    """Compute the entropy [nat] of an answer that is yes with a probability."""
    return -(yes * np.log(yes) + (1.0 - yes) * np.log1p(-yes))


def _make_choice_question(weights: Floats, around: _Surroundings, text: str) -> list[Question]:
    """Make at most one choice question, of names that together cover the likeliest places.

    Names are left out whose words, one space between two and around all, stand in the text.
    """
    left = weights.copy()
    sure = np.minimum(around.named, 1.0)
    rows: dict[str, int] = {}  # by their words: "McDonald's" and "McDonalds" are one
    while len(rows) < MAX_NAMES and around.names:
        share = sure @ left
        best = max(np.flatnonzero(share == share.max()).tolist(), key=lambda i: around.names[i])
        if share[best] < 0.02:  # the rest is too unlikely to be asked about
            break
        words = " ".join(tokens(around.names[best]))
        if f" {words} " in text:
            sure[best] = 0.0
            continue
        first = rows.setdefault(words, best)
        left = left * (1.0 - sure[best])
        if first != best:
            sure[first] = np.minimum(sure[first] + sure[best], 1.0)
    chosen = list(rows.values())
    if len(chosen) < 2:  # that would be a yes/no question
        return []
    present = sure[chosen]
    none = np.prod(1.0 - 0.95 * present, axis=0)
    answered = np.vstack([present / np.maximum(present.sum(axis=0), 1e-9) * (1.0 - none), none])
    answered = ERROR_RATE / len(answered) + (1.0 - ERROR_RATE) * answered
    names = tuple(around.names[i] for i in chosen)
    text = f"Which of these is within sight: {', '.join(names)}?"
    subjects = tuple(map(Subject, names))
    return [Question(text, (*names, NONE), subjects, compute_gain(weights, answered))]


def compute_gain(weights: Floats, options: Floats) -> float:
    """Compute the mutual information [nat] of the place (K,) and the answer (O, K)."""

    def entropy(p: Floats) -> Floats:
        return np.asarray(-(p * np.log(np.maximum(p, 1e-12))).sum(axis=0))

    return float(entropy(options @ weights) - entropy(options) @ weights)
