"""Log-likelihood ratios of scenes by a text: one scene alone, or many ranked side by side.

As outdoors, a statement s of a scene has P(s | scene) = (1 - WRONG) fit(s, scene) / fit(s, average)
+ WRONG: what few scenes have counts more, what is wrong costs no more than the logarithm of WRONG.
Somebody describes a room, or a scene of several rooms as a whole; where a text names a room, a room.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import Evidence, ObjectRef
from placegraph.core.graph import SceneGraph
from placegraph.errors import OptionError
from placegraph.indoor.language.appearance import ratios, room_ratios, with_colours
from placegraph.indoor.language.index import Columns, DescriptionUnit, columns_of, units
from placegraph.indoor.language.likeness import (
    EXACT,
    Floats,
    Floats32,
    base_rate,
    match_labels,
    table,
)
from placegraph.indoor.language.reader import read
from placegraph.indoor.language.sentence import Kind, Mention, Sentence, Statement
from placegraph.indoor.map.relations import NEXT_TO, interpret_relation
from placegraph.indoor.map.scene import Scene

TOLD = 0.05
"""Least weight of evidence that says anything [nat]."""
WRONG = 0.3
"""Share of statements that are wrong, or about what a map does not have."""
NOTED = 0.8
"""Power of how much a room holds, with which a thing in it is spoken of more rarely."""
AGAIN = 0.3
"""Weight of what was spoken of by another word already: books of a bookcase."""
UNSURE_ROOM = 0.25
"""Share of kinds of rooms that are wrong: a study is an office, what it holds only hints at it."""
APART = 0.3
"""Fit of two things that are there, but not so related: maps do not know all relations."""
SIDE = 0.6
"""Fit of "next to" to relations as seen by somebody: "in front of", "left of"."""
_RELATED = 0.4  # how well two things fit a relation in homes
_SHELL = ("wall", "floor", "ceiling")
_WITH = ("on", "next to", "in", "attached to")
_ONE = 0.6  # how well one thing fits a plural: a map has "curtains" in one piece
_SEEN = frozenset(("in front of", "behind", "left of", "right of", "opposite", "against"))


class Term(NamedTuple):
    """One thing that a statement says of scenes: a statement of two things says up to three."""

    statement: int
    fit: Floats
    """(U,) how well units fit it."""
    base_rate: float
    """Mean fit of all units."""
    sure: float
    """Probability that the term is read correctly."""
    where: Floats | None = None
    """(U,) of which units it says something at all; of all if None."""


def scene_scores(sentence: Sentence, columns: Columns) -> Floats:
    """Return the log-likelihood ratio (n,) of each scene against their average [nat]."""
    if not columns.scenes or not sentence.statements:
        return np.zeros(columns.scenes)
    return of_scenes(sentence, columns, score_statements(sentence, columns, columns).sum(axis=0))[0]


def score_statements(sentence: Sentence, columns: Columns, library: Columns | None) -> Floats:
    """Return log-likelihood ratios (S, U) of what each statement says.

    `library` says what is usual; where there is none, homes do (`rooms.toml`).
    """
    out = np.zeros((len(sentence.statements), len(columns.scene)))
    own = list(_terms(sentence, columns, columns if library is None else library))
    expected_fit = own
    if library is not None and library is not columns:
        expected_fit = list(_terms(sentence, library, library))
    for term, of in zip(own, expected_fit, strict=True):
        mean = term.base_rate
        if library is not None:  # of few scenes drawn to what has never been seen
            where = np.ones(len(of.fit)) if of.where is None else of.where
            mean = float(((where * of.fit).sum() + 0.05) / (where.sum() + 1.0))
        ratio = np.log(term.sure * term.fit / mean + 1.0 - term.sure)
        out[term.statement] += ratio if term.where is None else ratio * term.where
    return out


def _terms(sentence: Sentence, columns: Columns, library: Columns) -> Iterator[Term]:
    """Yield the claims of statements: that objects are there, and that two of them are related.

    Where the speaker is, nobody knows: of scenes it says that the things are there. What a text
    speaks of twice is there once.
    """
    known = _UnitFits(sentence, columns, library)
    spoken: set[int] = set()
    for row, s in enumerate(sentence.statements):
        sure = (1.0 - WRONG) * s.certainty
        things = [sentence.mentions[t] for t in s.mentions]
        if s.kind is Kind.ROOM:
            kind = things[0].room
            expected_fit = float(table().share[table().kinds.index(kind)]) if kind else 1.0
            fit = known.room(things[0])
            sure *= (1.0 - UNSURE_ROOM) / (1.0 - WRONG)
            yield Term(row, *_unless(fit, expected_fit, not_=s.negated), sure)
            continue
        paired = s.kind in (Kind.RELATED, Kind.NEAR, Kind.BETWEEN)
        for t in s.mentions:
            if t in spoken:
                continue
            spoken.add(t)
            thing = sentence.mentions[t]
            not_ = thing.negated or (s.negated and not paired)
            built_in = _built_in(thing.label)
            fit = known.fit(t) if not_ or built_in else known.fit(t) * known.noted
            news = 1.0 if known.claim(thing) else AGAIN
            yield Term(row, *_unless(fit, base_rate(thing.label), not_=not_), news * sure)
        if s.kind is Kind.RELATED and not any(thing.negated for thing in things):
            fit, both = known.score_relation(s)
            yield Term(row, *_unless(fit, _RELATED, not_=s.negated), sure, both)


def _unless(fit: Floats, expected_fit: float, *, not_: bool) -> tuple[Floats, float]:
    return (
        (1.0 - np.minimum(fit, 1.0), 1.0 - expected_fit) if not_ else (fit, max(expected_fit, 1e-3))
    )


def of_scenes(
    sentence: Sentence, columns: Columns, totals: Floats
) -> tuple[Floats, NDArray[np.int64]]:
    """Return scores (n,) of scenes from those of their units, and the unit of each that fits best."""
    rooms = np.bincount(columns.scene, ~columns.is_scene, columns.scenes)
    named = any(
        s.kind is Kind.ROOM and not s.negated and sentence.mentions[s.mentions[0]].room
        for s in sentence.statements
    )
    several = np.bincount(columns.scene, columns.is_scene, columns.scenes) > 0
    share = np.where(several & (not named), 0.5, 1.0)[columns.scene] / rooms[columns.scene]
    share[columns.is_scene] = 0.0 if named else 0.5
    first = np.searchsorted(columns.scene, np.arange(columns.scenes))
    weighted = totals + np.log(np.maximum(share, 1e-300))
    top = np.maximum.reduceat(weighted, first)
    sums = np.add.reduceat(np.exp(weighted - top[columns.scene]), first)
    winner = np.flatnonzero(weighted >= top[columns.scene])
    best = winner[np.searchsorted(columns.scene[winner], np.arange(columns.scenes))]
    return top + np.log(sums), best


class _UnitFits:
    """Fits of the things of a sentence to the units of an index, each found once.

    `columns`: the units.
    `library`: what is usual: how large a couch is, how many are green.
    """

    def __init__(self, sentence: Sentence, columns: Columns, library: Columns) -> None:
        self._sentence, self._columns, self._library = sentence, columns, library
        self._labels: dict[str, Floats32] = {}
        self._held: dict[int, Floats] = {}
        self._claimed: dict[int, str] = {}
        self.noted = (library.much.mean() / columns.much) ** NOTED

    def _match(self, label: str) -> Floats32:
        if label not in self._labels:
            self._labels[label] = self._columns.match_labels(label)
        return self._labels[label]

    def claim(self, mention: Mention) -> bool:
        """Tell whether a thing is news: what is called so was not spoken of by another word."""
        weights = self._library.match_labels(mention.label)
        if not weights.any():
            return True
        best = int(weights.argmax())
        word = mention.label.rpartition(" ")[2]
        return self._claimed.setdefault(best, word) == word

    def room(self, mention: Mention) -> Floats:
        """Return the agreement (U,) of units with the kind or number of rooms."""
        columns = self._columns
        expected = np.ones(len(columns.rooms))  # of no kind: "a large room"
        if mention.room:
            expected = columns.rooms[:, table().kinds.index(mention.room)]
        if mention.count is not None and mention.count > 1:
            return np.asarray(np.exp(-np.abs(expected - mention.count)))
        size = room_ratios(mention.attributes, columns.room_looks, self._library.room_looks)
        return np.minimum(expected, 1.0) * size

    def fit(self, t: int) -> Floats:
        """Return the agreement (U,) of units with a mention and its stated look."""
        if t not in self._held:
            thing = self._sentence.mentions[t]
            weights = self._match(thing.label)
            exact, kin, best, entries = self._columns.of_labels.count_matches(
                weights, len(self._columns.scene)
            )
            held = np.maximum(_counted(exact, thing), best * _counted(kin, thing))
            if _built_in(thing.label):
                held = np.ones(len(held))  # every room has walls; maps leave them out
            self._held[t] = held * self._appearance_ratio(thing, weights, entries, best)
        return self._held[t]

    def _appearance_ratio(
        self, mention: Mention, weights: Floats32, entries: NDArray[np.int64], best: Floats32
    ) -> Floats:
        """Return the likelihood ratio (U,) of the stated look: the best such object against the usual."""
        if not mention.attributes or not len(entries):
            return np.ones(len(best))
        postings = self._columns.of_labels
        like = weights[postings.words[entries]]
        far, expected_fit = self._library, self._library.of_labels
        fitting = far.match_labels(mention.label)[expected_fit.words].astype(np.float64)
        rows = np.flatnonzero(fitting)
        ratio = ratios(
            mention.attributes,
            self._columns.appearance[entries],
            far.appearance[rows],
            fitting[rows],
        )
        out = np.zeros(len(best))
        units = postings.units[entries]
        np.maximum.at(out, units, ratio * like / np.maximum(best[units], 1e-6))
        return np.where(best > 0.0, out, 1.0)

    def score_relation(self, s: Statement) -> tuple[Floats, Floats]:
        """Return the agreement (U,) with a stated relation of two objects, and whether both are there."""
        columns = self._columns
        things = [self._sentence.mentions[t] for t in s.mentions]
        first, second = (self._match(thing.label) for thing in things)
        subject, relation, target = columns.triples.T
        straight, turned = (
            np.array([says.get(name, 0.0) for name in columns.relations], np.float32)
            for says in sayings(s.relation)
        )
        weights = np.maximum(
            straight[relation] * first[subject] * second[target],
            turned[relation] * first[target] * second[subject],
        )
        fit = columns.of_triples.count_matches(weights, len(columns.scene)).best.astype(np.float64)
        both = np.minimum(*(np.minimum(self.fit(t), 1.0) for t in s.mentions))
        return np.maximum(fit, 0.0 if s.negated else APART), both


@cache
def _built_in(label: str) -> bool:
    """Tell whether it is a wall, a floor or a ceiling, by whatever word."""
    return bool(match_labels(label, _SHELL).max() >= EXACT)


@cache
def sayings(relation: str) -> tuple[dict[str, float], dict[str, float]]:
    """Return names of edges that say a relation, straight and turned, and how well they do."""
    straight: dict[str, float] = {}
    turned: dict[str, float] = {}
    for asked in _WITH if relation == "with" else (relation,):
        for name, other_way in interpret_relation(asked):
            (turned if other_way else straight)[name] = 1.0
    if relation in _SEEN:
        straight.setdefault(NEXT_TO, SIDE)
    return straight, turned


def _counted(counts: Floats, mention: Mention) -> Floats:
    """Return the agreement of counts of objects with a mention; counts that are one off cost little."""
    if mention.count is not None and mention.count > 1:
        off = np.abs(counts - mention.count)
        return np.where(counts > 0, np.where(off == 0, 1.0, np.where(off == 1, 0.4, 0.15)), 0.0)
    if mention.several:
        return np.select([counts >= 2, counts == 1], [1.0, 0.4], 0.0)
    if mention.plural:
        return np.select([counts >= 2, counts == 1], [1.0, _ONE], 0.0)
    if mention.count == 1:
        return np.select([counts == 1, counts > 1], [1.0, 0.7], 0.0)
    return (counts > 0).astype(np.float64)


@dataclass(frozen=True, slots=True)
class Score:
    """Log-likelihood ratio of a scene by a text, and its evidence."""

    log_likelihood: float
    """Log-likelihood ratio against an average scene [nat]."""
    evidence: tuple[Evidence, ...]
    """Evidence of each statement on the scene, or on the room of it that fits best."""


def rank_scenes(
    text: str | Sentence,
    graphs: Iterable[SceneGraph | Scene],
    rooms: Iterable[Sequence[str]] | None = None,
) -> Floats:
    """Score each of n scenes by how well it answers a text, rare things counting more.

    Parameters
    ----------
    text
        English, as "a kitchen with two sinks"; or what `read` made of it.
    graphs
        Scene graphs of rooms or homes; labels, relations, counts, sizes and places in the room are
        compared. Of maps (`SceneMap`) also colours, and attributes as 3DSSG has them (material,
        shape, color, texture).
    rooms
        Of each graph the names (N,) of its objects' rooms, empty where unknown; without, relations
        "same room" say what is together.

    Returns
    -------
        (n,) float64, log-likelihood ratio of each scene against the average of them [nat]; all zero
        for a text that says nothing of a place. A `SceneLibrary` ranks its scenes by the same.

    Raises
    ------
    DescriptionError
        The text is empty, too long, or no text.
    OptionError
        There is not one room for each object.

    """
    return TextIndex(graphs, rooms).scores(read(text) if isinstance(text, str) else text)


class TextIndex:
    """Finds scenes by text; scenes have rows as in a list.

    `rooms`: of each graph the names of its objects' rooms (`score`); of none if not given.
    """

    def __init__(
        self,
        graphs: Iterable[SceneGraph | Scene] = (),
        rooms: Iterable[Sequence[str]] | None = None,
    ) -> None:
        self._scenes: list[list[DescriptionUnit]] = []
        self._columns: Columns | None = None
        given = iter(rooms) if rooms is not None else None
        for graph in graphs:
            self.add(graph, next(given, ()) if given is not None else ())

    def __len__(self) -> int:
        return len(self._scenes)

    def add(
        self,
        graph: SceneGraph | Scene,
        rooms: Sequence[str] = (),
        attributes: Sequence[Mapping[str, str]] = (),
    ) -> int:
        """Add a scene at the end and return its row; raises `OptionError` as `score`.

        `attributes`: (N,) what else is known of the objects, as `colours.with_colours` says it of a
        map; a map itself has its own.
        """
        return self.add_units(_units(graph, rooms, attributes))

    def add_units(self, described: Sequence[DescriptionUnit]) -> int:
        """Add a scene by what may be described of it (`units`, `TextIndex.units`)."""
        self._scenes.append(list(described))
        self._columns = None
        return len(self._scenes) - 1

    def units(self, row: int) -> tuple[DescriptionUnit, ...]:
        """Return the describable units of a scene: its rooms and, if there are several, the scene."""
        return tuple(self._scenes[row])

    def remove(self, row: int) -> None:
        """Take a scene out; those after it move up. `OptionError` where there is none."""
        if not 0 <= row < len(self._scenes):
            raise OptionError(f"row is {row}; the index has {len(self._scenes)} scenes.")
        del self._scenes[row]
        self._columns = None

    def scores(self, sentence: Sentence) -> Floats:
        """Return the log-likelihood ratio (n,) of each scene against the average of them [nat].

        All zero for a sentence that says nothing.
        """
        return scene_scores(sentence, self.columns)

    def search(self, sentence: Sentence, most: int = 10) -> list[tuple[int, float]]:
        """Return rows and scores of the best scenes, best first, the first of equal ones before."""
        scores = self.scores(sentence)
        order = np.argsort(-scores, kind="stable")[:most]
        return [(int(row), float(scores[row])) for row in order]

    @property
    def columns(self) -> Columns:
        """All scenes as arrays; made anew after `add` and `remove`."""
        if self._columns is None:
            self._columns = columns_of(self._scenes)
        return self._columns


def _units(
    graph: SceneGraph | Scene,
    rooms: Sequence[str] = (),
    attributes: Sequence[Mapping[str, str]] = (),
) -> list[DescriptionUnit]:
    """Return the describable units of a graph, or of a map, which knows its rooms and colours."""
    if not isinstance(graph, Scene):
        return units(graph, rooms, attributes)
    own = [a.get("room", "") for a in graph.attributes]
    return units(graph.graph, rooms or own, attributes or with_colours(graph))


def score(
    sentence: Sentence,
    graph: SceneGraph | Scene,
    rooms: Sequence[str] = (),
    library: TextIndex | None = None,
    attributes: Sequence[Mapping[str, str]] = (),
) -> Score:
    """Return the log-likelihood ratio of a text for a scene against an average scene.

    Raises `OptionError`: there is not one room for each object.

    `sentence`: what `read` made of the text.
    `graph`: scene graph of a room, or of a home; or a map, which knows its rooms and colours.
    `rooms`: (N,) name or number of the room of each object, empty where unknown, as attribute
        `room` of a map's objects; without, relations "same room" say what is together.
    `library`: index that says how rare things are; else they are as rare as in homes
        (`rooms.toml`), and sizes and colours, of which nobody knows what is usual, say nothing.
    `attributes`: (N,) what else is known of the objects; see `TextIndex.add`.
    """
    columns = columns_of([_units(graph, rooms, attributes)])
    ratios = score_statements(sentence, columns, None if library is None else library.columns)
    total, best = of_scenes(sentence, columns, ratios.sum(axis=0))
    evidence = tuple(
        _evidence(
            s, sentence.mentions, graph.graph if isinstance(graph, Scene) else graph, float(ratio)
        )
        for s, ratio in zip(sentence.statements, ratios[:, best[0]], strict=True)
    )
    return Score(float(total[0]), evidence)


def _evidence(
    s: Statement, mentions: Sequence[Mention], graph: SceneGraph, ratio: float
) -> Evidence:
    labels = list(dict.fromkeys(graph.labels))
    serving = {
        label
        for t in s.mentions
        for label, fit in zip(labels, match_labels(mentions[t].label, labels), strict=True)
        if fit >= EXACT
    }
    verdict = "for" if ratio > TOLD else "against" if ratio < -TOLD else "silent"
    refs = tuple(
        ObjectRef(id_, label, name)
        for id_, label, name in zip(graph.ids, graph.labels, graph.names, strict=True)
        if label in serving and s.kind is not Kind.ROOM
    )
    return Evidence(s.text, verdict, ratio, refs)
