"""Proper names of a map, as people write them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from placegraph.outdoor.language.words import tokens

if TYPE_CHECKING:
    from collections.abc import Sequence

    from placegraph.outdoor.map.objects import CityObjects

LONGEST = 8
"""Names are found in running text up to this many words."""
CLOSE = 0.86
"""Similarity from which a misspelt name counts as meant."""


@dataclass(frozen=True, eq=False)
class NameIndex:
    """Names by their words; a `language.NameFinder`."""

    by_words: dict[str, list[int]]
    """Rows of `CityObjects.names` by the name's words, joined by a space."""
    first: dict[str, int]
    """First word of a name to the number of words of the longest name that begins so."""
    close: dict[str, tuple[str, float] | None] = field(default_factory=dict)

    @classmethod
    def build(cls, objects: CityObjects) -> NameIndex:
        """Index the names of a city."""
        by_words: dict[str, list[int]] = {}
        first: dict[str, int] = {}
        for row, name in enumerate(objects.names):
            words = tokens(name)
            # "The Rex Theatre" is also called "Rex Theatre"; but not every pub is "The Pub"
            article = words[:1] == ["the"] and len(words) > 2
            for said in (words, words[1:])[: 1 + article]:
                if said:
                    by_words.setdefault(" ".join(said), []).append(row)
                    first[said[0]] = max(first.get(said[0], 0), min(len(said), LONGEST))
        return cls(by_words, first)

    def longest_name(self, words: Sequence[str], start: int) -> int:
        """Return the number of words of the longest name that begins at `start`, 0 for none."""
        longest = self.first.get(words[start], 0)
        for n in range(min(longest, len(words) - start), 0, -1):
            if " ".join(words[start : start + n]) in self.by_words:
                return n
        return 0

    def closest_name(self, phrase: str) -> tuple[str, float] | None:
        """Name (its words) most similar to a phrase and the similarity, None below `CLOSE`."""
        from rapidfuzz import fuzz, process

        words = " ".join(tokens(phrase))
        if not words:
            return None
        if words not in self.close:
            found = process.extractOne(
                words, self.by_words.keys(), scorer=fuzz.ratio, score_cutoff=100 * CLOSE
            )
            self.close[words] = None if found is None else (found[0], found[1] / 100)
        return self.close[words]

    def named(self, phrase: str) -> dict[int, float]:
        """Rows of `CityObjects.names` that a phrase means, and how surely."""
        words = tokens(phrase)
        rows = self.by_words.get(" ".join(words))
        if rows is None and words and words[0] == "the":
            rows = self.by_words.get(" ".join(words[1:]))
        return dict.fromkeys(rows or (), 1.0)
