"""Queries: descriptions compiled against a map, with tokens for words and columns for statements.

A speaker at viewpoint v chooses objects in sight and tells their relations. The likelihood of a
statement s is

    P(s | v) = (1 - noise) * sum over map objects that fit s of sight * word * geometry / normalizer
               + noise * P(s | anywhere)

and its log-likelihood ratio log P(s | v) / P(s | anywhere) is its evidence. Directions are soft: a
small error costs little, the opposite direction costs all that `noise` leaves. A statement that no
object in sight fits may be about one out of sight that is rare enough to be mentioned from afar.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import cos, sin
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.language.description import (
    LISTENER,
    SPEAKER,
    Description,
    Mention,
    Relation,
    Statement,
)
from placegraph.outdoor.likelihood.match_kernels import ME
from placegraph.outdoor.map.directions_kernels import TABLE, direction_table
from placegraph.outdoor.map.names import NameIndex
from placegraph.outdoor.map.objects import POINT


class LabelledObjects(Protocol):
    """Map objects by row; `CityObjects` is one."""

    @property
    def labels(self) -> tuple[str, ...]:
        """All labels."""

    @property
    def kind(self) -> NDArray[np.uint8]:
        """(N,) POINT, LINE or AREA."""

    def label(self, i: int) -> str:
        """Return the most specific label of an object."""


class Lexicon(Protocol):
    """Vocabulary of a map; its tokens are labels, then names. A `City` is one."""

    @property
    def objects(self) -> LabelledObjects:
        """Map objects; at least those that `bearers` returns."""

    @property
    def label_index(self) -> Mapping[str, Sequence[int]]:
        """Tokens by label and by ``key=*``."""

    @property
    def name_index(self) -> NameIndex:
        """Proper names."""

    def frequency(self, tokens: NDArray[np.int32], weights: NDArray[np.float32]) -> float:
        """Return the share of all objects in sight, over all viewpoints, that bear these tokens."""

    def count_bearers(self, tokens: NDArray[np.int32]) -> NDArray[np.int64]:
        """Return the number of objects (K,) that bear each token."""

    def bearers(self, tokens: NDArray[np.int32]) -> list[NDArray[np.int64]]:
        """Return the rows of the objects that bear each of these tokens, in the order of the tokens."""


WRONG_DIRECTION = 0.08
"""Share of stated directions that are wrong."""
NOISE = 0.12
"""Share of statements about objects that are not there, or not on the map."""
UNKNOWN_NAME_CERTAINTY = 0.4
"""Certainty that an object whose name the map lacks is one of its kind on the map."""
MIN_SHARE = 1e-7
"""Smallest share of all objects in sight that a statement can be about."""
PAIR_SMOOTHING = 30.0
"""Additive smoothing of the number of pairs in sight, so that lonely places are not preferred."""
RELATION_CHANCE = {
    Relation.DIRECTION: 0.25,
    Relation.NEAR: 0.4,
    Relation.INSIDE: 0.2,
    Relation.ALONG: 0.2,
    Relation.ACROSS: 0.3,
    Relation.BETWEEN: 0.1,
    Relation.VISIBLE: 1.0,
    Relation.SAME: 0.3,
}
"""P(the relation holds | two objects in sight, anywhere)."""
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
    """Stated distance [m], 0 without one; negative for an upper limit."""
    negated: NDArray[np.bool_]
    number: NDArray[np.float32]
    """Stated number of sources, 0 without one."""
    noise: NDArray[np.float32]
    """Share of statements of this kind that are wrong or about something else."""
    background: NDArray[np.float32]
    """P(statement | anywhere)."""
    pair_smoothing: float
    """Additive smoothing of the number of pairs in sight."""

    @property
    def gain(self) -> NDArray[np.float32]:
        """Largest likelihood ratio (S,) of a statement."""
        return (1.0 - self.noise) / (self.noise * self.background)

    @property
    def floor(self) -> float:
        """Log-likelihood ratio of a place where no object fits any statement."""
        return float(np.log(self.noise[~self.negated]).sum())


class MentionTokens(NamedTuple):
    """Tokens that each mention may mean; row m is `mentions[m + 2]` of the description."""

    starts: NDArray[np.int64]
    """(M + 1,)"""
    tokens: NDArray[np.int32]
    weights: NDArray[np.float32]


class TokenWeights(NamedTuple):
    """Weights of all tokens of a map for the mentions of a query."""

    row: NDArray[np.int32]
    """(T,) row of `fit`; 0 for tokens that fit no mention."""
    fit: NDArray[np.float32]
    """(K + 1, M)"""


class DistantObjects(NamedTuple):
    """Objects that are rare enough to be mentioned from out of sight."""

    starts: NDArray[np.int64]
    """(M + 1,) objects of a mention; none where there are too many."""
    objects: NDArray[np.int64]
    weights: NDArray[np.float32]
    scale: NDArray[np.float32]
    """(S,) scale of the distance to the object of a statement [m]."""
    share: NDArray[np.float32]
    """(S,) probability that a statement is about one particular object out of sight."""
    anchors: NDArray[np.int64]
    """Objects around which candidates are sought, those of the rarest mention first."""


def ends(statement: Statement) -> tuple[int, int]:
    """Return source and target of a statement."""
    return statement.source, statement.target


def make_columns(
    used: list[Statement], description: Description, share: list[float], by_kind: frozenset[int]
) -> Statements:
    """Make the columns of statements; `share` (M,) tells how common mentions are, `by_kind` lacks names."""
    n = len(used)

    def mention(node: int | None) -> int:
        return ME if node is None or node == SPEAKER else node - 2

    bearing, table = np.zeros((n, 2), np.float32), np.zeros((n, TABLE), np.float32)
    background = np.empty(n, np.float32)
    for i, statement in enumerate(used):
        angle = statement.bearing or 0.0
        bearing[i] = sin(angle), cos(angle)
        table[i] = direction_table(statement.bearing_sigma, WRONG_DIRECTION)
        nodes = [*ends(statement)]
        if statement.relation is Relation.BETWEEN:
            nodes.append(statement.target2 or SPEAKER)
        # what is in sight is within most of the distances that people say
        chance = 1.0 if statement.within else RELATION_CHANCE[statement.relation]
        for node in nodes:
            chance *= 1.0 if node == SPEAKER else share[node - 2]
        background[i] = max(chance, MIN_SHARE)
    counts = [description.mentions[s.source].count or 0 for s in used]
    known = [1.0 if by_kind.isdisjoint(ends(s)) else UNKNOWN_NAME_CERTAINTY for s in used]
    noise = [1.0 - (1.0 - NOISE) * s.certainty * k for s, k in zip(used, known, strict=True)]
    distances = [(-1.0 if s.within else 1.0) * (s.distance or 0.0) for s in used]
    return Statements(
        op=np.array([OPERATION[s.relation] for s in used], np.int64),
        source=np.array([mention(s.source) for s in used], np.int64),
        target=np.array([mention(s.target) for s in used], np.int64),
        target2=np.array([mention(s.target2) for s in used], np.int64),
        bearing=bearing,
        table=table,
        distance=np.array(distances, np.float32),
        negated=np.array([s.negated for s in used], np.bool_),
        number=np.array(counts, np.float32),
        noise=np.array(noise, np.float32),
        background=background,
        pair_smoothing=PAIR_SMOOTHING,
    )


KIND_WEIGHT = 0.03
"""Weight of objects of the right kind where a text has a name: the map may lack the name."""
OTHER_SENSE_WEIGHT = 0.1
"""Weight of a word's other senses where it is a tag's own value ("path" for a footway)."""
UNKNOWN_KIND_SHARE, UNKNOWN_STREET_SHARE = 0.01, 0.1
"""Smallest share of all objects in sight of the kind of an unknown name, or of an unknown street."""
MAX_DISTANT_ON_WAY = 400
"""Largest number of objects of a mention from out of sight, where a text tells a way ..."""
MAX_DISTANT = 12
"""... and where it does not."""
NEAR_SCALE, FAR_SCALE = 80.0, 350.0
"""Scale of distances to objects out of sight, and where the text tells a way or names a quarter [m]."""
QUARTERS = frozenset(f"place={kind}" for kind in ("suburb", "neighbourhood", "quarter", "borough"))
NUM_SALIENT = 20.0
"""Number of objects out of sight that come to a speaker's mind."""


@dataclass(frozen=True)
class Query:
    """Description compiled against one map."""

    description: Description
    used: tuple[Statement, ...]
    """Statements that are scored, in the order of the columns."""
    unused: tuple[tuple[Statement, str], ...]
    """Statements that cannot be scored, each with the reason."""
    statements: Statements
    mentions: MentionTokens
    distant: DistantObjects | None
    """None where all statements are about objects in sight."""
    by_kind: frozenset[int]
    """Mentions whose name is not on the map; they are matched by kind."""

    def token_weights(self, n_tokens: int) -> TokenWeights:
        """Return the weight of each token of a map for each mention."""
        starts, tokens, weights = self.mentions
        known, at = np.unique(tokens, return_inverse=True)
        row = np.zeros(n_tokens, np.int32)
        fit = np.zeros((len(known) + 1, len(starts) - 1), np.float32)
        row[known] = np.arange(1, len(known) + 1)
        fit[at + 1, np.repeat(np.arange(len(starts) - 1), np.diff(starts))] = weights
        return TokenWeights(row, fit)


def compile_query(description: Description, city: Lexicon, *, tells_way: bool = False) -> Query:
    """Compile a description against a map (Eq. 3-4 meet Eq. 7-8).

    Where it tells the way to a place (`tells_way`), more objects are out of sight.
    """
    mentions = [_find_tokens(mention, city) for mention in description.mentions[2:]]
    by_kind = frozenset(
        m.id for m in description.mentions[2:] if m.name and not _find_names(m, city)
    )
    share = [city.frequency(tokens, weights) for tokens, weights in mentions]
    for node in by_kind:  # how many of its kind are on the map says nothing of one that is not
        senses, weights = description.mentions[node].senses, mentions[node - 2][1]
        road = any(sense.label.startswith("highway=") for sense in senses[:1])
        common = (UNKNOWN_STREET_SHARE if road else UNKNOWN_KIND_SHARE) * float(
            weights.max(initial=0.0)
        )
        share[node - 2] = max(share[node - 2], common)
    used: list[Statement] = []
    unused: list[tuple[Statement, str]] = []
    known: set[tuple[object, ...]] = set()
    for statement in description.statements:
        key = _make_key(statement, description)
        if key in known:
            continue  # repetition makes it no surer
        known.add(key)
        reason = _explain_unusable(statement, description, mentions)
        if reason:
            unused.append((statement, reason))
        else:
            used.append(statement)
    return Query(
        description,
        tuple(used),
        tuple(unused),
        make_columns(used, description, share, by_kind),
        MentionTokens(
            np.concatenate(([0], np.cumsum([len(t) for t, _ in mentions]))).astype(np.int64),
            np.concatenate([t for t, _ in mentions] or [np.zeros(0, np.int32)]),
            np.concatenate([w for _, w in mentions] or [np.zeros(0, np.float32)]),
        ),
        _find_distant(used, mentions, city, tells_way=tells_way),
        by_kind,
    )


def _find_distant(
    used: list[Statement],
    mentions: list[tuple[NDArray[np.int32], NDArray[np.float32]]],
    city: Lexicon,
    *,
    tells_way: bool,
) -> DistantObjects | None:
    """Find the objects of rare mentions, where a statement may be about objects out of sight."""
    here = find_speaker_nodes(used)
    tells_way = any(s.far for s in used) or tells_way
    few = set()
    for m, (tokens, weights) in enumerate(mentions):
        certain = tokens[weights > KIND_WEIGHT]
        if len(certain) and city.count_bearers(certain).sum() <= MAX_DISTANT:
            few.add(m + 2)
    reaches = [
        s.far or s.distance is not None or not here.isdisjoint(ends(s)) or few.issuperset(ends(s))
        for s in used
    ]
    spoken = {
        n - 2 for s, r in zip(used, reaches, strict=True) if r for n in ends(s) if n not in here
    }
    nothing = (np.zeros(0, np.int64), np.zeros(0, np.float32))
    away = {
        n - 2 for s in used if (s.distance or 0.0) > NEAR_SCALE for n in ends(s) if n not in here
    }
    members = [
        _find_objects(
            *mention, city, most=MAX_DISTANT_ON_WAY if tells_way or m in away else MAX_DISTANT
        )
        if m in spoken
        else nothing
        for m, mention in enumerate(mentions)
    ]
    if not tells_way:  # of many, no particular one comes to mind
        members = [(o, f * min(1.0, MAX_DISTANT / max(1, len(o)))) for o, f in members]
    if not any(len(o) for o, _ in members):
        return None
    o = city.objects  # a map draws quarters as points, and people are "in" them
    quarters = {
        m + 2
        for m, (rows, _) in enumerate(members)
        if len(rows) and all(o.kind[i] == POINT and o.label(i) in QUARTERS for i in rows)
    }

    def scale(s: Statement) -> float:
        inside = s.relation is Relation.INSIDE and s.target in quarters
        return FAR_SCALE if s.far or inside else NEAR_SCALE

    rarest = sorted((o for o, _ in members if 0 < len(o) <= MAX_DISTANT), key=len)
    return DistantObjects(
        starts=np.concatenate(([0], np.cumsum([len(o) for o, _ in members]))).astype(np.int64),
        objects=np.concatenate([o for o, _ in members]),
        weights=np.concatenate([f for _, f in members]).astype(np.float32),
        scale=np.array([max(scale(s), s.distance or 0.0) for s in used], np.float32),
        share=np.array(
            [
                (0.5 if s.far else 0.15) / NUM_SALIENT * r
                for s, r in zip(used, reaches, strict=True)
            ],
            np.float32,
        ),
        anchors=np.concatenate(rarest or [nothing[0]]),
    )


def _make_key(statement: Statement, description: Description) -> tuple[object, ...]:
    """Return a key that is equal for statements of one meaning in other words."""

    def key(node: int | None) -> object:
        if node in (None, SPEAKER, LISTENER):
            return node
        mention = description.mentions[node]
        return (mention.words.lower(), mention.name, mention.senses)

    ends = (statement.source, statement.target, statement.target2)
    plain = (statement.relation, statement.bearing, statement.distance, statement.within)
    return (*plain, statement.negated, *(key(node) for node in ends))


def find_speaker_nodes(statements: Sequence[Statement]) -> frozenset[int]:
    """Return the nodes at the place of the speaker: the speaker, and what they stand at."""
    at = {s.target for s in statements if s.relation is Relation.SAME and s.source == SPEAKER}
    return frozenset(at | {SPEAKER})


def _find_objects(
    tokens: NDArray[np.int32], weights: NDArray[np.float32], city: Lexicon, *, most: int
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Find the objects of a mention and their weights; none where there are more than `most`."""
    tokens, weights = tokens[weights > KIND_WEIGHT], weights[weights > KIND_WEIGHT]
    sizes = city.count_bearers(tokens)
    if not 0 < sizes.sum() <= most:
        return np.zeros(0, np.int64), np.zeros(0, np.float32)
    bearers = city.bearers(tokens)
    found = np.concatenate(bearers)
    fits = np.repeat(weights, [len(rows) for rows in bearers]).astype(np.float32)
    order = np.lexsort((-fits, found))
    first = np.diff(found[order], prepend=-1) > 0
    return found[order][first], fits[order][first]


def _find_tokens(mention: Mention, city: Lexicon) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Find the tokens that a mention may mean on a map, and their weights."""
    weights: dict[int, float] = {}
    names = _find_names(mention, city)
    by_kind = KIND_WEIGHT if mention.name else 1.0
    # the map has the name: others of its kind are something else
    exact = max(names.values(), default=0.0) >= 1.0
    for sense in () if exact else mention.senses:
        for label in city.label_index.get(sense.label, ()):
            weights[label] = max(weights.get(label, 0.0), by_kind * sense.weight)
    literal = {label for label in weights if is_tag(mention.words, city.objects.labels[label])}
    if literal:
        weights = {
            label: w if label in literal else OTHER_SENSE_WEIGHT * w for label, w in weights.items()
        }
    shift = len(city.objects.labels)
    for name, weight in names.items():
        weights[name + shift] = weight
    return np.array(list(weights), np.int32), np.array(list(weights.values()), np.float32)


def _find_names(mention: Mention, city: Lexicon) -> dict[int, float]:
    """Find the names on the map that a mention may mean: "New York" library, or "New York library"."""
    if not mention.name:
        return {}
    return city.name_index.find_rows(mention.name) or city.name_index.find_rows(mention.words)


def is_tag(words: str, label: str) -> bool:
    """Whether words are a tag's own value, as in the paper: "bicycle_parking", "the path"."""
    key, _, value = label.replace("_", " ").partition("=")
    plain = words.replace("_", " ").lower().removeprefix("the ").rstrip("s")
    return plain == (key if value == "yes" else value).rstrip("s")


def _explain_unusable(
    statement: Statement,
    description: Description,
    mentions: list[tuple[NDArray[np.int32], NDArray[np.float32]]],
) -> str:
    """Explain why a statement cannot be scored; empty where it can."""
    ends = [n for n in (statement.source, statement.target, statement.target2) if n is not None]
    if statement.relation is Relation.ACROSS:
        ends = ends[:2]  # what lies between may be any road
    if LISTENER in ends:
        return 'the position of the listener ("you") is unknown'
    if all(node == SPEAKER for node in ends):
        return "it says nothing about the place"
    for node in ends:
        if node != SPEAKER and not len(mentions[node - 2][0]):
            words = description.mentions[node].name or description.mentions[node].words
            return f"{words!r} is not on the map"
    return ""
