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
    """Words of the text: "two brown chairs"."""
    label: str
    """Noun without number and adjectives: "chairs"."""
    count: int | None = None
    """Number of objects, if the text gives it: "two sinks"."""
    several: bool = False
    """"some chairs", "many books": more than one."""
    plural: bool = False
    """"curtains", without saying how many."""
    attributes: tuple[str, ...] = ()
    """Appearance and position in the room: "brown", "tall", "in the corner" (`looks`)."""
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
    """RELATED: relation by a name of `map.relations.words`; NEAR: preposition, "in front of", "on"."""
    bearing: float = 0.0
    """TOWARDS: direction of the object from the viewing direction [rad, left is +pi/2]."""
    wide: bool = False
    """TOWARDS: anywhere in the image ("I see a plant"), not straight ahead."""
    distance: float | None = None
    """Distance, if the text gives it [m]."""
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
