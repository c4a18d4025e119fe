"""The English words of the grammar, from lexicon.toml."""

from __future__ import annotations

import tomllib
from functools import cached_property, lru_cache
from importlib.resources import files
from math import radians
from typing import TYPE_CHECKING, NamedTuple

from placegraph.language.measures import COUNTS
from placegraph.language.phrases import Phrases, Terminal

if TYPE_CHECKING:
    from collections.abc import Iterator

CARDINAL_SIGMA, DIAGONAL_SIGMA, SHARP_SIGMA, LOOSE_SIGMA = 0.5, 0.4, 0.25, 0.6
"""How loosely people mean "north", "north-east", "directly north", "mostly north" [rad]."""


class Direction(NamedTuple):
    """A direction of the compass, or of the body."""

    bearing: float
    """[rad], clockwise from north or, if `facing`, from where the speaker faces."""
    sigma: float = CARDINAL_SIGMA
    facing: bool = False
    certainty: float = 1.0


NORTH = Direction(0.0)


class Lexicon(Phrases):
    """The phrases of the grammar, and plain lists of words."""

    def __init__(
        self,
        known: dict[tuple[str, ...], tuple[Terminal, ...]],
        lists: dict[str, frozenset[str]],
    ) -> None:
        super().__init__(known)
        self.lists = lists

    @cached_property
    def compass(self) -> dict[str, Direction]:
        """Directions of the compass by their names in one word."""
        return {
            word: terminals[0].value
            for word, entries in self.by_word.items()
            for phrase, terminals in entries
            if terminals[0].type == "DIR" and not terminals[0].value.facing and len(phrase) == 1
        }


@lru_cache(maxsize=1)
def english() -> Lexicon:
    """Read the lexicon that comes with placegraph."""
    table = tomllib.loads(files(__package__).joinpath("lexicon.toml").read_text("utf-8"))
    lists = {name: frozenset(words) for name, words in table.pop("lists").items()}
    known: dict[tuple[str, ...], tuple[Terminal, ...]] = {}
    for section, entries in table.items():
        for key, phrases in entries.items():
            for phrase in phrases:
                words = tuple(phrase.split())
                known.setdefault(words, tuple(_terminals(section, key, words)))
    return Lexicon(known, lists)


def _terminals(section: str, key: str, words: tuple[str, ...]) -> Iterator[Terminal]:
    match section:
        case "compass" | "compass_short" | "facing":
            degrees = int(key)
            sigma = DIAGONAL_SIGMA if degrees % 90 else CARDINAL_SIGMA
            direction = Direction(radians(degrees), sigma, facing=section == "facing")
            yield Terminal("SHORT" if section == "compass_short" else "DIR", direction)
        case "relations":
            yield Terminal("PREP", key)
        case "parts":
            yield Terminal("PART", key)
        case "adverbs":
            yield Terminal("ADVERB", key)
        case _:
            for terminal in key.split():
                if terminal in ("SEVERAL", "MANY"):
                    yield Terminal("NUM", next((COUNTS[w] for w in words if w in COUNTS), None))
                else:
                    yield Terminal(terminal)
