"""How well what scenes hold fits the statements of a text, as a log-likelihood ratio.

As outdoors, a statement s of a scene has P(s | scene) = (1 - WRONG) fit(s, scene) / fit(s, average)
+ WRONG: what few scenes have counts more, what is wrong costs no more than the logarithm of WRONG.
Somebody describes a room, or a scene of several rooms as a whole; where a text names a room, a room.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.language.likeness import table, usual
from placegraph.indoor.language.sentence import Kind
from placegraph.indoor.map.relations import NEXT_TO
from placegraph.indoor.map.relations.words import readings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from placegraph.indoor.language.index import Columns
    from placegraph.indoor.language.sentence import Mention, Sentence, Statement

    Floats = NDArray[np.float64]

WRONG = 0.1
"""Share of statements that are wrong, or about what a map does not have."""
APART = 0.2
"""How well two things that are there, but not so related, fit: maps do not know all relations."""
SIDE = 0.6
"""How well "next to" fits relations as seen by somebody: "in front of", "left of"."""
_RELATED = 0.05  # share of average scenes in which two things are so related
_WITH = ("on", "next to", "in", "attached to")
_SEEN = frozenset(("in front of", "behind", "left of", "right of", "opposite", "against"))


def scene_scores(sentence: Sentence, columns: Columns) -> Floats:
    """Log-likelihood ratio (n,) of each scene against their average [nat]."""
    if not columns.scenes or not sentence.statements:
        return np.zeros(columns.scenes)
    fit = statement_fits(sentence, columns)
    ratios = compared(sentence, fit, _means(fit, columns))
    return of_scenes(sentence, columns, ratios.sum(axis=0))[0]


def backgrounds(sentence: Sentence, columns: Columns) -> list[float]:
    """How well each statement fits the average scene of an index."""
    return _means(statement_fits(sentence, columns), columns).tolist()


def compared(sentence: Sentence, fit: Floats, background: Floats) -> Floats:
    """Log-likelihood ratios (S, U)."""
    certain = np.array([s.certainty for s in sentence.statements])
    wrong = (1.0 - (1.0 - WRONG) * certain)[:, None]
    return np.log((1.0 - wrong) * fit / background[:, None] + wrong) if len(fit) else fit


def _means(fit: Floats, columns: Columns) -> Floats:
    """Mean fit (S,) of each statement, of few scenes drawn to what has never been seen."""
    return np.asarray((fit.sum(axis=1) + 0.05) / (len(columns.scene) + 1.0))


def of_scenes(
    sentence: Sentence, columns: Columns, totals: Floats
) -> tuple[Floats, NDArray[np.int64]]:
    """Scores (n,) of scenes from those of their units, and the unit of each that fits best."""
    rooms = np.bincount(columns.scene, ~columns.whole, columns.scenes)
    named = any(s.kind is Kind.ROOM and not s.negated for s in sentence.statements)
    several = np.bincount(columns.scene, columns.whole, columns.scenes) > 0
    share = np.where(several & (not named), 0.5, 1.0)[columns.scene] / rooms[columns.scene]
    share[columns.whole] = 0.0 if named else 0.5
    first = np.searchsorted(columns.scene, np.arange(columns.scenes))
    weighted = totals + np.log(np.maximum(share, 1e-300))
    top = np.maximum.reduceat(weighted, first)
    sums = np.add.reduceat(np.exp(weighted - top[columns.scene]), first)
    winner = np.flatnonzero(weighted >= top[columns.scene])
    best = winner[np.searchsorted(columns.scene[winner], np.arange(columns.scenes))]
    return top + np.log(sums), best


def statement_fits(sentence: Sentence, columns: Columns) -> Floats:
    """How well (S, U) each statement fits each unit."""
    known: dict[str, NDArray[np.float32]] = {}
    for mention in sentence.mentions:
        if mention.label not in known:
            known[mention.label] = columns.fits(mention.label)
    out = np.empty((len(sentence.statements), len(columns.scene)))
    for row, s in enumerate(sentence.statements):
        things = [sentence.mentions[t] for t in s.things]
        if s.kind is Kind.ROOM:
            fit = _room(things[0], columns)
        elif s.kind is Kind.RELATED:
            fit = _related(s, things, known, columns)
        else:  # where the speaker is, nobody knows: the things are there
            fit = np.min([_held(thing, known, columns) for thing in things], axis=0)
        absent = s.negated and s.kind not in (Kind.NEAR, Kind.BETWEEN)
        out[row] = 1.0 - fit if absent else fit
    return out


def _room(thing: Mention, columns: Columns) -> Floats:
    expected = columns.rooms[:, table().kinds.index(thing.room)]
    if thing.count is not None and thing.count > 1:
        return np.asarray(np.exp(-np.abs(expected - thing.count)))
    return np.minimum(expected, 1.0)


def _held(thing: Mention, known: dict[str, NDArray[np.float32]], columns: Columns) -> Floats:
    exact, kin, best = columns.of_labels.many(known[thing.label], len(columns.scene))
    return np.maximum(_counted(exact, thing), best * _counted(kin, thing))


def _related(
    s: Statement, things: Sequence[Mention], known: dict[str, NDArray[np.float32]], columns: Columns
) -> Floats:
    first, second = (known[thing.label] for thing in things)
    subject, relation, target = columns.triples.T
    straight, turned = (
        np.array([says.get(name, 0.0) for name in columns.relations], np.float32)
        for says in sayings(s.relation)
    )
    weights = np.maximum(
        straight[relation] * first[subject] * second[target],
        turned[relation] * first[target] * second[subject],
    )
    exact, kin, best = columns.of_triples.many(weights, len(columns.scene))
    fit = np.maximum(_counted(exact, things[0]), best * _counted(kin, things[0]))
    both = np.minimum(*(_held(thing, known, columns) for thing in things))
    return fit if s.negated else np.maximum(fit, APART * both)


@cache
def sayings(relation: str) -> tuple[dict[str, float], dict[str, float]]:
    """Names of edges that say a relation, straight and turned, and how well they do."""
    straight: dict[str, float] = {}
    turned: dict[str, float] = {}
    for asked in _WITH if relation == "with" else (relation,):
        for name, other_way in readings(asked):
            (turned if other_way else straight)[name] = 1.0
    if relation in _SEEN:
        straight.setdefault(NEXT_TO, SIDE)
    return straight, turned


def _counted(many: Floats, thing: Mention) -> Floats:
    """How well a number of things fits how many were said: one off is often a matter of taste."""
    if thing.count is not None and thing.count > 1:
        off = np.abs(many - thing.count)
        return np.where(many > 0, np.where(off == 0, 1.0, np.where(off == 1, 0.4, 0.15)), 0.0)
    if thing.several:
        return np.select([many >= 2, many == 1], [1.0, 0.4], 0.0)
    if thing.count == 1:
        return np.select([many == 1, many > 1], [1.0, 0.7], 0.0)
    return (many > 0).astype(np.float64)


def expected(s: Statement, mentions: Sequence[Mention]) -> float:
    """How well a statement fits an average room, where no library says."""
    things = [mentions[t] for t in s.things]
    if s.kind is Kind.ROOM:
        chance = float(table().usual[table().kinds.index(things[0].room)])
    else:
        chance = float(np.prod([usual(thing.label) for thing in things]))
    if s.kind is Kind.RELATED:
        chance = max(APART * chance, _RELATED * chance)
    return 1.0 - chance if s.negated else max(chance, 1e-3)
