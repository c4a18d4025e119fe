"""Lexicons: compact sorted word lists made from the iD presets by `placegraph-lab vocabulary`."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from placegraph.errors import InputError
from placegraph.outdoor.language.vocabulary.tables import read_text
from placegraph.outdoor.language.vocabulary.text import folded

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

KINDS = {"r": 1.0, "n": 1.0, "a": 0.95, "v": 0.85, "t": 0.7}
"""How likely a word is meant so: a raw tag value, a preset's name, an alias, a part or variant of
its name, a search term."""
DIACRITICS = 0.95
"""Factor for a word that was found only by leaving its diacritics out."""
LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz"
"""One for each language of a lexicon, in their order."""
CROWD = 12
"""A search term of more presets than this ("lunch", "transit") says nothing."""

_ENTRY = re.compile(r"(\d+)([a-z])([A-Za-z]+)")
"""``12nBD``: preset 12, by its name, in languages B and D."""


class Entry(NamedTuple):
    """One meaning of a word: a preset, and as what it is called so."""

    preset: int
    kind: str
    languages: str
    """One letter for each language of the lexicon."""


def weighted(text: str) -> list[tuple[str, float]]:
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
            raise ValueError(f"{label!r} is no label; write key=value or key=*")
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

    Parameters
    ----------
    text
        First line: the languages. Second line: the labels of every preset. Then a word a line,
        tab, its entries; sorted by the word without diacritics.
    """

    def __init__(self, text: str) -> None:
        lines = text.rstrip("\n").split("\n")
        if len(lines) < 3 or "\t" not in lines[-1]:
            raise ValueError("it is no list of words")
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

    def starts(self, word: str) -> bool:
        """Tell whether any entry is this word or starts with it and a space."""
        key = folded(word)
        at = bisect_left(self._lines, key, key=_key)
        if at == len(self._lines):
            return False
        first = _key(self._lines[at])
        return first == key or first.startswith(key + " ")

    def entries(self, word: str, letters: str = "") -> tuple[list[Entry], bool]:
        """Meanings of a word in normal form, and whether it was found with its diacritics.

        `letters`: in the languages of these letters only, if any are given.
        """
        key = folded(word)
        at = bisect_left(self._lines, key, key=_key)
        near: list[Entry] = []
        while at < len(self._lines) and _key(self._lines[at]) == key:
            entries = _entries(self._lines[at])
            if letters:
                entries = [entry for entry in entries if set(letters) & set(entry.languages)]
            if entries and _word(self._lines[at]) == word:
                return entries, True
            near += entries
            at += 1
        return near, False

    def senses(self, word: str, *, strong: bool = False, letters: str = "") -> dict[str, float]:
        """Labels a word may mean, with weights in (0, 1]; `strong` leaves search terms out.

        `letters`: in the languages of these letters only, if any are given.
        """
        entries, exact = self.entries(word, letters)
        if strong:
            entries = [entry for entry in entries if entry.kind in "rn"]
        terms = {entry.preset for entry in entries if entry.kind == "t"}
        named = any(entry.kind != "t" for entry in entries)
        found: dict[str, float] = {}
        for entry in entries:
            weight = KINDS[entry.kind] if exact else KINDS[entry.kind] * DIACRITICS
            if entry.kind == "t":
                if len(terms) > CROWD:
                    continue
                # a term shared by many presets is weak, and weaker if it is another's name
                weight *= (0.5 if named else 1.0) / len(terms) ** 0.5
            for label, share in weighted(self.presets[entry.preset]):
                found[label] = max(found.get(label, 0.0), weight * share)
        return found

    def letters(self, language: str) -> str:
        """Letters of a language and its varieties: those of "pt" are of "pt" and "pt-BR"."""
        return "".join(
            letter
            for letter, code in zip(LETTERS, self.languages, strict=False)
            if code.partition("-")[0] == language
        )

    def beginning(self, key: str, letters: str) -> list[str]:
        """Words in the languages of these letters that begin so without diacritics."""
        at = bisect_left(self._lines, key, key=_key)
        found = []
        while at < len(self._lines) and _key(self._lines[at]).startswith(key):
            line = self._lines[at]
            tail = line[line.index("\t") :]
            if any(letter in tail for letter in letters) and any(
                set(letters) & set(entry.languages) for entry in _entries(line)
            ):
                found.append(_word(line))
            at += 1
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
        """Preset names by language and label; a detail takes the name of the first preset that has it."""
        found: dict[tuple[str, str], str] = {}
        for preset, name in sorted(
            self.names(language).items(), key=lambda item: item[0].count("=")
        ):
            labels = weighted(preset)
            if labels[-1][1] == 1.0:
                found.setdefault((language, labels[-1][0]), name)
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
            f"{table}: {error}. Make it anew by `placegraph-lab vocabulary`, or delete it."
        ) from error


def _word(line: str) -> str:
    return line[: line.index("\t")]


def _key(line: str) -> str:
    return folded(line[: line.index("\t")])


def _entries(line: str) -> list[Entry]:
    found = _ENTRY.findall(line, line.index("\t"))
    return [Entry(int(preset), kind, languages) for preset, kind, languages in found]
