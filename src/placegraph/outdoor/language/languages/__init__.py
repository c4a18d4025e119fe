"""Languages: phrases by the terminals of the one grammar, word forms, and lists of words."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, lru_cache
from importlib.resources import files
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from placegraph.errors import InputError, OptionError
from placegraph.language.text import COUNTS, Phrases, Terminal, fold_case
from placegraph.outdoor.language.description import CARDINAL_SIGMA, DIAGONAL_SIGMA, Direction
from placegraph.outdoor.language.words import correct_word, fold_diacritics, spell_sounds

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

PHRASES = ("who", "determiners", "verbs", "prepositions", "joints", "plain", "after")
"""Sections whose keys are terminals of the grammar, one or several in a row."""
OWN = ("relations", "parts", "adverbs")
"""Sections with keys of their own."""
SPOKEN = (
    "who", "determiners", "verbs", "prepositions", "relations", "compass", "compass_short",
    "facing", "adverbs", "joints", "parts", "plain", "after",
)  # fmt: skip
"""Sections of phrases; the first that has a phrase counts."""
_MARKERS = ("GEN", "DROP", "UNSURE")
"""Terminals that only `word_order` and `clauses` know."""
_OF_LABELS = ("line_keys", "no_lines", "area_keys")
"""Lists that speak of labels, and are the same in every language."""
_ANGLES = frozenset(str(angle) for angle in range(0, 360, 45))
_ANGLED = ("compass", "compass_short", "facing")
_SEE = "see docs/howto-language.md"
_MEMORY = 1 << 14
_ALIKE = 0.93
"""Similarity (Jaro-Winkler) from which an unknown word is a misspelt one."""
_SURELY = 5
"""Letters of a word that is longer than most that differ in one letter."""


@dataclass(frozen=True)
class Order:
    """In what order a language speaks; see docs/howto-language.md."""

    postpositions: bool = False
    """A relation stands behind its thing: "kirkon vieressä"."""
    verb_final: bool = False
    """The verb ends its clause: "kita ni kyōkai ga aru"."""
    marked: bool = False
    """A thing before its postposition always has an ending or a particle."""
    genitive: bool = False
    """A thing follows its direction or part without a word between: "nördlich der Kirche"."""
    head_first: bool = False
    """Modifiers follow their noun: "côté nord", "Hôtel de la Gare"; "à côté de" is one word."""
    pro_drop: bool = False
    """A verb needs no subject: "está al norte"."""
    cases: bool = False
    """An owner stands in the genitive behind what it owns: "brama parku"."""
    verbless: bool = False
    """Statements of places need no verb: "слева парк"."""


@dataclass(frozen=True)
class Measures:
    """Units and numbers of a language."""

    units: Mapping[str, float] = field(default_factory=dict)
    """Metres in a unit, by all its forms."""
    numbers: Mapping[str, float] = field(default_factory=dict)
    before: tuple[str, ...] = ()
    """Words before a number that say nothing: "etwa"."""


class Form(NamedTuple):
    """A word of a text as what it may be a form of."""

    stem: str
    case: tuple[str, ...] = ()
    """Terminals that its ending stands for: ``("FROM",)``; none for a mere plural or accusative."""


class Forms:
    """Cuts endings, of texts and dictionary alike: "kirkosta" meets "kirkko" and says "from" it.

    Parameters
    ----------
    table
        ``endings``: endings of a text's words, by the terminals that they stand for (``""`` for
        none); ``nominative``: endings of dictionary words; ``changes``: how a stem changes before an
        ending, as "kk>k"; ``irregular``: further stems of dictionary words, as "joki>joe".
    """

    def __init__(self, table: Mapping[str, Any]) -> None:
        endings = [
            (fold_diacritics(ending), tuple(key.split()))
            for key, listed in table.get("endings", {}).items()
            for ending in listed
        ]
        self.endings = sorted(endings, key=lambda entry: len(entry[0]))
        self._nominative = [fold_diacritics(ending) for ending in table.get("nominative", ())]
        self._changes = [
            tuple(fold_diacritics(change).split(">")) for change in table.get("changes", ())
        ]
        self._irregular: dict[str, list[str]] = {}
        for pair in table.get("irregular", ()):
            word, _, stem = fold_diacritics(pair).partition(">")
            self._irregular.setdefault(word, []).append(stem)
        self.of = lru_cache(_MEMORY)(self._of)
        self.stems = lru_cache(_MEMORY)(self._stems)

    def __bool__(self) -> bool:
        return bool(self.endings or self._nominative)

    def _of(self, word: str) -> tuple[Form, ...]:
        """Return the possible base forms of a word without diacritics; the word itself first."""
        cut = [
            (word[: -len(ending)], case) for ending, case in self.endings if word.endswith(ending)
        ]
        return (Form(word), *[Form(stem, case) for stem, case in cut if _is_stem(stem)])

    def _stems(self, word: str) -> tuple[str, ...]:
        """Return the stems to which endings of a text are added to make forms of a dictionary word."""
        found = [word, *self._irregular.get(word, ())]
        cut = [word[: -len(ending)] for ending in self._nominative if word.endswith(ending)]
        found += [stem for stem in cut if _is_stem(stem)]
        for old, new in self._changes:
            found += [changed for stem in found if (changed := _change(stem, old, new))]
        return tuple(dict.fromkeys(found))

    def dictionary(self, word: str) -> tuple[Form, ...]:
        """Return words that a form may belong to, guessed without a dictionary: for names of a map."""
        found = []
        for stem, case in self.of(word):
            cut = len(stem) < len(word)
            found += [Form(stem + end, case) for end in (("", *self._nominative) if cut else ("",))]
            changed = [_change(stem, new, old) for old, new in self._changes if cut]
            found += [Form(other, case) for other in changed if other]
        return tuple(dict.fromkeys(found))


def _is_stem(word: str) -> bool:
    """Tell whether letters may be a stem: two of them, or a syllable, as in Korean."""
    return len(word) > 1 or word >= "\u1100"


def _change(stem: str, old: str, new: str) -> str:
    """Return a stem with letters near its end changed (Wald -> Wäld|er); empty if they are not there."""
    at = stem.rfind(old)
    near = at > 0 and len(stem) - at - len(old) <= 3
    return stem[:at] + new + stem[at + len(old) :] if near else ""


class Language(Phrases):
    """The phrases of a language, plain lists of words, and how its words bend and follow each other.

    Parameters
    ----------
    code
        ISO 639-1: "en".
    table
        A checked table (`check_table`).
    """

    def __init__(self, code: str, table: Mapping[str, Any]) -> None:
        self.code, self.name = code, str(table["name"])
        self.spaces: bool = table.get("spaces", True)
        """Whether spaces stand between words."""
        self.grammar: bool = table.get("grammar", True)
        """Whether its sentences are read better than by names and kinds of things alone."""
        self.capitals: bool = table.get("capitals", code == "en")
        """Whether a capital marks a name, and no common noun."""
        self.order = Order(**table.get("order", {}))
        measures = table.get("measures", {})
        units, numbers = (
            {w: float(n) for n, words in measures.get(key, {}).items() for w in words}
            for key in ("units", "numbers")
        )
        self.measures = Measures(units, numbers, tuple(measures.get("before", ())))
        self.forms = Forms(table.get("forms", {}))
        self.prefixes: tuple[str, ...] = tuple(table.get("prefixes", ()))
        """Words that are written onto the next word: "l'", "ال"; the longest first."""
        self.things: Mapping[str, list[str]] = table.get("things", {})
        """Everyday words of things, by what they mean: an English word or a tag."""
        self.say: Mapping[str, Any] = table.get("say", {})
        """Phrases of statements: frames with slots, and inflections of a noun in a slot."""
        self._compass: Mapping[str, list[str]] = table.get("compass", {})
        counts = {fold_case(word): int(n) for word, n in numbers.items() if n >= 1}
        self.counts: Mapping[str, int] = COUNTS if code == "en" else counts
        super().__init__(_read_phrases(table, self.counts))
        self.keys = section_keys(table)
        """Keys that sections of other tables may have, where it is English."""
        listed = table.get("lists", {})
        self.lists = {name: frozenset(map(fold_case, words)) for name, words in listed.items()}
        """Lists of words; those of labels are taken from English."""
        if code != "en":
            shared = {name: english().lists[name] for name in _OF_LABELS}
            names = (*english().lists, "street_prefixes", "place_prefixes")
            self.lists = {
                name: self.lists.get(name, shared.get(name, frozenset())) for name in names
            }

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
        return any(form.stem in self._thing_stems for form in self.forms.of(fold_diacritics(word)))

    @cached_property
    def _thing_stems(self) -> frozenset[str]:
        words = {fold_diacritics(word) for listed in self.things.values() for word in listed}
        return frozenset(stem for word in words for stem in self.forms.stems(word))

    def respell(self, word: str) -> str:
        """Return the word of the grammar or of a thing that an unknown word is a misspelling of.

        The word itself is returned if there is none.
        """
        sound = spell_sounds(word, self.code)
        if sound in self._sounding:
            return self._sounding[sound]
        near = correct_word(word, self._long_words)
        return near[0] if near and near[1] > _ALIKE else word

    @cached_property
    def _sounding(self) -> dict[str, str]:
        """Words of its grammar and of things by how they sound."""
        things = {
            word
            for listed in self.things.values()
            for phrase in listed
            for word in fold_case(phrase).split()
        }
        return {
            spell_sounds(word, self.code): word for word in (*sorted(things), *sorted(self.words))
        }

    @cached_property
    def _long_words(self) -> list[str]:
        return [word for word in self._sounding.values() if len(word) > _SURELY]

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
        """Stems of the endings of names of roads."""
        return tuple(stem for word in self.lists["road_words"] for stem in self.forms.stems(word))

    def said_of_compass(self, degrees: int) -> tuple[str, ...]:
        """Return the ways to say a direction of the compass, the commonest first."""
        return tuple(self._compass.get(str(degrees), ()))

    @cached_property
    def words(self) -> frozenset[str]:
        """All words of its phrases."""
        entries = [entry for listed in self.by_word.values() for entry in listed]
        return frozenset(word for phrase, _ in entries for word in phrase)


def tables(folder: Path | None = None) -> dict[str, Traversable | Path]:
    """Return tables of languages by their codes: shipped ones, and those of a folder."""
    places: list[Traversable | Path] = [files(__package__)]
    if folder is not None and (folder / "languages").is_dir():
        places.append(folder / "languages")
    listed = [table for place in places for table in place.iterdir()]
    return {table.name[:-5]: table for table in listed if table.name.endswith(".toml")}


def codes(folder: Path | None = None) -> tuple[str, ...]:
    """Return the codes of the languages that can be read."""
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
        content = tomllib.loads(table.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{table}: it is not a language table ({error}).") from error
    if (code, folder) != ("en", None):
        check_table(content, str(table), english().keys)
    return Language(code, content)


def english() -> Language:
    """Return English, the richest language, and that of everything that is not recognised."""
    return language("en")


def _read_phrases(
    table: Mapping[str, Any], counts: Mapping[str, int]
) -> dict[tuple[str, ...], tuple[Terminal, ...]]:
    """Read the phrases of a table, and the terminals that they stand for."""
    known: dict[tuple[str, ...], tuple[Terminal, ...]] = {}
    for section in SPOKEN:
        for key, phrases in table.get(section, {}).items():
            for phrase in phrases:
                words: list[str] = []
                for word in fold_case(phrase).split():
                    rest = word
                    for prefix in table.get("prefixes", ()):  # "l'autre", as in a scanned text
                        if (
                            prefix.endswith("'")
                            and rest.startswith(prefix)
                            and len(rest) > len(prefix) + 1
                        ):
                            words.append(prefix)
                            rest = rest.removeprefix(prefix)
                    words.append(rest)
                terminals = tuple(_terminals(section, key, words, counts))
                known.setdefault(tuple(words), terminals)
    return known


def _terminals(
    section: str, key: str, words: Sequence[str], counts: Mapping[str, int]
) -> Iterator[Terminal]:
    """Yield the terminals that a phrase under a key of a section stands for."""
    first, *others = key.split()
    match section:
        case "compass" | "compass_short" | "facing":
            part = key.partition(" ")[2]
            sigma = DIAGONAL_SIGMA if int(first) % 90 else CARDINAL_SIGMA
            direction = Direction(radians(int(first)), sigma, facing=section == "facing")
            yield Terminal("SHORT" if section == "compass_short" else "DIR", direction)
            if part.startswith(("OF", "ME")):  # "севернее", "kuzeyimde", "kuzeyindeyim"
                yield from map(Terminal, others)
            elif part:  # "nordseite": the north side
                yield Terminal("PART", part)
        case "relations":
            yield Terminal("PREP", first)
            yield from map(Terminal, others)  # "dahinter": behind it
        case "parts":
            yield Terminal("PART", key)
        case "adverbs":
            yield Terminal("ADVERB", key)
        case "after":
            yield Terminal("AFTER", tuple(key.split()))
        case _:
            count = next((counts[word] for word in words if word in counts), None)
            for terminal in (first, *others):
                counted = terminal in ("SEVERAL", "MANY")
                yield Terminal("NUM", count) if counted else Terminal(terminal)


# tables


def _is_list_of(value: object, is_valid: Callable[[str], object]) -> bool:
    return isinstance(value, list) and all(
        isinstance(word, str) and is_valid(word) for word in value
    )


_Requirement = tuple[str, Callable[[Any], bool]]
"""Description of a valid value, and a test of one."""
_WORDS: _Requirement = (
    'a list of phrases, as ["the"]',
    lambda value: _is_list_of(value, str.strip),
)
_CHANGES: _Requirement = (
    'a list of changes, as ["kk>k"]',
    lambda value: _is_list_of(value, lambda change: change.count(">") == 1),
)
_FLAG: _Requirement = ("true or false", lambda value: isinstance(value, bool))
_FIELDS: dict[str, _Requirement] = {
    "name": ("a text", lambda value: isinstance(value, str) and bool(value)),
    "examples": ("a list of tables", lambda value: isinstance(value, list)),
    "spaces": _FLAG, "capitals": _FLAG, "grammar": _FLAG, "prefixes": _WORDS, "scripts": _WORDS,
    "measures.before": _WORDS, "forms.nominative": _WORDS,
    "forms.changes": _CHANGES, "forms.irregular": _CHANGES,
}  # fmt: skip
_NUMBERED = ("measures.units", "measures.numbers")
_FREE = ("things", "lists", "say")


def section_keys(table: Mapping[str, Any]) -> dict[str, frozenset[str]]:
    """Return the keys that sections of other languages may have: the words of English keys."""
    parts = {
        section: frozenset(part for key in table.get(section, {}) for part in key.split())
        for section in (*OWN, *PHRASES)
    }
    terminals = frozenset(_MARKERS).union(*[parts[section] for section in PHRASES])
    return {
        **{section: parts[section] for section in OWN},
        "relations": parts["relations"] | terminals,  # "dahinter", "yanındayım"
        **dict.fromkeys((*PHRASES, "forms.endings"), terminals),
        "order": frozenset(Order.__dataclass_fields__),
    }


def check_table(table: Mapping[str, Any], where: str, keys: Mapping[str, frozenset[str]]) -> None:
    """Check the table of a language.

    Parameters
    ----------
    table, where
        Content of the file, and its path.
    keys
        Keys by section (`section_keys`).

    Raises
    ------
    InputError
        If it is malformed; names the file, the field and what belongs there.
    """
    if "name" not in table:
        raise InputError(f"{where}: the field 'name' is missing; give the language's own name.")
    for section, value in table.items():
        fields = {section: value}
        if section in ("measures", "forms") and isinstance(value, dict):
            fields = {f"{section}.{name}": inner for name, inner in value.items()}
        for field_, content in fields.items():
            if field_ in _FIELDS:
                _require(content, _FIELDS[field_], where, field_)
            elif field_ not in (*keys, *_FREE, *_ANGLED, *_NUMBERED):
                raise InputError(f"{where}: the field {field_!r} is unknown; {_SEE}.")
            elif not isinstance(content, dict):
                raise InputError(f"{where}: the field {field_!r} is not a table; {_SEE}.")
            else:
                _check_entries(field_, content, where, keys)


def _check_entries(
    section: str, entries: Mapping[str, Any], where: str, keys: Mapping[str, frozenset[str]]
) -> None:
    for key, value in entries.items():
        if not _is_key(section, key, keys):
            choice = ", ".join(sorted(keys.get(section, _ANGLES if section in _ANGLED else ())))
            choose = f"choose from {choice}: {_SEE}" if choice else _SEE
            raise InputError(f"{where}: the key {key!r} of {section!r} is unknown; {choose}.")
        if section != "say":
            _require(value, _FLAG if section == "order" else _WORDS, where, f"{section}.{key}")


def _is_key(section: str, key: str, keys: Mapping[str, frozenset[str]]) -> bool:
    if section in _NUMBERED:
        return key.replace(".", "", 1).isdecimal() and float(key) > 0
    if section in _ANGLED:
        angle, _, part = key.partition(" ")
        of, _, owner = part.partition(" ")
        whose = of == "OF" and owner in keys["who"]
        return angle in _ANGLES and (whose or part in ("", "OF", "ME BE", *keys["parts"]))
    known = section in _FREE or keys[section].issuperset(key.split())
    return known and (bool(key) or section == "forms.endings")


def _require(value: object, requirement: _Requirement, where: str, name: str) -> None:
    if not requirement[1](value):
        raise InputError(f"{where}: the field '{name}' is {value!r}; write {requirement[0]}.")


def translate(text: str, code: str) -> str:
    """Translate the sentences of a reason or a question; those that the table lacks stay English."""
    for pattern, sentence in _sentences(code):
        found = pattern.search(text)
        if found:
            text = text[: found.start()] + sentence.format(*found.groups()) + text[found.end() :]
    joined = "” and “"
    return text.replace(joined, translate_option(joined, code))


def translate_option(option: str, code: str) -> str:
    """Translate an option of a question; a name stays as it is."""
    return read_answers().get(code, {}).get(option, option)


@cache
def read_options() -> dict[str, str]:
    """Read options of questions in English, by what they are in every language."""
    tables = read_answers().values()
    return {said: known for t in tables for known, said in t.items() if known[-1].isalpha()}


@cache
def read_answers() -> dict[str, dict[str, str]]:
    """Read sentences and options of every language of the table, by what they are in English."""
    return tomllib.loads((files("placegraph.outdoor.language") / "answers.toml").read_text("utf-8"))


@cache
def _sentences(code: str) -> list[tuple[re.Pattern[str], str]]:
    """Return patterns of English sentences, the longest first, and their translations."""
    table = read_answers().get(code, {})
    found = sorted((e for e in table if e[-1] in ".?"), key=len, reverse=True)
    return [(re.compile(re.escape(e).replace(r"\{\}", "(.+?)")), table[e]) for e in found]
