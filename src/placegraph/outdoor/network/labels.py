"""Vectors for any word offline: hashed subwords, whose vectors the network learns.

What a word *means* is the vocabulary's business: a mention arrives as its senses, labels such as
``amenity=cafe``. A label is the sum of the vectors of its parts: the whole, its key, its words and
their letters in threes to fives. What training has seen is known as a whole; what it has not
(a rare tag, a word that the vocabulary lacks, a name) still resembles what is spelled alike.

The paper has word vectors of 300 numbers instead (Sec. III-A). A network may be trained with those of
a file (`WordVectors`): they stand for every label that holds a word of theirs, and hashed subwords
for the rest.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.network.labels_kernels import _parts


def words_of(label: str) -> tuple[str, ...]:
    """Words that stand for a label, in small letters: of a name, or of a tag's value.

    ``amenity=bicycle_parking`` is "bicycle", "parking"; a value that says nothing leaves the word to
    the key: ``building=yes`` is "building".
    """
    key, _, value = (label, "", "") if label.startswith("~") else label.partition("=")
    words = re.findall(r"[^\W_]+", (key if value in ("", "*", "yes") else value).lower())
    return tuple(words)


@dataclass(frozen=True, eq=False)
class WordVectors:
    """Vectors of single words that were trained elsewhere, such as word2vec's."""

    words: tuple[str, ...]
    """N words in small letters, each once."""
    vectors: NDArray[np.float32]
    """(N, n), as 16 bits hold them."""

    @cached_property
    def _rows(self) -> dict[str, int]:
        return {word: row for row, word in enumerate(self.words)}

    def means(self, labels: Sequence[str]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Mean vectors (W, n) of the words of labels that are known, and which have any (W,)."""
        found = np.zeros((len(labels), self.vectors.shape[1]), np.float32)
        known = np.zeros(len(labels), bool)
        for i, label in enumerate(labels):
            rows = [self._rows[word] for word in words_of(label) if word in self._rows]
            if rows:
                found[i], known[i] = self.vectors[rows].mean(axis=0), True
        return found, known


@dataclass(frozen=True, eq=False)
class Bags:
    """Weighted parts of W words, as CSR, and where they are known the means of word vectors."""

    starts: NDArray[np.int64]
    """(W + 1,)"""
    buckets: NDArray[np.int64]
    """(P,) rows of the table of vectors."""
    weights: NDArray[np.float32]
    """(P,) 0 of words that have a mean."""
    means: NDArray[np.float32] | None = None
    """(W, n) of `WordVectors`, 0 where a word is not known to them."""

    @classmethod
    def of(
        cls, words: Sequence[str], subwords: float = 1.0, known: WordVectors | None = None
    ) -> Bags:
        """Parts of labels (``key=value``), names (``~`` before them) and plain words.

        `subwords` is the length of what all subwords add together, against 1 of the whole word;
        `known` are word vectors that stand for the words they know.
        """
        letters = [np.frombuffer(w.encode("utf-32-le", "surrogatepass"), np.uint32) for w in words]
        bounds = np.concatenate(([0], np.cumsum([len(x) for x in letters]))).astype(np.int64)
        parts = _parts(np.concatenate([np.zeros(0, np.uint32), *letters]), bounds, subwords)
        if known is None:
            return cls(*parts)
        starts, buckets, weights = parts
        means, found = known.means(words)
        return cls(starts, buckets, weights * ~np.repeat(found, np.diff(starts)), means)

    def vectors(
        self, table: NDArray[np.float32], meaning: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Vectors (W, d) of the words, from the table (BUCKETS, d) and the map (d, n) of means."""
        rows = table[self.buckets] * self.weights[:, None]
        sums = np.add.reduceat(rows, self.starts[:-1], axis=0) if len(rows) else rows[:0]
        return sums if self.means is None or meaning is None else sums + self.means @ meaning.T
