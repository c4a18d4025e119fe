"""What labels say of objects: which are the building itself, and which have no name at all.

By what is built in two maps of a place are aligned, and it stays.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.map.floor import label_words

WORDS = frozenset({
    "wall", "walls", "floor", "floors", "ground", "ceiling", "roof", "pillar", "column", "beam",
    "stairs", "staircase", "window", "windows", "doorframe", "windowsill",
})  # fmt: skip
"""Last words of labels of what is built in."""
NAMELESS = frozenset({
    "object", "objects", "unknown", "unlabelled", "unlabeled", "thing", "none", "mesh", "scan",
    "scene", "structure", "other",
})  # fmt: skip
"""Words of labels that name nothing."""


def structure(labels: Sequence[str]) -> NDArray[np.bool_]:
    """(N,) whether an object is part of the building, by its label's last word."""
    words = map(label_words, labels)
    return np.array([bool(w) and w[-1] in WORDS for w in words], np.bool_)


def nameless(label: str) -> bool:
    """Whether a label says nothing of what an object is: "", "unknown", "object"."""
    return not set(label_words(label)) - NAMELESS


def same_label(one: str, other: str) -> bool:
    """Whether two labels may be of one object: they are the same, or one names nothing."""
    return one.casefold() == other.casefold() or nameless(one) or nameless(other)
