"""The hand-made tables: words.tsv, spoken.tsv and stop.tsv."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from placegraph.errors import InputError
from placegraph.outdoor.language.vocabulary.lexicon import weighted
from placegraph.outdoor.language.vocabulary.tables import find, rows
from placegraph.outdoor.language.vocabulary.text import folded, normal, singular

if TYPE_CHECKING:
    from pathlib import Path

    from placegraph.outdoor.language.vocabulary.objects import ObjectTable

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
