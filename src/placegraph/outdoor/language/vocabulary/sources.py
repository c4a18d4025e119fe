"""All tables of a vocabulary, read once."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

from placegraph.outdoor.language.description import Sense
from placegraph.outdoor.language.vocabulary.lexicon import Lexicon, read_lexicon
from placegraph.outdoor.language.vocabulary.objects import read_objects
from placegraph.outdoor.language.vocabulary.tables import find
from placegraph.outdoor.language.vocabulary.text import beginnings, folded, normal
from placegraph.outdoor.language.vocabulary.words import read_words

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

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
