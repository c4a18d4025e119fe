"""Vectors for any word offline: hashed subwords, whose vectors the network learns.

What a word *means* is the vocabulary's business: a mention arrives as its senses, labels such as
``amenity=cafe``. A label is the sum of the vectors of its parts: the whole, its key, its words and
their letters in threes to fives. What training has seen is known as a whole; what it has not
(a rare tag, a word that the vocabulary lacks, a name) still resembles what is spelled alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

BUCKETS = 8192
"""Rows of the table of vectors that parts are hashed into."""
SHORTEST, LONGEST = 3, 5
"""Letters of a subword."""


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
    def of(cls, words: Sequence[str], subwords: float = 1.0) -> Bags:
        """Parts of labels (``key=value``), names (``~`` before them) and plain words.

        `subwords` is the length of what all subwords add together, against 1 of the whole word.
        """
        letters = [np.frombuffer(w.encode("utf-32-le", "surrogatepass"), np.uint32) for w in words]
        bounds = np.concatenate(([0], np.cumsum([len(x) for x in letters]))).astype(np.int64)
        return cls(*_parts(np.concatenate([np.zeros(0, np.uint32), *letters]), bounds, subwords))

    def vectors(self, table: NDArray[np.float32]) -> NDArray[np.float32]:
        """Vectors (W, d) of the words, from the table (BUCKETS, d)."""
        rows = table[self.buckets] * self.weights[:, None]
        return np.add.reduceat(rows, self.starts[:-1], axis=0) if len(rows) else rows[:0]


def of_name(name: str) -> str:
    """The word that stands for a proper name."""
    return "~" + " ".join(name.split()).casefold()


WHOLE, KEY, SUBWORD = range(3)
"""What a part is: `cafe` as a word is not `cafe` within one."""
EQUALS, SPACE, UNDERSCORE, TILDE, BEGIN, END = (ord(c) for c in "= _~<>")


@njit(cache=True, nogil=True)
def _parts(letters, bounds, subwords):
    """Parts of words that follow each other in `letters`, as CSR: starts, buckets, weights."""
    starts = np.zeros(len(bounds), np.int64)
    most = (LONGEST - SHORTEST + 1) * (3 * len(letters) + 2) + 2 * len(bounds)
    buckets, weights = np.empty(most, np.int64), np.empty(most, np.float32)
    n = 0
    for w in range(len(bounds) - 1):
        word = letters[bounds[w] : bounds[w + 1]]
        buckets[n], weights[n] = _bucket(word, WHOLE), 1.0
        n += 1
        value = 0
        for i in range(len(word)):
            if word[i] == EQUALS:
                buckets[n], weights[n] = _bucket(word[:i], KEY), 0.5
                n += 1
                value = i + 1
                break
        if value == 0 and len(word) and word[0] == TILDE:
            value = 1
        first = n
        i = value
        while i < len(word):
            j = i
            while j < len(word) and word[j] != SPACE and word[j] != UNDERSCORE:
                j += 1
            marked = np.empty(j - i + 2, np.uint32)
            marked[0], marked[1 : j - i + 1], marked[j - i + 1] = BEGIN, word[i:j], END
            for size in range(SHORTEST, LONGEST + 1):
                for k in range(len(marked) - size + 1 if j > i else 0):
                    buckets[n] = _bucket(marked[k : k + size], SUBWORD)
                    n += 1
            i = j + 1
        weights[first:n] = subwords / np.sqrt(max(1, n - first))
        starts[w + 1] = n
    return starts, buckets[:n], weights[:n]


@njit(cache=True, nogil=True)
def _bucket(letters, kind):
    """Row of the table of vectors (FNV-1a over the letters' code points)."""
    code = np.uint64(14695981039346656037) ^ np.uint64(kind)
    for letter in letters:
        code = (code * np.uint64(1099511628211)) ^ np.uint64(letter)
    code ^= code >> np.uint64(29)
    return np.int64(code % np.uint64(BUCKETS))
