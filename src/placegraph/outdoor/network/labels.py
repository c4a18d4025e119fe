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

from placegraph.outdoor.network.labels_kernels import _parts

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray


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
