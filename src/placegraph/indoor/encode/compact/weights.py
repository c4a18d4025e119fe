"""Weights files: what `train` writes and the network reads; 16-bit numbers, checksummed, no pickle."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.errors import InputError, MapError
from placegraph.indoor.encode.compact.network import Shape
from placegraph.store import read_map, write_map
from placegraph.weights import arrays_of, digest, halves, rounded

if TYPE_CHECKING:
    from collections.abc import Mapping
    from os import PathLike

    from numpy.typing import NDArray

KIND = "compact-encoder"
VERSION = 1
_MEND = "train weights by `placegraph-lab compact train`, or use those that come with placegraph."


@dataclass(frozen=True, eq=False)
class Weights:
    """A trained network."""

    shape: Shape
    arrays: dict[str, NDArray[np.float32]]
    """By the names of `Shape.arrays`."""
    temperature: float
    """Cosine that counts one nat, calibrated on homes and maps that training did not see."""
    training: dict[str, Any]
    """How it was trained."""

    def check(self) -> None:
        """Raise `ValueError` where a weight is of another shape or no number."""
        for name, size in self.shape.arrays().items():
            if self.arrays[name].shape != size or not np.isfinite(self.arrays[name]).all():
                raise ValueError(f"{name} is no {size} of finite numbers")
        if not 0.0 < self.temperature < 10.0:
            raise ValueError(f"temperature is {self.temperature}")

    @property
    def fingerprint(self) -> str:
        """Of shape and weights: twelve hexadecimal digits."""
        return digest(self.shape, self.arrays)[:12]


def write_weights(path: str | PathLike[str], weights: Weights) -> None:
    """Write a weights file, atomically; raises `MapError` where it cannot be written."""
    meta = {
        "shape": weights.shape.to_dict(),
        "temperature": weights.temperature,
        "training": weights.training,
    }
    write_map(path, KIND, VERSION, meta, halves(weights.arrays))


def read_weights(path: str | PathLike[str]) -> Weights:
    """Read a weights file.

    Raises
    ------
    InputError
        There is no such file.
    MapError
        It is damaged, cut short, no weights file, of a newer version, or its arrays do not fit.

    """
    try:
        file = read_map(path, KIND, VERSION)
    except InputError as error:
        raise InputError(f"{path}: no weights file can be read there; {_MEND}") from error
    except MapError as error:
        why = str(error).removeprefix(f"{path} ").partition("; ")[0].partition(". ")[0]
        raise MapError(f"{path}, as a weights file, {why}; {_MEND}") from error
    try:
        shape = Shape.from_dict(file.meta["shape"])
        arrays = arrays_of(file, shape.arrays())
        weights = Weights(
            shape, arrays, float(file.meta["temperature"]), dict(file.meta["training"])
        )
        weights.check()
    except (MapError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise MapError(f"{path}: its weights do not fit together ({error}); {_MEND}") from error
    return weights


def shipped() -> Path:
    """Weights that come with placegraph."""
    with as_file(files("placegraph.indoor.encode.compact") / "data" / "compact.weights") as path:
        return Path(path)


def trained(
    shape: Shape, state: Mapping[str, NDArray[Any]], temperature: float, training: dict[str, Any]
) -> Weights:
    """Weights as they will be read again: rounded to 16 bits."""
    return Weights(shape, rounded(shape.arrays(), state), temperature, training)
