"""Chunks: the words of a text, grouped into the terminals of the grammar."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace

from placegraph.language.grammar import Chunk
from placegraph.language.text import Word, fold_case, parse_count
from placegraph.outdoor.language.description import Sense
from placegraph.outdoor.language.grammar import NounMeaning
from placegraph.outdoor.language.languages import Language
from placegraph.outdoor.language.proper_names import LONGEST_NOUN, InflectedNames, ProperNames
from placegraph.outdoor.language.scan import (
    Stretch,
    find_labels,
    is_shouting,
    scan_any,
    scan_english,
)
from placegraph.outdoor.language.vocabulary import LanguageWords, Vocabulary
from placegraph.outdoor.language.word_order import order_chunks
from placegraph.outdoor.language.words import NameFinder, fold

_OPEN = frozenset(
    ("WORD", "GO", "PASS", "CROSS", "PART", "ADVERB", "PREP", "FACE", "SEE", "BE", "REACH", "SPOT")
)
"""Terminals whose words may also begin or be a phrase of the vocabulary."""
_BEFORE_NOUN = frozenset(("DET", "THIS", "A", "ANOTHER", "NUM", "NO", "MY", "YOUR", "ITS", "WORD"))
_NOUN_AFTER = frozenset(("DET", "A", "ANOTHER", "NUM", "NO", "MY", "EXISTS", "HAVE", "SEE", "OF"))
_LONGEST_SENTENCE = 120
"""Chunks that are brought into order together; nobody speaks in longer sentences."""
_RAW_WORD = re.compile(r"[^\W_]+(?:['’`´״׳\"]{1,2}[^\W_]+)*")
_QUOTES = tuple('「『“„«"')
_STOP = re.compile(r"[^\s\"'׳״-]")
"""What stands between no two words of a name."""
LONGEST = 8
"""Words of the longest name that is looked for in a raw text."""
_SHORTEST = 4
"""Letters of the shortest word that is held for a misspelt one."""


class Chunker:
    """Groups the words of one sentence after the other.

    Parameters
    ----------
    vocabulary
        Common nouns.
    names
        Proper names, or None where there is no map.
    """

    def __init__(
        self,
        text: str,
        language: Language,
        vocabulary: Vocabulary | LanguageWords,
        names: NameFinder | None,
    ) -> None:
        self.text, self.vocabulary = text, vocabulary
        self.proper = ProperNames(text, language, vocabulary, names)
        self.lexicon, self.lists = language, language.lists

    def chunks(self, sentence: list[Word]) -> list[Chunk]:
        """Return the chunks of a sentence, in order, without what says nothing about a place."""
        self.words = sentence
        self.lower = [word.lower for word in sentence]
        self.shouting = is_shouting(sentence)
        self.proper.take(sentence, shouting=self.shouting)
        found: list[Chunk] = []
        i = 0
        while i < len(sentence):
            if sentence[i].kind == "word":
                i += self._take_words(i, found)
            else:
                found.append(self._take_mark(i, sentence[i]))
                i += 1
        return found

    def split_label(self, sentence: list[Word]) -> list[list[Word]]:
        """Split "Elm Park: by the gate" behind the name; drop "Location:", which says nothing."""
        at = next((i for i, word in enumerate(sentence) if word.lower == ":"), 0)
        if not 0 < at < len(sentence) - 1:
            return [sentence]
        before, after = sentence[:at], sentence[at + 1 :]
        if before[0].kind == "site" or self.proper.is_one(" ".join(w.lower for w in before)):
            return [before, after]
        word = before[0].lower
        known = at > 1 or self.lexicon.longest([word], 0) or self._senses(word)
        return [sentence if known or before[0].kind != "word" else after]

    def _senses(self, phrase: str) -> tuple[Sense, ...]:
        """Return the senses of a phrase; none if it is longer than any that names a thing."""
        return self.vocabulary.senses(phrase) if len(phrase) <= LONGEST_NOUN else ()

    def _take_mark(self, i: int, word: Word) -> Chunk:
        """Return the chunk of a distance, a comma or a label."""
        if word.kind == "measure":
            return self._chunk("DIST", i, 1, word.metres)
        if word.kind == "comma":
            return self._chunk("AND", i, 1)
        written = self.text[word.start : word.end]
        if word.kind == "site":
            return self._chunk("NAME", i, 1, NounMeaning((), written))
        name, senses = written.replace("_", " "), self._senses(word.lower)
        if word.capital:
            common = bool(senses) and "_" not in written and not self.proper.is_one(name)
        else:
            common = bool(senses) or not (name[0].isdigit() or self.proper.is_one(name))
        if common:
            return self._chunk("NOUN", i, 1, NounMeaning(senses, exact=True))
        return self._chunk("NAME", i, 1, NounMeaning(senses or self.proper.kind(name), name))

    def _take_words(self, i: int, chunks: list[Chunk]) -> int:
        """Append what begins at word i, and return how many words it takes."""
        known = self.lexicon.longest(self.lower, i)
        n_known, terminals = known or (0, ())
        kind, before = terminals[0].type if terminals else "", chunks[-1].type if chunks else ""
        noun = None
        if known is None or kind in _OPEN:
            noun = self.vocabulary.longest_match(self.lower, i)
        n_name = self.proper.length(i, known, n_known, noun[0] if noun else 0)
        if n_name:
            written = self.text[self.words[i].start : self.words[i + n_name - 1].end]
            name = self.proper.as_on_the_map(written)
            meaning = NounMeaning(self.proper.kind(written), name, exact=self.proper.is_one(name))
            chunks.append(self._chunk("NAME", i, n_name, meaning))
            return n_name
        if noun is None and (known is None or kind in ("PART", "GO", "CROSS")):
            noun = self._find_noun(i, before)
        # a word that may be a verb or a noun is a noun after a determiner
        ties = kind not in ("", "WORD", "ADVERB", "PREP", "PART", "SPOT") and before in _BEFORE_NOUN
        if noun and (noun[0] > n_known or (noun[0] == n_known and ties)):
            chunks.append(self._chunk("NOUN", i, noun[0], NounMeaning(noun[1])))
            return noun[0]
        if known:
            chunks.extend([self._chunk(t.type, i, n_known, t.value) for t in terminals])
            return n_known
        chunks.extend(self._take_other(i))
        return 1

    def _find_noun(self, i: int, before: str) -> tuple[int, tuple[Sense, ...]] | None:
        """Return an ordinary word or phrase that names a thing where only a noun can stand."""
        if before not in _NOUN_AFTER or (self.words[i].capital and not self.shouting):
            return None
        for n in (3, 2, 1):
            words = self.words[i : i + n]
            if len(words) < n or any(word.kind != "word" for word in words):
                continue
            last = self.lexicon.longest(self.lower, i + n - 1)
            if last and (n == 1 or last[1][0].type not in _OPEN):
                continue
            senses = self._senses(" ".join(self.lower[i : i + n]))
            if senses and not self._cuts_noun(i, n):
                return n, senses
        return None

    def _cuts_noun(self, i: int, n: int) -> bool:
        """Tell whether a noun that begins within n words ends beyond them: "large | parking lot"."""
        for j in range(i + 1, i + n):
            inner = self.vocabulary.longest_match(self.lower, j)
            if inner and j + inner[0] > i + n:
                return True
        return False

    def _take_other(self, i: int) -> list[Chunk]:
        """Return the chunks of a number, a possessive, or a word that says nothing by itself."""
        lower = self.lower[i]
        count = parse_count(lower, self.lexicon.counts)
        if count is not None:
            return [self._chunk("NUM", i, 1, count)]
        owner, apostrophe, _ = lower.partition("'")
        senses = self._senses(owner) if apostrophe else ()
        if senses:
            noun = self._chunk("NOUN", i, 1, NounMeaning(senses))
            return [replace(noun, words=owner), self._chunk("POSS", i, 1)]
        return [self._chunk("WORD", i, 1)]

    def _chunk(self, kind: str, i: int, n: int, value: object = None) -> Chunk:
        words = self.lower[i] if n == 1 else " ".join(self.lower[i : i + n])
        first, last = self.words[i], self.words[i + n - 1]
        return Chunk(kind, first.start, last.end, words, value, first.capital)


class InflectedChunker(Chunker):
    """A `Chunker` of any language but English: words in any form meet their dictionary form."""

    def __init__(
        self, text: str, language: Language, vocabulary: LanguageWords, names: NameFinder | None
    ) -> None:
        super().__init__(text, language, vocabulary, names)
        self.dictionary = vocabulary
        self.proper: InflectedNames = InflectedNames(text, language, vocabulary, names)

    def is_word(self, word: str) -> bool:
        """Tell whether something is a word: of the grammar, of things, or a name of the map."""
        if word in self.lexicon.words or word in self.lexicon.counts:
            return True
        if self.dictionary.contains(word):
            return True
        for article in self.lists["articles"].intersection(self.lexicon.prefixes):
            if word.startswith(article) and self.dictionary.contains(word.removeprefix(article)):
                return False  # "المكتبة" is the library, whatever begins with it
        if len(word) > 1 and self.proper.is_one(word):
            return True
        # of several words only the first may have a prefix
        return bool(self.lexicon.prefixes) and self.dictionary.begins(word)

    def find_names(self, span: tuple[int, int]) -> dict[int, int]:
        """Find names of the map in a stretch of a text, before prefixes are cut off its words.

        Returns the end of each by its start; the longest name counts. Words of things or of the
        grammar are no names. A word for a street that stands before a name belongs to it.
        """
        prefixes = self.lexicon.prefixes
        words = [
            word
            for word in _RAW_WORD.finditer(self.text, *span)
            if self.text[word.end() : word.end() + 1] not in ("=", "_")
            and self.text[word.start() - 1 : word.start()] not in ("=", "_")
        ]
        found: dict[int, int] = {}
        i = 0
        while i < len(words):
            end = i + 1
            while end < min(len(words), i + LONGEST) and not _STOP.search(
                self.text, words[end - 1].end(), words[end].start()
            ):
                end += 1
            spoken = [word.group() for word in words[i:end]]
            n, prefix = max(self._name_behind(spoken, prefix) for prefix in ("", *prefixes))
            if not n:
                i += 1
                continue
            start = words[i].start() - prefix  # the length of a prefix counts against it
            before = words[i - 1].group() if i and not prefix else ""
            kinds = [kind for kind in self.lists["street_prefixes"] if before.endswith(kind)]
            kind = max(kinds, key=len, default="")
            if kind and before.removesuffix(kind) in ("", *prefixes):
                start = words[i - 1].end() - len(kind)
            i += n
            found[start] = words[i - 1].end()
        return found

    def _name_behind(self, spoken: list[str], prefix: str) -> tuple[int, int]:
        """Return the words of the longest name behind a prefix, and minus the letters of the prefix."""
        names, first = self.proper.names, spoken[0].removeprefix(prefix)
        if names is None or not spoken[0].startswith(prefix) or len(first) < 2:
            return 0, 0
        n = names.longest_name([fold(word) for word in (first, *spoken[1:])], 0)
        return (0, 0) if n == 0 or self._is_common([first, *spoken[1:n]]) else (n, -len(prefix))

    def _is_common(self, words: list[str]) -> bool:
        """Tell whether words are of things or the grammar, with or without prefixes."""
        spoken = [fold_case(word) for word in words]
        known = self.lexicon.longest(spoken, 0)
        kinds = self.lists["place_prefixes"] | self.lists["street_prefixes"]
        if (known and known[0] == len(spoken)) or " ".join(spoken) in kinds:
            return True
        if self.dictionary.contains(" ".join(spoken)):
            return True
        rests = [
            spoken[0].removeprefix(p) for p in self.lexicon.prefixes if spoken[0].startswith(p)
        ]
        return any(self._is_common([rest, *spoken[1:]]) for rest in rests if rest)

    def chunks(self, sentence: list[Word]) -> list[Chunk]:
        """Return the chunks of a sentence, in the order of the grammar."""
        self.proper.inflected = {}
        lower, spelt = [word.lower for word in sentence], list[Word]()
        while (i := len(spelt)) < len(sentence):  # "rue piétonne" is no misspelt "rue | piéton"
            n, _ = self.vocabulary.longest_match(lower, i) or (1, ())
            spelt += sentence[i : i + n] if n > 1 else [self._respell(sentence[i])]
        found = self._mark_cases(super().chunks(spelt))
        parts = (found[i : i + _LONGEST_SENTENCE] for i in range(0, len(found), _LONGEST_SENTENCE))
        return [chunk for part in parts for chunk in order_chunks(part, self.lexicon)]

    def _respell(self, word: Word) -> Word:
        """Return a word as it should be spelt."""
        spelt = word.kind == "word" and not word.capital and len(word.lower) >= _SHORTEST
        if not spelt or self.is_word(word.lower):
            return word
        return word._replace(lower=self.lexicon.respell(word.lower))

    def _take_mark(self, i: int, word: Word) -> Chunk:
        if word.kind != "quoted":
            return super()._take_mark(i, word)
        written = self.text[word.start : word.end].strip()
        exact = self.text[word.start - 1 : word.start] not in _QUOTES
        return self._chunk(
            "NAME", i, 1, NounMeaning(self.proper.kind(written), written, exact=exact)
        )

    def _mark_cases(self, chunks: list[Chunk]) -> list[Chunk]:
        """Put what endings and particles stand for behind their things."""
        found: list[Chunk] = []
        for chunk in chunks:
            case: tuple[str, ...] = ()
            if chunk.type == "AFTER":
                found += [replace(chunk, type=kind, value=None) for kind in chunk.value]
                continue
            if chunk.type == "NOUN" and (known := self.dictionary.find(chunk.words)) is not None:
                chunk.words, case = known.word, known.case
            elif chunk.type == "NAME" and chunk.start in self.proper.inflected:
                chunk.value.name, case = self.proper.inflected[chunk.start]
            elif chunk.type == "NAME" and not self.proper.is_one(chunk.words):
                forms = self.lexicon.forms.of(fold(chunk.words.rpartition(" ")[2]))
                case = next((form.case for form in reversed(forms) if form.case), ())
            if chunk.type == "NAME":
                chunk.value.exact = chunk.value.exact or self.proper.is_one(chunk.value.name)
            found.append(chunk)
            found += [Chunk(kind, chunk.end, chunk.end) for kind in case]
        return found


def find_sentences(
    text: str,
    part: Stretch,
    vocabulary: Vocabulary,
    names: NameFinder | None,
    sites: Sequence[tuple[int, int]],
) -> Iterator[list[Chunk]]:
    """Yield the chunks of the sentences of a part of a text in one language.

    `sites` are stretches of the text that name a crossing or a house.
    """
    sites = [span for span in sites if part.start <= span[0] < span[1] <= part.end]
    if part.language.code == "en":
        chunker = Chunker(text, part.language, vocabulary, names)
        spans = find_labels(text, vocabulary, names)
        inside = [span for span in spans if part.start <= span[0] < part.end]
        sites = [s for s in sites if not any(a < s[1] and s[0] < b for a, b in inside)]
        for sentence in scan_english(text[: part.end], part.language, inside, sites, part.start):
            yield from map(chunker.chunks, chunker.split_label(sentence))
        return
    inflected = InflectedChunker(text, part.language, vocabulary.of(part.language), names)
    span = (part.start, part.end)
    named = inflected.find_names(span)
    for sentence in scan_any(text, part.language, inflected.is_word, span, named, sites):
        yield inflected.chunks(sentence)
