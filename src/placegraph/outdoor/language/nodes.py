"""What the grammar makes of a clause: things, places said of them, and the clause itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from placegraph.outdoor.language.lexicon import NORTH, Direction

if TYPE_CHECKING:
    from placegraph.outdoor.language.description import Sense


@dataclass(slots=True)
class Noun:
    """Value of a NOUN or NAME: what it may be on a map."""

    senses: tuple[Sense, ...] = ()
    name: str = ""
    exact: bool = False
    """Whether it is a label as a map has it, and no English."""


@dataclass(slots=True)
class Thing:
    """Somebody or something spoken of, in one place of the text."""

    kind: str
    """``ME YOU IT SPOT HERE`` or ``thing``."""
    start: int
    end: int
    determiner: str = ""
    """Terminal of the determiner: ``DET A ANOTHER NO NUM MY ...``, or empty."""
    count: int | None = None
    senses: tuple[Sense, ...] = ()
    head: str = ""
    """Common noun, lower-case: "bakery"; the last unknown word where there is none."""
    modifiers: tuple[str, ...] = ()
    """Words before the noun: "grey", "main"."""
    exact: bool = False
    """Whether the noun is a label as a map has it, and no English."""
    name: str = ""
    part: str = ""
    """Of a part of a thing: ``corner middle block ...``."""


@dataclass(slots=True)
class Place:
    """What is said of where something is: "50 m north of the church"."""

    how: str
    """Rule of the grammar: ``towards side possessed at prep across between ...``."""
    start: int
    end: int
    targets: tuple[Thing, ...] = ()
    word: str = ""
    """Which preposition: ``ON IN AT TO``, or a relation of lexicon.toml."""
    direction: Direction = NORTH
    """Of directions."""
    distance: float | None = None
    part: str = ""
    owner: str = ""
    """``MY YOUR ITS``."""
    negated: bool = False


@dataclass(slots=True)
class Clause:
    """One clause: a verb, what stands before it and after it."""

    verb: str
    """Rule of the grammar: ``fragment is_ exists sees meets goes too_far``."""
    before: tuple[Thing | Place, ...] = ()
    after: tuple[Thing | Place, ...] = ()
    negated: bool = False
    condition: bool = False
    """"if you see ...", "when you get to ...", "until ..."."""
    travel: str = ""
    """``GO PASS CROSS FOLLOW REACH``."""
    certainty: float = 1.0
    start: int = 0
    end: int = 0
