"""Models of 3D files: triangles that know their object, and pictures.

Floor, relations and the size of pictures are the builder's: `placegraph.indoor.build`.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import check_regular
from placegraph.errors import InputError

Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Turns y-up axes, as of glTF, into the map's: x, y, z become x, -z, y."""
UNKNOWN = "unknown"
"""Id and label of the object made of faces that belong to none."""


@dataclass(frozen=True, slots=True)
class ModelObject:
    """One object of a model."""

    id: str
    label: str
    name: str = ""
    attributes: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Texture:
    """Colour of a material: an encoded image times a factor, or a factor alone."""

    data: bytes | None
    """Image file (JPEG, PNG, WebP); None: white."""
    factor: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Linear, 0 to 1."""
    mirrored: tuple[bool, bool] = (False, False)
    """Repeated mirror-wise along u, v. Texture coordinates are halved already where it is."""
    name: str = "a picture"
    """For messages: file and picture."""


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """A 3D file, in the map's axes (z up, metres)."""

    path: Path
    objects: tuple[ModelObject, ...]
    vertices: NDArray[np.float64]
    """(V, 3) [m]; may hold NaN, which the builder refuses."""
    triangles: NDArray[np.int64]
    """(T, 3) rows of vertices."""
    object_of: NDArray[np.int64]
    """(T,) rows of objects."""
    colours: NDArray[np.uint8]
    """(V, 3) sRGB; 255 where there are none."""
    uv: NDArray[np.float64]
    """(V, 2) texture coordinates, v down; 0 where there are none."""
    picture_of: NDArray[np.int64]
    """(T,) rows of pictures."""
    pictures: tuple[Texture, ...]
    """At least one."""
    left_out: Counter[str] = field(default_factory=Counter)
    """Number of unusable parts of the file, by reason."""
    relations: tuple[tuple[int, str, int], ...] = ()
    """(row of an object, relation, row of another) where the file says so."""
    floor: float | None = None
    """Height of the floor [m] where the file says so."""


def read_bytes(path: Path) -> bytes:
    """Read a file; raises `InputError` where it cannot be read."""
    try:
        return check_regular(path).read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist.") from error
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise InputError(f"{path} cannot be read: {why}.") from error


def triangulate_fans(lengths: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Cut polygons into fans: triangles (T, 3) in rows of all their corners, and the polygon of each.

    `lengths`: (F,) corners of each polygon, whose corners stand one polygon after the other.
    """
    count = np.maximum(lengths - 2, 0)
    face = np.repeat(np.arange(len(lengths)), count)
    step = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    first = (np.cumsum(lengths) - lengths)[face]
    return np.stack([first, first + step + 1, first + step + 2], axis=1), face
