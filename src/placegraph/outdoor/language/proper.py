"""Proper names in a text: on the map, by their capitals, or as streets written small."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from placegraph.language.words import Terminal, Word
from placegraph.outdoor.language.description import Sense
from placegraph.outdoor.language.words import NameFinder, Words, fold, tokens

if TYPE_CHECKING:
    from placegraph.outdoor.language.languages import Language


Known = tuple[int, tuple[Terminal, ...]]
"""Words of a phrase that the grammar knows, and its terminals."""


NAMED_KIND = 0.5
"""Weight of a common noun that ends a proper name: the Dollar Tree is no tree."""
MISSPELT_NAME = 0.9
"""Similarity from which a name is a misspelt one of the map."""
LONGEST_NOUN = 80
"""Characters of a phrase that may name a kind of thing."""
CLEARLY = 0.8
"""Weight of a sense from which a word with a capital is a common noun after an article."""
_TELLS = frozenset(
    ("BE", "HAVE", "AND", "ON", "IN", "AT", "PREP", "ACROSS", "BETWEEN", "WITH", "DIR")
)
"""What follows a name that opens a sentence."""
_BEFORE_STREET = frozenset(("on", "onto", "at", "of", "and", "&", "between", "from", "to", "past"))
_ORDINAL = re.compile(r"\d+(?:st|nd|rd|th)")


class ProperNames:
    """Finds the proper names of one sentence after the other; parameters as of `Chunker`."""

    def __init__(
        self, text: str, language: Language, vocabulary: Words, names: NameFinder | None
    ) -> None:
        self.text, self.vocabulary, self.names = text, vocabulary, names
        self.lexicon, self.lists = language, language.lists

    def take(self, sentence: list[Word], *, shouting: bool) -> None:
        """Go on to a sentence; of one that is all capitals these say nothing."""
        self.words, self.shouting = sentence, shouting
        self.lower = [word.lower for word in sentence]
        if self.names is None:
            return
        self.name_ends = [i for i, word in enumerate(self.words) if word.kind == "word"]
        self.name_words = [fold(self.lower[i]) for i in self.name_ends]
        self.name_at = {i: k for k, i in enumerate(self.name_ends)}

    def is_one(self, name: str) -> bool:
        """Tell whether words are a name of the map, as a whole."""
        words = tokens(name)
        return bool(words and self.names and self.names.longest_name(words, 0) == len(words))

    def as_on_the_map(self, name: str) -> str:
        """Return the map's spelling of a misspelt name, or the name as written."""
        if self.names is None or self.is_one(name):
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

    def kind(self, name: str) -> tuple[Sense, ...]:
        """What a name's last words say it is: "Hot Metal Bridge" is a bridge, half surely."""
        words = [word.lower() for word in name.split()]
        while len(words) > 2 and words[-1] in self.lexicon.compass:
            words.pop()  # "King Street West" is a street
        if len(words) > 2 and words[0].isdecimal() and words[-1] in self.lists["street_suffixes"]:
            words = ["building"]  # a house number
        for n in (2, 1) if len(words) > 2 else (1,):
            phrase = " ".join(words[-n:])
            senses = self.vocabulary.senses(phrase) if len(phrase) <= LONGEST_NOUN else ()
            if senses:
                return tuple([Sense(s.label, NAMED_KIND * s.weight) for s in senses])
        return ()

    def length(self, i: int, known: Known | None, n_known: int, n_noun: int) -> int:
        """How many words of a proper name begin at word i: on the map, or by its capitals."""
        spelt = (
            self._house(i)
            or self._capitals(i, known, n_noun)
            or self._small_street(i, known, n_noun)
        )
        if self.names is None:
            return spelt
        k = self.name_at[i]
        mapped = self.names.longest_name(self.name_words, k)
        if mapped:
            mapped = self.name_ends[k + mapped - 1] - i + 1
        if mapped and known and known[1][0].type == "DET" and self._span(i + 1) > i + mapped:
            return 0  # "the Independent Hotel" is no "The Independent"
        if mapped > 1 and mapped >= max(n_known, n_noun) and self._all_capital(i, mapped):
            return max(mapped, spelt)
        capital = self.words[i].capital and not self.shouting
        if n_noun == 1 and capital and not known and max(mapped, spelt) == 1:
            return int(bool(mapped) and (bool(spelt) or self._seldom_common(i)))
        if mapped <= max(n_known, n_noun) and not (spelt and capital and mapped >= spelt):
            return spelt
        if known and known[1][0].type == "DET" and not spelt:  # "the bench" is no "The Bench"
            noun = self.vocabulary.longest_match(self.lower, i + 1)
            mapped = mapped if mapped > 1 + (noun[0] if noun else 0) else 0
        if mapped == 1 and (known or n_noun or len(self.lower[i]) < 3):
            return spelt
        if mapped == 1 and not capital and self.vocabulary.senses(self.lower[i]):
            return spelt  # "a craft shop" is no business called "Craft"
        return max(mapped, spelt)

    def _seldom_common(self, i: int) -> bool:
        """Tell whether a word is a common noun only in a manner of speaking: "an Aldi"."""
        noun = self.vocabulary.longest_match(self.lower, i)
        return noun is not None and max((s.weight for s in noun[1]), default=0.0) < CLEARLY

    def _all_capital(self, i: int, n: int) -> bool:
        """Tell whether n words are written as names are: "The Salvation Army"."""
        small = self.lists["connectives"]
        names = [w for w in self.words[i : i + n] if w.kind == "word" and w.lower not in small]
        return (
            bool(names)
            and not self.shouting
            and all(w.capital or w.lower[0].isdigit() for w in names)
        )

    def _capitals(self, i: int, known: Known | None, n_noun: int) -> int:
        """How many words of a name written with capitals begin at word i."""
        word = self.words[i]
        if self._counted(i, known):
            return self._span(i + (known is not None)) - i
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
        if end == i + 1 and (
            word.lower in self.lexicon.counts or (i == 0 and not self._told_of(i))
        ):
            return 0
        if end == i + 1 and n_noun == 1 and (i == 0 or self.lower[i - 1] in self.lists["articles"]):
            return 0  # "Bakery north of me", "the Cathedral"
        after_article = i == 0 or self.lower[i - 1] in self.lists["articles"]
        return 0 if n_noun >= end - i and (end - i > 1 or after_article) else end - i

    def _counted(self, i: int, known: Known | None) -> bool:
        """Tell whether a number counts a street: "W. 38th", "east 34th", "at 5th and 34th"."""
        if _ORDINAL.fullmatch(self.lower[i]) and i and self.lower[i - 1] in _BEFORE_STREET:
            following = self.lexicon.longest(self.lower, i + 1) if i + 1 < len(self.words) else None
            return (
                i + 1 == len(self.words)
                or self.words[i + 1].kind != "word"
                or (following is not None and following[1][0].type in _TELLS)
            )
        return (
            known is not None
            and known[0] == 1
            and known[1][0].type in ("DIR", "SHORT")
            and i + 1 < len(self.words)
            and _ORDINAL.fullmatch(self.lower[i + 1]) is not None
        )

    def _house(self, i: int) -> int:
        """How many words a house number at word i has with its street: "125 Main Street"."""
        if not self.lower[i].isdecimal() or self.words[i + 1 : i + 2] == []:
            return 0
        if self.words[i + 1].kind != "word":
            return 0
        n = self._capitals(i + 1, self.lexicon.longest(self.lower, i + 1), 0)
        return n + 1 if n > 1 and self.lower[i + n] in self.lists["street_suffixes"] else 0

    def _told_of(self, i: int) -> bool:
        """Tell whether something is said of the word: "Lidl is near me", not "Wanna join me"."""
        if i + 1 == len(self.words) or self.words[i + 1].kind != "word":
            return True
        known = self.lexicon.longest(self.lower, i + 1)
        if known is None:  # "Cupka's cafe"
            return self.vocabulary.longest_match(self.lower, i + 1) is not None
        return known[1][0].type in _TELLS

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
            number = at == end and (word.lower.isdecimal() or _ORDINAL.fullmatch(word.lower))
            if not (word.capital or number) or word.lower in self.lists["persons"]:
                break
            end = at + 1
        if end < len(self.words) and self.lower[end] in self.lists["suffixes"]:
            end += 1
        return end
