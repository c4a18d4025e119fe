"""Proper names of a map, as people write them: whole, in part, inflected or misspelt."""

from __future__ import annotations

import re
import sys
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import log
from typing import Protocol

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.outdoor.language.words import (
    COMPASS,
    ROADS,
    SMALL,
    normalise,
    tokens,
    transliterate,
)
from placegraph.outdoor.map.streets import Streets

LONGEST = 8
"""Names are found in running text up to this many words."""
MOST_LETTERS, DENSE = 60, "\u0e00"
"""Letters of the longest name that is found within words, and the first letter of scripts without spaces."""
CLOSE = 0.86
"""Similarity from which a misspelt name counts as meant."""
SAID, KNOWN = 0.7, 0.25
"""Shares of what a phrase tells, and of what a name tells, that the two must have in common."""
SAME = 0.75
"""From this share of a name on, it is another spelling of one that is whole on the map."""
PART = 0.5
"""Weight of a name of which only a part was said, beside one that was said as a whole."""
ALMOST = 0.9
"""A name that has less of the phrase than this share of the best is not meant."""
MANY = 60
"""A part of more names than this means none of them."""
CROWDED = 20_000
"""Maximum number of names with a number that are searched for streets."""


class NameTable(Protocol):
    """Table with names: the objects of a city, or the words of a world."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names as written."""


@dataclass(frozen=True, eq=False)
class NameIndex:
    """Names by their words; a `language.NameFinder`."""

    by_words: Mapping[str, Sequence[int]]
    """Rows of `CityObjects.names` by the name's words, joined by a space."""
    first: Mapping[str, int]
    """First word of a name to the number of words of the longest name that begins so."""
    close: dict[str, tuple[str, float] | None] = field(default_factory=dict)
    meant: dict[str, dict[int, float]] = field(default_factory=dict)
    streets: Streets | None = None
    """Streets of the map, where it has geometry."""

    @classmethod
    def build(cls, objects: NameTable) -> NameIndex:
        """Index the names of a city."""
        by_words: dict[str, list[int]] = {}
        first: dict[str, int] = {}
        for row, name in enumerate(objects.names):
            for said in list_spoken_forms(name):
                by_words.setdefault(" ".join(said), []).append(row)
                first[said[0]] = max(first.get(said[0], 0), min(len(said), LONGEST))
        return cls(by_words, first)

    def find_sites(self, text: str) -> list[tuple[int, int]]:
        """Find stretches (start, end) of a text that name a place by its streets."""
        if self.streets is None:
            return []
        return [(site.start, site.end) for site in self.streets.find_sites(text)]

    def find_places(self, phrase: str) -> Floats:
        """Return the places (K, 2) [m] of a crossing or a house that is no object of the map."""
        exact = self.streets is None or " ".join(tokens(phrase)) in self.by_words
        return np.zeros((0, 2)) if exact or not self.streets else self.streets.resolve(phrase)

    def longest_name(self, words: Sequence[str], start: int) -> int:
        """Return the number of words of the longest name that begins at `start`, 0 for none."""
        longest = self.first.get(words[start], 0)
        for n in range(min(longest, len(words) - start), 0, -1):
            if " ".join(words[start : start + n]) in self.by_words:
                return n
        return 0

    def find_within(self, text: str) -> Iterator[tuple[str, str]]:
        """Yield names that words of a text begin with, and the rest of the last word.

        Such names are inflected, part of a compound, or in a script without spaces.
        """
        words, at = normalise(text), 0
        while at < len(words):
            dense = words[at] >= DENSE
            last = (
                min(len(words), at + MOST_LETTERS)
                if dense or words[at - 1 : at] in ("", " ")
                else 0
            )
            ends = range(last, at + (1 if dense else 4), -1)
            name = next((words[at:end] for end in ends if words[at:end] in self.by_words), "")
            at += max(len(name), 1)
            if name:
                yield name, "" if dense else words[at:].partition(" ")[0]

    def closest_name(self, phrase: str) -> tuple[str, float] | None:
        """Name (its words) most similar to a phrase and the similarity, None below `CLOSE`."""
        from rapidfuzz import fuzz, process

        words = " ".join(tokens(phrase))
        if not words:
            return None
        if words not in self.close:
            found = process.extractOne(
                words, self._list_similar(words), scorer=fuzz.ratio, score_cutoff=100 * CLOSE
            )
            self.close[words] = None if found is None else (found[0], found[1] / 100)
        return self.close[words]

    def _list_similar(self, words: str) -> Iterable[str]:
        """Return names that words may be a misspelling of."""
        del words
        return self.by_words.keys()

    def find_rows(self, phrase: str) -> dict[int, float]:
        """Find the rows of `CityObjects.names` that a phrase may mean, and their weights.

        A name that was said as a whole weighs 1. One of which a part was said weighs the less the
        more was left out, and the more names the part belongs to.
        """
        words = tokens(phrase)
        if words[:1] == ["the"] and " ".join(words) not in self.by_words:
            words = words[1:]
        said = " ".join(words)
        if said not in self.meant:
            found = dict.fromkeys(self.by_words.get(said, ()), 1.0)
            for name, fit in self._in_part(words, is_name=bool(found)):
                for row in self.by_words[name]:
                    found.setdefault(row, fit)
            rest = words[:-1]
            if not found and _is_address(words):  # the map may lack the house
                found = dict.fromkeys(self.by_words.get(" ".join(words[1:]), ()), PART)
            road = _is_road(words) or _is_road(rest)
            if not found and rest and not road and not _tells_apart(words[-1]):
                # "Starbucks Cafe" is Starbucks, "HSBC UK" HSBC
                name = " ".join(rest)
                rows = self.by_words.get(name) or self.by_words.get(f"the {name}") or []
                found = dict.fromkeys(rows, PART)
            if not found and (latin := transliterate(said)) != said:
                found = self.find_rows(latin)
            self.meant[said] = found
        return self.meant[said]

    def _in_part(self, words: Sequence[str], *, is_name: bool) -> Iterator[tuple[str, float]]:
        """Yield names that share so much with a phrase that it may mean them, and their fit.

        `is_name`: whether the phrase is itself a name of the map.
        """
        phrase = [self._written(word) for word in self._joined(words)]
        weights = {word: self._word_weight(word) for word in phrase}
        rare = [word for word in weights if word in self._counts and word not in SMALL]
        if not rare or sum(weights.values()) <= 0.0:
            return
        rarest = max(rare, key=lambda word: weights[word])
        street = all(map(_tells_apart, phrase))
        if self._counts[rarest] > (CROWDED if street else MANY):
            return
        names = self._postings[rarest]
        if street:  # "W. 38th" is one
            names = [name for name in names if _is_counted(name.split())]
        if not 0 < len(names) <= MANY:
            return
        shares = {name: self._shares(phrase, weights, name, is_name=is_name) for name in names}
        least = ALMOST * max(share for share, _ in shares.values())
        fits = {name: share * of for name, (share, of) in shares.items() if share >= least > 0.0}
        weight = (PART if is_name else 1.0) / max(1, len(fits)) ** 0.5
        for name, fit in fits.items():
            yield name, weight * fit

    def _shares(
        self, phrase: Sequence[str], weights: dict[str, float], name: str, *, is_name: bool
    ) -> tuple[float, float]:
        """Return the shares of a phrase and of a name that both have; 0 if it means another name."""
        words = [_stem(word) for word in name.split()]
        common = set(phrase) & set(words)
        if (
            any(_tells_apart(word) for word in phrase if word not in common)
            or _is_road(phrase) > _is_road(words)
            or (is_name and words == phrase)  # the phrase itself
        ):
            return 0.0, 0.0
        own = {word: self._word_weight(word) for word in words}
        share = sum(weights[word] for word in common) / sum(weights.values())
        of_name = sum(own[word] for word in common) / max(sum(own.values()), 1e-9)
        enough = share >= (SAME if is_name else SAID) and of_name >= (SAME if is_name else KNOWN)
        return (share, of_name) if enough else (0.0, 0.0)

    def _word_weight(self, word: str) -> float:
        """Return the weight of a word: the rarer in names, the larger (inverse document frequency)."""
        if word in SMALL:
            return 0.0
        return log(1.0 + len(self.by_words) / (1.0 + self._counts.get(word, 0)))

    def _joined(self, words: Sequence[str]) -> list[str]:
        """Join words of a phrase that names write as one: "Met Life" is "MetLife"."""
        found: list[str] = []
        at = 0
        while at < len(words):
            pair = _stem("".join(words[at : at + 2]))
            two = at + 1 < len(words) and pair in self._counts and len(pair) > 4
            found.append(pair if two else _stem(words[at]))
            at += 1 + two
        return found

    def _written(self, word: str) -> str:
        """Return an inflected or misspelt word as names write it."""
        if word in self._counts or not is_alphabetic(word):
            return word
        at = bisect_left(self._alphabetic, word)
        near = [w for w in self._alphabetic[max(0, at - 3) : at + 3] if _inflected(word, w)]
        if near:
            return near[0]
        if len(word) < 6:
            return word
        from rapidfuzz import process
        from rapidfuzz.distance import OSA

        begin = word[:2]
        ends = (bisect_left(self._alphabetic, end) for end in (begin, begin + chr(sys.maxunicode)))
        found = process.extractOne(
            word, self._alphabetic[slice(*ends)], scorer=OSA.distance,
            score_cutoff=1 + (len(word) >= 8),
        )  # fmt: skip
        return found[0] if found else word

    @cached_property
    def _counts(self) -> Mapping[str, int]:
        """In how many names a word stands, by its stem."""
        return {word: len(names) for word, names in self._postings.items()}

    @cached_property
    def _alphabetic(self) -> Sequence[str]:
        return sorted(filter(is_alphabetic, self._postings))

    @cached_property
    def _postings(self) -> Mapping[str, Sequence[str]]:
        """Names by the stems of their words."""
        found: dict[str, list[str]] = {}
        for name in self.by_words:
            for word in stems(name):
                found.setdefault(word, []).append(name)
        return found


_ELISION = re.compile(r"\b([DdLl])['’`](?=\w{2})")


def list_spoken_forms(name: str) -> list[list[str]]:
    """List the words by which a name is called.

    "The Rex Theatre" is also called "Rex Theatre", but not every pub is "The Pub"; "Rex (closed)"
    is called "Rex", and "Place d'Armes" is written "place d armes" in haste.
    """
    words = tokens(name)
    found = [words, words[1:]] if words[:1] == ["the"] and len(words) > 2 else [words]
    if _ELISION.search(name):
        found.append(tokens(_ELISION.sub(r"\1 ", name)))
    if name.endswith(")"):
        found.append(tokens(name.rpartition("(")[0]))
    return [said for said in found if said]


def stems(name: str) -> list[str]:
    """List the stems of a name's words; none of an address, a part of which means the street."""
    words = name.split()
    return [] if _is_address(words) else list(dict.fromkeys(map(_stem, words)))


def is_alphabetic(word: str) -> bool:
    """Tell whether a word may be inflected or misspelt."""
    return len(word) >= 5 and word.isalpha()


def _stem(word: str) -> str:
    """Cut the ending of plurals and possessives: "Macy's", "Macys" and "Macy"."""
    return word[:-1] if len(word) > 3 and word[-1] == "s" and word[-2] not in "su" else word


def _inflected(one: str, other: str) -> bool:
    """Tell whether two words are forms of one: "ulicy" and "ulica", "Floriańskiej" and "Floriańska"."""
    from rapidfuzz.distance import Prefix

    stem = Prefix.similarity(one, other)
    ending = max(len(one), len(other)) - stem
    return stem >= 4 and ending <= (1 if stem < 6 else 3) and "" not in (one[stem:], other[stem:])


def _tells_apart(word: str) -> bool:
    """Tell whether a name that lacks this word is another one: "4th Street" is not "Street"."""
    return word in COMPASS or any(c.isdigit() for c in word)


def _is_address(words: Sequence[str]) -> bool:
    """Tell whether words are a house number and a street: "125 East 34th Street"."""
    return (
        len(words) > 2
        and words[0][0].isdecimal()
        and not words[0].endswith(("st", "nd", "rd", "th"))
    )


def _is_counted(words: Sequence[str]) -> bool:
    """Tell whether words are a street with a number, and no more: "West 38th Street"."""
    return _is_road(words) and all(_tells_apart(word) or word in ROADS for word in words)


def _is_road(words: Sequence[str]) -> bool:
    return bool(words) and words[-1] in ROADS
