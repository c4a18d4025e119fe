"""Tables of the vocabulary: nameable tags (objects.tsv), words, and lexicons, shipped or the user's own."""

from __future__ import annotations

import gzip
import lzma
import re
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from placegraph.core.cache import load_or_make
from placegraph.errors import InputError
from placegraph.outdoor.language.description import Sense
from placegraph.outdoor.language.words import beginnings, fold_diacritics, normal, singular

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

COLUMNS = ("key", "values", "role", "rank", "with", "said")
OBJECT, KIND, DETAIL, SKIP = ROLES = ("object", "kind", "detail", "skip")
KIN = {
    "shop": ("shop", "amenity", "craft", "office", "leisure"),
    "office": ("office", "amenity", "healthcare", "craft"),
    "healthcare": ("healthcare", "amenity"),
    "craft": ("craft", "shop"),
}
"""Keys whose labels "x shop", "x office" ... may mean as well ("pharmacy shop")."""
SHORTEST = 4
"""Letters of the shortest word that is corrected."""
MOST = 24
"""Senses of a word, at most."""
LEAST = 0.15
"""Senses below this weight are left out."""
CALLED = 0.8
"""Weight of a label for the name that spoken.tsv gives it, where words.tsv does not list it."""
WEIGHTS = {"r": 1.0, "n": 1.0, "a": 0.95, "v": 0.85, "t": 0.7}
"""Probability of a word's meaning by its source: a raw tag value, a preset's name, an alias, a part or
variant of its name, a search term."""
DIACRITICS = 0.95
"""Factor for a word that was found only by leaving its diacritics out."""
LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz"
"""One for each language of a lexicon, in their order."""
COMMON_TERM = 12
"""A search term of more presets than this ("lunch", "transit") says nothing."""

_UNPACK: dict[str, Callable[[bytes], bytes]] = {".gz": gzip.decompress, ".xz": lzma.decompress}
_ENTRY = re.compile(r"(\d+)([a-z])([A-Za-z]+)")
"""``12nBD``: preset 12, by its name, in languages B and D."""
_VALUE = re.compile(r"[^\W_][\w:.+-]{0,39}")
"""A tag value that can be a label; free text ("The old mill, now closed") cannot."""


# files


def open_folder(path: str | Path) -> Path:
    """Return a user's folder of tables.

    Raises
    ------
    InputError
        If it is no folder.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise InputError(
            f"{folder}: it is not a folder of vocabulary tables. Give a folder with your "
            "objects.tsv or words.tsv; missing tables are taken from placegraph."
        )
    return folder


def find(name: str, folder: Path | None) -> Traversable | Path:
    """Return the table `name`, plain, .gz or .xz, from `folder` or else as shipped."""
    shipped = files("placegraph.outdoor.language.vocabulary").joinpath("data")
    for place in (shipped,) if folder is None else (folder, shipped):
        for suffix in ("", *_UNPACK):
            table = place.joinpath(name + suffix)
            if table.is_file():
                return table
    raise InputError(f"{name}: this table is missing from the installation; reinstall placegraph.")


def read_text(table: Traversable | Path) -> str:
    """Read a table as text.

    Raises
    ------
    InputError
        If it cannot be read, unpacked, or is no UTF-8 text.
    """
    unpack = _UNPACK.get(f".{table.name.rpartition('.')[2]}")
    try:
        data = table.read_bytes()
        if unpack is None:
            return data.decode("utf-8-sig")
        key = f"table-{sha256(data).hexdigest()[:16]}"
        return load_or_make(key, lambda: unpack(data), lambda text: text.decode("utf-8-sig"))
    except (OSError, EOFError, lzma.LZMAError) as error:
        raise InputError(f"{table}: cannot be read ({error}). Restore or delete it.") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{table}: is not UTF-8 text ({error}). Save it as UTF-8.") from error


def rows(
    table: Traversable | Path, columns: Sequence[str]
) -> Iterator[tuple[int, tuple[str, ...]]]:
    """Yield line number and stripped fields of every row of a small, editable table.

    Empty lines and lines that start with ``#`` are comments; the first other line must be the
    header `columns`. Fields missing at the end of a row are empty.

    Raises
    ------
    InputError
        Naming file and line, if the header is another or a row has too many fields.
    """
    header = None
    for number, line in enumerate(read_text(table).splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        fields = tuple(field.strip() for field in line.split("\t"))
        if header is None:
            header = fields
            if header != tuple(columns):
                raise InputError(
                    f"{table}, line {number}: the header must be {' '.join(columns)}"
                    f" (tab-separated), not {' '.join(header)!r}."
                )
            continue
        if len(fields) > len(columns):
            raise InputError(
                f"{table}, line {number}: {len(fields)} fields where {len(columns)}"
                f" ({', '.join(columns)}) are expected. Remove the surplus tabs."
            )
        yield number, fields + ("",) * (len(columns) - len(fields))
    if header is None:
        raise InputError(
            f"{table}: is empty; its first line must be the header {' '.join(columns)}."
        )


# lexicons


class Entry(NamedTuple):
    """One meaning of a word: a preset, and as what it is called so."""

    preset: int
    kind: str
    languages: str
    """One letter for each language of the lexicon."""


def parse_weighted_labels(text: str) -> list[tuple[str, float]]:
    """Read labels with weights: ``"leisure=pitch@0.4 sport=tennis"``; no weight means 1.

    Raises
    ------
    ValueError
        Saying which label or weight is wrong.
    """
    labels = []
    for part in text.split():
        label, _, number = part.partition("@")
        key, equals, value = label.partition("=")
        if not (key and equals and value):
            raise ValueError(f"{label!r} is not a label; write key=value or key=*")
        try:
            weight = float(number or 1)
        except ValueError:
            weight = 0.0
        if not 0.0 < weight <= 1.0:
            raise ValueError(f"the weight {number!r} of {label} is not in (0, 1]")
        labels.append((label, weight))
    return labels


class Lexicon:
    """A sorted word list: which words, in which languages, name which preset.

    Made from the iD presets by `placegraph-lab vocabulary`.

    Parameters
    ----------
    text
        First line: the languages. Second line: the labels of every preset. Then a word a line,
        tab, its entries; sorted by the word without diacritics.
    """

    def __init__(self, text: str) -> None:
        lines = text.rstrip("\n").split("\n")
        if len(lines) < 3 or "\t" not in lines[-1]:
            raise ValueError("it is not a list of words")
        self.languages = lines[0].split("\t")
        self.presets = lines[1].split("\t")
        self._lines = lines[2:]

    def __len__(self) -> int:
        return len(self._lines)

    def words(self, *, strong: bool = False) -> Iterator[str]:
        """Yield all words, in normal form; `strong` leaves mere search terms out."""
        for line in self._lines:
            if not strong or any(entry.kind != "t" for entry in _entries(line)):
                yield _word(line)

    def _lines_from(self, key: str) -> Iterator[tuple[str, str]]:
        """Yield key and line of every word from a key without diacritics on."""
        for at in range(bisect_left(self._lines, key, key=_key), len(self._lines)):
            yield _key(self._lines[at]), self._lines[at]

    def starts(self, word: str) -> bool:
        """Tell whether any entry is this word or starts with it and a space."""
        key = fold_diacritics(word)
        first = next(self._lines_from(key), ("", ""))[0]
        return bool(first) and (first == key or first.startswith(key + " "))

    def entries(self, word: str, letters: str = "") -> tuple[list[Entry], bool]:
        """Return the meanings of a word in normal form, and whether it was found with its diacritics.

        `letters`: in the languages of these letters only, if any are given.
        """
        key = fold_diacritics(word)
        near: list[Entry] = []
        for other, line in self._lines_from(key):
            if other != key:
                break
            entries = _entries(line)
            if letters:
                entries = [entry for entry in entries if set(letters) & set(entry.languages)]
            if entries and _word(line) == word:
                return entries, True
            near += entries
        return near, False

    def senses(self, word: str, *, strong: bool = False, letters: str = "") -> dict[str, float]:
        """Return labels a word may mean, with weights in (0, 1]; `strong` leaves search terms out.

        `letters`: in the languages of these letters only, if any are given.
        """
        entries, exact = self.entries(word, letters)
        if strong:
            entries = [entry for entry in entries if entry.kind in "rn"]
        terms = {entry.preset for entry in entries if entry.kind == "t"}
        named = any(entry.kind != "t" for entry in entries)
        found: dict[str, float] = {}
        for entry in entries:
            weight = WEIGHTS[entry.kind] if exact else WEIGHTS[entry.kind] * DIACRITICS
            if entry.kind == "t":
                if len(terms) > COMMON_TERM:
                    continue
                # a term shared by many presets is weak, and weaker if it is another's name
                weight *= (0.5 if named else 1.0) / len(terms) ** 0.5
            for label, share in parse_weighted_labels(self.presets[entry.preset]):
                found[label] = max(found.get(label, 0.0), weight * share)
        return found

    def letters(self, language: str) -> str:
        """Return the letters of a language and its varieties: those of "pt" are of "pt" and "pt-BR"."""
        pairs = zip(LETTERS, self.languages, strict=False)
        return "".join([letter for letter, code in pairs if code.partition("-")[0] == language])

    def find_by_prefix(self, key: str, letters: str) -> list[str]:
        """Return words in the languages of these letters that begin so without diacritics."""
        found = []
        for other, line in self._lines_from(key):
            if not other.startswith(key):
                break
            tail = line[line.index("\t") :]
            if any(letter in tail for letter in letters) and any(
                set(letters) & set(entry.languages) for entry in _entries(line)
            ):
                found.append(_word(line))
        return found

    def names(self, language: str) -> dict[str, str]:
        """Return the name of every preset, by its labels, in one of the lexicon's languages."""
        if language not in self.languages:
            return {}
        letter = LETTERS[self.languages.index(language)]
        return {
            self.presets[entry.preset]: _word(line)
            for line in self._lines
            if letter in line
            for entry in _entries(line)
            if entry.kind == "n" and letter in entry.languages
        }

    def names_of_labels(self, language: str) -> dict[tuple[str, str], str]:
        """Return preset names by language and label; a detail takes that of the first preset that has it."""
        found: dict[tuple[str, str], str] = {}
        names = self.names(language)
        for preset in sorted(names, key=lambda preset: preset.count("=")):
            label, weight = parse_weighted_labels(preset)[-1]
            if weight == 1.0:
                found.setdefault((language, label), names[preset])
        return found


def read_lexicon(table: Traversable | Path) -> Lexicon:
    """Read a lexicon.

    Raises
    ------
    InputError
        If the file is none.
    """
    try:
        return Lexicon(read_text(table))
    except ValueError as error:
        raise InputError(
            f"{table}: {error}. Create it again with `placegraph-lab vocabulary`, or delete it."
        ) from error


def _word(line: str) -> str:
    return line[: line.index("\t")]


def _key(line: str) -> str:
    return fold_diacritics(line[: line.index("\t")])


def _entries(line: str) -> list[Entry]:
    found = _ENTRY.findall(line, line.index("\t"))
    return [Entry(int(preset), kind, languages) for preset, kind, languages in found]


# objects.tsv


class Rule(NamedTuple):
    """One row of objects.tsv, for one value."""

    role: str
    rank: int = 0
    needs: tuple[str, ...] = ()
    """Tags, ``key`` or ``key=value``, of which a thing must have one."""
    template: str = "{}"
    """Words for a value, ``{}``, that no table has a better word for."""


_Hit: TypeAlias = tuple[int, str, bool, tuple[str, ...]]
"""Rank, label, whether it makes an object, what a detail needs."""


class _Values(dict[str, tuple[_Hit, ...]]):
    """Labels of every value of one key met so far; a new value is looked up in the rules once."""

    def __init__(self, key: str, rules: Mapping[str, Rule], common: Mapping[str, Rule]) -> None:
        self.key, self.rules, self.common = key, rules, common

    def __missing__(self, text: str) -> tuple[_Hit, ...]:
        hits: dict[_Hit, None] = {}
        for part in text.split(";"):
            value = "_".join(part.lower().split())
            rule = self.rules.get(value) or self.common.get(value) or self.rules.get("*")
            if not value or rule is None or rule.role == SKIP:
                continue
            if not _VALUE.fullmatch(value):
                if rule.role != OBJECT:
                    continue
                value = "yes"  # a shop of a kind told in free text is still a shop
            hits[rule.rank, f"{self.key}={value}", rule.role == OBJECT, rule.needs] = None
        self[text] = tuple(hits)
        return self[text]


class ObjectTable:
    """The rules of objects.tsv.

    Attributes
    ----------
    keys
        Keys that can make an object: what a reader needs to look at.
    detail_keys
        Keys that only add labels to an object.
    """

    def __init__(self, rules: Mapping[str, Mapping[str, Rule]]) -> None:
        self._common = rules.get("*", {})
        self._rules = {key: values for key, values in rules.items() if key != "*"}
        roles = {k: {rule.role for rule in values.values()} for k, values in self._rules.items()}
        self.keys = frozenset(key for key in roles if OBJECT in roles[key])
        self.detail_keys = (
            frozenset(key for key in roles if roles[key] & {KIND, DETAIL}) - self.keys
        )
        self._values = {k: _Values(k, values, self._common) for k, values in self._rules.items()}

    def labels_of(self, tags: Mapping[str, str]) -> tuple[str, ...]:
        """Return labels ``key=value`` of a tagged thing, most specific first; none if it is no object."""
        known = self._values
        hits: list[_Hit] = []
        for key in tags:
            if key in known:
                hits += known[key][tags[key]]
        if len(hits) == 1:
            return (hits[0][1],) if hits[0][2] else ()
        if not any(hit[2] for hit in hits):
            return ()
        hits.sort()
        return tuple([label for _, label, _, needs in hits if not needs or _any(needs, tags)])

    def names(self, label: str) -> bool:
        """Tell whether a label (also ``key=*``) can be one of a thing's labels."""
        key, _, value = label.partition("=")
        if value == "*":
            return key in self.keys or key in self.detail_keys
        return key in self._values and any(hit[1] == label for hit in self._values[key][value])

    def rule(self, label: str) -> Rule:
        """Return the rule that a nameable label falls under."""
        key, _, value = label.partition("=")
        values = self._rules[key]
        return values.get(value) or values.get("*") or next(iter(values.values()))

    def list_labels(self) -> list[str]:
        """Return the labels of objects and kinds that have a row of their own."""
        return [
            f"{key}={value}"
            for key, values in self._rules.items()
            for value, rule in values.items()
            if value != "*" and rule.role in (OBJECT, KIND)
        ]

    @cached_property
    def undrawn(self) -> frozenset[str]:
        """Values, in normal form, that are words for things no map draws: skipped, but said."""
        everywhere = [self._common, *self._rules.values()]
        skipped = [
            (v, r.template) for rules in everywhere for v, r in rules.items() if r.role == SKIP
        ]
        return frozenset(singular(normal(value)) for value, template in skipped if template != "{}")

    def by_rank(self, weights: Mapping[str, float]) -> dict[str, float]:
        """Return nameable labels, those of specific keys first."""
        known = [label for label in weights if self.names(label)]
        known.sort(key=lambda label: self.rule(label).rank)
        return {label: weights[label] for label in known}

    def split_phrase(self, form: str) -> Iterator[tuple[str, str]]:
        """Yield key and value of a phrase by the way it is built: "kite shop" is ``shop``, "kite"."""
        for key, pattern in self._patterns:
            if match := pattern.fullmatch(form):
                yield key, match[1]

    @cached_property
    def _patterns(self) -> tuple[tuple[str, re.Pattern[str]], ...]:
        """Expressions of unlisted values ("0 shop"), by key."""
        rules = [(key, values["*"]) for key, values in self._rules.items() if "*" in values]
        said = [
            (k, normal(r.template.replace("{}", " 0 "))) for k, r in rules if r.template != "{}"
        ]
        said.append(("shop", "0 store"))
        return tuple((key, re.compile(pattern.replace("0", "(.+)", 1))) for key, pattern in said)


def _any(needs: tuple[str, ...], tags: Mapping[str, str]) -> bool:
    """Tell whether tags have one of some needed, ``key`` or ``key=value``."""
    for need in needs:
        key, _, value = need.partition("=")
        if key in tags and (not value or value in tags[key].split(";")):
            return True
    return False


def read_objects(folder: Path | None = None) -> ObjectTable:
    """Read objects.tsv from `folder`, or as shipped.

    Raises
    ------
    InputError
        Naming file, line and field of what is wrong.
    """
    table = find("objects.tsv", folder)
    rules: dict[str, dict[str, Rule]] = {}
    for number, (key, values, *fields) in rows(table, COLUMNS):
        where = f"{table}, line {number}"
        if not key or not values:
            raise InputError(f"{where}: the fields 'key' and 'values' must not be empty.")
        rule = _read_rule(where, key, *fields)
        known = rules.setdefault(key, {})
        for value in values.split():
            if value in known:
                raise InputError(f"{where}: {key}={value} has a row already; keep one of the two.")
            known[value] = rule
    if not any(rule.role == OBJECT for values in rules.values() for rule in values.values()):
        raise InputError(f"{table}: no row has the role 'object'; add at least one.")
    return ObjectTable(rules)


def _read_rule(where: str, key: str, role: str, rank: str, needs: str, template: str) -> Rule:
    if role not in ROLES:
        raise InputError(f"{where}: the field 'role' is {role!r}; write {', '.join(ROLES)}.")
    if key == "*" and role != SKIP:
        raise InputError(f"{where}: a row over every key ('key' is *) can only be a skip.")
    if role != SKIP and not (rank.isascii() and rank.isdigit()):
        raise InputError(f"{where}: the field 'rank' is {rank!r}; write a whole number.")
    if needs and role not in (KIND, DETAIL):
        raise InputError(
            f"{where}: only a kind or detail can have the field 'with'; it is {needs!r}."
        )
    if template.count("{}") != bool(template):
        raise InputError(f"{where}: the field 'said' is {template!r}; write {{}} once in it.")
    return Rule(role, int(rank or 0), tuple(needs.split()), template or "{}")


# words.tsv, spoken.tsv, stop.tsv

Meanings: TypeAlias = dict[str, dict[str, float]]
"""Word in normal form -> label -> weight."""


@dataclass(frozen=True)
class WordTables:
    """Content of the hand-made tables."""

    english: Meanings
    """Replaces what the lexicon says of these words."""
    foreign: Meanings
    """Words of other languages."""
    tongues: dict[str, Meanings]
    """The same, language by language."""
    spoken: dict[tuple[str, str], str]
    """(language, label) -> everyday name."""
    stops: frozenset[str]
    """Ordinary words, in normal form, that name no thing when they stand alone."""


def read_words(objects: ObjectTable, folder: Path | None = None) -> WordTables:
    """Read words.tsv, spoken.tsv and stop.tsv from `folder`, or as shipped.

    Raises
    ------
    InputError
        Naming file, line and field of what is wrong.
    """
    english: Meanings = {}
    foreign: Meanings = {}
    tongues: dict[str, Meanings] = {}
    for where, language, words, labels in _labelled_rows("words.tsv", folder):
        meaning = english.get(normal(labels)) or _read_meaning(where, labels, objects)
        if not meaning:
            continue
        non_english = (foreign, tongues.setdefault(language.partition("-")[0], {}))
        books = (english,) if language == "en" else non_english
        for form in [normal(word) for word in words.split(",")]:
            if not form:
                raise InputError(f"{where}: the field 'words' is {words!r}; it contains no word.")
            for key in dict.fromkeys((form, fold_diacritics(form))):
                for book in books:
                    known = book.setdefault(key, {})
                    known.update({k: max(w, known.get(k, 0.0)) for k, w in meaning.items()})
    for word in list(english):  # the singular of every phrase that has no row of its own
        english.setdefault(singular(word), english[word])
    spoken = {}
    for where, language, word, label in _labelled_rows("spoken.tsv", folder):
        _read_meaning(where, label, objects)
        spoken[language, label] = word
    stops = frozenset(
        fold_diacritics(normal(word.replace("_", " ")))
        for _, (line,) in rows(find("stop.tsv", folder), ("words",))
        for word in line.split()
    )
    return WordTables(english, foreign, tongues, spoken, stops)


def _labelled_rows(name: str, folder: Path | None) -> Iterator[tuple[str, str, str, str]]:
    """Yield the line of each row of a table, its language, words and labels."""
    table, columns = find(name, folder), ("language", "words", "labels")
    for number, fields in rows(table, columns):
        where = f"{table}, line {number}"
        for column, text in zip(columns, fields, strict=True):
            if not text:
                raise InputError(f"{where}: the field {column!r} is empty.")
        yield (where, *fields)  # type: ignore[misc]  # three fields, as the header


def _read_meaning(where: str, labels: str, objects: ObjectTable) -> dict[str, float]:
    """Read labels and weights of a row, as far as objects.tsv makes them worth naming."""
    try:
        meaning = dict(parse_weighted_labels(labels))
    except ValueError as error:
        raise InputError(
            f"{where}: in the field 'labels', {error}, or an English phrase of a row above."
        ) from error
    return {label: weight for label, weight in meaning.items() if objects.names(label)}


class Sources:
    """The tables of `folder`; those missing there as shipped.

    Raises
    ------
    InputError
        Naming file, line and field of what is wrong.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder
        self.objects = read_objects(folder)
        self.words = read_words(self.objects, folder)
        self.english = read_lexicon(find("english.tsv", folder))
        self.listed = {
            normal(label.partition("=")[2]): {label: 1.0} for label in self.objects.list_labels()
        }
        """Values that have a row of their own in objects.tsv."""
        self.called: Meanings = {}
        """Names of spoken.tsv."""
        for (language, label), name in self.words.spoken.items():
            if language == "en" and not label.endswith("*"):
                self.called.setdefault(fold_diacritics(normal(name)), {})[label] = CALLED

    @cached_property
    def world(self) -> Lexicon:
        """The lexicon of all other languages: read when English does not know a word."""
        return read_lexicon(find("world.tsv", self.folder))

    @cached_property
    def prefixes(self) -> frozenset[str]:
        """All proper beginnings of English phrases."""
        return beginnings((*self.english.words(), *self.words.english, *self.words.foreign))

    @cached_property
    def solid(self) -> dict[str, str]:
        """English words without their spaces: "book store" is "bookstore"."""
        words = (*self.english.words(), *self.words.english)
        return {word.replace(" ", ""): word for word in words}

    @cached_property
    def choices(self) -> list[str]:
        """English words worth correcting a typing error to."""
        words = {*self.words.english, *self.english.words(strong=True)} - self.words.stops
        return sorted(word for word in words if len(word) >= SHORTEST)

    def rank_senses(self, weights: Mapping[str, float]) -> tuple[Sense, ...]:
        """Return senses of nameable labels, likeliest first, otherwise in the given order."""
        senses = [
            Sense(label, round(weight, 3))
            for label, weight in weights.items()
            if weight >= LEAST and self.objects.names(label)
        ]
        senses.sort(key=lambda sense: -sense.weight)
        return tuple(senses[:MOST])

    def names_in(self, language: str) -> dict[tuple[str, str], str]:
        """Return preset names by language and label."""
        lexicon = self.english if language in self.english.languages else self.world
        return lexicon.names_of_labels(language)
