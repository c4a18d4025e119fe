"""Options of searching a library: plain structs; defaults are what measured best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera, Floats, between, level_from_camera
from placegraph.core.threads import product
from placegraph.errors import OptionError
from placegraph.indoor.encode import Encoder, patches_of
from placegraph.indoor.library.search_kernels import (
    add_told,
    along_ways,
    beside,
    best_cosines,
    held,
    mixtures,
    sums_of,
)
from placegraph.indoor.library.signature import BANDS, REACH, TURNS, distinct
from placegraph.indoor.options import check_numbers, check_positive, check_whole
from placegraph.indoor.pose.window import leveled
from placegraph.io.capture.frame import Frame

if TYPE_CHECKING:
    from placegraph.indoor.library.signature import Index, Vocabulary


@dataclass(frozen=True, slots=True)
class SearchOptions:
    """How a capture is compared with the scenes of a library."""

    method: Literal["likelihood", "cosines"] = "likelihood"
    """``likelihood``: a log-likelihood ratio against the library and the homes beside it; ``cosines``: the
    paper's sum over frames of the mean over patches of the best cosine (Sec. 4)."""
    rarity: bool = True
    """Weigh what is said against how common it is in the library."""
    geometry: bool = True
    """Compare with panoramas: what is seen together, and in which direction."""
    odometry: bool = True
    """Frames lie on one way; without, each frame may lie anywhere in the scene."""
    wrong: float = 0.4
    """Share of patches taken to say something wrong."""
    focus: float = 0.75
    """Share of what is seen in a direction that is the object which fills most of it."""
    witnesses: float = 24.0
    """Patches of a frame that speak independently of each other."""
    thing: float = 6.0
    """Patches that say the same, in all frames together, that speak independently of each other."""
    heat: float = 3.3
    """Nats of log-likelihood that count as one, for a single frame; T frames of one way see much
    the same, and T^0.45 times as many count as one; of two encoders, sqrt(2) times."""
    looks: int = 12
    """Frames compared, spread over the capture: those between show much the same."""
    finalists: int = 16
    """Scenes compared with panoramas: the best by what they hold."""
    shortlist: int = 1000
    """Scenes looked at in a larger library: those whose vectors are nearest."""

    def __post_init__(self) -> None:
        if self.method not in {"likelihood", "cosines"}:
            raise OptionError(f"method is {self.method!r}; it is 'likelihood' or 'cosines'.")
        if not 0 < self.wrong < 1:
            raise OptionError(f"wrong is {self.wrong}; a share lies between 0 and 1.")
        check_numbers(self)
        check_positive(self, "witnesses", "thing", "heat")
        check_whole(self, "looks", "finalists", "shortlist")


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


_COMPARED = 50_000  # vectors that a word is compared with quickly
_TABLE = 1 << 24  # cosines held at once
_TOGETHER = 0.45  # exponent of the frames of one way in what counts as one
BESIDE = 2.0
"""Patches around one that have to say the same for it to count in full."""
ANYTHING = 4e-4
"""Belief that what is said is of anything, at least: what is like nothing in the library, and
nothing in the homes beside it, is no evidence for what it is least unlike."""


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """What a query says of each of S scenes."""

    total: NDArray[np.float64]
    """(S,) [nat], or sums of cosines; the larger the better."""
    heat: float
    """Nats that count as one."""
    seconds: dict[str, float]


def scores(index: Index, query: Query, options: SearchOptions) -> Scores:
    """Scores of all scenes of an index; of a large one those not looked at are as the worst."""
    start = perf_counter()
    said = [s for s in query.said if s.key in index.vocabularies]
    if options.method == "cosines":
        total = np.sum([_cosines(index, s, len(query)) for s in said], axis=0)
        # sums are no likelihoods: a hundredth of the cosine counts as one
        return Scores(total, 0.01 * len(query), {"cosines": perf_counter() - start})
    rows, part = _shortlist(index, said, options)
    ratios = [ratio(s, part.vocabularies[s.key], options) for s in said]
    total = _held(part, query, said, ratios, options)
    seconds = {"held": perf_counter() - start}
    if options.geometry:
        start = perf_counter()
        total = _placed(part, query, said, ratios, total, options)
        seconds["placed"] = perf_counter() - start
    whole = np.full(len(index), total.min())
    whole[rows] = total
    heat = float(options.heat * len(said) ** 0.5 * len(query) ** _TOGETHER)
    return Scores(_of_scenes(whole, index.owner, heat), heat, seconds)


def _of_scenes(
    total: NDArray[np.float64], owner: NDArray[np.int64], heat: float
) -> NDArray[np.float64]:
    """Scores of scenes from those (S,) of their units, any of which the camera may be in."""
    first = np.searchsorted(owner, np.arange(int(owner[-1]) + 1))
    top = np.maximum.reduceat(total, first)
    shares = np.add.reduceat(np.exp((total - top[owner]) / heat), first)
    return np.asarray(top + heat * np.log(shares / np.bincount(owner)))


def _shortlist(
    index: Index, said: list[Said], options: SearchOptions
) -> tuple[NDArray[np.int64], Index]:
    """Rows of the scenes looked at, and their index: all, where words are compared quickly."""
    work = sum(len(index.vocabularies[s.key].vectors) for s in said)
    if len(index) <= options.shortlist or work <= _COMPARED:
        return np.arange(len(index)), index
    means = {
        s.key: np.bincount(s.word, minlength=len(s.words)) @ s.words / len(s.word) for s in said
    }
    rows = index.nearest(means, options.shortlist)
    return rows, index.subset(rows)


def ratio(said: Said, vocabulary: Vocabulary, options: SearchOptions) -> NDArray[np.float32]:
    """How much likelier each word is of a thing that looks like each vector, than of anything.

    (U, W): exp(cosine / temperature) over its mean over what is usually seen. Of what nothing is
    known, nothing follows: 1.
    """
    cosines = product(vocabulary.vectors, said.words.T)
    belief = np.exp((cosines - np.float32(1.0)) * np.float32(1.0 / said.temperature))
    seen = belief[vocabulary.usual]
    usual = vocabulary.common @ seen if options.rarity else seen.mean(axis=0)
    out = belief / np.maximum(usual, np.float32(ANYTHING))
    out[vocabulary.unknown] = 1.0
    return np.ascontiguousarray(out, np.float32)


def _cosines(index: Index, said: Said, frames: int) -> NDArray[np.float64]:
    """Sum over frames of the mean over patches of the best cosine (S,): Sec. 4."""
    vocabulary = index.vocabularies[said.key]
    per_frame = np.bincount(said.frame, minlength=frames)
    weight = np.bincount(said.word, 1.0 / per_frame[said.frame], len(said.words))
    first = np.searchsorted(index.owner, np.arange(int(index.owner[-1]) + 2))
    total = np.zeros(len(first) - 1)
    step = max(1, _TABLE // len(vocabulary.vectors))
    for row in range(0, len(weight), step):
        cosines = said.words[row : row + step] @ vocabulary.vectors.T
        total += best_cosines(
            np.ascontiguousarray(cosines),
            vocabulary.code,
            index.starts[first],
            weight[row : row + step],
        )
    return total


def patch_weights(said: Said, frames: int, options: SearchOptions) -> NDArray[np.float32]:
    """Weight (P,) of each patch, which is no witness of its own.

    Those of one frame count for `witnesses` together at most, and those that say one word for
    `thing`: networks err by whole things, alike in all frames. What no patch beside says is noise.
    """
    per_frame = np.bincount(said.frame, minlength=frames)
    share = np.minimum(1.0, options.witnesses / np.maximum(per_frame, 1))[said.frame]
    share = share * np.minimum(1.0, said.beside / BESIDE)
    per_word = np.bincount(said.word, share, len(said.words))
    capped = np.minimum(1.0, options.thing / np.maximum(per_word, 1e-9))
    return np.asarray(share * capped[said.word], np.float32)


def _held(
    index: Index,
    query: Query,
    said: list[Said],
    ratios: list[NDArray[np.float32]],
    options: SearchOptions,
) -> NDArray[np.float64]:
    """What the patches say of what each unit holds (S,), wherever in it."""
    total = np.zeros(len(index))
    for s, r in zip(said, ratios, strict=True):
        weight = np.bincount(s.word, patch_weights(s, len(query), options), len(s.words))
        code = index.vocabularies[s.key].code
        total += held(r, code, index.share, index.starts, weight, options.wrong)
    return total


def _placed(
    index: Index,
    query: Query,
    said: list[Said],
    ratios: list[NDArray[np.float32]],
    bound: NDArray[np.float64],
    options: SearchOptions,
) -> NDArray[np.float64]:
    """Scores (S,) of the finalists by what is seen where; no other is better than these."""
    able = np.flatnonzero(np.diff(index.place_starts))
    count = min(options.finalists, len(able))
    if not count:
        return bound
    chosen = np.sort(able[np.argpartition(-bound[able], count - 1)[:count]])
    rows = [np.arange(index.starts[s], index.starts[s + 1]) for s in chosen]
    objects = np.concatenate([own[index.shown[own]] for own in rows])
    code = np.zeros(int(index.starts[-1]), np.int32)
    code[objects] = np.arange(len(objects))
    bins, off = _told(index, query, said, ratios, chosen, objects, options)
    told, turns, bands, starts = bins
    every = np.arange(len(query))
    placed = np.zeros(count)
    for group in [every] if options.odometry else list(every[:, None]):
        first, last = starts[group[0]], starts[group[-1] + 1]
        ends = np.append(starts[group], last) - first
        own = (told[first:last], turns[first:last], bands[first:last], ends)
        placed += along_ways(own, query.steps(group), off[group], chosen, code, index)
    total = np.minimum(bound, placed.min())
    total[chosen] = placed
    return total


def _told(
    index: Index,
    query: Query,
    said: list[Said],
    ratios: list[NDArray[np.float32]],
    chosen: NDArray[np.int64],
    objects: NDArray[np.int64],
    options: SearchOptions,
) -> tuple[tuple[NDArray[Any], ...], NDArray[np.float32]]:
    """What bins of frames tell of some objects (O,), and each frame (T,) of being off the map.

    As `along_ways` takes them.
    """
    uses = [s.band >= 0 for s in said]
    where = [
        (s.frame * BANDS + s.band)[use] * TURNS + s.turn[use]
        for s, use in zip(said, uses, strict=True)
    ]
    used = np.zeros(len(query) * BANDS * TURNS, np.bool_)
    for places in where:
        used[places] = True
    bins, number = np.flatnonzero(used), np.cumsum(used) - 1
    told = np.zeros((len(bins), len(objects) + 1), np.float32)
    off = np.zeros(len(query), np.float32)
    # of each object its place among the chosen
    unit = np.searchsorted(chosen, np.searchsorted(index.starts, objects, "right") - 1)
    for s, r, use, places in zip(said, ratios, uses, where, strict=True):
        code = index.vocabularies[s.key].code[objects]
        mixture = mixtures(r, index.vocabularies[s.key].code, index.share, index.starts, chosen)
        # a bin of a panorama names the object that fills most of it; others are there too
        there = np.float32(options.focus) * r[code]
        there += np.float32(1.0 - options.focus) * mixture[unit]
        right = np.ascontiguousarray(there.T) * np.float32(1.0 - options.wrong)
        logs = np.log(right + np.float32(options.wrong))
        weight = patch_weights(s, len(query), options)[use]
        add_told(told, number[places], s.word[use], weight, logs)
        half_wrong = 0.5 * np.log(options.wrong) * weight
        off += np.bincount(s.frame[use], half_wrong, len(query)).astype(np.float32)
    frame, place = np.divmod(bins, BANDS * TURNS)
    band, turn = np.divmod(place, TURNS)
    starts = np.searchsorted(frame, np.arange(len(query) + 1))
    told[:, -1] = (off / np.maximum(1, np.diff(starts)))[frame]
    return (told, turn, band, starts), off
