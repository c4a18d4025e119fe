"""Image features that the network starts from: of patches, and of crops of objects.

The published network takes DINOv2's (`dino.DinoFeatures`). Anything that satisfies `ImageFeatures`
will do, for a network trained on it; `ColourFeatures` needs no weights.
"""

from __future__ import annotations

import json
from os import PathLike
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from placegraph.core.files import regular
from placegraph.errors import InputError, OptionError
from placegraph.indoor.map.relations import ABOVE, NEXT_TO

GRID = (9, 16)
"""Rows and columns of patches of an image that is wider than high; the other way round else."""
FEATURES = ("dinov2", "colour")
NONE = "none"
RELATIONS = (
    NONE, "supported by", "left", "right", "front", "behind", "close by", "inside", "bigger than",
    "smaller than", "higher than", "lower than", "same symmetry as", "same as", "attached to",
    "standing on", "lying on", "hanging on", "connected to", "leaning against", "part of",
    "belonging to", "build in", "standing in", "cover", "lying in", "hanging in", "same color",
    "same material", "same texture", "same shape", "same state", "same object type", "messier than",
    "cleaner than", "fuller than", "more closed", "more open", "brighter than", "darker than",
    "more comfortable than",
)  # fmt: skip
"""3DSSG's relations, in the order of its `relationships.txt`."""

_ROW = {word: row for row, word in enumerate(RELATIONS)} | {
    # ours that 3DSSG says otherwise; "same room" it does not say
    NEXT_TO: RELATIONS.index("close by"),
    ABOVE: RELATIONS.index("higher than"),
}


class ImageFeatures(Protocol):
    """Turns images and crops of them into features of one space."""

    @property
    def key(self) -> str:
        """What decides the features: they compare only where keys are equal."""

    @property
    def dimension(self) -> int:
        """Numbers of a feature, f."""

    def grid(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Features (rows, columns, f), unit vectors, of an image (H, W, 3), sRGB, any size."""

    def crop(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """One feature (f,), a unit vector, of an image (H, W, 3) that shows one thing."""


def features_named(
    name: str, *, weights: Path | str | None = None, device: str = "cpu"
) -> ImageFeatures:
    """Features by name, one of `FEATURES`; `weights` are a file with those of DINOv2.

    Raises
    ------
    OptionError
        There are none of this name, or `weights` are given to what has none.
    InputError, MissingExtraError, ServiceError
        As `dino.DinoFeatures.load`.

    """
    if name == "dinov2":
        from placegraph_learn.scenegraphloc.dino import DinoFeatures

        return DinoFeatures.load(weights, device=device)
    if name != "colour":
        raise OptionError(f"features is {name!r}; it is one of {', '.join(FEATURES)}.")
    if weights is not None:
        raise OptionError("feature_weights: features of colour have none; leave them out.")
    return ColourFeatures()


_CELL = 8  # pixels of a patch, each way, that statistics are made of
_LEVELS = (0.1, 0.5, 0.9)
_WEIGHTS = np.repeat(np.array([0.8, 3.0, 5.0, 4.0, 1.0]), [4, 4, 4, 4, 1]).astype(np.float32)
"""Of brightness, two chromaticities, edges, and a constant: their usual sizes are made alike."""


class ColourFeatures:
    """Levels of brightness and chromaticity, and the directions of edges, of each patch.

    A baseline and a stand-in for tests and synthetic worlds: 17 numbers that say little of what a
    thing is, but need no weights and no time.
    """

    key = "colour-1"
    dimension = len(_WEIGHTS)

    def grid(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """As `ImageFeatures.grid`."""
        rows, columns = GRID if image.shape[1] >= image.shape[0] else GRID[::-1]
        return _statistics(_resized(image, columns * _CELL, rows * _CELL), rows, columns)

    def crop(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """As `ImageFeatures.crop`."""
        out: NDArray[np.float32] = _statistics(_resized(image, 4 * _CELL, 4 * _CELL), 1, 1)[0, 0]
        return out


def _resized(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.float32]:
    if not image.size:
        raise OptionError(f"image: shape {image.shape}; it needs at least one pixel.")
    small = Image.fromarray(image).resize((width, height), Image.Resampling.BOX)
    return np.asarray(small, np.float32) / np.float32(255.0)


def _statistics(image: NDArray[np.float32], rows: int, columns: int) -> NDArray[np.float32]:
    total = image.sum(axis=2)
    bright = np.log(total + 0.1)
    red = (image[..., 0] - image[..., 2]) / (total + 0.1)
    green = (2.0 * image[..., 1] - image[..., 0] - image[..., 2]) / (total + 0.1)

    def blocks(plane: NDArray[np.floating]) -> NDArray[np.floating]:
        h, w = plane.shape
        cut = plane.reshape(rows, h // rows, columns, w // columns)
        return cut.swapaxes(1, 2).reshape(rows, columns, -1)

    parts = []
    for plane in (bright, red, green):
        cells = blocks(plane)
        parts += [*np.quantile(cells, _LEVELS, axis=2), cells.mean(axis=2)]
    down, across = np.gradient(bright)
    strength = np.hypot(down, across)
    turn = np.arctan2(down, across)  # an edge and its reverse are one direction
    for k in range(4):
        near = np.cos(2.0 * (turn - k * np.pi / 4.0))
        parts.append(blocks(strength * np.maximum(near, 0.0)).mean(axis=2))
    parts.append(np.ones((rows, columns)))
    out = np.stack(parts, axis=2).astype(np.float32) * _WEIGHTS
    unit: NDArray[np.float32] = out / np.linalg.norm(out, axis=2, keepdims=True)
    return unit


def relation_row(relation: str) -> int | None:
    """Row of an edge's name in `RELATIONS`; None where 3DSSG has nothing like it."""
    return _ROW.get(relation.strip().lower())


def read_attributes(path: str | PathLike[str]) -> tuple[str, ...]:
    """Attribute words in their order: a JSON list, or a text file with one a line.

    The published network counts the 164 of `obj_attr.pkl`, which comes with SGAligner's data:
    write its words in such a file. Raises `InputError` where the file is missing, empty, no text,
    or names a word twice.
    """
    try:
        text = regular(Path(path)).read_text(encoding="utf-8")
        listed = json.loads(text) if text.lstrip().startswith("[") else text.splitlines()
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: no list of attributes ({str(error)[:100]}); give a text file, a word a line."
        ) from error
    if not all(isinstance(word, str) for word in listed):
        raise InputError(f"{path}: an attribute is no word; give a list of words.")
    words = tuple(word.strip().lower() for word in listed if word.strip())
    if not words or len(set(words)) < len(words):
        what = "holds no words" if not words else "names a word twice"
        raise InputError(f"{path}: {what}; give every attribute once, in their order.")
    return words
