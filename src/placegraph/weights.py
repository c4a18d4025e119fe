"""What files of weights share that NumPy computes with: 16-bit numbers, a digest, arrays by name."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from placegraph.store import MapFile


def halves(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[np.float16]]:
    """Arrays as the file holds them."""
    return {name: np.ascontiguousarray(array, np.float16) for name, array in arrays.items()}


def rounded(
    names: Iterable[str], state: Mapping[str, NDArray[Any]]
) -> dict[str, NDArray[np.float32]]:
    """Arrays of these names as they will be read again."""
    return {n: a.astype(np.float32) for n, a in halves({n: state[n] for n in names}).items()}


def arrays_of(
    file: MapFile, sizes: Mapping[str, tuple[int, ...]]
) -> dict[str, NDArray[np.float32]]:
    """Arrays of a file by name, with as many axes as their sizes, finite.

    Raises as `MapFile.array` does, and `ValueError`.
    """
    found = {
        name: file.array(name, "<f2", len(size)).astype(np.float32) for name, size in sizes.items()
    }
    for name, array in found.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{name} holds what is no finite number")
    return found


def digest(shape: object, arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 of a network's shape, by what it prints as, and of its weights as the file has them."""
    told = hashlib.sha256(repr(shape).encode())
    for name, array in sorted(halves(arrays).items()):
        told.update(name.encode() + array.tobytes())
    return told.hexdigest()
