"""A language: phrases by the terminals of the one grammar that they stand for, and lists of words."""

from __future__ import annotations

import tomllib
from functools import cache, cached_property
from importlib.resources import files
from math import radians
from typing import TYPE_CHECKING

from placegraph.errors import OptionError
from placegraph.language.measures import COUNTS
from placegraph.language.phrases import Phrases, Terminal
from placegraph.outdoor.language.words import CARDINAL_SIGMA, DIAGONAL_SIGMA, Direction

if TYPE_CHECKING:
    from collections.abc import Iterator


class Language(Phrases):
    """The phrases of a language, and plain lists of words.

    Attributes
    ----------
    code
        ISO 639-1: "en".
    lists
        Words of the language by what they are: suffixes, articles, persons ...
    """

    def __init__(
        self,
        code: str,
        known: dict[tuple[str, ...], tuple[Terminal, ...]],
        lists: dict[str, frozenset[str]],
    ) -> None:
        super().__init__(known)
        self.code, self.lists = code, lists

    @cached_property
    def compass(self) -> dict[str, Direction]:
        """Directions of the compass by their names in one word."""
        return {
            word: terminals[0].value
            for word, entries in self.by_word.items()
            for phrase, terminals in entries
            if terminals[0].type == "DIR" and not terminals[0].value.facing and len(phrase) == 1
        }


def shipped() -> tuple[str, ...]:
    """Codes of the languages that come with placegraph."""
    tables = [table.name for table in files(__package__).iterdir()]
    return tuple(sorted(name[:-5] for name in tables if name.endswith(".toml")))


@cache
def language(code: str) -> Language:
    """Read the table of a language.

    Raises
    ------
    OptionError
        If there is none; lists the codes.
    """
    if code not in shipped():
        raise OptionError(
            f"language is {code!r}; choose one of {', '.join(shipped())}, or leave it out."
        )
    table = tomllib.loads(files(__package__).joinpath(f"{code}.toml").read_text("utf-8"))
    lists = {name: frozenset(words) for name, words in table.pop("lists").items()}
    known: dict[tuple[str, ...], tuple[Terminal, ...]] = {}
    for section, entries in table.items():
        for key, phrases in entries.items():
            for phrase in phrases:
                words = tuple(phrase.split())
                known.setdefault(words, tuple(_terminals(section, key, words)))
    return Language(code, known, lists)


def english() -> Language:
    """Return English, the richest: what is not in a language's own lists is taken from it."""
    return language("en")


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
