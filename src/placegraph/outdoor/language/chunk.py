"""Chunks: the words of a text, grouped into the terminals of the grammar."""

from __future__ import annotations

from typing import TYPE_CHECKING

from placegraph.language.islands import Chunk
from placegraph.language.measures import whole
from placegraph.language.words import Terminal, Word
from placegraph.outdoor.language.description import Sense
from placegraph.outdoor.language.parse import Noun
from placegraph.outdoor.language.proper import LONGEST_NOUN, ProperNames
from placegraph.outdoor.language.words import NameFinder, Words, shouting

if TYPE_CHECKING:
    from placegraph.outdoor.language.languages import Language

_OPEN = frozenset(
    ("WORD", "GO", "PASS", "CROSS", "PART", "ADVERB", "PREP", "FACE", "SEE", "BE", "REACH", "SPOT")
)
"""Terminals whose words may also begin or be a phrase of the vocabulary."""
_BEFORE_NOUN = frozenset(("DET", "THIS", "A", "ANOTHER", "NUM", "NO", "MY", "YOUR", "ITS", "WORD"))
_NOUN_AFTER = frozenset(("DET", "A", "ANOTHER", "NUM", "NO", "MY", "EXISTS", "HAVE", "SEE", "OF"))


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
        self, text: str, language: Language, vocabulary: Words, names: NameFinder | None
    ) -> None:
        self.text, self.vocabulary = text, vocabulary
        self.proper = ProperNames(text, language, vocabulary, names)
        self.lexicon, self.lists = language, language.lists

    def chunks(self, sentence: list[Word]) -> list[Chunk]:
        """Chunks of a sentence, in order; what says nothing about a place is left out."""
        self.words = sentence
        self.lower = [word.lower for word in sentence]
        self.shouting = shouting(sentence)
        self.proper.take(sentence, shouting=self.shouting)
        found: list[Chunk] = []
        i = 0
        while i < len(sentence):
            word = sentence[i]
            if word.kind == "word":
                n = self._word(i, found)
            else:
                n = 1
                found.append(self._mark(i, word))
            i += n
        return found

    def _senses(self, phrase: str) -> tuple[Sense, ...]:
        """Senses of a phrase; none if it is longer than any that names a thing."""
        return self.vocabulary.senses(phrase) if len(phrase) <= LONGEST_NOUN else ()

    def _mark(self, i: int, word: Word) -> Chunk:
        if word.kind == "measure":
            return self._chunk("DIST", i, 1, word.metres)
        if word.kind == "comma":
            return self._chunk("AND", i, 1)
        written = self.text[word.start : word.end]
        name, joined = written.replace("_", " "), "_" in written
        senses = self._senses(word.lower)
        if word.capital:
            common = bool(senses) and not joined and not self.proper.is_one(name)
        else:
            common = bool(senses) or not (name[0].isdigit() or self.proper.is_one(name))
        if common:
            return self._chunk("NOUN", i, 1, Noun(senses, exact=True))
        return self._chunk("NAME", i, 1, Noun(senses or self.proper.kind(name), name))

    def _word(self, i: int, found: list[Chunk]) -> int:
        """Append what begins at word i, and return how many words it takes."""
        known = self.lexicon.longest(self.lower, i)
        n_known, noun = known[0] if known else 0, None
        before = found[-1].type if found else ""
        if known is None or known[1][0].type in _OPEN:
            noun = self.vocabulary.longest_match(self.lower, i)
        n_noun = noun[0] if noun else 0
        n_name = self.proper.length(i, known, n_known, n_noun)
        if n_name:
            written = self.text[self.words[i].start : self.words[i + n_name - 1].end]
            noun_of = Noun(self.proper.kind(written), self.proper.as_on_the_map(written))
            found.append(self._chunk("NAME", i, n_name, noun_of))
            return n_name
        if noun is None and (known is None or known[1][0].type in ("PART", "GO", "CROSS")):
            noun = self._noun_here(i, before)
            n_noun = noun[0] if noun else 0
        if noun and (
            n_noun > n_known or (n_noun == n_known and known and _is_noun_here(known[1][0], before))
        ):
            found.append(self._chunk("NOUN", i, n_noun, Noun(noun[1])))
            return n_noun
        if known:
            found.extend(
                self._chunk(terminal.type, i, n_known, terminal.value) for terminal in known[1]
            )
            return n_known
        return self._other(i, found)

    def _noun_here(self, i: int, before: str) -> tuple[int, tuple[Sense, ...]] | None:
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
            if senses and not self._cuts(i, n):
                return n, senses
        return None

    def _cuts(self, i: int, n: int) -> bool:
        """Tell whether a noun that begins within n words ends beyond them: "large | parking lot"."""
        for j in range(i + 1, i + n):
            inner = self.vocabulary.longest_match(self.lower, j)
            if inner and j + inner[0] > i + n:
                return True
        return False

    def _other(self, i: int, found: list[Chunk]) -> int:
        """Append a number, a possessive, or a word that says nothing by itself."""
        lower = self.lower[i]
        if lower.isdecimal() or lower in self.lexicon.counts:
            count = self.lexicon.counts.get(lower) or whole(lower, 10**6)
            found.append(self._chunk("NUM", i, 1, count))
            return 1
        owner, apostrophe, _ = lower.partition("'")
        if apostrophe:
            senses = self._senses(owner)
            if senses:
                found.append(self._chunk("NOUN", i, 1, Noun(senses)))
                found[-1].words = owner
                found.append(self._chunk("POSS", i, 1))
                return 1
        found.append(self._chunk("WORD", i, 1))
        return 1

    def _chunk(self, kind: str, i: int, n: int, value: object = None) -> Chunk:
        words = self.lower[i] if n == 1 else " ".join(self.lower[i : i + n])
        first, last = self.words[i], self.words[i + n - 1]
        return Chunk(kind, first.start, last.end, words, value, first.capital)


def _is_noun_here(terminal: Terminal, before: str) -> bool:
    """Tell whether a word that may be a verb or a noun is a noun after the chunk before."""
    return (
        terminal.type not in ("WORD", "ADVERB", "PREP", "PART", "SPOT") and before in _BEFORE_NOUN
    )
