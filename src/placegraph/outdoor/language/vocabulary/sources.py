"""All tables of a vocabulary, read once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TypeAlias

from placegraph.errors import InputError
from placegraph.outdoor.language.description import Sense
from placegraph.outdoor.language.vocabulary.lexicon import Lexicon, read_lexicon, weighted
from placegraph.outdoor.language.vocabulary.objects import ObjectTable, read_objects
from placegraph.outdoor.language.vocabulary.tables import find, rows
from placegraph.outdoor.language.vocabulary.text import beginnings, folded, normal, singular

SHORTEST = 4
"""Letters of the shortest word that is corrected."""
MOST = 24
"""Senses of a word, at most."""
LEAST = 0.15
"""Senses below this weight are left out."""
CALLED = 0.8
"""Weight of a label for the name that spoken.tsv gives it, where words.tsv does not list it."""


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
            normal(label.partition("=")[2]): {label: 1.0} for label in self.objects.listed()
        }
        """Values that have a row of their own in objects.tsv."""
        self.called: dict[str, dict[str, float]] = {}
        """Names of spoken.tsv."""
        for (language, label), name in self.words.spoken.items():
            if language == "en" and not label.endswith("*"):
                self.called.setdefault(folded(normal(name)), {})[label] = CALLED

    @cached_property
    def world(self) -> Lexicon:
        """The lexicon of all other languages: read when English does not know a word."""
        return read_lexicon(find("world.tsv", self.folder))

    @cached_property
    def prefixes(self) -> frozenset[str]:
        """All proper beginnings of English phrases."""
        return beginnings((*self.english.words(), *self.words.english, *self.words.others))

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

    def ranked(self, found: Mapping[str, float]) -> tuple[Sense, ...]:
        """Senses of nameable labels, likeliest first, otherwise in the given order."""
        senses = [
            Sense(label, round(weight, 3))
            for label, weight in found.items()
            if weight >= LEAST and self.objects.names(label)
        ]
        senses.sort(key=lambda sense: -sense.weight)
        return tuple(senses[:MOST])

    def names_in(self, language: str) -> dict[tuple[str, str], str]:
        """Preset names by language and label; a detail takes the name of the first preset that has it."""
        lexicon = self.english if language in self.english.languages else self.world
        return lexicon.names_of_labels(language)


Meanings: TypeAlias = dict[str, dict[str, float]]
"""Word in normal form -> label -> weight."""


@dataclass(frozen=True)
class Words:
    """What the hand-made tables say."""

    english: Meanings
    """Replaces what the lexicon says of these words."""
    others: Meanings
    """Words of other languages."""
    tongues: dict[str, Meanings]
    """The same, language by language."""
    spoken: dict[tuple[str, str], str]
    """(language, label) -> everyday name."""
    stops: frozenset[str]
    """Ordinary words, in normal form, that name no thing when they stand alone."""


def read_words(objects: ObjectTable, folder: Path | None = None) -> Words:
    """Read words.tsv, spoken.tsv and stop.tsv from `folder`, or as shipped.

    Raises
    ------
    InputError
        Naming file, line and field of what is wrong.
    """
    english: Meanings = {}
    others: Meanings = {}
    tongues: dict[str, Meanings] = {}
    for where, language, words, labels in _rows("words.tsv", folder):
        meaning = english.get(normal(labels)) or _meaning(where, labels, objects)
        if not meaning:
            continue
        foreign = (others, tongues.setdefault(language.partition("-")[0], {}))
        books = (english,) if language == "en" else foreign
        for word in words.split(","):
            form = normal(word)
            if not form:
                raise InputError(f"{where}: the field 'words' is {words!r}; it names no word.")
            for key in dict.fromkeys((form, folded(form))):
                for book in books:
                    known = book.setdefault(key, {})
                    known.update({k: max(w, known.get(k, 0.0)) for k, w in meaning.items()})
    _singulars(english)
    spoken = {}
    for where, language, word, label in _rows("spoken.tsv", folder):
        _meaning(where, label, objects)
        spoken[language, label] = word
    stops = frozenset(
        folded(normal(word.replace("_", " ")))
        for _, (line,) in rows(find("stop.tsv", folder), ("words",))
        for word in line.split()
    )
    return Words(english, others, tongues, spoken, stops)


def _rows(name: str, folder: Path | None) -> list[tuple[str, str, str, str]]:
    """Rows of a table of language, words and labels, each with where it stands."""
    table = find(name, folder)
    found = []
    for number, (language, words, labels) in rows(table, ("language", "words", "labels")):
        where = f"{table}, line {number}"
        for field, text in (("language", language), ("words", words), ("labels", labels)):
            if not text:
                raise InputError(f"{where}: the field {field!r} is empty.")
        found.append((where, language, words, labels))
    return found


def _meaning(where: str, labels: str, objects: ObjectTable) -> dict[str, float]:
    """Labels and weights of a row, as far as objects.tsv makes them worth naming."""
    try:
        meaning = dict(weighted(labels))
    except ValueError as error:
        raise InputError(
            f"{where}: in the field 'labels', {error}, or an English phrase of a row above."
        ) from error
    return {label: weight for label, weight in meaning.items() if objects.names(label)}


def _singulars(book: Meanings) -> None:
    """Add the singular of every phrase that has no row of its own."""
    for word in list(book):
        book.setdefault(singular(word), book[word])
