"""A language: phrases by the terminals of the one grammar that they stand for, and lists of words."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from importlib.resources import files
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Any

from placegraph.errors import InputError, OptionError
from placegraph.language.measures import COUNTS
from placegraph.language.words import Phrases, Terminal, spelt
from placegraph.outdoor.language.languages.check import checked, keys
from placegraph.outdoor.language.languages.forms import Forms
from placegraph.outdoor.language.vocabulary.text import folded
from placegraph.outdoor.language.words import CARDINAL_SIGMA, DIAGONAL_SIGMA, Direction

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

SPOKEN = (
    "who", "determiners", "verbs", "prepositions", "relations", "compass", "compass_short",
    "facing", "adverbs", "joints", "parts", "plain", "after",
)  # fmt: skip
"""Sections of phrases."""
_OF_LABELS = ("line_keys", "no_lines", "area_keys")
"""Lists that speak of labels, and are the same in every language."""


@dataclass(frozen=True)
class Order:
    """In what order a language speaks; see docs/howto-language.md."""

    postpositions: bool = False
    """What relates stands behind its thing: "kirkon vieressä"."""
    verb_final: bool = False
    """The verb ends its clause: "kita ni kyōkai ga aru"."""
    marked: bool = False
    """A thing before its postposition always has an ending or a particle."""
    genitive: bool = False
    """A thing follows its direction or part without a word between: "nördlich der Kirche"."""
    head_first: bool = False
    """What is said of a noun follows it: "côté nord", "Hôtel de la Gare"; "à côté de" is one word."""
    pro_drop: bool = False
    """A verb needs no subject: "está al norte"."""
    cases: bool = False
    """What a thing belongs to stands behind it in the genitive: "brama parku"."""
    verbless: bool = False
    """Where something is can be said without a verb: "слева парк"."""


@dataclass(frozen=True)
class Measures:
    """How a language counts and measures."""

    units: Mapping[str, float] = field(default_factory=dict)
    """Metres in a unit, by all its forms."""
    numbers: Mapping[str, float] = field(default_factory=dict)
    before: tuple[str, ...] = ()
    """Words before a number that say nothing: "etwa"."""


class Language(Phrases):
    """The phrases of a language, plain lists of words, and how its words bend and follow each other.

    Parameters
    ----------
    code
        ISO 639-1: "en".
    table
        A checked table (`check.checked`).
    """

    def __init__(self, code: str, table: Mapping[str, Any]) -> None:
        self.code, self.name = code, str(table["name"])
        self.spaces: bool = table.get("spaces", True)
        """Whether spaces stand between words."""
        self.capitals: bool = table.get("capitals", code == "en")
        """Whether a capital marks a name, and no common noun."""
        self.order = Order(**table.get("order", {}))
        measures = table.get("measures", {})
        self.measures = Measures(
            _by_word(measures.get("units", {})),
            _by_word(measures.get("numbers", {})),
            tuple(measures.get("before", ())),
        )
        self.forms = Forms(table.get("forms", {}))
        self.prefixes: tuple[str, ...] = tuple(table.get("prefixes", ()))
        """What is written onto the next word: "l'", "ال"; the longest first."""
        self.things: Mapping[str, list[str]] = table.get("things", {})
        """Everyday words of things, by what they mean: an English word or a tag."""
        self.say: Mapping[str, Any] = table.get("say", {})
        """How a statement is said: frames with slots, and what is done to a noun in a slot."""
        self._compass: Mapping[str, list[str]] = table.get("compass", {})
        counts = {spelt(word): int(n) for word, n in self.measures.numbers.items() if n >= 1}
        self.counts: Mapping[str, int] = COUNTS if code == "en" else counts
        super().__init__(_phrases(table, self.counts))
        self.keys = keys(table)
        """Keys that sections of other tables may have, where it is English."""
        self.lists = _lists(code, table.get("lists", {}))

    @cached_property
    def compass(self) -> dict[str, Direction]:
        """Directions of the compass by their names in one word."""
        return {
            word: terminals[0].value
            for word, entries in self.by_word.items()
            for phrase, terminals in entries
            if terminals[0].type == "DIR" and not terminals[0].value.facing and len(phrase) == 1
        }

    def has_thing(self, word: str) -> bool:
        """Tell whether a word is one of its everyday words of things, in any form."""
        return any(form.stem in self._thing_stems for form in self.forms.of(folded(word)))

    @cached_property
    def _thing_stems(self) -> frozenset[str]:
        words = {folded(word) for spelt in self.things.values() for word in spelt}
        return frozenset(stem for word in words for stem in self.forms.stems(word))

    def is_road(self, name: Sequence[str]) -> bool:
        """Tell whether a name, as `words.tokens`, is that of a street."""
        if not name:
            return False
        if self.code == "en":
            return name[-1] in self.lists["road_words"]
        if name[0] in self.lists["street_prefixes"]:
            return True
        return any(form.stem.endswith(self._road_ends) for form in self.forms.of(name[-1]))

    @cached_property
    def _road_ends(self) -> tuple[str, ...]:
        """How names of roads end before an ending is added."""
        return tuple(stem for word in self.lists["road_words"] for stem in self.forms.stems(word))

    def said_of_compass(self, degrees: int) -> tuple[str, ...]:
        """Ways to say a direction of the compass, the commonest first."""
        return tuple(self._compass.get(str(degrees), ()))

    @cached_property
    def words(self) -> frozenset[str]:
        """All words of its phrases."""
        return frozenset(
            word for entries in self.by_word.values() for phrase, _ in entries for word in phrase
        )


def tables(folder: Path | None = None) -> dict[str, Traversable | Path]:
    """Tables of languages by their codes: those that come with placegraph, and those of a folder."""
    found: dict[str, Traversable | Path] = {}
    own = folder / "languages" if folder is not None else None
    for place in (files(__package__), own if own is not None and own.is_dir() else None):
        for table in () if place is None else place.iterdir():
            if table.name.endswith(".toml"):
                found[table.name[:-5]] = table
    return found


def codes(folder: Path | None = None) -> tuple[str, ...]:
    """Codes of the languages that can be read."""
    return tuple(sorted(tables(folder)))


@cache
def language(code: str, folder: Path | None = None) -> Language:
    """Read the table of a language: shipped, or in the folder ``languages`` of a user's `folder`.

    Raises
    ------
    OptionError
        If there is none; lists the codes.
    InputError
        If it is malformed; names the file and the field.
    """
    known = tables(folder)
    if code not in known:
        raise OptionError(
            f"language is {code!r}; choose one of {', '.join(sorted(known))}, or leave it out."
        )
    table = known[code]
    try:
        told = tomllib.loads(table.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{table}: is no table of a language ({error}).") from error
    wanted = None if code == "en" else english().keys
    return Language(code, checked(told, str(table), wanted))


def english() -> Language:
    """Return English, the richest language, and that of everything that is not recognised."""
    return language("en")


def _by_word(words: Mapping[str, list[str]]) -> dict[str, float]:
    return {phrase: float(number) for number, phrases in words.items() for phrase in phrases}


def _lists(code: str, lists: Mapping[str, list[str]]) -> dict[str, frozenset[str]]:
    """Lists of words; those of labels are taken from English."""
    found = {name: frozenset(map(spelt, words)) for name, words in lists.items()}
    if code == "en":
        return found
    theirs = english().lists
    theirs = theirs | {"street_prefixes": frozenset(), "place_prefixes": frozenset()}
    return {
        name: found.get(name, theirs[name] if name in _OF_LABELS else frozenset())
        for name in theirs
    }


def _phrases(
    table: Mapping[str, Any], counts: Mapping[str, int]
) -> dict[tuple[str, ...], tuple[Terminal, ...]]:
    known: dict[tuple[str, ...], tuple[Terminal, ...]] = {}
    for section in SPOKEN:
        for key, phrases in table.get(section, {}).items():
            for phrase in phrases:
                words = tuple(
                    part
                    for word in spelt(phrase).split()
                    for part in _cut(word, table.get("prefixes", ()))
                )
                known.setdefault(words, tuple(_terminals(section, key, words, counts)))
    return known


def _cut(word: str, prefixes: Sequence[str]) -> Iterator[str]:
    """Cut elided words off a word of a phrase, as `scan` does in a text: "l'autre"."""
    for prefix in prefixes:
        rest = word.removeprefix(prefix)
        if prefix.endswith("'") and 2 <= len(rest) < len(word):
            yield prefix
            word = rest
    yield word


def _terminals(
    section: str, key: str, words: tuple[str, ...], counts: Mapping[str, int]
) -> Iterator[Terminal]:
    match section:
        case "compass" | "compass_short" | "facing":
            angle, _, part = key.partition(" ")
            degrees = int(angle)
            sigma = DIAGONAL_SIGMA if degrees % 90 else CARDINAL_SIGMA
            direction = Direction(radians(degrees), sigma, facing=section == "facing")
            yield Terminal("SHORT" if section == "compass_short" else "DIR", direction)
            if part.startswith(("OF", "ME")):  # "севернее", "kuzeyimde", "kuzeyindeyim"
                yield from map(Terminal, part.split())
            elif part:  # "nordseite": the north side
                yield Terminal("PART", part)
        case "relations":
            relation, *others = key.split()
            yield Terminal("PREP", relation)
            yield from map(Terminal, others)  # "dahinter": behind it
        case "parts":
            yield Terminal("PART", key)
        case "adverbs":
            yield Terminal("ADVERB", key)
        case "after":
            yield Terminal("AFTER", tuple(key.split()))
        case _:
            for terminal in key.split():
                if terminal in ("SEVERAL", "MANY"):
                    yield Terminal("NUM", next((counts[w] for w in words if w in counts), None))
                else:
                    yield Terminal(terminal)
