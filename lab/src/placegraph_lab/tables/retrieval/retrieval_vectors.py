"""Errors that stay: a thing taken for another in one frame is taken for it in the next ones, too.

Segmentations err like that. The noise of `label_noise` is drawn for every patch by itself, so that
many frames wash it out; this one is drawn for a thing as long as it is in view.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from placegraph.core.geometry import Camera
from placegraph.errors import OptionError
from placegraph.indoor.encode import Encoder
from placegraph.indoor.encode import encoder as encoder_named
from placegraph.indoor.encode.labels import LabelsEncoder
from placegraph.indoor.map.scene import Scene
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame, Images
from placegraph_lab.tables.indoor.bench import SHARE, NoisyLabels
from placegraph_lab.tables.retrieval.retrieval_places import Walk
from placegraph_lab.tables.runner import INDOOR, WORLDS, code_key

_AROUND = np.ones((3, 3), np.bool_)


class NoisyThings(NoisyLabels):
    """An encoder of labels that mislabels whole things, alike in all frames that follow.

    A thing is a connected region of patches that say the same; it is the one of the frame before
    that says the same within a patch of it, the largest of several. Frames are to be asked for
    in order, each once. Parameters and errors are those of `NoisyLabels`.
    """

    def __init__(
        self,
        encoder: LabelsEncoder,
        vocabulary: Iterable[str],
        share: float = SHARE,
        *,
        seed: int = 0,
        name: str = "",
    ) -> None:
        super().__init__(encoder, vocabulary, share, seed=seed, name=name)
        self._rng = np.random.default_rng([seed, crc32(name.encode())])
        self._words: dict[bytes, int] = {}
        self._before: tuple[NDArray[np.int64], NDArray[np.int64]] | None = None
        self._taken: list[NDArray[np.float32] | None] = []
        """Of each thing what it is taken for; None: for itself."""

    def patches(self, image: Frame) -> NDArray[np.float32] | None:
        """Vectors (rows, columns, d) of the next frame's patches, those of some things wrong."""
        clean = self.encoder.patches(image)
        if clean is None:
            return None
        words = self._numbered(clean)
        things = np.full(words.shape, -1)
        out = clean.copy()
        for word in np.unique(words[words >= 0]):
            regions, count = ndimage.label(words == word)
            for region in range(1, count + 1):
                own = regions == region
                thing = self._before_this(own, int(word))
                if thing is None:
                    thing = len(self._taken)
                    self._taken.append(self._drawn(clean[own][0]))
                things[own] = thing
                taken = self._taken[thing]
                if taken is not None:
                    out[own] = taken
        self._before = words, things
        return out

    def _numbered(self, clean: NDArray[np.float32]) -> NDArray[np.int64]:
        """Number (rows, columns) of what each patch says; -1 of nothing."""
        words = np.full(clean.shape[:2], -1)
        for at in zip(*np.nonzero(clean.any(axis=2)), strict=True):
            words[at] = self._words.setdefault(clean[at].tobytes(), len(self._words))
        return words

    def _before_this(self, own: NDArray[np.bool_], word: int) -> int | None:
        if self._before is None:
            return None
        words, things = self._before
        near = things[ndimage.binary_dilation(own, _AROUND) & (words == word)]
        return int(np.bincount(near).argmax()) if near.size else None

    def _drawn(self, vector: NDArray[np.float32]) -> NDArray[np.float32] | None:
        if self._rng.random() >= self.share:
            return None
        others = self.vectors[self.vectors @ vector < 1 - 1e-5]
        return np.asarray(others[self._rng.integers(len(others))])


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

    walk: Walk  # its frames bring the vectors that `Replay` says
    seconds: float  # of encoding a frame; the median


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
    vectors: dict[str, NDArray[np.float32]]  # by the key of the encoder

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
    path = cache / f"scene_retrieval_vectors_{code_key((*INDOOR, *WORLDS))}" / f"{name}.npz"
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
