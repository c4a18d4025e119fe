"""How well a label fits what somebody calls a thing: the same, a synonym, or kin at a discount."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.encode.words import vector
from placegraph.indoor.map.floor import label_words
from placegraph.indoor.map.relation_words import same_thing

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

LEAST = 0.5
"""Cosine of words that are no kin any more (`encode.word_tree`: 0.64 of two kinds of a thing)."""
SYNONYM = 0.95
"""How well a synonym fits."""
GENERAL = 0.7
"""How well a label fits that says less than what was asked for: a "table" may be a "side table"."""
EXACT = 0.9
"""What fits this well is the thing itself."""
_MANY = 20_000  # words kept


def fits(asked: str, labels: Sequence[str]) -> NDArray[np.float32]:
    """How well labels (n,) fit what is asked for, in [0, 1]: 1 the same thing, 0 no kin of it.

    A "desk" is a "table" by half. Labels that name nothing fit nothing.
    """
    if not labels:
        return np.zeros(0, np.float32)
    cosines = np.stack([_vector(label) for label in labels]) @ _vector(asked)
    out = SYNONYM * np.clip((cosines - LEAST) / (1.0 - LEAST), 0.0, 1.0)
    start = _start(asked)
    for i, label in enumerate(labels):
        if _start(label) == start and start and same_thing(asked, label):
            said, own = set(label_words(asked)[:-1]), set(label_words(label)[:-1])
            out[i] = 1.0 if said <= own else max(out[i], GENERAL)
    return np.asarray(out, np.float32)


@lru_cache(maxsize=_MANY)
def _vector(label: str) -> NDArray[np.float32]:
    return vector(label)


@lru_cache(maxsize=_MANY)
def _start(label: str) -> str:
    """Two letters that the last word of a label has in common with its plural."""
    words = label_words(label)
    return words[-1][:2] if words else ""
