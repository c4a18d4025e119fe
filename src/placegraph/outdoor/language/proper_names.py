"""Proper names in a text: on the map, by their capitals, or as streets written small."""

from __future__ import annotations

import re

from placegraph.language.text import Terminal, Word
from placegraph.outdoor.language.description import Sense
from placegraph.outdoor.language.languages import Language
from placegraph.outdoor.language.vocabulary import LanguageWords, Vocabulary
from placegraph.outdoor.language.words import NameFinder, fold, tokens

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
_AFTER_NAME = frozenset(
    ("BE", "HAVE", "AND", "ON", "IN", "AT", "PREP", "ACROSS", "BETWEEN", "WITH", "DIR")
)
"""Terminals that follow a name that opens a sentence."""
_BEFORE_STREET = frozenset(("on", "onto", "at", "of", "and", "&", "between", "from", "to", "past"))
_CASED = re.compile(r"[a-z,] (?!I\b)[A-Z]")
_ORDINAL = re.compile(r"\d+(?:st|nd|rd|th)")
_LONGEST_NAME = 4
"""Words of the longest name that is looked for in other forms than it has on the map."""
_FURTHER = 3
"""Words that follow the kind of a street in a script without capitals, at most."""


class ProperNames:
    """Finds proper names: on the map, by their capitals, or as streets written small.

    Parameters
    ----------
    vocabulary
        Common nouns.
    names
        Names of the map, or None where there is no map.
    """

    def __init__(
        self,
        text: str,
        language: Language,
        vocabulary: Vocabulary | LanguageWords,
        names: NameFinder | None,
    ) -> None:
        self.text, self.vocabulary, self.names = text, vocabulary, names
        self.lexicon, self.lists = language, language.lists
        self.is_cased = _CASED.search(text) is not None
        """Whether the text writes names with capitals."""

    def take(self, sentence: list[Word], *, shouting: bool) -> None:
        """Go on to a sentence; of one that is all capitals these say nothing."""
        self.words, self.shouting = sentence, shouting
        self.lower = [word.lower for word in sentence]
        if self.names is not None:
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
        """Return the label in a name's last words: "Hot Metal Bridge" is a bridge, with half certainty."""
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

    def length(self, i: int, entry: Known | None, n_known: int, n_noun: int) -> int:
        """Return the length [words] of a proper name at word i: one on the map, or one in capitals."""
        spelt = (
            self._house(i)
            or self._capitals(i, entry, n_noun)
            or self._small_street(i, entry, n_noun)
        )
        if self.names is None:
            return spelt
        mapped, led = self._mapped(i), entry is not None and entry[1][0].type == "DET"
        if mapped and led and self._span(i + 1) > i + mapped:
            return 0  # "the Independent Hotel" is no "The Independent"
        if mapped > 1 and mapped >= max(n_known, n_noun) and self._all_capital(i, mapped):
            return max(mapped, spelt)
        capital = self.words[i].capital and not self.shouting
        if n_noun == 1 and capital and not entry and max(mapped, spelt) == 1:
            # "an Aldi": a common noun only in a manner of speaking
            noun = self.vocabulary.longest_match(self.lower, i)
            seldom = noun is not None and max((s.weight for s in noun[1]), default=0.0) < CLEARLY
            before = self.lexicon.longest(self.lower, i - 1) if i else None
            opens = i == 0 or (before is not None and before[1][-1].type == "BE")  # "It is Roof."
            return int(bool(mapped) and (seldom or bool(spelt and not opens)))
        if mapped <= max(n_known, n_noun) and not (spelt and capital and mapped >= spelt):
            return spelt
        if led and not spelt:  # "the bench" is no "The Bench"
            noun = self.vocabulary.longest_match(self.lower, i + 1)
            mapped = mapped if mapped > 1 + (noun[0] if noun else 0) else 0
        counts = self.lower[i] in self.lexicon.counts  # "two fountains" are no shop "Two"
        if mapped == 1 and (entry or n_noun or counts or len(self.lower[i]) < 3):
            return spelt
        if mapped == 1 and not capital and self.vocabulary.senses(self.lower[i]):
            return spelt  # "a craft shop" is no business called "Craft"
        return max(mapped, spelt)

    def _mapped(self, i: int) -> int:
        """Return the length [words] of the longest name of the map at word i.

        Ordinary words in lower case are none where a text writes names with capitals: "the field
        house" is no "Field House".
        """
        k = self.name_at[i]
        n = self.names.longest_name(self.name_words, k) if self.names else 0
        if not n:
            return 0
        n = self.name_ends[k + n - 1] - i + 1
        words = range(i, i + n)
        common = (
            n > 1
            and self.is_cased
            and not any(self.words[j].capital for j in words)
            and all(
                self.vocabulary.longest_match(self.lower, j) or self.lexicon.longest(self.lower, j)
                for j in words
            )
        )
        return 0 if common else n

    def _all_capital(self, i: int, n: int) -> bool:
        """Tell whether n words are written as names are: "The Salvation Army"."""
        small = self.lists["connectives"]
        names = [w for w in self.words[i : i + n] if w.kind == "word" and w.lower not in small]
        capitals = all(w.capital or w.lower[0].isdigit() for w in names)
        return bool(names) and not self.shouting and capitals

    def _capitals(self, i: int, entry: Known | None, n_noun: int) -> int:
        """Return the length [words] of a name in capitals at word i."""
        word = self.words[i]
        if self._is_counted_street(i, entry):
            return self._span(i + (entry is not None)) - i
        if self.shouting or not (word.capital or self._is_numbered(i)):
            return 0
        following = self.words[i + 1] if i + 1 < len(self.words) else None
        continues = following is not None and following.kind == "word" and following.capital
        kind = entry[1][0].type if entry is not None else "WORD"
        if kind not in ("DIR", "SHORT", "WORD", "PART") and (
            i == 0 or kind in ("ME", "YOU", "IT", "DET", "AND")
        ):
            return 0
        if entry is not None and not continues:
            return 0
        end = self._span(i)
        after_article = i == 0 or self.lower[i - 1] in self.lists["articles"]
        # "Find the", "Bakery north of me", "the Cathedral"
        alone = word.lower in self.lexicon.counts or (i == 0 and not self._opens_sentence(i))
        if end == i + 1 and (alone or (n_noun == 1 and after_article)):
            return 0
        return 0 if n_noun >= end - i and (end - i > 1 or after_article) else end - i

    def _is_counted_street(self, i: int, entry: Known | None) -> bool:
        """Tell whether a number counts a street: "W. 38th", "east 34th", "at 5th and 34th"."""
        last = i + 1 >= len(self.words)
        if _ORDINAL.fullmatch(self.lower[i]) and i and self.lower[i - 1] in _BEFORE_STREET:
            following = None if last else self.lexicon.longest(self.lower, i + 1)
            ends = last or self.words[i + 1].kind != "word"
            return ends or (following is not None and following[1][0].type in _AFTER_NAME)
        led = entry is not None and entry[0] == 1 and entry[1][0].type in ("DIR", "SHORT")
        return led and not last and _ORDINAL.fullmatch(self.lower[i + 1]) is not None

    def _house(self, i: int) -> int:
        """Return the length [words] of a house number at word i with its street: "125 Main Street"."""
        numbered = self.lower[i].isdecimal() and i + 1 < len(self.words)
        if not numbered or self.words[i + 1].kind != "word":
            return 0
        n = self._capitals(i + 1, self.lexicon.longest(self.lower, i + 1), 0)
        return n + 1 if n > 1 and self.lower[i + n] in self.lists["street_suffixes"] else 0

    def _opens_sentence(self, i: int) -> bool:
        """Tell whether something is said of the word: "Lidl is near me", not "Wanna join me"."""
        if i + 1 == len(self.words) or self.words[i + 1].kind != "word":
            return True
        known = self.lexicon.longest(self.lower, i + 1)
        if known is None:  # "Cupka's cafe"
            return self.vocabulary.longest_match(self.lower, i + 1) is not None
        return known[1][0].type in _AFTER_NAME

    def _small_street(self, i: int, entry: Known | None, n_noun: int) -> int:
        """Return the length [words] of a street's name in lower case at word i: "smallman street"."""
        at, suffixes = i, self.lists["street_suffixes"]
        if entry is not None:
            if entry[1][0].type != "DIR" or entry[0] != 1:
                return 0
            at = i + 1  # "east carson street", "west avenue"
        if at + 1 < len(self.words) and self.lower[at] not in suffixes:
            plain = (entry is None and n_noun) or self.lexicon.longest(self.lower, at)
            at = len(self.words) if plain else at + 1
        if at >= len(self.words) or self.lower[at] not in suffixes:
            return 0
        before = self.lower[i - 1] if i else ""
        return 0 if at == i or before in self.lists["articles"] else at + 1 - i

    def _is_numbered(self, i: int) -> bool:
        """Tell whether a name begins with the number at word i: "16th Street", "7-Eleven"."""
        if i + 1 >= len(self.words) or not self.lower[i][0].isdigit():
            return False
        following = self.words[i + 1]
        if not _ORDINAL.fullmatch(self.lower[i]):
            return following.capital and self.text[self.words[i].end : following.start] == "-"
        return following.capital or following.lower in self.lists["suffixes"]

    def _span(self, i: int) -> int:
        """Return the end of the words with capitals, and small ones between them, from word i on."""
        end = i + 1
        small = self.lists["connectives"]
        while end < len(self.words):
            at = end
            while at < min(end + 2, len(self.words)) and self.lower[at] in small:
                at += 1
            if at >= len(self.words) or self.words[at].kind != "word":
                break
            word = self.words[at]
            number = at == end and (word.lower.isdecimal() or _ORDINAL.fullmatch(word.lower))
            if not (word.capital or number) or word.lower in self.lists["persons"]:
                break
            end = at + 1
        return end + (end < len(self.words) and self.lower[end] in self.lists["suffixes"])


class InflectedNames(ProperNames):
    """`ProperNames` that may stand in another form than on the map: "Mannerheimintiellä"."""

    inflected: dict[int, tuple[str, tuple[str, ...]]]
    """Names of a sentence that are not as on the map, by where they begin: as there, and case."""

    def take(self, sentence: list[Word], *, shouting: bool) -> None:
        """Go on to a sentence; a short one that is all capitals is no name either."""
        written = self.text[sentence[0].start : sentence[-1].end]
        super().take(sentence, shouting=shouting or (len(sentence) > 2 and written.isupper()))

    def _mapped(self, i: int) -> int:
        """Return 0: names as on the map were found in the raw text (`InflectedChunker.find_names`)."""
        del i
        return 0

    def length(self, i: int, entry: Known | None, n_known: int, n_noun: int) -> int:
        """Return the length [words] of a proper name at word i: one on the map, or one in capitals."""
        n = self._inflected(i) if self.names is not None and self.lexicon.forms else 0
        found = super().length(i, entry, n_known, n_noun)
        exact = bool(found) and self.is_one(" ".join(self.lower[i : i + found]))
        if n > max(n_known, n_noun) and n >= found and not exact:
            return n
        self.inflected.pop(self.words[i].start, None)
        return found

    def kind(self, name: str) -> tuple[Sense, ...]:
        """Return the label in a name's last words, or in its first: "Bäckerei Schmidt"."""
        first = super().kind(name.split(maxsplit=1)[0]) if " " in name else ()
        if self.lexicon.order.head_first and first:
            return first  # "Hôtel de la Gare" is no station
        return super().kind(name) or first

    def _inflected(self, i: int) -> int:
        """Return the length [words] of a name at word i in another form than the map's."""
        words = self.words[i : i + _LONGEST_NAME]
        prefixes = self.lists["street_prefixes"] | self.lists["place_prefixes"]
        street = words[0].lower in prefixes  # "na ulicy Długiej"
        named = words[0].capital or _lacks_capitals(words[0]) or street
        if not named or (len(words[0].lower) < 4 and not street):
            return 0
        for n in range(len(words), 0, -1):
            if any(word.kind != "word" for word in words[:n]):
                continue
            for written, case in self._forms_of([fold(word.lower) for word in words[:n]]):
                if self.is_one(" ".join(written)):
                    self.inflected[words[0].start] = (" ".join(written), case)
                    return n
        return 0

    def _forms_of(self, words: list[str]) -> list[tuple[list[str], tuple[str, ...]]]:
        """Return names that words may be forms of: the last or the first bends alone, or both of two."""
        forms = [self.lexicon.forms.dictionary(word) for word in (words[0], words[-1])]
        found = [([*words[:-1], form.stem], form.case) for form in forms[1]]
        if len(words) > 1:  # "на улице Ленина"
            found += [([form.stem, *words[1:]], form.case) for form in forms[0]]
        if len(words) == 2:
            found += [([a.stem, b.stem], b.case) for a in forms[0] for b in forms[1]]
        return found

    def _capitals(self, i: int, entry: Known | None, n_noun: int) -> int:
        if self.lexicon.capitals:
            return super()._capitals(i, entry, n_noun)
        word = self.words[i]
        counted = word.lower in self.lexicon.counts
        if not word.capital or self.shouting or counted or entry is not None:
            return 0
        end = i + 1
        while end < len(self.words) and self.words[end].kind == "word" and self.words[end].capital:
            if self.lexicon.longest(self.lower, end):
                break
            end += 1
        if end - i > 1:
            return end - i if n_noun < end - i else 0
        street = any(word.lower.endswith(ending) for ending in self.lists["street_suffixes"])
        article = i == 0 or self.lower[i - 1] in self.lists["articles"]
        return 0 if n_noun or (article and not street) else 1

    def _small_street(self, i: int, entry: Known | None, n_noun: int) -> int:
        """Return the words of streets whose kind stands first, too: "rue de la Paix"."""
        return self._street_after(i) or super()._small_street(i, entry, n_noun)

    def _is_onto_next(self, i: int) -> bool:
        """Tell whether word i is a prefix that is written onto the word behind it."""
        glued = i + 1 < len(self.words) and self.words[i].end == self.words[i + 1].start
        return glued and self.lower[i] in self.lexicon.prefixes

    def _street_after(self, i: int) -> int:
        """Return the length [words] of a street's name at word i, its kind first."""
        articles = self.lists["articles"]
        led = i > 0 and self._is_onto_next(i - 1) and self.lower[i - 1] in articles
        if led and _lacks_capitals(self.words[i]):
            return 0  # "ال|شارع", the street
        at = i + 1
        while at < len(self.words) and self.lower[at] in self.lists["connectives"]:
            at += 1
        place = self.lower[i] in self.lists["place_prefixes"] and (
            at > i + 1 or self.lexicon.order.cases  # "площадь Революции"
        )
        if not place and self.lower[i] not in self.lists["street_prefixes"]:
            return 0
        if not place and self._is_onto_next(at):
            at += 1  # "רחוב המלך": an article written onto the name
        if at >= len(self.words) or self.words[at].kind != "word":
            return 0
        bare = self._is_bare_name(at)
        noun = self.vocabulary.longest_match(self.lower, i)
        # "chemin piéton" is a kind of road
        common = noun is not None and noun[0] > 1 and not self.words[at].capital
        plain = not (place or bare) and self._is_small_name(i, at)
        if common or not (self.words[at].capital or bare or plain):
            return 0
        end = at + 1
        while end < len(self.words) and self.words[end].kind == "word":
            further = bare and end < at + _FURTHER and not self._is_onto_next(end)
            # "شارع الملك | فهد"
            further = further and self.lexicon.longest(self.lower, end) is None
            further = further and self.vocabulary.longest_match(self.lower, end) is None
            if not (self.words[end].capital or further):
                break
            end += 1
        return end - i

    def _is_small_name(self, i: int, at: int) -> bool:
        """Tell whether an unknown word at `at` is a street's name in lower case: "avenida venezuela"."""
        known = self.lexicon.longest(self.lower, i - 1) if i else None
        kind = known[1][0].type if known else ""
        return (
            kind not in ("A", "NUM", "ANOTHER", "NO")
            and self.lexicon.longest(self.lower, at) is None
            and self.vocabulary.longest_match(self.lower, at) is None
        )

    def _is_bare_name(self, i: int) -> bool:
        """Tell whether a word in a script without capitals may be a street's name."""
        articles = self.lists["articles"]
        written_on = tuple(articles.intersection(self.lexicon.prefixes))  # "شارع الحمراء"
        led = self.lower[i - 1] in articles or self.lower[i].startswith(written_on)
        unknown = led or self.lexicon.longest(self.lower, i) is None
        return unknown and _lacks_capitals(self.words[i])


def _lacks_capitals(word: Word) -> bool:
    """Tell whether a word is in a script without capitals."""
    return word.lower == word.lower.upper()
