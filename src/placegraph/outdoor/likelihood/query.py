"""A description compiled against a map: words become tokens, statements become columns.

A speaker at viewpoint v picks things in sight and says how they lie. A statement s then has

    P(s | v) = (1 - noise) * sum over map objects that serve s of sight * word * geometry / normaliser
               + noise * P(s | anywhere)

and its log-likelihood ratio log P(s | v) / P(s | anywhere) is its evidence. Directions are soft: a
little wrong costs little, the opposite costs all that `noise` leaves. A statement that no object in
sight serves may be served from afar, by a thing rare enough to be spoken of from there.
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


class Labelled(Protocol):
    """Things by row, as `CityObjects` has them."""

    @property
    def labels(self) -> tuple[str, ...]:
        """All labels that there are."""

    @property
    def kind(self) -> NDArray[np.uint8]:
        """(N,) POINT, LINE or AREA."""

    def label(self, i: int) -> str:
        """Most specific label of a thing."""


class Lexicon(Protocol):
    """Words of a map; its tokens are labels, then names. A `City` is one."""

    @property
    def objects(self) -> Labelled:
        """Things, as far as `bearers` names them."""

    @property
    def label_index(self) -> Mapping[str, Sequence[int]]:
        """Tokens by label and by ``key=*``."""

    @property
    def name_index(self) -> NameIndex:
        """Proper names."""

    def frequency(self, tokens: NDArray[np.int32], weights: NDArray[np.float32]) -> float:
        """Share of all things in sight, over all viewpoints, that these tokens stand for."""

    def borne(self, tokens: NDArray[np.int32]) -> NDArray[np.int64]:
        """Return the number of things (K,) that bear each token."""

    def bearers(self, tokens: NDArray[np.int32]) -> list[NDArray[np.int64]]:
        """Rows of the things that bear each of these tokens, in the order of the tokens."""


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
        """Likelihood ratio (S,) of a statement where P(what serves it) is 1."""
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
    """Weights of a map's tokens for mentions."""

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


KIND_ONLY = 0.03
"""Weight of things of the right kind where a name was said: the map may lack the name."""
LOOSELY = 0.1
"""Weight of a word's other senses where it is a tag's own value ("path" for a footway)."""
COMMON, COMMON_ROADS = 0.01, 0.1
"""Share of all things in sight that the kind of an unknown name, or of an unknown street, has at least."""
MOST_FAR = 400
"""Mentions of more objects than this are only looked for in sight, on a way as well."""
RARE = 12
"""Mentions of no more objects than this may be spoken of from out of sight."""
NEARBY, FAR = 80.0, 350.0
"""Scale of distances to things out of sight, and where the text speaks of a way or a town [m]."""
QUARTERS = frozenset(f"place={kind}" for kind in ("suburb", "neighbourhood", "quarter", "borough"))
SALIENT = 20.0
"""About so many things out of sight come to mind."""


@dataclass(frozen=True)
class Query:
    """A description, ready to be scored on one map."""

    description: Description
    used: tuple[Statement, ...]
    """Statements that take part, in the order of the columns."""
    unused: tuple[tuple[Statement, str], ...]
    """Statements that cannot take part, and why."""
    statements: Statements
    mentions: MentionTokens
    far: Far | None
    """None where everything is said of things in sight."""
    by_kind: frozenset[int]
    """Mentions with a name that the map does not know; they are looked for by their kind."""

    @property
    def unknown_names(self) -> tuple[str, ...]:
        """Names that were said and that the map does not know, as written, in the order of speech."""
        names = [self.description.mentions[node].name for node in sorted(self.by_kind)]
        return tuple(dict.fromkeys(names))

    def words(self, n_tokens: int) -> Words:
        """Return how well each of a map's tokens fits each mention."""
        starts, tokens, weights = self.mentions
        known, at = np.unique(tokens, return_inverse=True)
        row, fit = (
            np.zeros(n_tokens, np.int32),
            np.zeros((len(known) + 1, len(starts) - 1), np.float32),
        )
        row[known] = np.arange(1, len(known) + 1)
        fit[at + 1, np.repeat(np.arange(len(starts) - 1), np.diff(starts))] = weights
        return Words(row, fit)


def compile_query(description: Description, city: Lexicon, *, on_a_way: bool = False) -> Query:
    """Compile a description against a map (Eq. 3-4 meet Eq. 7-8).

    `on_a_way` says that it describes the way to a place for somebody elsewhere: then more things
    are out of sight.
    """
    mentions = [_tokens(mention, city) for mention in description.mentions[2:]]
    by_kind = frozenset(m.id for m in description.mentions[2:] if m.name and not _named(m, city))
    share = [city.frequency(tokens, weights) for tokens, weights in mentions]
    for node in by_kind:  # that few of its kind are on the map says nothing of the one that is not
        senses, weights = description.mentions[node].senses, mentions[node - 2][1]
        road = any(sense.label.startswith("highway=") for sense in senses[:1])
        common = (COMMON_ROADS if road else COMMON) * float(weights.max(initial=0.0))
        share[node - 2] = max(share[node - 2], common)
    used: list[Statement] = []
    unused: list[tuple[Statement, str]] = []
    heard: set[tuple[object, ...]] = set()
    for statement in description.statements:
        said = _meaning(statement, description)
        if said in heard:
            continue  # said again, it is no surer
        heard.add(said)
        reason = _unusable(statement, description, mentions)
        if reason:
            unused.append((statement, reason))
        else:
            used.append(statement)
    return Query(
        description,
        tuple(used),
        tuple(unused),
        columns_of(used, description, share, by_kind),
        MentionTokens(
            np.concatenate(([0], np.cumsum([len(t) for t, _ in mentions]))).astype(np.int64),
            np.concatenate([t for t, _ in mentions] or [np.zeros(0, np.int32)]),
            np.concatenate([w for _, w in mentions] or [np.zeros(0, np.float32)]),
        ),
        _far(used, mentions, city, on_a_way=on_a_way),
        by_kind,
    )


def _far(
    used: list[Statement],
    mentions: list[tuple[NDArray[np.int32], NDArray[np.float32]]],
    city: Lexicon,
    *,
    on_a_way: bool,
) -> Far | None:
    """Objects of rare mentions, where a statement may be about things out of sight."""
    here = standing_at(used)
    on_a_way = any(s.far for s in used) or on_a_way
    few = set()
    for m, (tokens, weights) in enumerate(mentions):
        certain = tokens[weights > KIND_ONLY]
        if len(certain) and city.borne(certain).sum() <= RARE:
            few.add(m + 2)
    reaches = [
        s.far or s.distance is not None or not here.isdisjoint(ends(s)) or few.issuperset(ends(s))
        for s in used
    ]
    spoken = {
        n - 2 for s, r in zip(used, reaches, strict=True) if r for n in ends(s) if n not in here
    }
    nothing = (np.zeros(0, np.int64), np.zeros(0, np.float32))
    away = {n - 2 for s in used if (s.distance or 0.0) > NEARBY for n in ends(s) if n not in here}
    members = [
        _members(*mention, city, most=MOST_FAR if on_a_way or m in away else RARE)
        if m in spoken
        else nothing
        for m, mention in enumerate(mentions)
    ]
    if not on_a_way:  # of many, no particular one comes to mind
        members = [(o, f * min(1.0, RARE / max(1, len(o)))) for o, f in members]
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
        return FAR if s.far or inside else NEARBY

    rarest = sorted((o for o, _ in members if 0 < len(o) <= RARE), key=len)
    return Far(
        starts=np.concatenate(([0], np.cumsum([len(o) for o, _ in members]))).astype(np.int64),
        objects=np.concatenate([o for o, _ in members]),
        fits=np.concatenate([f for _, f in members]).astype(np.float32),
        scale=np.array([max(scale(s), s.distance or 0.0) for s in used], np.float32),
        share=np.array(
            [(0.5 if s.far else 0.15) / SALIENT * r for s, r in zip(used, reaches, strict=True)],
            np.float32,
        ),
        anchors=np.concatenate(rarest or [nothing[0]]),
    )


def _meaning(statement: Statement, description: Description) -> tuple[object, ...]:
    """Return the meaning of a statement: equal for statements that say the same in other words."""

    def thing(node: int | None) -> object:
        if node in (None, SPEAKER, LISTENER):
            return node
        mention = description.mentions[node]
        return (mention.words.lower(), mention.name, mention.senses)

    ends = (statement.source, statement.target, statement.target2)
    plain = (statement.relation, statement.bearing, statement.distance, statement.within)
    return (*plain, statement.negated, *(thing(node) for node in ends))


def standing_at(statements: Sequence[Statement]) -> frozenset[int]:
    """Nodes that are where the speaker is: the speaker, and what they stand at."""
    at = {s.target for s in statements if s.relation is Relation.SAME and s.source == SPEAKER}
    return frozenset(at | {SPEAKER})


def _members(
    tokens: NDArray[np.int32], weights: NDArray[np.float32], city: Lexicon, *, most: int
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Objects of a mention and how well it fits them; none where there are more than `most`."""
    tokens, weights = tokens[weights > KIND_ONLY], weights[weights > KIND_ONLY]
    sizes = city.borne(tokens)
    if not 0 < sizes.sum() <= most:
        return np.zeros(0, np.int64), np.zeros(0, np.float32)
    bearers = city.bearers(tokens)
    found = np.concatenate(bearers)
    fits = np.repeat(weights, [len(rows) for rows in bearers]).astype(np.float32)
    order = np.lexsort((-fits, found))
    first = np.diff(found[order], prepend=-1) > 0
    return found[order][first], fits[order][first]


def _tokens(mention: Mention, city: Lexicon) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Tokens that a mention may stand for on this map, and how well they fit."""
    weights: dict[int, float] = {}
    names = _named(mention, city)
    by_kind = KIND_ONLY if mention.name else 1.0
    # the map has it: what else is of its kind is something else
    exact = max(names.values(), default=0.0) >= 1.0
    for sense in () if exact else mention.senses:
        for label in city.label_index.get(sense.label, ()):
            weights[label] = max(weights.get(label, 0.0), by_kind * sense.weight)
    literal = {label for label in weights if is_tag(mention.words, city.objects.labels[label])}
    if literal:
        weights = {label: w if label in literal else LOOSELY * w for label, w in weights.items()}
    shift = len(city.objects.labels)
    for name, weight in names.items():
        weights[name + shift] = weight
    return np.array(list(weights), np.int32), np.array(list(weights.values()), np.float32)


def _named(mention: Mention, city: Lexicon) -> dict[int, float]:
    """Names that a mention with a name may mean: "New York" library, or "New York library"."""
    if not mention.name:
        return {}
    return city.name_index.named(mention.name) or city.name_index.named(mention.words)


def is_tag(words: str, label: str) -> bool:
    """Whether words are a tag's own value, as in the paper: "bicycle_parking", "the path"."""
    key, _, value = label.replace("_", " ").partition("=")
    said = words.replace("_", " ").lower().removeprefix("the ").rstrip("s")
    return said == (key if value == "yes" else value).rstrip("s")


def _unusable(
    statement: Statement,
    description: Description,
    mentions: list[tuple[NDArray[np.int32], NDArray[np.float32]]],
) -> str:
    """Why a statement cannot be scored, or an empty string."""
    ends = [n for n in (statement.source, statement.target, statement.target2) if n is not None]
    if statement.relation is Relation.ACROSS:
        ends = ends[:2]  # what lies between may be any road
    if LISTENER in ends:
        return "where you are is not known"
    if all(node == SPEAKER for node in ends):
        return "it says nothing about the place"
    for node in ends:
        if node != SPEAKER and not len(mentions[node - 2][0]):
            words = description.mentions[node].name or description.mentions[node].words
            return f"the map knows no {words!r}"
    return ""
