"""Vectors of labels."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

DIMENSION = 64


def vector(label: str) -> NDArray[np.float32]:
    """Unit vector (d,) of a label; zero of one that says nothing."""
    word = label.strip().casefold()
    if word in {"", "unknown", "object", "other"}:
        return np.zeros(DIMENSION, np.float32)
    bits = np.unpackbits(
        np.frombuffer(hashlib.blake2b(word.encode(), digest_size=8).digest(), np.uint8)
    )
    return ((bits * 2.0 - 1.0) / 8.0).astype(np.float32)
