"""Chunks of a language whose words bend: what stands in a text meets its dictionary form."""

from __future__ import annotations

from dataclasses import replace

from placegraph.language.islands import Chunk
from placegraph.language.words import Word
from placegraph.outdoor.language.chunk import Chunker
from placegraph.outdoor.language.description import Sense
from placegraph.outdoor.language.languages import Language
from placegraph.outdoor.language.order import ordered
from placegraph.outdoor.language.parse import Noun
from placegraph.outdoor.language.proper import Known, ProperNames
from placegraph.outdoor.language.vocabulary.tongue import LanguageWords
from placegraph.outdoor.language.words import NameFinder, fold

_LONGEST_SENTENCE = 120
"""Chunks that are brought into order together; nobody speaks in longer sentences."""
_LONGEST_NAME = 4
"""Words of the longest name that is looked for in other forms than it has on the map."""
_FURTHER = 3
"""Words that follow the kind of a street in a script without capitals, at most."""


class InflectedChunker(Chunker):
    """A `Chunker` of any language but English."""

    def __init__(
        self, text: str, language: Language, vocabulary: LanguageWords, names: NameFinder | None
    ) -> None:
        super().__init__(text, language, vocabulary, names)
        self.dictionary = vocabulary
        self.proper: InflectedNames = InflectedNames(text, language, vocabulary, names)

    def known(self, word: str) -> bool:
        """Tell whether something is a word: of the grammar, of things, or a name of the map."""
        if word in self.lexicon.words or word in self.lexicon.counts:
            return True
        if len(word) == 1 and "\u3041" <= word <= "\u30ff":
            return False  # a letter of Japanese, not a word
        if self.dictionary.known(word) or (len(word) > 1 and self.proper.is_one(word)):
            return True
        articles = self.proper.lists["articles"].intersection(self.lexicon.prefixes)
        if any(
            word.startswith(a) and self.dictionary.known(word.removeprefix(a)) for a in articles
        ):
            return False  # "المكتبة" is the library, whatever begins with it
        # of several words only the first may have a prefix
        return bool(self.lexicon.prefixes) and self.dictionary.begins(word)

    def chunks(self, sentence: list[Word]) -> list[Chunk]:
        """Chunks of a sentence, in the order of the grammar."""
        self.proper.bent = {}
        found = self._marked(super().chunks(sentence))
        parts = (found[i : i + _LONGEST_SENTENCE] for i in range(0, len(found), _LONGEST_SENTENCE))
        return [chunk for part in parts for chunk in ordered(part, self.lexicon)]

    def _mark(self, i: int, word: Word) -> Chunk:
        if word.kind != "quoted":
            return super()._mark(i, word)
        written = self.text[word.start : word.end].strip()
        return self._chunk("NAME", i, 1, Noun(self.proper.kind(written), written))

    def _marked(self, chunks: list[Chunk]) -> list[Chunk]:
        """Chunks with what endings and particles stand for behind their things."""
        found: list[Chunk] = []
        for chunk in chunks:
            case: tuple[str, ...] = ()
            if chunk.type == "AFTER":
                found += [replace(chunk, type=kind, value=None) for kind in chunk.value]
                continue
            if chunk.type == "NOUN" and (known := self.dictionary.find(chunk.words)) is not None:
                chunk.words, case = known.word, known.case
            elif chunk.type == "NAME":
                case = self._case_of_name(chunk)
            found.append(chunk)
            found += [Chunk(kind, chunk.end, chunk.end) for kind in case]
        return found

    def _case_of_name(self, chunk: Chunk) -> tuple[str, ...]:
        if chunk.start in self.proper.bent:
            chunk.value.name, case = self.proper.bent[chunk.start]
            return case
        if self.proper.is_one(chunk.words):
            return ()
        forms = self.lexicon.forms.of(fold(chunk.words.rpartition(" ")[2]))
        return next((form.case for form in reversed(forms) if form.case), ())


class InflectedNames(ProperNames):
    """`ProperNames` that may stand in another form than on the map: "Mannerheimintiellä"."""

    bent: dict[int, tuple[str, tuple[str, ...]]]
    """Names of a sentence that are not as on the map, by where they begin: as there, and case."""

    def take(self, sentence: list[Word], *, shouting: bool) -> None:
        """Go on to a sentence; a short one that is all capitals is no name either."""
        written = self.text[sentence[0].start : sentence[-1].end]
        super().take(sentence, shouting=shouting or (len(sentence) > 2 and written.isupper()))

    def length(self, i: int, known: Known | None, n_known: int, n_noun: int) -> int:
        """How many words of a proper name begin at word i: on the map, or by its capitals."""
        n = self._bent(i) if self.names is not None and self.lexicon.forms else 0
        found = super().length(i, known, n_known, n_noun)
        whole = bool(found) and self.is_one(" ".join(self.lower[i : i + found]))
        if n > max(n_known, n_noun) and n >= found and not whole:
            return n
        self.bent.pop(self.words[i].start, None)
        return found

    def kind(self, name: str) -> tuple[Sense, ...]:
        """What a name's last words say it is, or its first: "Bäckerei Schmidt"."""
        first = super().kind(name.split(maxsplit=1)[0]) if " " in name else ()
        if self.lexicon.order.head_first and first:
            return first  # "Hôtel de la Gare" is no station
        return super().kind(name) or first

    def _bent(self, i: int) -> int:
        """How many words of a name in another form than the map's begin at word i."""
        words = self.words[i : i + _LONGEST_NAME]
        prefixes = self.lists["street_prefixes"] | self.lists["place_prefixes"]
        street = words[0].lower in prefixes  # "na ulicy Długiej"
        told = words[0].capital or _lacks_capitals(words[0]) or street
        if not told or (len(words[0].lower) < 4 and not street):
            return 0
        for n in range(len(words), 0, -1):
            if any(word.kind != "word" for word in words[:n]):
                continue
            for written, case in self._forms_of([fold(word.lower) for word in words[:n]]):
                if self.is_one(" ".join(written)):
                    self.bent[words[0].start] = (" ".join(written), case)
                    return n
        return 0

    def _forms_of(self, words: list[str]) -> list[tuple[list[str], tuple[str, ...]]]:
        """Names that words may be forms of: the last or the first bends alone, or both of two do."""
        dictionary = self.lexicon.forms.dictionary
        found = [([*words[:-1], form.stem], form.case) for form in dictionary(words[-1])]
        if len(words) > 1:  # "на улице Ленина"
            found += [([form.stem, *words[1:]], form.case) for form in dictionary(words[0])]
        if len(words) == 2:
            found += [
                ([first.stem, last.stem], last.case)
                for first in dictionary(words[0])
                for last in dictionary(words[1])
            ]
        return found

    def _capitals(self, i: int, known: Known | None, n_noun: int) -> int:
        if self.lexicon.capitals:
            return super()._capitals(i, known, n_noun)
        word = self.words[i]
        counted = word.lower in self.lexicon.counts
        if not word.capital or self.shouting or counted or known is not None:
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

    def _small_street(self, i: int, known: Known | None, n_noun: int) -> int:
        """Streets whose kind stands first, too: "rue de la Paix"."""
        return self._street_after(i) or super()._small_street(i, known, n_noun)

    def _is_onto_next(self, i: int) -> bool:
        """Tell whether word i is a prefix that is written onto the word behind it."""
        glued = i + 1 < len(self.words) and self.words[i].end == self.words[i + 1].start
        return glued and self.lower[i] in self.lexicon.prefixes

    def _street_after(self, i: int) -> int:
        led = i > 0 and self._is_onto_next(i - 1) and self._is_article(i - 1)
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
        bare = _lacks_capitals(self.words[at])
        if bare and not self._is_article(at - 1) and not self._has_article(at):
            bare = self.lexicon.longest(self.lower, at) is None
        noun = self.vocabulary.longest_match(self.lower, i)
        common = bare and noun is not None and noun[0] > 1  # a "foot path" in its own script
        if common or not (self.words[at].capital or bare):
            return 0
        end = at + 1
        while end < len(self.words) and self.words[end].kind == "word":
            further = bare and end < at + _FURTHER and self._says_nothing(end)
            if not (self.words[end].capital or further):
                break
            end += 1
        return end - i

    def _is_article(self, i: int) -> bool:
        return self.lower[i] in self.lists["articles"]

    def _has_article(self, i: int) -> bool:
        """Tell whether an article is written onto a word: "شارع الحمراء"."""
        articles = self.lists["articles"].intersection(self.lexicon.prefixes)
        return self.lower[i].startswith(tuple(articles))

    def _says_nothing(self, i: int) -> bool:
        """Tell whether a word is none of the grammar and no thing: "شارع الملك | فهد"."""
        known = self.lexicon.longest(self.lower, i) or self.vocabulary.longest_match(self.lower, i)
        return known is None


def _lacks_capitals(word: Word) -> bool:
    """Tell whether a word is in a script without capitals."""
    return word.lower == word.lower.upper()
