"""A capture as it asks a library: words that its patches say, and where in each frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera, Floats, between, level_from_camera
from placegraph.core.threads import product
from placegraph.errors import OptionError
from placegraph.indoor.encode import Encoder, patches_of
from placegraph.indoor.library.index import distinct
from placegraph.indoor.library.search_kernels import beside, sums_of
from placegraph.indoor.library.signature import BANDS, REACH, TURNS
from placegraph.indoor.pose.query import leveled
from placegraph.io.capture.frame import Frame

WORDS = 128
"""Vectors that the patches of one query are told apart by, where they are not fewer; of T frames
48 + 16 T, if these are fewer."""
_UNIT = 2.0 * np.pi / TURNS


@dataclass(frozen=True, slots=True, eq=False)
class Said:
    """What the patches of T frames say to one encoder."""

    key: str
    """Of the encoder."""
    temperature: float
    words: NDArray[np.float32]
    """(W, d) distinct unit vectors."""
    word: NDArray[np.int32]
    """(P,) word of each patch that says something, frame by frame."""
    frame: NDArray[np.int32]
    """(P,) its frame, 0 to T - 1, ascending."""
    turn: NDArray[np.int32]
    """(P,) bin of its azimuth, relative to the camera's heading."""
    band: NDArray[np.int32]
    """(P,) bin of its elevation; -1: beyond what panoramas show."""
    beside: NDArray[np.int32]
    """(P,) patches around it, of eight, that say the same."""


@dataclass(frozen=True, slots=True, eq=False)
class Query:
    """T frames of one capture, encoded."""

    said: tuple[Said, ...]
    poses: NDArray[np.float64]
    """(T, 4) odometry, level."""

    def __len__(self) -> int:
        return len(self.poses)

    def steps(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Steps (R, 3) from the middle one of some frames to each: x, y [m], bins of yaw."""
        steps = between(self.poses[rows[len(rows) // 2]], self.poses[rows])
        return np.column_stack([steps[:, 0], steps[:, 1], steps[:, 3] / _UNIT])


def encode(frames: Sequence[Frame], encoders: Sequence[Encoder], *, exact: bool = False) -> Query:
    """Encode frames with every encoder that they have something for.

    `exact`: patches keep the vectors that they have, instead of the nearest of some `WORDS`.

    Raises
    ------
    OptionError
        There is no frame; no encoder has anything to encode.
    InputError
        An image is broken.

    """
    if not frames:
        raise OptionError("frames: there is none; a query needs at least one.")
    levels = level_from_camera(np.stack([frame.gravity for frame in frames]))
    said = [s for s in (_said(frames, levels, e, exact) for e in encoders) if s is not None]
    if not said:
        names = ", ".join(e.name for e in encoders)
        raise OptionError(
            f"Nothing to compare: the frames have nothing for {names}. Give frames with labels, or a "
            "library whose scenes are encoded by their looks: appearance."
        )
    return Query(tuple(said), leveled(frames))


def _said(frames: Sequence[Frame], levels: Floats, encoder: Encoder, exact: bool) -> Said | None:
    looked = [(t, patches_of(encoder, frame)) for t, frame in enumerate(frames)]
    seen = [(t, patches) for t, patches in looked if patches is not None]
    if not seen:
        return None
    shapes = np.array([patches.shape[:2] for _, patches in seen])
    flat = np.concatenate([patches.reshape(-1, patches.shape[2]) for _, patches in seen])
    telling = flat.any(axis=1)
    if not telling.any():
        return None
    level = np.concatenate(
        [centres(encoder.camera(frames[t]), patches.shape[:2]) @ levels[t].T for t, patches in seen]
    )[telling]
    elevation = np.arcsin(level[:, 2])
    turn = np.round(np.arctan2(level[:, 1], level[:, 0]) / _UNIT).astype(np.int32) % TURNS
    band = ((elevation / REACH + 1.0) / 2.0 * BANDS).astype(np.int32)
    most = len(flat) if exact else min(WORDS, 48 + 16 * len(seen))
    words, word = told_apart(flat[telling], most)
    said = np.full(len(flat), -1, np.int32)
    said[telling] = word
    return Said(
        key=encoder.key,
        temperature=encoder.temperature,
        words=words,
        word=word,
        frame=np.repeat(np.array([t for t, _ in seen], np.int32), shapes.prod(axis=1))[telling],
        turn=turn,
        band=np.where(np.abs(elevation) < REACH, band, -1).astype(np.int32),
        beside=beside(said, shapes)[telling],
    )


@lru_cache(maxsize=16)
def centres(camera: Camera, grid: tuple[int, int]) -> NDArray[np.float64]:
    """Unit rays (rows * columns, 3) through the centres of a grid's cells, in the camera."""
    rows, columns = grid
    y, x = np.mgrid[:rows, :columns] + 0.5
    uv = np.stack([x * camera.width / columns, y * camera.height / rows], axis=-1)
    rays = camera.directions(uv.reshape(-1, 2))
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def told_apart(
    vectors: NDArray[np.float32], most: int = WORDS
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Distinct vectors (W, d) and the one (P,) that each of vectors (P, d) is, or is nearest to.

    Up to `most` are kept as they are; of more, `most` spread evenly are centres to the others, and
    move to their mean (one round of spherical k-means).
    """
    first, word = distinct(vectors)
    if len(first) <= most:
        return vectors[first], word.astype(np.int32)
    centre = vectors[np.linspace(0, len(vectors) - 1, most).astype(np.int64)]
    nearest = product(vectors, centre.T).argmax(axis=1)
    sums = sums_of(vectors, nearest, most)
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return sums / np.maximum(lengths, 1e-9), nearest.astype(np.int32)
