"""Chunks: the words of a text, grouped into the terminals of the grammar."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from placegraph.language.islands import Chunk
from placegraph.language.measures import COUNTS
from placegraph.outdoor.language.description import Sense
from placegraph.outdoor.language.parse import Noun
from placegraph.outdoor.language.words import fold, shouting, tokens

if TYPE_CHECKING:
    from placegraph.language.phrases import Terminal
    from placegraph.language.words import Word
    from placegraph.outdoor.language.languages import Language
    from placegraph.outdoor.language.words import NameFinder, Words

    Known = tuple[int, tuple[Terminal, ...]]
    """Words of a phrase that the grammar knows, and its terminals."""

NAMED_KIND = 0.5
"""Weight of a common noun that ends a proper name: the Dollar Tree is no tree."""
MISSPELT_NAME = 0.9
"""Similarity from which a name is a misspelt one of the map."""
LONGEST_NOUN = 80
"""Characters of a phrase that may name a kind of thing."""
_ORDINAL = re.compile(r"\d+(?:st|nd|rd|th)")
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
    text
        The text.
    language
        In which it is.
    vocabulary
        Common nouns.
    names
        Proper names, or None where there is no map.
    """

    def __init__(
        self, text: str, language: Language, vocabulary: Words, names: NameFinder | None
    ) -> None:
        self.text, self.vocabulary, self.names = text, vocabulary, names
        self.lexicon, self.lists = language, language.lists

    def chunks(self, sentence: list[Word]) -> list[Chunk]:
        """Chunks of a sentence, in order; what says nothing about a place is left out."""
        self.words = sentence
        self.lower = [word.lower for word in sentence]
        self.shouting = shouting(sentence)
        self._fold_names()
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

    def _fold_names(self) -> None:
        """Words in the form of names, without the marks between them."""
        if self.names is None:
            return
        self.name_ends = [i for i, word in enumerate(self.words) if word.kind == "word"]
        self.name_words = [fold(self.lower[i]) for i in self.name_ends]
        self.name_at = {i: k for k, i in enumerate(self.name_ends)}

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
            common = bool(senses) and not joined and not self._is_name(name)
        else:
            common = bool(senses) or not (joined or name[0].isdigit())  # "479._Sokak"
        if common:
            return self._chunk("NOUN", i, 1, Noun(senses, exact=True))
        return self._chunk("NAME", i, 1, Noun(senses or self._kind_of_name(name), name))

    def _is_name(self, name: str) -> bool:
        words = tokens(name)
        return bool(words and self.names and self.names.longest_name(words, 0) == len(words))

    def _word(self, i: int, found: list[Chunk]) -> int:
        """Append what begins at word i, and return how many words it takes."""
        known = self.lexicon.longest(self.lower, i)
        n_known, noun = known[0] if known else 0, None
        before = found[-1].type if found else ""
        if known is None or known[1][0].type in _OPEN:
            noun = self.vocabulary.longest_match(self.lower, i)
        n_noun = noun[0] if noun else 0
        n_name = self._name(i, known, n_known, n_noun)
        if n_name:
            written = self.text[self.words[i].start : self.words[i + n_name - 1].end]
            noun_of = Noun(self._kind_of_name(written), self._spelt_as_on_the_map(written))
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

    def _spelt_as_on_the_map(self, name: str) -> str:
        """Return the map's spelling of a misspelt name, or the name as written."""
        if self.names is None or self._is_name(name):
            return name
        close = self.names.closest_name(name)
        if close is None or close[1] < MISSPELT_NAME:
            return name
        # "4th Street" is not "14th Street", and "East Street" is no misspelt "West Street"
        telling = [
            {word for word in tokens(one) if word in self.lexicon.compass or not word.isalpha()}
            for one in (name, close[0])
        ]
        return close[0] if telling[0] == telling[1] else name

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
        if lower.isdecimal() or lower in COUNTS:
            count = COUNTS.get(lower) or min(int(lower), 10**6)
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

    def _name(self, i: int, known: Known | None, n_known: int, n_noun: int) -> int:
        """How many words of a proper name begin at word i: on the map, or by its capitals."""
        spelt = self._capitals(i, known, n_noun) or self._small_street(i, known, n_noun)
        if self.names is None:
            return spelt
        k = self.name_at[i]
        mapped = self.names.longest_name(self.name_words, k)
        if mapped:
            mapped = self.name_ends[k + mapped - 1] - i + 1
        capital = self.words[i].capital and not self.shouting
        if mapped <= max(n_known, n_noun) and not (spelt and capital and mapped >= spelt):
            return spelt
        if known and known[1][0].type == "DET" and not spelt:  # "the bench" is no "The Bench"
            noun = self.vocabulary.longest_match(self.lower, i + 1)
            mapped = mapped if mapped > 1 + (noun[0] if noun else 0) else 0
        if mapped == 1 and (known or n_noun or len(self.lower[i]) < 3):
            return spelt
        return max(mapped, spelt)

    def _capitals(self, i: int, known: Known | None, n_noun: int) -> int:
        """How many words of a name written with capitals begin at word i."""
        word = self.words[i]
        if self.shouting or not (word.capital or word.lower[0].isdigit()):
            return 0
        if not word.capital and not self._numbered(i):
            return 0
        following = self.words[i + 1] if i + 1 < len(self.words) else None
        continues = following is not None and following.kind == "word" and following.capital
        if known is not None:
            kind = known[1][0].type
            name_like = kind in ("DIR", "SHORT", "WORD", "PART") or (
                i > 0 and kind not in ("ME", "YOU", "IT", "DET", "AND")
            )
            if not (continues and name_like):
                return 0
        end = self._span(i)
        if i == 0 and end == 1 and following and following.lower in self.lists["articles"]:
            return 0  # "Find the", "Disregard the"
        if end == i + 1 and word.lower in COUNTS:
            return 0
        if end == i + 1 and n_noun == 1 and (i == 0 or self.lower[i - 1] in self.lists["articles"]):
            return 0  # "Bakery north of me", "the Cathedral"
        after_article = i == 0 or self.lower[i - 1] in self.lists["articles"]
        return 0 if n_noun >= end - i and (end - i > 1 or after_article) else end - i

    def _small_street(self, i: int, known: Known | None, n_noun: int) -> int:
        """How many words of a street's name begin at word i, written small: "smallman street"."""
        at = i
        if known is not None:
            if known[1][0].type != "DIR" or known[0] != 1:
                return 0
            at = i + 1  # "east carson street", "west avenue"
        if at + 1 < len(self.words) and self.lower[at] not in self.lists["street_suffixes"]:
            plain = (known is None and n_noun) or self.lexicon.longest(self.lower, at)
            at = len(self.words) if plain else at + 1
        before = self.lower[i - 1] if i else ""
        if at >= len(self.words) or self.lower[at] not in self.lists["street_suffixes"]:
            return 0
        return 0 if at == i or before in self.lists["articles"] else at + 1 - i

    def _numbered(self, i: int) -> bool:
        """Tell whether a name begins with the number at word i: "16th Street", "7-Eleven"."""
        if i + 1 >= len(self.words):
            return False
        following = self.words[i + 1]
        if not _ORDINAL.fullmatch(self.lower[i]):
            return following.capital and self.text[self.words[i].end : following.start] == "-"
        return following.capital or following.lower in self.lists["suffixes"]

    def _span(self, i: int) -> int:
        """End of the words with capitals, and small ones between them, that begin at word i."""
        end = i + 1
        while end < len(self.words):
            at = end
            while (
                at < min(end + 2, len(self.words)) and self.lower[at] in self.lists["connectives"]
            ):
                at += 1
            if at >= len(self.words) or self.words[at].kind != "word":
                break
            word = self.words[at]
            number = at == end and word.lower.isdecimal()
            if not (word.capital or number) or word.lower in self.lists["persons"]:
                break
            end = at + 1
        if end < len(self.words) and self.lower[end] in self.lists["suffixes"]:
            end += 1
        return end

    def _kind_of_name(self, name: str) -> tuple[Sense, ...]:
        """What a name's last words say it is: "Hot Metal Bridge" is a bridge, half surely."""
        words = [word.lower() for word in name.split()]
        while len(words) > 2 and words[-1] in self.lexicon.compass:
            words.pop()  # "King Street West" is a street
        for n in (2, 1) if len(words) > 2 else (1,):
            senses = self._senses(" ".join(words[-n:]))
            if senses:
                return tuple([Sense(s.label, NAMED_KIND * s.weight) for s in senses])
        return ()

    def _chunk(self, kind: str, i: int, n: int, value: object = None) -> Chunk:
        words = self.lower[i] if n == 1 else " ".join(self.lower[i : i + n])
        first, last = self.words[i], self.words[i + n - 1]
        return Chunk(kind, first.start, last.end, words, value, first.capital)


def _is_noun_here(terminal: Terminal, before: str) -> bool:
    """Tell whether a word that may be a verb or a noun is a noun after the chunk before."""
    return (
        terminal.type not in ("WORD", "ADVERB", "PREP", "PART", "SPOT") and before in _BEFORE_NOUN
    )
