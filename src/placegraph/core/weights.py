"""Weights of networks that run without PyTorch: float16 in map files, float32 in memory."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.mapfile import MapFile


def to_float16(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[np.float16]]:
    """Return arrays as the file stores them."""
    return {name: np.ascontiguousarray(array, np.float16) for name, array in arrays.items()}


def round_to_float16(
    names: Iterable[str], state: Mapping[str, NDArray[Any]]
) -> dict[str, NDArray[np.float32]]:
    """Return the arrays of these names, rounded as if read from a file."""
    return {n: a.astype(np.float32) for n, a in to_float16({n: state[n] for n in names}).items()}


def read_arrays(
    file: MapFile, shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, NDArray[np.float32]]:
    """Read finite arrays by name, with as many axes as their shapes.

    Raises `MapError` where one is missing or has other axes, `ValueError` where it is not finite.
    """
    arrays = {
        name: file.array(name, "<f2", len(shape)).astype(np.float32)
        for name, shape in shapes.items()
    }
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{name} contains numbers that are not finite")
    return arrays


def hash_weights(shape: object, arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return the SHA-256 of the `repr` of a network's shape and of its weights in float16."""
    sha = hashlib.sha256(repr(shape).encode())
    for name, array in sorted(to_float16(arrays).items()):
        sha.update(name.encode() + array.tobytes())
    return sha.hexdigest()
