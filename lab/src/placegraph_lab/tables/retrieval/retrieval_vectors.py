"""What encoders said of the walks of the retrieval benchmark: computed once, kept, replayed.

A `Replay` stands for an encoder and says of a frame what that encoder said of it before, so that
searching is timed without encoding, which is timed by itself.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import OptionError
from placegraph.indoor.encode import Encoder
from placegraph.indoor.encode import encoder as encoder_named
from placegraph.indoor.encode.labels import LabelsEncoder
from placegraph.indoor.map.scene import Scene
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame, Images
from placegraph_lab.tables.indoor.label_noise import NoisyLabels
from placegraph_lab.tables.retrieval.retrieval_noise import NoisyThings
from placegraph_lab.tables.retrieval.retrieval_places import Walk
from placegraph_lab.tables.retrieval.retrieval_walks import RENDERING
from placegraph_lab.tables.runner import fingerprint

NOISY = "labels, 30 % wrong"
THINGS = "labels, 30 % of the things wrong"
BOTH = f"{NOISY}, and appearance"
ROWS: dict[str, tuple[str, ...]] = {
    "labels": ("labels",),
    NOISY: (NOISY,),
    THINGS: (THINGS,),
    BOTH: (NOISY, "appearance"),
    f"{THINGS}, and appearance": (THINGS, "appearance"),
    "appearance": ("appearance",),
}
"""Rows of the tables: what is said of frames, by one encoder or by two."""
ENCODING = (
    "placegraph/indoor/encode/**/*.py",
    "placegraph/indoor/encode/**/data/*",
    "placegraph_lab/tables/indoor/label_noise.py",
    "placegraph_lab/tables/retrieval/retrieval_noise.py",
    *RENDERING,
)
"""Code and data that decide what patches say."""
_ENCODER = {NOISY: "labels", THINGS: "labels"}


def encoder_of(part: str) -> Encoder:
    """Encoder of a part of a row, without noise; raises as `placegraph.indoor.encode.encoder`."""
    return encoder_named(_ENCODER.get(part, part))


def noisy(encoder: Encoder, part: str, vocabulary: Sequence[str], walk: Walk) -> Encoder:
    """Encoder as it errs on one walk; that of `THINGS` is to be asked frame by frame, in order."""
    if part not in _ENCODER:
        return encoder
    if not isinstance(encoder, LabelsEncoder):
        raise OptionError(f"{part}: noise is of labels, not of the encoder {encoder.name}.")
    kind = NoisyLabels if part == NOISY else NoisyThings
    return kind(encoder, vocabulary, name=walk.name)


@dataclass(frozen=True, eq=False)
class Encoded:
    """What an encoder said of a walk."""

    walk: Walk
    """Its frames bring the vectors that `Replay` says."""
    seconds: float
    """Of encoding a frame; the median."""


class Replay:
    """Says what an encoder said before; of maps it says what the encoder does."""

    def __init__(self, encoder: Encoder) -> None:
        self.encoder = encoder
        self.name = encoder.name
        self.key = encoder.key
        self.dimension = encoder.dimension
        self.temperature = encoder.temperature

    def patches(self, image: Frame) -> NDArray[np.float32] | None:
        """Vectors (rows, columns, d) that a frame of `encoded` brings."""
        return _said_of(image, self.key)

    def camera(self, image: Frame) -> Camera:
        """Camera whose image the grid divides."""
        return self.encoder.camera(image)

    def objects(self, scene: Scene, captures: Sequence[Capture] = ()) -> NDArray[np.float32]:
        """Vectors (N, d) of a map's objects."""
        return self.encoder.objects(scene, captures)


class ReplayLabels(LabelsEncoder):
    """As `Replay`, and still an encoder of labels to who asks it for the vector of a label."""

    def patches(self, image: Frame) -> NDArray[np.float32] | None:
        """Vectors (rows, columns, d) that a frame of `encoded` brings."""
        return _said_of(image, self.key)


def replay(encoder: Encoder) -> Encoder:
    """Encoder that says what this one said before."""
    return ReplayLabels() if isinstance(encoder, LabelsEncoder) else Replay(encoder)


def _said_of(image: Frame, key: str) -> NDArray[np.float32] | None:
    if not isinstance(image.images, _Said):
        raise OptionError(f"frame {image.index} has not been encoded; see `encoded`.")
    return image.images.vectors.get(key)


@dataclass(frozen=True, slots=True, eq=False)
class _Said:
    """Images of a frame, and what was said of it."""

    images: Images
    vectors: dict[str, NDArray[np.float32]]
    """By the key of the encoder."""

    def rgb(self) -> NDArray[np.uint8]:
        """As `Frame.rgb`."""
        return self.images.rgb()

    def depth(self) -> NDArray[np.float32] | None:
        """As `Frame.depth`."""
        return self.images.depth()

    def labels(self) -> NDArray[np.int32] | None:
        """As `Frame.labels`."""
        return self.images.labels()


def all_encoded(
    walk: Walk,
    parts: Sequence[str],
    encoders: Sequence[Encoder],
    vocabulary: Sequence[str],
    cache: Path,
) -> Encoded | None:
    """What all encoders of a row say of a walk; None where none has anything for its frames."""
    seconds, known = 0.0, False
    for part, encoder in zip(parts, encoders, strict=True):
        found = encoded(walk, part, encoder, vocabulary, cache)
        if found is not None:
            walk, seconds, known = found.walk, seconds + found.seconds, True
    return Encoded(walk, seconds) if known else None


def encoded(
    walk: Walk, row: str, encoder: Encoder, vocabulary: Sequence[str], cache: Path
) -> Encoded | None:
    """What an encoder says of a walk; None where it has nothing for its frames.

    Answers are kept in a file under `cache` for as long as code, data and the encoder's key stay.
    """
    name = hashlib.sha256(
        "\n".join((row, encoder.key, walk.name, *vocabulary)).encode()
    ).hexdigest()[:24]
    path = cache / f"scene_retrieval_vectors_{fingerprint(ENCODING)}" / f"{name}.npz"
    if not path.exists():
        _write(path, noisy(encoder, row, vocabulary, walk), walk)
    with np.load(path) as file:
        seconds, table, rows = float(file["seconds"]), file["table"], file["rows"]
    if not rows.size:
        return None
    frames = [
        replace(frame, images=_added(frame.images, encoder.key, table[of].astype(np.float32)))
        for frame, of in zip(walk.capture, rows, strict=True)
    ]
    return Encoded(replace(walk, capture=replace(walk.capture, frames=tuple(frames))), seconds)


def _added(images: Images, key: str, vectors: NDArray[np.float32]) -> _Said:
    if isinstance(images, _Said):
        return replace(images, vectors={**images.vectors, key: vectors})
    return _Said(images, {key: vectors})


def _write(path: Path, encoder: Encoder, walk: Walk) -> None:
    """Write vectors (T, rows, columns, d), each that differs once, and the time that a frame took."""
    spent, images = [], []
    for frame in walk.capture:
        frame.rgb(), frame.labels()  # rendering and decoding are not timed
        start = time.perf_counter()
        image = encoder.patches(frame)
        spent.append(time.perf_counter() - start)
        if image is not None:
            images.append(image)
    if images and len(images) != len(walk.capture):
        raise OptionError(f"{walk.name}: only some frames have something for {encoder.name}.")
    whole = np.array(images, np.float32) if images else np.zeros((0, 1, 1, encoder.dimension))
    flat = whole.reshape(-1, encoder.dimension)
    table, rows = np.unique(flat, axis=0, return_inverse=True)
    part = path.with_suffix(".part")
    path.parent.mkdir(parents=True, exist_ok=True)
    with part.open("wb") as file:
        np.savez_compressed(
            file,
            table=table.astype(np.float16) if len(table) > len(rows) // 4 else table,
            rows=rows.reshape(whole.shape[:3]).astype(np.int32),
            seconds=np.median(spent),
        )
    part.replace(path)
