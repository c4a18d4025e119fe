"""Sentences: mentions of things and statements that relate them, before any map is looked at."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from placegraph.language.text import IgnoredText


ME = -1
"""Stands for the speaker where a mention could stand."""


class Kind(StrEnum):
    """Kinds of statements; all but ROOM, HOLDS and RELATED are about where the speaker is."""

    ROOM = "room"
    """This is such a room, or one is in it: "in the kitchen", "a kitchen with ..."."""
    HOLDS = "holds"
    """The thing is here, in sight: "there is a plant", "with two sinks"."""
    NEAR = "near"
    """The thing is near me, or `distance` away: "next to the sofa"."""
    FAR = "far"
    """"far from the door"."""
    BETWEEN = "between"
    """I am between the things: "between the table and the fridge"."""
    TOWARDS = "towards"
    """The thing lies at `bearing` from where I look: "facing the window", "behind me"."""
    RELATED = "related"
    """The first thing is `relation` of the second: "a plant on the table"."""


@dataclass(frozen=True, slots=True)
class Mention:
    """Object or person that a description mentions."""

    words: str
    """As written: "two brown chairs"."""
    label: str
    """What it is called, without what counts or describes it: "chairs"."""
    count: int | None = None
    """How many, where said: "two sinks"."""
    several: bool = False
    """"some chairs", "many books": more than one."""
    plural: bool = False
    """"curtains", without saying how many."""
    attributes: tuple[str, ...] = ()
    """How it looks, and where in the room it stands: "brown", "tall", "in the corner" (`looks`)."""
    negated: bool = False
    """"no plant", "without a desk"."""
    room: str = ""
    """Kind of room that the label names (`rooms.toml`), or empty."""


@dataclass(frozen=True, slots=True)
class Statement:
    """Statement of one or two things."""

    kind: Kind
    mentions: tuple[int, ...]
    """Rows of `Sentence.mentions`."""
    relation: str = ""
    """Of RELATED, by a name that `map.relations.words` knows; of NEAR how: "in front of", "on"."""
    bearing: float = 0.0
    """Of TOWARDS: direction of the thing from where the speaker looks [rad, left is +pi/2]."""
    wide: bool = False
    """Of TOWARDS: anywhere in the picture ("I see a plant"), not straight there."""
    distance: float | None = None
    """How far, where said [m]."""
    negated: bool = False
    certainty: float = 1.0
    """In (0, 1]: lower for what is said to be "maybe" so."""
    text: str = ""
    """The words it was read from."""


@dataclass(frozen=True)
class Sentence:
    """Mentions and statements of a text, and what was not understood."""

    text: str
    mentions: tuple[Mention, ...] = ()
    statements: tuple[Statement, ...] = ()
    ignored: tuple[IgnoredText, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings, ready for `json.dumps`."""
        return asdict(self)
