"""Vectors for any word offline: hashed subwords, whose vectors the network learns.

What a word *means* is the vocabulary's business: a mention arrives as its senses, labels such as
``amenity=cafe``. A label is the sum of the vectors of its parts: the whole, its key, its words and
their letters in threes to fives. What training has seen is known as a whole; what it has not
(a rare tag, a word that the vocabulary lacks, a name) still resembles what is spelled alike.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

BUCKETS = 8192
"""Rows of the table of vectors that parts are hashed into."""
SHORTEST, LONGEST = 3, 5
"""Letters of a subword."""
LETTERS = 1.0
"""Length of what all subwords add together, against 1 of the whole label."""


@dataclass(frozen=True, eq=False)
class Bags:
    """Weighted parts of W words, as CSR."""

    starts: NDArray[np.int64]
    """(W + 1,)"""
    buckets: NDArray[np.int64]
    """(P,) rows of the table of vectors."""
    weights: NDArray[np.float32]
    """(P,)"""

    @classmethod
    def of(cls, words: Sequence[str]) -> Bags:
        """Parts of labels (``key=value``), names (``~`` before them) and plain words."""
        bags = [_parts(word) for word in words]
        return cls(
            np.concatenate(([0], np.cumsum([len(bag) for bag in bags]))).astype(np.int64),
            np.array([bucket for bag in bags for bucket, _ in bag], np.int64),
            np.array([weight for bag in bags for _, weight in bag], np.float32),
        )

    def vectors(self, table: NDArray[np.float32]) -> NDArray[np.float32]:
        """Vectors (W, d) of the words, from the table (BUCKETS, d)."""
        rows = table[self.buckets] * self.weights[:, None]
        return np.add.reduceat(rows, self.starts[:-1], axis=0) if len(rows) else rows[:0]


def of_name(name: str) -> str:
    """The word that stands for a proper name."""
    return "~" + " ".join(name.split()).casefold()


def _parts(word: str) -> list[tuple[int, float]]:
    key, equals, value = word.partition("=")
    if not equals:
        value = key
    letters = list(_subwords(value.removeprefix("~")))
    share = LETTERS / np.sqrt(max(1, len(letters)))
    parts = [(_bucket("w:" + word), 1.0)]
    if equals:
        parts.append((_bucket("k:" + key), 0.5))
    return parts + [(_bucket("s:" + part), share) for part in letters]


def _subwords(text: str) -> Iterable[str]:
    """Letters in threes to fives of every word, with its ends marked."""
    for word in text.replace("_", " ").split():
        marked = f"<{word}>"
        for size in range(SHORTEST, LONGEST + 1):
            for i in range(len(marked) - size + 1):
                yield marked[i : i + size]


def _bucket(part: str) -> int:
    return zlib.crc32(part.encode()) % BUCKETS
