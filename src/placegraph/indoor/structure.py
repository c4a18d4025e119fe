"""Which objects are the building itself: by these two maps of a place are aligned, and they stay."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.floor import label_words

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

WORDS = frozenset({
    "wall", "walls", "floor", "floors", "ground", "ceiling", "roof", "pillar", "column", "beam",
    "stairs", "staircase", "window", "windows", "doorframe", "windowsill",
})  # fmt: skip
"""Last words of labels of what is built in."""


def structure(labels: Sequence[str]) -> NDArray[np.bool_]:
    """(N,) whether an object is part of the building, by its label's last word."""
    words = map(label_words, labels)
    return np.array([bool(w) and w[-1] in WORDS for w in words], np.bool_)
