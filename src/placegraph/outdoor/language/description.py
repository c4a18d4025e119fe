"""The query graph: what a description says, after parsing and before any map is searched (Eq. 3-4).

Objects are mentioned, statements relate them. The speaker, the listener and every thing spoken of
are nodes; "the road" in two sentences is one node.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from math import pi, radians
from typing import TYPE_CHECKING, Any, NamedTuple

from placegraph.core.geometry import angle_between

if TYPE_CHECKING:
    from placegraph.language.text import IgnoredText


SPEAKER = 0
"""Node of whoever speaks: the place that is sought."""
LISTENER = 1
"""Node of whoever is spoken to ("south-west of you"): a known place, where `locate` is told it."""


CARDINAL_SIGMA, DIAGONAL_SIGMA, SHARP_SIGMA, LOOSE_SIGMA = 0.5, 0.4, 0.25, 0.6
"""Standard deviations of "north", "north-east", "directly north" and "mostly north" [rad]."""


class Direction(NamedTuple):
    """A direction of the compass, or of the body."""

    bearing: float
    """[rad], clockwise from north or, if `facing`, from where the speaker faces."""
    sigma: float = CARDINAL_SIGMA
    facing: bool = False
    certainty: float = 1.0


NORTH = Direction(0.0)


class Relation(StrEnum):
    """Kinds of statements. `source` is described relative to `target`."""

    DIRECTION = "direction"
    """The source lies in the direction `bearing`, seen from the target."""
    NEAR = "near"
    """Source and target are close: "next to", "by", "beside", or at `distance`."""
    INSIDE = "inside"
    """The source lies in the target's area: "in the park", "on the square"."""
    ALONG = "along"
    """The source lies on a line: "on Penn Avenue", "along the river"."""
    ACROSS = "across"
    """A road (or `target2`) runs between source and target: "across the street from"."""
    BETWEEN = "between"
    """The source lies between `target` and `target2`."""
    VISIBLE = "visible"
    """The source is in sight of the target, mostly of the speaker: "there is a church"."""
    SAME = "same"
    """Source stands at the target itself: "I'm at the bakery"."""


WITHIN = (Relation.INSIDE, Relation.SAME)
"""Relations of who is inside of something, or is there where it is."""


@dataclass(frozen=True, slots=True)
class Sense:
    """One meaning of a word: a map label and how likely the word means it."""

    label: str
    """``key=value``; ``key=*`` stands for every value of the key."""
    weight: float
    """In (0, 1]; 1 where the word is the label's own name or tag value."""


@dataclass(frozen=True, slots=True)
class Mention:
    """A thing spoken of: a node of the query graph."""

    id: int
    words: str
    """Words of the first occurrence: "two benches", "the Rex Theater"."""
    senses: tuple[Sense, ...] = ()
    """Meanings of the common noun on a map; empty for an unknown word or a bare name."""
    name: str = ""
    """Proper name as written ("Rex Theater", "Ripley's Aquarium of Canada"), or empty."""
    count: int | None = None
    """Number of objects, if given: "two benches" -> 2; None for one or an unknown number."""
    definite: bool = True
    """"the bakery" (True) or "a bakery" (False)."""


@dataclass(frozen=True, slots=True)
class Statement:
    """An edge of the query graph."""

    relation: Relation
    source: int
    target: int
    target2: int | None = None
    """Second target of BETWEEN, or what lies between for ACROSS."""
    bearing: float | None = None
    """Direction of the source seen from the target [rad], clockwise from north."""
    bearing_sigma: float = 0.5
    """Standard deviation of the direction [rad]."""
    distance: float | None = None
    """Distance, if the text gives it [m]."""
    within: bool = False
    """Whether the distance is the most: "within 50 m", "on the same block"."""
    negated: bool = False
    """"no trees here", "not near a church"."""
    certainty: float = 1.0
    """In (0, 1]: lower for hedged or loosely parsed statements."""
    far: bool = False
    """Said of a walk or of the town, not of what is in sight ("head north", "past the park")."""
    text: str = ""
    """The words it was read from."""


@dataclass(frozen=True)
class Description:
    """Query graph of a text: what was understood, and what was not."""

    text: str
    mentions: tuple[Mention, ...] = ()
    """`mentions[SPEAKER]` and `mentions[LISTENER]` always stand first."""
    statements: tuple[Statement, ...] = ()
    ignored: tuple[IgnoredText, ...] = ()
    conflicts: tuple[str, ...] = field(default=())
    """Sentences that say which statements contradict each other."""
    language: str = "en"
    """Code of the language in which it was read."""

    @property
    def unknown_words(self) -> tuple[str, ...]:
        """Things spoken of of whose words nothing is known, as written."""
        known = self.mentions[LISTENER + 1 :]
        return tuple(m.words for m in known if not m.senses and not m.name)

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings, ready for `json.dumps`."""
        return dict(_plain(self))


def _plain(value: Any) -> Any:  # noqa: ANN401  # fields of dataclasses
    """Return dataclasses as dictionaries, five times as fast as `asdict`, which copies deeply."""
    if isinstance(value, tuple):
        return tuple(map(_plain, value))
    names = getattr(value, "__dataclass_fields__", None)
    return value if names is None else {name: _plain(getattr(value, name)) for name in names}


OPPOSITE = radians(120.0)
"""Directions further apart than this contradict each other."""
ALIKE = radians(60.0)
"""Directions nearer than this are the same direction."""
SURE = 0.75
"""Statements less certain than this contradict nothing."""
_HERE = (Relation.VISIBLE, Relation.NEAR, Relation.DIRECTION)


def ends(statement: Statement) -> tuple[int, int]:
    """Return source and target of a statement."""
    return statement.source, statement.target


def find_speaker_nodes(statements: Sequence[Statement]) -> frozenset[int]:
    """Return the nodes at the place of the speaker: the speaker, and what they stand at."""
    at = {s.target for s in statements if s.relation is Relation.SAME and s.source == SPEAKER}
    return frozenset(at | {SPEAKER})


def find_conflicts(
    statements: Sequence[Statement],
    nouns: Sequence[str],
    here: Collection[int],
    kinds: Collection[int] = (),
) -> tuple[str, ...]:
    """Say which statements contradict each other.

    Parameters
    ----------
    nouns
        Common noun of every mention.
    here
        Nodes that stand where the speaker stands.
    kinds
        Nodes that are spoken of by a label of the map: any thing of that kind serves, and another
        one in the next sentence.
    """
    sure = [s for s in statements if s.certainty >= SURE]
    of_one = [s for s in sure if s.source not in kinds and s.target not in kinds]
    found = [*_find_opposites(of_one, here), *_find_denials(sure, nouns, here)]
    return tuple(
        dict.fromkeys(
            f"“{one.text}” contradicts itself."
            if one.text == other.text
            else f"“{one.text}” and “{other.text}” cannot both be true."
            for one, other in found
        )
    )


_Pairs = Iterator[tuple[Statement, Statement]]


def _find_opposites(statements: Sequence[Statement], here: Collection[int]) -> _Pairs:
    """Yield statements of two things that lie in opposite directions of each other."""
    first: dict[tuple[int, int], tuple[float, Statement]] = {}
    for statement in statements:
        if statement.bearing is None or statement.negated:
            continue
        a, b = (SPEAKER if n in here else n for n in (statement.source, statement.target))
        bearing = statement.bearing if a < b else statement.bearing + pi
        known = first.setdefault((min(a, b), max(a, b)), (bearing, statement))
        if angle_between(known[0], bearing) > OPPOSITE:
            yield known[1], statement


def _find_denials(
    statements: Sequence[Statement], nouns: Sequence[str], here: Collection[int]
) -> _Pairs:
    """Yield statements of something that is said to be here and not to be here."""
    claims = [s for s in statements if s.relation in _HERE and s.target in here and not s.far]
    for no in claims:
        noun = nouns[no.source]
        for yes in claims if no.negated and noun else ():
            if yes.negated or nouns[yes.source] != noun:
                continue
            if no.bearing is None or (
                yes.bearing is not None and angle_between(yes.bearing, no.bearing) < ALIKE
            ):
                yield no, yes
                break
