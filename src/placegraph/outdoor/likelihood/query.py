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

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import cos, sin
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.outdoor.language.description import (
    LISTENER,
    SPEAKER,
    WITHIN,
    Description,
    Mention,
    Relation,
    Statement,
    ends,
    find_speaker_nodes,
)
from placegraph.outdoor.likelihood.match_kernels import ME
from placegraph.outdoor.map.directions_kernels import TABLE, direction_table
from placegraph.outdoor.map.names import NameIndex
from placegraph.outdoor.map.objects import AREA, LINE, POINT, CityObjects

if TYPE_CHECKING:
    from placegraph.outdoor.map.city import City


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


def make_columns(
    used: list[Statement],
    description: Description,
    share: list[float],
    by_kind: frozenset[int],
    named: NamedPlaces | None = None,
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
    if named is not None:
        noise = [named.adjust(s, n) for s, n in zip(used, noise, strict=True)]
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
MAX_DISTANT_ON_WAY = 400
"""Largest number of objects of a mention from out of sight, where a text tells a way ..."""
MAX_DISTANT = 12
"""... and where it does not."""
NEAR_SCALE, FAR_SCALE = 80.0, 350.0
"""Scale of distances to objects out of sight, and where the text tells a way or names a quarter [m]."""
SITE_SCALE, STREET_SCALE = 35.0, 15.0
"""Scale of distances to a crossing or a house, and from a street that something is on [m]."""
QUARTERS = frozenset(f"place={kind}" for kind in ("suburb", "neighbourhood", "quarter", "borough"))
NUM_SALIENT = 20.0
"""Number of objects out of sight that come to a speaker's mind."""
OTHER_SENSE_WEIGHT = 0.1
"""Weight of a word's other senses where it is a tag's own value ("path" for a footway)."""
UNKNOWN_KIND_SHARE, UNKNOWN_STREET_SHARE = 0.01, 0.1
"""Smallest share of all objects in sight of the kind of an unknown name, or of an unknown street."""
NAMED_NOISE = 0.04
"""Share of wrong statements that the speaker is at a place that is named exactly."""
ROAD_SHAPES = ("junction=", "highway=turning_", "highway=mini_roundabout")
SHAPE_SHARE = 0.05
"""Smallest share of all objects in sight of shapes of roads: what people call a roundabout, a map may not."""
NAMED_SHARE = 0.01
"""Largest share of all objects in sight of a place that is named exactly."""
MENTIONED = 0.7
"""Largest certainty of a thing that is only named, and not said to be in sight."""
MAPPED = 0.15
"""Share of things of a kind that a map has where it has none of that kind near a named place."""
VAGUE = ("name=", "place=", "natural=bay", "natural=water", "leisure=park", "leisure=garden")
"""Beginnings of labels of things that are wide even where a map draws them as points ..."""
UNKNOWN_EXTENT = 400.0
"""... and how wide [m]."""
MAX_UNIQUE = 2
"""Largest number of objects that bear a unique name: a shop is a building and a point in it."""
NEAR_NAMED, MAX_KIND = 60.0, 20_000
"""What stands nearer to a named place is there [m]; a kind with more objects is everywhere."""
WIDE, MAX_DRAWN = 30.0, 50
"""Median extent from which on maps hold nearly all things of a kind [m], of this many of them."""
NOT_MAPPED = "is not on the map"
"""Reason why a statement about what a map lacks cannot be scored, after the words."""
_NO_TOKENS = (np.zeros(0, np.int32), np.zeros(0, np.float32))


class DistantObjects(NamedTuple):
    """Objects that are rare enough to be mentioned from out of sight."""

    starts: NDArray[np.int64]
    """(M + 1,) objects of a mention; none where there are too many."""
    objects: NDArray[np.int64]
    """Rows of the map's objects; beyond these, rows of `sites`."""
    weights: NDArray[np.float32]
    sites: NDArray[np.float32]
    """(V, 2) crossings and houses that are no objects, east and north [m]."""
    scale: NDArray[np.float32]
    """(S,) scale of the distance to the object of a statement [m]."""
    share: NDArray[np.float32]
    """(S,) probability that a statement is about one particular object out of sight."""
    anchors: NDArray[np.int64]
    """Objects around which candidates are sought, those of the rarest mention first."""


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
    sites: frozenset[int] = frozenset()
    """Mentions of crossings and houses that are no objects of the map."""
    unique: frozenset[int] = frozenset()
    """Mentions by names that one place of the map bears, and `sites`."""

    def find_extent(
        self, node: int, position: Floats, city: City, kinds: Sequence[int] = (POINT, LINE, AREA)
    ) -> float:
        """Return the distance [m] to the far end of what a unique name means, of some kinds of objects.

        Maps draw quarters, bays and gardens as points, too: their extent is `UNKNOWN_EXTENT`.
        """
        row = slice(*self.mentions.starts[node - 2 : node])
        names = self.mentions.tokens[row][self.mentions.weights[row] > KIND_WEIGHT]
        extents = []
        for row in np.concatenate([np.zeros(0, np.int64), *city.bearers(names)]).tolist():
            if city.objects.kind[row] not in kinds:
                continue
            points = np.concatenate(city.objects.parts(row))
            far = float(np.hypot(*(points - position).T).max())
            vague = city.objects.kind[row] == POINT and city.objects.label(row).startswith(VAGUE)
            extents.append(max(far, UNKNOWN_EXTENT) if vague else far)
        return min(extents, default=0.0)

    def is_about_site(self, statement: Statement) -> bool:
        """Tell whether a statement is about a crossing or a house that is no object."""
        return not self.sites.isdisjoint(ends(statement))

    def token_weights(self, n_tokens: int) -> TokenWeights:
        """Return the weight of each token of a map for each mention."""
        known, fit = self._fit
        row = np.zeros(n_tokens, np.int32)
        row[known] = np.arange(1, len(fit))
        return TokenWeights(row, fit)

    @cached_property
    def _fit(self) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Tokens of all mentions (K,), and their weights (K + 1, M), a row of zeros first."""
        starts, tokens, weights = self.mentions
        known, at = np.unique(tokens, return_inverse=True)
        fit = np.zeros((len(known) + 1, len(starts) - 1), np.float32)
        fit[at + 1, np.repeat(np.arange(len(starts) - 1), np.diff(starts))] = weights
        return known, fit


def compile_query(description: Description, city: Lexicon, *, tells_way: bool = False) -> Query:
    """Compile a description against a map (Eq. 3-4 meet Eq. 7-8).

    Where it tells the way to a place (`tells_way`), more objects are out of sight.
    """
    sites = {
        m.id: places
        for m in description.mentions[2:]
        if m.name and len(places := city.name_index.find_places(m.name))
    }
    mentions = [
        _NO_TOKENS if mention.id in sites else _find_tokens(mention, city)
        for mention in description.mentions[2:]
    ]
    by_kind = frozenset(
        m.id
        for m in description.mentions[2:]
        if m.name and m.id not in sites and not _find_names(m, city)
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
    named = _find_named(description, mentions, sites, city)
    labels = city.objects.labels
    for m, (tokens, _) in enumerate(mentions):
        shaped = [t < len(labels) and labels[t].startswith(ROAD_SHAPES) for t in tokens]
        if shaped and all(shaped):
            share[m] = max(share[m], SHAPE_SHARE)
    for node in named.nodes if named else ():  # few places of the world bear the name
        share[node - 2] = min(share[node - 2], NAMED_SHARE)
    statements = description.statements
    for statement in statements if named is None else named.stand_in(statements):
        key = _make_key(statement, description)
        if key in known:
            continue  # repetition makes it no surer
        known.add(key)
        reason = _explain_unusable(statement, description, mentions, sites)
        if reason:
            unused.append((statement, reason))
        else:
            used.append(statement)
    return Query(
        description,
        tuple(used),
        tuple(unused),
        make_columns(used, description, share, by_kind, named),
        MentionTokens(
            np.concatenate(([0], np.cumsum([len(t) for t, _ in mentions]))).astype(np.int64),
            np.concatenate([t for t, _ in mentions] or [np.zeros(0, np.int32)]),
            np.concatenate([w for _, w in mentions] or [np.zeros(0, np.float32)]),
        ),
        find_distant(used, mentions, city, sites, tells_way=tells_way),
        by_kind,
        frozenset(sites),
        frozenset(sites) | _find_unique(description, mentions, city),
    )


def _find_unique(
    description: Description,
    mentions: list[tuple[NDArray[np.int32], NDArray[np.float32]]],
    city: Lexicon,
) -> frozenset[int]:
    """Find the mentions by names that one place of the map bears."""
    found = set()
    for mention, (tokens, weights) in zip(description.mentions[2:], mentions, strict=True):
        names = tokens[(weights > KIND_WEIGHT) & (tokens >= len(city.objects.labels))]
        if mention.name and len(names) and city.count_bearers(names).sum() <= MAX_UNIQUE:
            found.add(mention.id)
    return frozenset(found)


class NamedPlaces(NamedTuple):
    """Places that a text names exactly as where the speaker is: "in Elm Park", "at Main & 5th"."""

    nodes: frozenset[int]
    """Mentions of them."""
    lacking: frozenset[int]
    """Mentions of nameless things of which the map has none there: it lacks most of them."""
    here: frozenset[int]
    """Mentions at the place of the speaker, who is one."""

    def adjust(self, statement: Statement, noise: float) -> float:
        """Return the share of wrong statements like this: of exact names few, of what is lacking most."""
        if is_binding(statement) and not self.nodes.isdisjoint(ends(statement)):
            return min(noise, NAMED_NOISE)
        if not self.lacking.isdisjoint(ends(statement)) and not statement.negated:
            return 1.0 - (1.0 - noise) * MAPPED
        return noise

    def stand_in(self, statements: Sequence[Statement]) -> Iterator[Statement]:
        """Yield statements with the speaker in place of what is lacking and the speaker stands at.

        "I'm at the fountain in Elm Park. It is north of the pool": maps lack most fountains.
        """
        at = self.lacking & self.here
        for s in statements:
            source, target = (SPEAKER if node in at else node for node in ends(s))
            if s.relation is Relation.SAME and SPEAKER in ends(s):
                yield s
            elif source != target:
                target2 = SPEAKER if s.target2 in at else s.target2
                yield replace(s, source=source, target=target, target2=target2)


def is_binding(s: Statement) -> bool:
    """Tell whether a statement says that the speaker is where something is, or only names it."""
    bare = s.relation is Relation.VISIBLE and s.certainty <= MENTIONED
    return (s.relation in WITHIN or bare) and not (s.negated or s.far)


def _is_proper(mention: Mention) -> bool:
    """Tell whether a mention has a proper name: "the totem pole" says a kind, whatever bears it as name."""
    return bool(mention.name) and not (mention.name.islower() and mention.words != mention.name)


def _is_beside(s: Statement) -> bool:
    """Tell whether a statement says that something is near something else, as "the statue at ..."."""
    return s.relation is Relation.NEAR and s.distance is None and not (s.negated or s.far)


def _find_named(
    description: Description,
    mentions: list[tuple[NDArray[np.int32], NDArray[np.float32]]],
    sites: Mapping[int, Floats],
    city: Lexicon,
) -> NamedPlaces | None:
    """Find the places that a text names exactly as where the speaker is; None without any."""
    here = find_speaker_nodes(description.statements)
    about = {s.source for s in description.statements}
    if len(about) == 1 and all(is_binding(s) or _is_beside(s) for s in description.statements):
        here |= about  # "Fountain: in Elm Park, by the gate" tells the place of the fountain
    nodes = {
        node
        for s in description.statements
        if (is_binding(s) or _is_beside(s)) and not here.isdisjoint(ends(s))
        for node in ends(s)
        if node > LISTENER and _is_proper(description.mentions[node])
    }
    boxes: dict[int, Floats] = {}
    streets = city.name_index.streets  # a world in shards holds no geometry
    for node in nodes:
        tokens, weights = mentions[node - 2]
        exact = tokens[(weights >= 1.0) & (tokens >= len(city.objects.labels))]
        if node in sites:
            boxes[node] = np.tile(sites[node], 2)
        elif len(exact) and city.count_bearers(exact).sum() <= MAX_DISTANT:
            rows = np.concatenate(city.bearers(exact)).tolist() if streets else []
            points = [np.concatenate(streets.objects.parts(row)) for row in rows if streets]
            boxes[node] = np.array([[*p.min(axis=0), *p.max(axis=0)] for p in points])
    if streets is None:
        return NamedPlaces(frozenset(boxes), frozenset(), here) if boxes else None
    around = np.concatenate([np.zeros((0, 4)), *boxes.values()])
    lacking = {
        m.id
        for m, tokens in zip(description.mentions[2:], mentions, strict=True)
        if m.id not in sites
        if not len(tokens[0])
        or (len(around) and not _is_proper(m) and _may_lack(tokens, around, city, streets.objects))
    }
    return NamedPlaces(frozenset(boxes), frozenset(lacking), here) if boxes or lacking else None


def _may_lack(
    mention: tuple[NDArray[np.int32], NDArray[np.float32]],
    boxes: Floats,
    city: Lexicon,
    objects: CityObjects,
) -> bool:
    """Tell whether a map may lack what a mention means in or near boxes (K, 4) [m], and holds none there.

    Maps lack many benches, fountains and statues, but few cemeteries: what they draw wide is mapped.
    """
    count = city.count_bearers(mention[0]).sum()
    if not 0 < count < MAX_KIND:
        return not count
    rows = np.concatenate(city.bearers(mention[0]))
    at = objects.center[rows]
    low, high = boxes[:, :2] - NEAR_NAMED, boxes[:, 2:] + NEAR_NAMED
    if ((at[:, None] >= low) & (at[:, None] <= high)).all(axis=2).any():
        return False
    few = rows[:: -(-len(rows) // MAX_DRAWN)].tolist()
    wide = [np.ptp(np.concatenate(objects.parts(row)), axis=0).max() for row in few]
    return bool(np.median(wide) < WIDE)


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
    sites: Mapping[int, Floats],
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
        if node != SPEAKER and node not in sites and not len(mentions[node - 2][0]):
            words = description.mentions[node].name or description.mentions[node].words
            return f"{words!r} {NOT_MAPPED}"
    return ""


def find_distant(
    used: list[Statement],
    mentions: list[tuple[NDArray[np.int32], NDArray[np.float32]]],
    city: Lexicon,
    sites: Mapping[int, Floats],
    *,
    tells_way: bool,
) -> DistantObjects | None:
    """Find objects of rare mentions, and `sites`, where a statement may be about what is out of sight."""
    here = find_speaker_nodes(used)
    tells_way = any(s.far for s in used) or tells_way
    few = {m + 2 for m, mention in enumerate(mentions) if _is_rare(*mention, city)}.union(sites)
    reaches = [
        s.far
        or s.distance is not None
        or not here.union(sites).isdisjoint(ends(s))
        or few.issuperset(ends(s))
        for s in used
    ]
    spoken = {
        n - 2
        for s, r in zip(used, reaches, strict=True)
        if r
        for n in ends(s)
        if n in sites or n not in here
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
    rows = len(city.objects.kind)
    for node, places in sites.items():
        if node - 2 in spoken:
            at = np.arange(rows, rows + len(places), dtype=np.int64)
            members[node - 2] = (at, np.full(len(at), 1.0 / len(at) ** 0.5, np.float32))
            rows += len(at)
    if not any(len(o) for o, _ in members):
        return None
    bearers = {m + 2: rows for m, (rows, _) in enumerate(members) if m + 2 not in sites}
    quarters = {node for node, rows in bearers.items() if _are_quarters(rows, city)}

    def scale(s: Statement) -> float:
        inside = s.relation is Relation.INSIDE and s.target in quarters
        if s.far or inside:
            return FAR_SCALE
        if s.relation is Relation.ALONG:
            return STREET_SCALE
        return NEAR_SCALE if sites.keys().isdisjoint(ends(s)) else SITE_SCALE

    rarest: list[NDArray[np.int64]] = sorted(
        (o for o, _ in members if 0 < len(o) <= MAX_DISTANT), key=len
    )
    return DistantObjects(
        starts=np.concatenate(([0], np.cumsum([len(o) for o, _ in members]))).astype(np.int64),
        objects=np.concatenate([o for o, _ in members]),
        weights=np.concatenate([f for _, f in members]).astype(np.float32),
        sites=np.concatenate(
            [np.zeros((0, 2)), *(at for node, at in sites.items() if node - 2 in spoken)]
        ).astype(np.float32),
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


def _is_rare(tokens: NDArray[np.int32], weights: NDArray[np.float32], city: Lexicon) -> bool:
    """Return whether at most `MAX_DISTANT` objects surely bear some of tokens (k,)."""
    certain = tokens[weights > KIND_WEIGHT]
    return bool(len(certain) and city.count_bearers(certain).sum() <= MAX_DISTANT)


def _are_quarters(rows: NDArray[np.int64], city: Lexicon) -> bool:
    """Return whether objects are quarters that a map draws as points, and people are "in"."""
    o = city.objects
    return len(rows) > 0 and all(o.kind[i] == POINT and o.label(i) in QUARTERS for i in rows)


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
