"""The words of one language, in all their forms."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

from placegraph.outdoor.language.description import Sense
from placegraph.outdoor.language.vocabulary.text import folded, normal

if TYPE_CHECKING:
    from placegraph.outdoor.language.languages import Language
    from placegraph.outdoor.language.languages.forms import Form
    from placegraph.outdoor.language.vocabulary.vocabulary import Vocabulary

LONGEST = 5
"""Words of the longest phrase that is looked up."""
_KEY = 2
"""Letters by which words are put into bins."""
_CLEAR = 0.75
"""Weight that the best sense of a lone word must have: more than that of a search term."""
_MEMORY = 1 << 13


class Found(NamedTuple):
    """A phrase of a text in the dictionary."""

    word: str
    """Its dictionary form, without diacritics."""
    senses: tuple[Sense, ...]
    case: tuple[str, ...]
    """Terminals that its last word's ending stands for."""


class LanguageWords:
    """What the chunker needs of a vocabulary (`words.Words`), of one language.

    Parameters
    ----------
    vocabulary
        Says what English words and tags mean, and holds the tables of all languages.
    language
        Its forms, and everyday words of its own.
    """

    def __init__(self, vocabulary: Vocabulary, language: Language) -> None:
        self.language, self.vocabulary = language, vocabulary
        sources = vocabulary.sources
        self._world = sources.world
        self._own: dict[str, dict[str, tuple[Sense, ...]]] = {}
        """Words without diacritics, each with its spellings: in Swedish "bank" and "bänk"."""
        for meaning, words in language.things.items():
            senses = vocabulary.senses(meaning)
            for word in words:
                spelt = self._own.setdefault(folded(normal(word)), {})
                merged = {s.label: s.weight for s in (*senses, *spelt.get(normal(word), ()))}
                spelt[normal(word)] = sources.ranked(merged)
        for word, labels in sources.words.tongues.get(language.code, {}).items():
            self._own.setdefault(folded(word), {word: sources.ranked(labels)})
        self._letters = self._world.letters(language.code)
        self._articles = language.lists["articles"].intersection(language.prefixes)
        self._prefixes = frozenset(language.prefixes)
        self._bins: dict[str, dict[str, list[str]]] = {}
        self._own_bins: dict[str, list[str]] = {}
        for word in self._own:
            # stems may differ in their first letters, too: "міст", "мосту"
            for key in {stem[:_KEY] for stem in self.language.forms.stems(word.partition(" ")[0])}:
                self._own_bins.setdefault(key, []).append(word)
        self.find = lru_cache(_MEMORY)(self._find)

    def senses(self, phrase: str) -> tuple[Sense, ...]:
        """Labels a phrase may stand for, likeliest first; a tag's value where the language has no word."""
        found = self.find(phrase)
        if found is not None:
            return found.senses
        tag = "_" in phrase or "=" in phrase
        return self.vocabulary.senses(phrase) if tag else ()

    def longest_match(
        self, tokens: Sequence[str], start: int = 0
    ) -> tuple[int, tuple[Sense, ...]] | None:
        """Longest phrase that begins at `start`: number of words and senses."""
        for n in range(min(LONGEST, len(tokens) - start), 0, -1):
            words = tokens[start : start + n]
            if n == 1 and words[0] in self.language.counts:
                continue
            if n > 1 and not all(normal(word) for word in words):
                continue
            # an article inside a name of a thing: "בית ה|ספר"
            bare = [word for word in words[1:-1] if word not in self._articles]
            found = self.find(" ".join((words[0], *bare, *words[1:][-1:])))
            if found is None and not self._prefixes.isdisjoint(words[1:-1]):
                found = self.find(self._joined(words))
            if found is not None and found.senses[0].weight >= (_CLEAR if n == 1 else 0.0):
                return n, found.senses
        return None

    def _joined(self, words: Sequence[str]) -> str:
        """Words with the prefixes inside a name of a thing written onto them: "طريق مشي ب|ال|أقدام"."""
        joined = ""
        for word in words:
            joined += word if word in self._prefixes else f"{word} "
        return joined.rstrip()

    def closest(self, phrase: str, *, cutoff: float) -> tuple[str, float] | None:
        """Most similar known phrase; none is guessed in other languages than English."""
        del phrase, cutoff
        return None

    def unknown(self, phrase: str) -> str:
        """Say why a phrase has no senses."""
        del phrase
        return "unknown word"

    def known(self, word: str) -> bool:
        """Tell whether a word or phrase is one of things, in any form."""
        return self.find(word) is not None

    def begins(self, word: str) -> bool:
        """Tell whether a phrase for a thing begins with a word, in any form."""
        forms = self.language.forms.of(folded(normal(word)))
        return any(self._beginning(form.stem) for form in forms)

    def _find(self, phrase: str) -> Found | None:
        """Look a phrase up: as it stands, then by its stems, the longest first."""
        words = folded(normal(phrase)).split(" ")
        if not words[0]:
            return None
        forms = [self.language.forms.of(word) for word in words]
        last = {form.stem: form.case for form in reversed(forms[-1])}
        for own, first in itertools.product((True, False), forms[0]):
            best: tuple[int, str, tuple[str, ...]] | None = None
            for entry in self._beginning(first.stem):
                if (entry in self._own) is not own:
                    continue
                case = self._case(entry.split(" "), forms, first.stem, last)
                # a word as it stands before one whose own ending had to be cut as well
                if case is not None and (best is None or len(entry) < best[0]):
                    best = (len(entry), entry, case)
            if best is not None and (senses := self._senses(best[1], normal(phrase))):
                return Found(best[1], senses, best[2])
        return None

    def _case(
        self,
        entry: list[str],
        forms: Sequence[tuple[Form, ...]],
        first: str,
        last: Mapping[str, tuple[str, ...]],
    ) -> tuple[str, ...] | None:
        """Case of a phrase as a form of an entry of the dictionary; None if it is none."""
        if len(entry) != len(forms):
            return None
        stems = self.language.forms.stems
        if len(entry) == 1:
            bare = first != entry[0] and first == forms[0][0].stem
            return ("GEN",) if bare and self.language.order.cases else last[first]
        for word, could_be in zip(entry[1:-1], forms[1:-1], strict=True):
            known = {form.stem for form in could_be}
            if known.isdisjoint(stems(word)):
                return None
        ends = stems(entry[-1])
        return next((form.case for form in forms[-1] if form.stem in ends), None)

    def _beginning(self, stem: str) -> list[str]:
        """Phrases of the dictionary whose first word has this stem."""
        key = stem[:_KEY]
        if key not in self._bins:
            letters, world = self._letters, self._world
            words = {folded(word) for word in world.beginning(key, letters)} if letters else set()
            bins: dict[str, list[str]] = {}
            for word in sorted({*words, *self._own_bins.get(key, ())}):
                for first in self.language.forms.stems(word.partition(" ")[0]):
                    bins.setdefault(first, []).append(word)
            self._bins[key] = bins
        return self._bins[key].get(stem, [])

    def _senses(self, entry: str, phrase: str) -> tuple[Sense, ...]:
        """Senses of an entry, by its spelling that is most like that of a phrase."""
        if entry in self._own:
            spelt = self._own[entry]
            if len(spelt) == 1:
                return next(iter(spelt.values()))
            from rapidfuzz.distance import Prefix

            return spelt[max(spelt, key=lambda word: Prefix.similarity(word, phrase))]
        sources = self.vocabulary.sources
        found = self._world.senses(entry, letters=self._letters)
        return sources.ranked(sources.objects.by_rank(found))
