"""Languages: phrases by the terminals of the one grammar, word forms, and lists of words."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, lru_cache
from importlib.resources import files
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from placegraph.errors import InputError, OptionError
from placegraph.language.measures import COUNTS
from placegraph.language.text import Phrases, Terminal
from placegraph.language.text import fold_case as spelt
from placegraph.outdoor.language.description import CARDINAL_SIGMA, DIAGONAL_SIGMA, Direction
from placegraph.outdoor.language.words import folded

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

_SYLLABLES = "\u1100"
"""From here on a letter is a syllable or more, as in Korean."""
_FOLLOWING = 3
"""So many letters may stand behind a change of a stem: Kirch|e, Wald -> Wäld|er."""
_MEMORY = 1 << 14


class Form(NamedTuple):
    """A word of a text as what it may be a form of."""

    stem: str
    case: tuple[str, ...] = ()
    """Terminals that its ending stands for: ``("FROM",)``; none for a mere plural or accusative."""


class Forms:
    """Cuts the endings of a language, of its texts and of its dictionary alike.

    Parameters
    ----------
    table
        ``endings``: endings of a text's words, by the terminals that they stand for (``""`` for
        none); ``nominative``: endings of dictionary words; ``changes``: how a stem changes before an
        ending, as "kk>k"; ``irregular``: further stems of dictionary words, as "joki>joe".
    """

    def __init__(self, table: Mapping[str, Any]) -> None:
        self.endings = sorted(
            (
                (folded(ending), tuple(key.split()))
                for key, endings in table.get("endings", {}).items()
                for ending in endings
            ),
            key=lambda entry: len(entry[0]),
        )
        self._nominative = [folded(ending) for ending in table.get("nominative", ())]
        self._changes = [tuple(folded(change).split(">")) for change in table.get("changes", ())]
        self._irregular: dict[str, list[str]] = {}
        for pair in table.get("irregular", ()):
            word, _, stem = folded(pair).partition(">")
            self._irregular.setdefault(word, []).append(stem)
        self.of = lru_cache(_MEMORY)(self._of)
        self.stems = lru_cache(_MEMORY)(self._stems)

    def __bool__(self) -> bool:
        return bool(self.endings or self._nominative)

    def _of(self, word: str) -> tuple[Form, ...]:
        """What a word of a text, without diacritics, may be a form of; the word itself first."""
        found = [Form(word)]
        for ending, case in self.endings:
            stem = word[: -len(ending)]
            if _is_stem(stem) and word.endswith(ending):
                found.append(Form(stem, case))
        return tuple(found)

    def _stems(self, word: str) -> tuple[str, ...]:
        """Stems to which endings of a text are added to make forms of a dictionary word."""
        found = [word, *self._irregular.get(word, ())]
        found += [
            word[: -len(ending)]
            for ending in self._nominative
            if word.endswith(ending) and _is_stem(word[: -len(ending)])
        ]
        for old, new in self._changes:
            for stem in tuple(found):
                at = stem.rfind(old)
                if at > 0 and len(stem) - at - len(old) <= _FOLLOWING:
                    found.append(stem[:at] + new + stem[at + len(old) :])
        return tuple(dict.fromkeys(found))

    def dictionary(self, word: str) -> tuple[Form, ...]:
        """Words that a form may belong to, guessed without a dictionary: for names of a map."""
        found = []
        for stem, case in self.of(word):
            ends = ("", *self._nominative) if len(stem) < len(word) else ("",)
            found += [Form(stem + end, case) for end in ends]
            for old, new in self._changes:
                at = stem.rfind(new)
                if len(stem) < len(word) and at > 0 and len(stem) - at - len(new) <= _FOLLOWING:
                    found.append(Form(stem[:at] + old + stem[at + len(new) :], case))
        return tuple(dict.fromkeys(found))


def _is_stem(word: str) -> bool:
    """Tell whether letters may be a stem: two of them, or a syllable."""
    return len(word) > 1 or word >= _SYLLABLES


if TYPE_CHECKING:
    _What = tuple[str, Callable[[Any], bool]]
    """What is wanted of a value, in words, and whether it is so."""

PHRASES = ("who", "determiners", "verbs", "prepositions", "joints", "plain", "after")
"""Sections whose section_keys are terminals of the grammar, one or several in a row."""
OWN = ("relations", "parts", "adverbs")
"""Sections with section_keys of their own."""
_MARKERS = ("GEN", "DROP", "UNSURE")
"""Terminals that only `order` and `settle` know."""
_ANGLES = frozenset(str(angle) for angle in range(0, 360, 45))
_SEE = "see docs/howto-language.md"


def _is_phrase_list(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(word, str) and word.strip() for word in value)


def _changes(value: object) -> bool:
    return isinstance(value, list) and all(
        isinstance(change, str) and change.count(">") == 1 for change in value
    )


def _number(key: str) -> bool:
    return key.replace(".", "", 1).isdecimal() and float(key) > 0


_WORDS: _What = ('a list of phrases, as ["the"]', _is_phrase_list)
_CHANGES: _What = ('a list of changes, as ["kk>k"]', _changes)
_FLAG: _What = ("true or false", lambda value: isinstance(value, bool))
_TEXT: _What = ("a text", lambda value: isinstance(value, str) and bool(value))
_TABLES: _What = ("a list of tables", lambda value: isinstance(value, list))
_SINGLE: dict[str, _What] = {
    "name": _TEXT, "spaces": _FLAG, "capitals": _FLAG, "prefixes": _WORDS, "scripts": _WORDS,
    "examples": _TABLES,
}  # fmt: skip
_INNER: dict[tuple[str, str], _What] = {
    ("measures", "before"): _WORDS,
    ("forms", "nominative"): _WORDS,
    ("forms", "changes"): _CHANGES,
    ("forms", "irregular"): _CHANGES,
}
_NUMBERED = (("measures", "units"), ("measures", "numbers"))


def section_keys(table: Mapping[str, Any]) -> dict[str, frozenset[str]]:
    """Keys that the sections of another language may have: the words of those that English has."""
    found = {section: _parts(table, (section,)) for section in OWN}
    terminals = _parts(table, PHRASES) | set(_MARKERS)
    return found | dict.fromkeys((*PHRASES, "endings"), terminals) | {
        "order": frozenset(
            ("postpositions", "verb_final", "marked", "genitive", "head_first", "pro_drop", "cases",
             "verbless")
        )
    }  # fmt: skip


def _parts(table: Mapping[str, Any], sections: tuple[str, ...]) -> frozenset[str]:
    return frozenset(part for s in sections for key in table.get(s, {}) for part in key.split())


def check_table(
    table: dict[str, Any], where: str, known: Mapping[str, frozenset[str]] | None
) -> dict[str, Any]:
    """Return the table of a language.

    Parameters
    ----------
    table, where
        What the file holds, and its path.
    known
        Keys by section (`section_keys`); None: any.

    Raises
    ------
    InputError
        If it is malformed; names the file, the field and what belongs there.
    """
    if "name" not in table:
        raise InputError(f"{where}: the field 'name' is missing; give the language's own name.")
    for section, value in table.items():
        if section in _SINGLE:
            _demand(value, _SINGLE[section], where, section)
        elif not isinstance(value, dict):
            raise InputError(f"{where}: the field {section!r} is no table; {_SEE}.")
        elif section in ("measures", "forms"):
            _check_nested(section, value, where, known or {})
        else:
            _check_section(section, value, where, known)
    return table


def _check_section(
    section: str,
    value: dict[str, Any],
    where: str,
    known: Mapping[str, frozenset[str]] | None,
) -> None:
    free = ("things", "lists", "say", "compass", "compass_short", "facing")
    if known is not None and section not in known and section not in free:
        raise InputError(f"{where}: there is no field {section!r}; {_SEE}.")
    for key, inner in value.items():
        angle, _, part = key.partition(" ")
        if section.startswith("compass") or section == "facing":
            of, _, whom = part.partition(" ")
            of_what = known is None or part in ("", "OF", "ME BE", *known["parts"])
            of_what = of_what or (known is not None and of == "OF" and whom in known["who"])
            right = angle in _ANGLES and of_what
            choice = ", ".join(sorted(_ANGLES))
        else:
            allowed = known.get(section) if known is not None else None
            others: frozenset[str] = frozenset()
            if known is not None and section in ("relations", "prepositions"):
                others = known["who"] | {"BE"}  # "dahinter", "yanındayım"
            right = allowed is None or (allowed | others).issuperset(key.split())
            choice = ", ".join(sorted(allowed or ()))
        if not key or not right:
            raise InputError(
                f"{where}: the key {key!r} of {section!r} is not known; choose from {choice}: {_SEE}."
            )
        flag = section == "order"
        if section != "say":
            _demand(inner, _FLAG if flag else _WORDS, where, f"{section}.{key}")


def _check_nested(
    section: str, value: dict[str, Any], where: str, known: Mapping[str, frozenset[str]]
) -> None:
    for key, inner in value.items():
        if (section, key) in _INNER:
            _demand(inner, _INNER[section, key], where, f"{section}.{key}")
            continue
        if (section, key) not in (*_NUMBERED, ("forms", "endings")):
            raise InputError(f"{where}: there is no field '{section}.{key}'; {_SEE}.")
        if not isinstance(inner, dict):
            raise InputError(f"{where}: the field '{section}.{key}' is no table; {_SEE}.")
        for name, words in inner.items():
            _demand(words, _WORDS, where, f"{section}.{key}.{name}")
            if key == "endings":
                right = known.get(key, frozenset()).issuperset(name.split())
            else:
                right = _number(name)
            if not right:
                raise InputError(
                    f"{where}: the key {name!r} of '{section}.{key}' is not known; {_SEE}."
                )


def _demand(value: object, what: _What, where: str, name: str) -> None:
    if not what[1](value):
        raise InputError(f"{where}: the field '{name}' is {value!r}; write {what[0]}.")


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
        A check_table table (`check.checked`).
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
        self.keys = section_keys(table)
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
    return Language(code, check_table(told, str(table), wanted))


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
