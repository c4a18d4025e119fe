"""Words to labels and labels to words, of English texts and of any one language."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from placegraph.outdoor.language.description import Sense
from placegraph.outdoor.language.vocabulary.tables import KIN, SHORTEST, Sources, open_folder
from placegraph.outdoor.language.words import (
    ARTICLES,
    beginnings,
    correct_word,
    find_similar,
    fold_diacritics,
    normal,
    singular,
)

if TYPE_CHECKING:
    from placegraph.outdoor.language.languages import Form, Language

LONGEST = 5
"""Words of the longest phrase that is looked up."""
_KEY = 2
"""Letters by which words are put into bins."""
_CLEAR = 0.75
"""Weight that the best sense of a lone word must have: more than that of a search term."""
_MEMORY = 1 << 13


class DictionaryEntry(NamedTuple):
    """A phrase of a text in the dictionary."""

    word: str
    """Its dictionary form, without diacritics."""
    senses: tuple[Sense, ...]
    case: tuple[str, ...]
    """Terminals that its last word's ending stands for."""


class LanguageWords:
    """Words of one language, as far as the chunker needs them.

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
                spelt = self._own.setdefault(fold_diacritics(normal(word)), {})
                merged = {s.label: s.weight for s in (*senses, *spelt.get(normal(word), ()))}
                spelt[normal(word)] = sources.rank_senses(merged)
        for word, labels in sources.words.tongues.get(language.code, {}).items():
            self._own.setdefault(fold_diacritics(word), {word: sources.rank_senses(labels)})
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
        """Return labels a phrase may stand for, likeliest first; a tag's value where there is no word."""
        found = self.find(phrase)
        if found is not None:
            return found.senses
        tag = "_" in phrase or "=" in phrase
        return self.vocabulary.senses(phrase) if tag else ()

    def longest_match(
        self, tokens: Sequence[str], start: int = 0
    ) -> tuple[int, tuple[Sense, ...]] | None:
        """Return the longest phrase that begins at `start`: number of words and senses."""
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
                # prefixes inside a name: "طريق مشي ب|ال|أقدام"
                parts = [word if word in self._prefixes else f"{word} " for word in words]
                found = self.find("".join(parts).rstrip())
            if found is not None and found.senses[0].weight >= (_CLEAR if n == 1 else 0.0):
                return n, found.senses
        return None

    def contains(self, word: str) -> bool:
        """Tell whether a word or phrase is one of things, in any form."""
        return self.find(word) is not None

    def begins(self, word: str) -> bool:
        """Tell whether a phrase for a thing begins with a word, in any form."""
        forms = self.language.forms.of(fold_diacritics(normal(word)))
        return any(self._beginning(form.stem) for form in forms)

    def _find(self, phrase: str) -> DictionaryEntry | None:
        """Look a phrase up: as it stands, then by its stems, the longest first."""
        words = fold_diacritics(normal(phrase)).split(" ")
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
                return DictionaryEntry(best[1], senses, best[2])
        return None

    def _case(
        self,
        entry: list[str],
        forms: Sequence[tuple[Form, ...]],
        first: str,
        last: Mapping[str, tuple[str, ...]],
    ) -> tuple[str, ...] | None:
        """Return the case of a phrase as a form of an entry of the dictionary; None if it is none."""
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
        """Return the phrases of the dictionary whose first word has this stem."""
        key = stem[:_KEY]
        if key not in self._bins:
            letters, world = self._letters, self._world
            words = (
                {fold_diacritics(word) for word in world.find_by_prefix(key, letters)}
                if letters
                else set()
            )
            bins: dict[str, list[str]] = {}
            for word in sorted({*words, *self._own_bins.get(key, ())}):
                for first in self.language.forms.stems(word.partition(" ")[0]):
                    bins.setdefault(first, []).append(word)
            self._bins[key] = bins
        return self._bins[key].get(stem, [])

    def _senses(self, entry: str, phrase: str) -> tuple[Sense, ...]:
        """Return the senses of an entry, by its spelling that is most like that of a phrase."""
        if entry in self._own:
            spelt = self._own[entry]
            if len(spelt) == 1:
                return next(iter(spelt.values()))
            from rapidfuzz.distance import Prefix

            return spelt[max(spelt, key=lambda word: Prefix.similarity(word, phrase))]
        sources = self.vocabulary.sources
        found = self._world.senses(entry, letters=self._letters)
        return sources.rank_senses(sources.objects.by_rank(found))


_ASIDE = 0.6
"""Factor for tags of a word's name that its row in words.tsv does not list."""
_GUESS = 0.6
"""Weight of ``shop=x`` for "x shop", where nothing is known of x."""
UNKNOWN = "unknown word"
NOT_DRAWN = "is known, but never on a city map"
_TAG = re.compile(r"([\w:]+)=(\*|[\w:.+-]+)")


class Vocabulary:
    """Nameable things of a map, and the words that name them.

    `default()` is the one that comes with placegraph; `load(folder)` reads edited tables.
    Immutable, apart from what it remembers of earlier questions.

    Attributes
    ----------
    keys
        OpenStreetMap keys that can make an object: a reader need look at no others.
    detail_keys
        Keys that only add labels to an object.
    stops
        Ordinary English words that `longest_match` and `closest` leave alone.
    of
        Words of one `languages.Language` alone, in all their forms.
    """

    def __init__(self, sources: Sources | None = None, labels: Iterable[str] = ()) -> None:
        sources = sources or Sources()
        self.sources, self._objects, self._words = sources, sources.objects, sources.words
        self._english = sources.english
        self.keys, self.detail_keys = sources.objects.keys, sources.objects.detail_keys
        self.stops = sources.words.stops
        self._own: dict[str, dict[str, float]] = {}
        for label in labels:
            value = label.partition("=")[2]
            if value not in ("yes", "*"):
                self._own.setdefault(singular(fold_diacritics(normal(value))), {})[label] = 1.0
        self._starts = beginnings((*self._own, *self._objects.undrawn))
        self._known = lru_cache(_MEMORY)(self._look_up)
        self._meant = lru_cache(_MEMORY)(self._guess)
        self._opens = lru_cache(_MEMORY)(self._begins)
        self._lone = lru_cache(_MEMORY)(self._find_single_word)
        self._near = lru_cache(_MEMORY)(self._nearest)
        self._names = lru_cache(None)(sources.names_in)
        self.of = lru_cache(None)(partial(LanguageWords, self))

    def of_map(self, labels: Iterable[str]) -> Vocabulary:
        """Return a vocabulary that knows every tag value among the labels of a map as well."""
        return Vocabulary(self.sources, labels)

    @staticmethod
    @lru_cache(maxsize=1)
    def default() -> Vocabulary:
        """Return the vocabulary that comes with placegraph."""
        return Vocabulary()

    @staticmethod
    def load(path: str | Path) -> Vocabulary:
        """Read a user's folder of edited tables; tables missing there are taken as shipped.

        Raises
        ------
        InputError
            Naming file, line and field of what is wrong.
        """
        from placegraph.outdoor.language.languages import language

        folder = open_folder(path)
        for table in (folder / "languages").glob("*.toml"):
            language(table.stem, folder)
        return Vocabulary(Sources(folder))

    def labels_of(self, tags: Mapping[str, str]) -> tuple[str, ...]:
        """Return labels ``key=value`` of a tagged thing, most specific first; none if it is no object."""
        return self._objects.labels_of(tags)

    def senses(self, phrase: str) -> tuple[Sense, ...]:
        """Return the possible meanings of a word or phrase on a map, likeliest first; none if unknown.

        Takes everyday words, tag values (``bicycle_parking``), tags (``amenity=bench``), singular
        or plural, with or without an article, in any language of the vocabulary.
        """
        return self._meant(phrase)

    def longest_match(
        self, tokens: Sequence[str], start: int = 0
    ) -> tuple[int, tuple[Sense, ...]] | None:
        """Return the longest phrase of at most `LONGEST` tokens that starts at `start` and names a thing.

        Ordinary words (`stops`) match only within a longer phrase. Returns how many tokens, and
        what they may mean: nothing for what OpenStreetMap knows and no city map draws.
        """
        best = None
        phrase = ""
        for length, token in enumerate(tokens[start : start + LONGEST], 1):
            if not normal(token) and token not in ("'", "'s", "’s", "&"):
                break  # punctuation ends a phrase
            phrase = f"{phrase} {token}" if phrase else token
            senses = self._lone(phrase) if length == 1 else self._known(phrase)
            if senses and not (length > 1 and all(self._is_stop(word) for word in phrase.split())):
                best = (length, senses)
            elif self._undrawn(phrase):
                best = (length, ())
            if not self._opens(phrase):
                break
        return best

    def closest(self, phrase: str, *, cutoff: float = 0.85) -> tuple[str, float] | None:
        """Return the known English word nearest to a misspelt one, and how near it is (Jaro-Winkler).

        At most one letter may differ, two in words of eight letters or more; words of up to
        three letters and ordinary English words are left alone.
        """
        found = self._near(fold_diacritics(normal(phrase)))
        return found if found and found[1] >= cutoff else None

    def explain_unknown(self, phrase: str) -> str:
        """Say why a phrase has no senses: "unknown word; did you mean beach or bench?"."""
        if self._undrawn(phrase) or self._undrawn(phrase.rpartition(" ")[2]):
            return NOT_DRAWN
        near = find_similar(
            singular(fold_diacritics(normal(phrase))), [*self.sources.choices, *self._own]
        )
        return f"{UNKNOWN}; did you mean {' or '.join(near)}?" if near else UNKNOWN

    def _undrawn(self, phrase: str) -> bool:
        """Tell whether a phrase is only known as a tag value that no city map draws."""
        return singular(
            fold_diacritics(normal(phrase))
        ) in self._objects.undrawn and not self._known(phrase)

    def name_label(self, label: str, *, language: str = "en") -> str:
        """Return the everyday name of a label: ``amenity=cafe`` -> "cafe".

        Lower case, in the singular. Where the language has none, English is used.
        """
        key, _, value = label.partition("=")
        labels = (label, f"{key}=*") if value == "yes" else (label,)
        for tongue in dict.fromkeys((language, "en")):
            for table in (self._words.spoken, self._names(tongue)):
                for name in labels:
                    if word := table.get((tongue, name)):
                        return word
        value = " ".join(re.split(r"[_:-]", value))
        if value in ("*", "yes"):
            return key.partition(":")[0].replace("_", " ")
        return (
            self._objects.rule(label).template.format(value)
            if self._objects.names(label)
            else value
        )

    @cached_property
    def english(self) -> dict[str, tuple[str, ...]]:
        """English words by the label they mean first: ``amenity=cafe`` -> "cafe", "coffee shop"."""
        found: dict[str, list[str]] = {}
        for word in dict.fromkeys((*self._words.english, *self._english.words())):
            senses = self.senses(word)
            if senses and senses[0].weight >= _CLEAR:
                found.setdefault(senses[0].label, []).append(word)
        return {label: tuple(words) for label, words in found.items()}

    def _begins(self, phrase: str) -> bool:
        """Tell whether a longer known phrase may begin with this one."""
        form = normal(phrase)
        forms = dict.fromkeys((form, singular(fold_diacritics(form))))
        return any(
            form in self._starts
            or form in self.sources.prefixes
            or (not self._is_stop(form) and self.sources.world.starts(form))
            for form in forms
        )

    def _look_up(self, phrase: str) -> tuple[Sense, ...]:
        """Return the senses that the tables give a phrase."""
        tag = _TAG.fullmatch(phrase.strip())
        if tag:
            return self.sources.rank_senses({tag[0]: 1.0})
        form = normal(phrase)
        if not form:
            return ()
        plain = fold_diacritics(form)
        for word in dict.fromkeys((plain, singular(plain))):
            if senses := self._in_english(word):
                return senses
        forms = dict.fromkeys((form, plain, singular(form)))
        for word in forms:
            if senses := self.sources.rank_senses(self._words.foreign.get(word, {})):
                return senses
        for word in () if self._is_stop(plain) else forms:
            if senses := self.sources.rank_senses(
                self._objects.by_rank(self.sources.world.senses(word))
            ):
                return senses
        return ()

    def _in_english(self, word: str) -> tuple[Sense, ...]:
        """Return the senses of an English word: its row in words.tsv, then tags and presets of its name."""
        made = self._words.english.get(word)
        tagged = self._english.senses(word, strong=made is not None) or self.sources.listed.get(
            word, {}
        )
        if made is not None:
            tagged = {label: _ASIDE * weight for label, weight in tagged.items()}
        found = dict(made or {})
        for others in (self._objects.by_rank(tagged), self.sources.called.get(word, {})):
            for label, weight in others.items():
                if label not in (made or {}):
                    found[label] = max(weight, found.get(label, 0.0))
        values = {label.partition("=")[2] for label in found}
        aside = _ASIDE if found else 1.0
        for label in self._own.get(word, ()):
            if aside == 1.0 or label.partition("=")[2] in values:
                found.setdefault(label, aside)
        return self.sources.rank_senses(found)

    def _find_single_word(self, token: str) -> tuple[Sense, ...]:
        """Return the senses of a single word of a text: no ordinary word, no mere English search term."""
        form = fold_diacritics(normal(token))
        if self._is_stop(form):
            return ()
        senses = self._known(token)
        forms = (form, singular(form))
        books = (self._words.english, self._own)
        if any(word in book for book in books for word in forms) or any(
            self._english.senses(word) for word in forms
        ):
            return senses if senses and senses[0].weight >= _CLEAR else ()
        foreign = len(form) >= SHORTEST or not token.isascii() or form in self._words.foreign
        return senses if foreign else ()

    def _is_stop(self, word: str) -> bool:
        """Tell whether a normal form without diacritics is an ordinary word."""
        return word in self.stops or singular(word) in self.stops

    def _guess(self, phrase: str) -> tuple[Sense, ...]:
        """Return the senses of a phrase: by the tables, without its article, or by the way it is built."""
        known = self._known(phrase)
        if known:
            return known
        form = normal(phrase)
        first, _, rest = form.partition(" ")
        if rest and first in ARTICLES:
            return self._meant(rest)
        joined = fold_diacritics(form).replace(" ", "")
        if rest and joined in self.sources.solid:
            return self._known(self.sources.solid[joined])
        return self._built(form)

    def _built(self, form: str) -> tuple[Sense, ...]:
        """Return the senses of "x shop", "x office", "x building" ...: a kind of shop, office, building."""
        found: dict[str, float] = {}
        for key, value in self._objects.split_phrase(form):
            inner = {
                sense.label: sense.weight
                for sense in self._meant(value)
                if sense.label.partition("=")[0] in KIN.get(key, (key,))
            }
            found |= inner or {f"{key}={value.replace(' ', '_')}": _GUESS, f"{key}=*": _GUESS / 2}
        return self.sources.rank_senses(found)

    def _nearest(self, form: str) -> tuple[str, float] | None:
        if self._known(form) and not self._is_stop(form):
            return form, 1.0
        mendable = len(form) >= SHORTEST and not self._is_stop(form)
        return correct_word(form, self.sources.choices) if mendable else None
