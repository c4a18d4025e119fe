"""Weights files: what `train` writes and the network reads; 16-bit numbers, checksummed, no pickle."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from placegraph.errors import InputError, MapError
from placegraph.outdoor.network.graphs_kernels import MOST_THINGS, REACH
from placegraph.outdoor.network.labels_kernels import BUCKETS, LONGEST, SHORTEST
from placegraph.outdoor.network.relations_kernels import CHANNELS
from placegraph.outdoor.network.shape import Shape
from placegraph.store import read_header, read_map, write_map
from placegraph.weights import arrays_of, digest, halves, rounded

if TYPE_CHECKING:
    from collections.abc import Mapping
    from os import PathLike

    import numpy as np
    from numpy.typing import NDArray

    from placegraph.store import MapFile

KIND = "graph-transformer"
VERSION = 1
LABELS = {"buckets": BUCKETS, "subwords": [SHORTEST, LONGEST]}
"""How words become rows of the table; weights made otherwise mean something else."""
GRAPHS = {"channels": list(CHANNELS), "reach": REACH, "things": MOST_THINGS}
"""What graphs are made of."""


@dataclass(frozen=True, eq=False)
class Weights:
    """A trained network."""

    shape: Shape
    arrays: dict[str, NDArray[np.float32]]
    training: dict[str, Any]
    """How it was trained: cities, examples, seed, curves' last points."""

    @property
    def fingerprint(self) -> str:
        """Of shape and weights: sixteen hexadecimal digits."""
        return digest(self.shape, self.arrays)[:16]


def write_weights(path: str | PathLike[str], weights: Weights) -> None:
    """Write a weights file, atomically; raises `MapError` where it cannot be written."""
    meta = {
        "shape": weights.shape.to_dict(),
        "labels": LABELS,
        "graphs": GRAPHS,
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
        It is damaged, none, of a newer version, or made with another label set or other graphs.

    """
    file = _open(path)
    for part, here in (("labels", LABELS), ("graphs", GRAPHS)):
        if file.meta.get(part) != here:
            raise MapError(
                f"{path}: the network was trained with other {part} ({file.meta.get(part)}) than "
                f"this version of placegraph has ({here}). Train it again by `placegraph city train`."
            )
    try:
        shape = Shape.from_dict(file.meta["shape"])
        arrays = arrays_of(file, shape.arrays())
        return Weights(shape, arrays, dict(file.meta["training"]))
    except MapError as error:
        why = str(error).removeprefix(f"{path}: ").partition("; ")[0]
        raise MapError(f"{path}: {why}; train or install the weights again.") from error
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise MapError(
            f"{path}: its weights do not fit together ({error}). Train or install them again."
        ) from error


def _open(path: str | PathLike[str]) -> MapFile:
    """Columns of a weights file; errors speak of weights where the map reader speaks of maps."""
    mend = "train one by `placegraph city train`, or use the one that comes with placegraph."
    try:
        header = read_header(path)
        file = read_map(path, header.kind, header.version)
    except InputError as error:
        why = (
            "does not exist" if isinstance(error.__cause__, FileNotFoundError) else "cannot be read"
        )
        raise InputError(f"{path}: this weights file {why}; {mend}") from error
    except MapError as error:
        why = str(error).removeprefix(f"{path} ").partition("; ")[0].partition(". ")[0]
        raise MapError(f"{path}, as a weights file, {why}; {mend}") from error
    if header.kind != KIND:
        raise MapError(f"{path} is a {header.kind} map, not a weights file; {mend}")
    if header.version > VERSION:
        raise MapError(
            f"{path} is a weights file of version {header.version}, this placegraph reads up to "
            f"{VERSION}; update placegraph, or train again with this one."
        )
    return file


def shipped() -> Path:
    """Weights that come with placegraph."""
    with as_file(files("placegraph.outdoor.network") / "data" / "city.weights") as path:
        return Path(path)


def trained(shape: Shape, state: Mapping[str, NDArray[Any]], training: dict[str, Any]) -> Weights:
    """Weights as they will be read again: rounded to 16 bits."""
    return Weights(shape, rounded(shape.arrays(), state), training)
