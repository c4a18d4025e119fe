"""How well a viewpoint explains a description: a generative reading, compiled.

A speaker at viewpoint v picks things in sight and says how they lie. A statement s then has

    P(s | v) = (1 - noise) * sum over map objects that serve s of sight * word * geometry / normaliser
               + noise * P(s | anywhere)

and its log-likelihood ratio log P(s | v) / P(s | anywhere) is the evidence it brings. Directions are
soft: a little wrong costs little, the opposite costs all that `noise` leaves. What no map object in
sight serves may still be served from afar, if the thing is rare enough to be spoken of from there.
"""

from __future__ import annotations

from math import cos, sin
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.language.description import SPEAKER, Description, Relation, Statement
from placegraph.outdoor.likelihood.fit_kernels import ME, TABLE, direction_table

SLIP = 0.08
"""Share of stated directions that are simply wrong."""
NOISE = 0.12
"""Share of statements about things that are not there, or that the map does not know."""
UNNAMED = 0.4
"""Certainty that a thing whose name the map does not know is one of its kind on the map."""
FLOOR = 1e-7
"""Things cannot be rarer than this share of all things in sight."""
CROWD = 30.0
"""Added to the number of pairs in sight, so that lonely places are not preferred."""
GEOMETRY = {
    Relation.DIRECTION: 0.25,
    Relation.NEAR: 0.4,
    Relation.INSIDE: 0.2,
    Relation.ALONG: 0.2,
    Relation.ACROSS: 0.3,
    Relation.BETWEEN: 0.1,
    Relation.VISIBLE: 1.0,
    Relation.SAME: 0.3,
}
"""P(the relation holds | two things in sight, anywhere)."""
OPERATION = {relation: i for i, relation in enumerate(Relation)}


class Statements(NamedTuple):
    """Columns of a compiled query, one row a statement."""

    op: NDArray[np.int64]
    source: NDArray[np.int64]
    """Mention, or ME."""
    target: NDArray[np.int64]
    """Mention, or ME."""
    target2: NDArray[np.int64]
    """Mention, or ME; of BETWEEN only."""
    bearing: NDArray[np.float32]
    """(S, 2) unit vector east, north."""
    table: NDArray[np.float32]
    """(S, TABLE) P(the direction was said | cosine of the angle to it)."""
    distance: NDArray[np.float32]
    """Stated distance [m], 0 where unsaid; negative where it is the most."""
    negated: NDArray[np.bool_]
    number: NDArray[np.float32]
    """Stated number of sources, 0 where unsaid."""
    noise: NDArray[np.float32]
    """Share of statements of this kind that are wrong or about something else."""
    background: NDArray[np.float32]
    """P(statement | anywhere)."""
    crowd: float
    """Added to the number of pairs in sight: who sees few things is no more likely to be heard."""

    @property
    def gain(self) -> NDArray[np.float32]:
        """How much likelier than anywhere a statement is (S,) where P(what serves it) is 1."""
        return (1.0 - self.noise) / (self.noise * self.background)

    @property
    def floor(self) -> float:
        """Log-likelihood ratio of a place where nothing serves anything [nat]."""
        return float(np.log(self.noise[~self.negated]).sum())


class MentionTokens(NamedTuple):
    """Tokens that each mention may stand for; row m is `mentions[m + 2]` of the description."""

    starts: NDArray[np.int64]
    """(M + 1,)"""
    tokens: NDArray[np.int32]
    weights: NDArray[np.float32]


class Words(NamedTuple):
    """How well a map's tokens fit mentions."""

    row: NDArray[np.int32]
    """(T,) row of `fit`; 0 of tokens that fit none."""
    fit: NDArray[np.float32]
    """(K + 1, M)"""


class Far(NamedTuple):
    """Things rare enough to be spoken of from out of sight."""

    starts: NDArray[np.int64]
    """(M + 1,) objects of a mention; none where it is too common."""
    objects: NDArray[np.int64]
    fits: NDArray[np.float32]
    scale: NDArray[np.float32]
    """(S,) how far a statement reaches [m]."""
    share: NDArray[np.float32]
    """(S,) how often it is said of one particular thing out of sight."""
    anchors: NDArray[np.int64]
    """Objects around which candidates are sought, the rarest mention's first."""


def ends(statement: Statement) -> tuple[int, int]:
    """Source and target of a statement."""
    return statement.source, statement.target


def columns_of(
    used: list[Statement], description: Description, share: list[float], by_kind: frozenset[int]
) -> Statements:
    """Columns of statements; `share` is how common each mention is, `by_kind` has the unknown names."""
    n = len(used)

    def mention(node: int | None) -> int:
        return ME if node is None or node == SPEAKER else node - 2

    bearing, table = np.zeros((n, 2), np.float32), np.zeros((n, TABLE), np.float32)
    background = np.empty(n, np.float32)
    for i, statement in enumerate(used):
        angle = statement.bearing or 0.0
        bearing[i] = sin(angle), cos(angle)
        table[i] = direction_table(statement.bearing_sigma, SLIP)
        nodes = [*ends(statement)]
        if statement.relation is Relation.BETWEEN:
            nodes.append(statement.target2 or SPEAKER)
        # what is in sight is within most of the distances that people say
        chance = 1.0 if statement.within else GEOMETRY[statement.relation]
        for node in nodes:
            chance *= 1.0 if node == SPEAKER else share[node - 2]
        background[i] = max(chance, FLOOR)
    counts = [description.mentions[s.source].count or 0 for s in used]
    return Statements(
        op=np.array([OPERATION[s.relation] for s in used], np.int64),
        source=np.array([mention(s.source) for s in used], np.int64),
        target=np.array([mention(s.target) for s in used], np.int64),
        target2=np.array([mention(s.target2) for s in used], np.int64),
        bearing=bearing,
        table=table,
        distance=np.array(
            [(-1.0 if s.within else 1.0) * (s.distance or 0.0) for s in used], np.float32
        ),
        negated=np.array([s.negated for s in used], np.bool_),
        number=np.array(counts, np.float32),
        noise=np.array(
            [
                1.0
                - (1.0 - NOISE) * s.certainty * (1.0 if by_kind.isdisjoint(ends(s)) else UNNAMED)
                for s in used
            ],
            np.float32,
        ),
        background=background,
        crowd=CROWD,
    )
