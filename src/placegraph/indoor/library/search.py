"""Search of the scene that a capture was taken in, or that a text describes (Sec. 4).

The paper sums the best cosines, of every patch as its encoder has it. Here every patch may err: its
likelihood ratio for a scene is how much likelier it is there than in the library and the homes beside it
(`decoys`), so that a wall says little and a piano much. Scenes that hold what was seen are then asked
whether it is seen there *together*: frames are laid along their way through a scene's panoramas.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import Evidence, ObjectRef, PoseEstimate, SceneEstimate, SceneMode
from placegraph.core.geo import EarthPose
from placegraph.core.geometry import Camera, Floats, between, level_from_camera
from placegraph.core.options import check_options, option
from placegraph.core.threads import multiply_matrices
from placegraph.errors import OptionError
from placegraph.indoor.encode import Encoder, encode_patches
from placegraph.indoor.language import Sentence, read
from placegraph.indoor.library import search_kernels as kernels
from placegraph.indoor.library.signature import BANDS, REACH, TURNS, Signature, find_distinct
from placegraph.indoor.likelihood.observe import spread
from placegraph.indoor.pose.window import chosen_frames, level_frames
from placegraph.indoor.status import decide_scene
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame

if TYPE_CHECKING:
    from placegraph.indoor.library.library import SceneLibrary
    from placegraph.indoor.library.signature import Index, Vocabulary

WORDS = 128
"""Vectors that the patches of one query are clustered to, where they are not fewer; of T frames
48 + 16 T, if these are fewer."""
DOUBT, FEW = 1.25, 4
"""Being in none of S scenes is `DOUBT` (S + `FEW`) times as likely, before anything is seen, as being
in a certain one of them."""
UNKNOWN = 0.05  # Probability that a text describes no scene of the library, before it is read
BESIDE = 2.0  # Patches around one that have to say the same for it to count in full
ANYTHING = 4e-4
"""Belief that what is said is of anything, at least: what is like nothing in the library, and
nothing in the homes beside it, is no evidence for what it is least unlike."""
_EXPLAINED = 8  # objects named
_COMPARED = 50_000  # vectors that a word is compared with quickly
_TABLE = 1 << 24  # cosines held at once
_TOGETHER = 0.45  # exponent of the frames of one way in what counts as one
_BIN = 2.0 * np.pi / TURNS


@dataclass(frozen=True, slots=True)
class SearchOptions:
    """Options of comparing a capture with the scenes of a library; defaults measured best."""

    method: Literal["likelihood", "cosines"] = option(
        "likelihood",
        "`likelihood`: log-likelihood ratio against the library and the background homes; "
        "`cosines`: sum over frames of the mean best cosine of the patches, as in the paper "
        "(Sec. 4).",
    )
    rarity: bool = option(True, "Weigh words by how rare they are in the library.")
    geometry: bool = option(
        True, "Compare with panoramas: objects seen together, with their directions."
    )
    odometry: bool = option(
        True,
        "Assume that the frames lie on one path; otherwise each may lie anywhere in the scene.",
    )
    wrong: float = option(0.4, "Share of patches with a wrong word.", above=0, below=1)
    focus: float = option(0.75, "Share of the patches in a direction that show its largest object.")
    patches_per_frame: float = option(24.0, "Number of independent patches in a frame.", above=0)
    patches_per_word: float = option(
        6.0, "Number of independent patches with the same word, over all frames.", above=0
    )
    temperature: float = option(
        3.3,
        "Temperature of the log-likelihood of a single frame. T frames of one way see much the same, "
        "and take T^0.45 times as much; two encoders take sqrt(2) times.",
        above=0,
    )
    max_frames: int = option(12, "Number of frames compared, spread over the capture.", minimum=1)
    finalists: int = option(
        16,
        "Maximum number of scenes compared with panoramas, the best by their objects.",
        minimum=1,
    )
    shortlist: int = option(
        1000, "Maximum number of scenes compared, those with the nearest vectors.", minimum=1
    )

    def __post_init__(self) -> None:
        check_options(self)


@dataclass(frozen=True, slots=True, eq=False)
class PatchWords:
    """Words of the patches of T frames, by one encoder."""

    key: str  # Of the encoder
    temperature: float
    words: NDArray[np.float32]  # (W, d) distinct unit vectors
    word: NDArray[np.int32]  # (P,) word of each patch that says something, frame by frame
    frame: NDArray[np.int32]  # (P,) its frame, 0 to T - 1, ascending
    turn: NDArray[np.int32]  # (P,) bin of its azimuth, relative to the camera's heading
    band: NDArray[np.int32]  # (P,) bin of its elevation; -1: beyond what panoramas show
    agreeing: NDArray[np.int32]  # (P,) patches around it, of eight, that say the same

    def weights(self, frames: int, options: SearchOptions) -> NDArray[np.float32]:
        """Return the weight (P,) of each patch, which is not independent of the others.

        Patches of one frame together count for at most `patches_per_frame`, those of one word for
        at most `patches_per_word`: networks err by whole objects, alike in all frames. A patch that
        agrees with none of its neighbours is noise.
        """
        per_frame = np.bincount(self.frame, minlength=frames)
        share = np.minimum(1.0, options.patches_per_frame / np.maximum(per_frame, 1))[self.frame]
        share = share * np.minimum(1.0, self.agreeing / BESIDE)
        per_word = np.bincount(self.word, share, len(self.words))
        capped = np.minimum(1.0, options.patches_per_word / np.maximum(per_word, 1e-9))
        return np.asarray(share * capped[self.word], np.float32)

    def word_weights(self, frames: int, options: SearchOptions) -> NDArray[np.float64]:
        """Return the total weight (W,) of the patches of each word."""
        weights = self.weights(frames, options)
        return np.asarray(np.bincount(self.word, weights, len(self.words)), np.float64)

    def ratios(self, vocabulary: Vocabulary, options: SearchOptions) -> NDArray[np.float32]:
        """Return likelihood ratios of each word: an object that looks like each vector, against any object.

        (U, W): exp(cosine / temperature) over its mean over what is usually seen. Of what nothing is
        known, nothing follows: 1.
        """
        cosines = multiply_matrices(vocabulary.vectors, self.words.T)
        belief = np.exp((cosines - np.float32(1.0)) * np.float32(1.0 / self.temperature))
        seen = belief[vocabulary.background]
        usual = vocabulary.common @ seen if options.rarity else seen.mean(axis=0)
        out = belief / np.maximum(usual, np.float32(ANYTHING))
        out[vocabulary.unknown] = 1.0
        return np.ascontiguousarray(out, np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Query:
    """T frames of one capture, encoded."""

    parts: tuple[PatchWords, ...]  # By encoder
    poses: NDArray[np.float64]  # (T, 4) odometry, level

    def __len__(self) -> int:
        return len(self.poses)

    def steps(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return steps (R, 3) from the middle one of some frames to each: x, y [m], bins of yaw."""
        steps = between(self.poses[rows[len(rows) // 2]], self.poses[rows])
        return np.column_stack([steps[:, 0], steps[:, 1], steps[:, 3] / _BIN])


def encode_frames(
    frames: Sequence[Frame], encoders: Sequence[Encoder], *, exact: bool = False
) -> Query:
    """Encode frames with every encoder that they have something for.

    `exact`: patches keep the vectors that they have, instead of the nearest of some `WORDS`.

    Raises `OptionError`: there is no frame; no encoder has anything to encode; `InputError`: an
    image is broken.
    """
    if not frames:
        raise OptionError("frames: the query has no frame; give at least one.")
    levels = level_from_camera(np.stack([frame.gravity for frame in frames]))
    found = (_encode_by(frames, levels, e, exact) for e in encoders)
    parts = tuple(part for part in found if part is not None)
    if not parts:
        names = " or ".join(e.name for e in encoders)
        raise OptionError(
            f"The frames show nothing to compare by {names}. Give images that show the place, or "
            "labelled frames."
        )
    return Query(parts, level_frames(frames))


def _encode_by(
    frames: Sequence[Frame], levels: Floats, encoder: Encoder, exact: bool
) -> PatchWords | None:
    looked = [(t, encode_patches(encoder, frame)) for t, frame in enumerate(frames)]
    seen = [(t, patches) for t, patches in looked if patches is not None]
    if not seen:
        return None
    shapes = np.array([patches.shape[:2] for _, patches in seen])
    flat = np.concatenate([patches.reshape(-1, patches.shape[2]) for _, patches in seen])
    informative = flat.any(axis=1)
    if not informative.any():
        return None
    level = np.concatenate([
        _cell_rays(encoder.camera(frames[t]), patches.shape[:2]) @ levels[t].T for t, patches in seen
    ])[informative]  # fmt: skip
    elevation = np.arcsin(level[:, 2])
    turn = np.round(np.arctan2(level[:, 1], level[:, 0]) / _BIN).astype(np.int32) % TURNS
    band = ((elevation / REACH + 1.0) / 2.0 * BANDS).astype(np.int32)
    most = len(flat) if exact else min(WORDS, 48 + 16 * len(seen))
    words, word = cluster_vectors(flat[informative], most)
    every = np.full(len(flat), -1, np.int32)
    every[informative] = word
    return PatchWords(
        encoder.key, encoder.temperature, words, word,
        frame=np.repeat(np.array([t for t, _ in seen], np.int32), shapes.prod(axis=1))[informative],
        turn=turn, band=np.where(np.abs(elevation) < REACH, band, -1).astype(np.int32),
        agreeing=kernels.count_agreeing(every, shapes)[informative],
    )  # fmt: skip


@lru_cache(maxsize=16)
def _cell_rays(camera: Camera, grid: tuple[int, int]) -> NDArray[np.float64]:
    """Return unit rays (rows * columns, 3) through the centres of a grid's cells, in the camera."""
    rows, columns = grid
    y, x = np.mgrid[:rows, :columns] + 0.5
    uv = np.stack([x * camera.width / columns, y * camera.height / rows], axis=-1)
    rays = camera.directions(uv.reshape(-1, 2))
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def cluster_vectors(
    vectors: NDArray[np.float32], most: int = WORDS
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return distinct vectors (W, d) and the one (P,) that each of vectors (P, d) is, or is nearest to.

    Up to `most` are kept as they are; of more, `most` spread evenly are centres to the others, and
    move to their mean (one round of spherical k-means).
    """
    first, word = find_distinct(vectors)
    if len(first) <= most:
        return vectors[first], word.astype(np.int32)
    centre = vectors[np.linspace(0, len(vectors) - 1, most).astype(np.int64)]
    nearest = multiply_matrices(vectors, centre.T).argmax(axis=1)
    sums = kernels.sum_groups(vectors, nearest, most)
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return sums / np.maximum(lengths, 1e-9), nearest.astype(np.int32)


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """Scores of S scenes by a query."""

    total: NDArray[np.float64]
    """(S,) log-likelihood ratios, or sums of cosines; the larger the better."""
    temperature: float  # By which scores are divided
    seconds: dict[str, float]


def score_scenes(index: Index, query: Query, options: SearchOptions) -> Scores:
    """Score all scenes of an index; of a large one those not looked at are as the worst."""
    start = perf_counter()
    parts = [s for s in query.parts if s.key in index.vocabularies]
    if options.method == "cosines":
        total = np.sum([_sum_cosines(index, s, len(query)) for s in parts], axis=0)
        # sums are no likelihoods: a hundredth of the cosine counts as one
        return Scores(total, 0.01 * len(query), {"cosines": perf_counter() - start})
    rows, part = np.arange(len(index)), index
    work = sum(len(index.vocabularies[s.key].vectors) for s in parts)
    if len(index) > options.shortlist and work > _COMPARED:
        means = {
            s.key: np.bincount(s.word, minlength=len(s.words)) @ s.words / len(s.word)
            for s in parts
        }
        rows = index.nearest(means, options.shortlist)
        part = index.subset(rows)
    ratios = [s.ratios(part.vocabularies[s.key], options) for s in parts]
    total = np.zeros(len(part))  # by what each unit holds, wherever in it
    for s, r in zip(parts, ratios, strict=True):
        weight, code = s.word_weights(len(query), options), part.vocabularies[s.key].code
        total += kernels.score_mixtures(r, code, part.share, part.starts, weight, options.wrong)
    seconds = {"held": perf_counter() - start}
    if options.geometry:
        start = perf_counter()
        total = _score_views(part, query, parts, ratios, total, options)
        seconds["placed"] = perf_counter() - start
    whole = np.full(len(index), total.min())
    whole[rows] = total
    temperature = float(options.temperature * len(parts) ** 0.5 * len(query) ** _TOGETHER)
    # of the units of a scene, any of which the camera may be in
    first = np.searchsorted(index.owner, np.arange(int(index.owner[-1]) + 1))
    top = np.maximum.reduceat(whole, first)
    shares = np.add.reduceat(np.exp((whole - top[index.owner]) / temperature), first)
    joined = np.asarray(top + temperature * np.log(shares / np.bincount(index.owner)))
    return Scores(joined, temperature, seconds)


def _sum_cosines(index: Index, part: PatchWords, frames: int) -> NDArray[np.float64]:
    """Sum over frames the mean over patches of the best cosine (S,): Sec. 4."""
    vocabulary = index.vocabularies[part.key]
    per_frame = np.bincount(part.frame, minlength=frames)
    weight = np.bincount(part.word, 1.0 / per_frame[part.frame], len(part.words))
    first = np.searchsorted(index.owner, np.arange(int(index.owner[-1]) + 2))
    total = np.zeros(len(first) - 1)
    step = max(1, _TABLE // len(vocabulary.vectors))
    for row in range(0, len(weight), step):
        cosines = np.ascontiguousarray(part.words[row : row + step] @ vocabulary.vectors.T)
        some = weight[row : row + step]
        total += kernels.sum_best_cosines(cosines, vocabulary.code, index.starts[first], some)
    return total


def _score_views(
    index: Index,
    query: Query,
    parts: list[PatchWords],
    ratios: list[NDArray[np.float32]],
    bound: NDArray[np.float64],
    options: SearchOptions,
) -> NDArray[np.float64]:
    """Score the finalists (S,) by what is seen where; no other is better than these."""
    able = np.flatnonzero(np.diff(index.place_starts))
    count = min(options.finalists, len(able))
    if not count:
        return bound
    chosen = np.sort(able[np.argpartition(-bound[able], count - 1)[:count]])
    rows = [np.arange(index.starts[s], index.starts[s + 1]) for s in chosen]
    objects = np.concatenate([own[index.is_visible[own]] for own in rows])
    code = np.zeros(int(index.starts[-1]), np.int32)
    code[objects] = np.arange(len(objects))
    bins, off = _score_bins(index, query, parts, ratios, chosen, objects, options)
    logs, turns, bands, starts = bins
    every = np.arange(len(query))
    placed = np.zeros(count)
    for group in [every] if options.odometry else list(every[:, None]):
        first, last = starts[group[0]], starts[group[-1] + 1]
        ends = np.append(starts[group], last) - first
        own = (logs[first:last], turns[first:last], bands[first:last], ends)
        placed += kernels.score_paths(own, query.steps(group), off[group], chosen, code, index)
    total = np.minimum(bound, placed.min())
    total[chosen] = placed
    return total


def _score_bins(
    index: Index,
    query: Query,
    parts: list[PatchWords],
    ratios: list[NDArray[np.float32]],
    chosen: NDArray[np.int64],
    objects: NDArray[np.int64],
    options: SearchOptions,
) -> tuple[tuple[NDArray[Any], ...], NDArray[np.float32]]:
    """Score some objects (O,) by the bins of frames, and each frame (T,) for being off the map.

    As `score_paths` takes them.
    """
    uses = [s.band >= 0 for s in parts]
    where = [
        (s.frame * BANDS + s.band)[use] * TURNS + s.turn[use]
        for s, use in zip(parts, uses, strict=True)
    ]
    used = np.zeros(len(query) * BANDS * TURNS, np.bool_)
    for places in where:
        used[places] = True
    bins, number = np.flatnonzero(used), np.cumsum(used) - 1
    out = np.zeros((len(bins), len(objects) + 1), np.float32)
    off = np.zeros(len(query), np.float32)
    # of each object its place among the chosen
    unit = np.searchsorted(chosen, np.searchsorted(index.starts, objects, "right") - 1)
    for s, r, use, places in zip(parts, ratios, uses, where, strict=True):
        code = index.vocabularies[s.key].code[objects]
        mixture = kernels.mix_ratios(
            r, index.vocabularies[s.key].code, index.share, index.starts, chosen
        )
        # a bin of a panorama names the object that fills most of it; others are there too
        there = np.float32(options.focus) * r[code]
        there += np.float32(1.0 - options.focus) * mixture[unit]
        right = np.ascontiguousarray(there.T) * np.float32(1.0 - options.wrong)
        logs = np.log(right + np.float32(options.wrong))
        weight = s.weights(len(query), options)[use]
        kernels.add_log_likelihoods(out, number[places], s.word[use], weight, logs)
        half_wrong = 0.5 * np.log(options.wrong) * weight
        off += np.bincount(s.frame[use], half_wrong, len(query)).astype(np.float32)
    frame, place = np.divmod(bins, BANDS * TURNS)
    band, turn = np.divmod(place, TURNS)
    starts = np.searchsorted(frame, np.arange(len(query) + 1))
    out[:, -1] = (off / np.maximum(1, np.diff(starts)))[frame]
    return (out, turn, band, starts), off


class SceneCollection(ABC):
    """Scenes by rows, to be searched: a library that was read, or shards that are mapped."""

    encoders: tuple[Encoder, ...]
    """By which scenes and captures are compared."""
    missing: int
    """Scenes that are known to be there, and cannot be searched."""
    notes: tuple[str, ...]
    """Why not."""

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def name(self, row: int) -> str:
        """Return the name of a scene."""

    @abstractmethod
    def earth(self, row: int) -> tuple[EarthPose, ...]:
        """Return the anchors of a scene on Earth: one a candidate, likeliest first."""

    @abstractmethod
    def score_frames(self, query: Query, options: SearchOptions) -> Scores:
        """Score all scenes, and the homes beside them, by frames."""

    @abstractmethod
    def score_text(self, sentence: Sentence) -> NDArray[np.float64]:
        """Return the log-likelihood ratio of a text for each scene (n,), against what is usual."""

    @abstractmethod
    def explain(
        self, row: int, query: Query | Sentence, options: SearchOptions
    ) -> tuple[Evidence, ...]:
        """Return the evidence for a scene."""

    @abstractmethod
    def open_scenes(self, rows: Sequence[int]) -> SceneLibrary:
        """Return a library, with their maps, of some scenes at least."""

    def search(
        self,
        query: str | Capture | Sequence[Frame],
        *,
        frames: slice | Sequence[int] | None = None,
        description: str | None = None,
        options: SearchOptions | None = None,
        most: int = 10,
    ) -> SceneEstimate:
        """Return the scenes that a capture was taken in, or a text describes, likeliest first.

        Raises `OptionError`: the library is empty; the query has nothing that can be compared, or
        understood; `InputError`: an image is broken.

        `query`: a capture or frames in order of time; or a text: "a kitchen with two sinks".
        `frames`: which frames; all if not given.
        `description`: what somebody says of the place where a capture was taken.
        `options`: `SearchOptions`; what measured best if not given. Of captures only.
        `most`: modes returned at most.
        """
        if most < 1:
            raise OptionError(f"most is {most}; give at least 1.")
        if isinstance(query, str):
            return infer_from_text(self, query).estimate(self, most)
        text = None if description is None else read(description)
        found = infer_from_frames(self, query, frames, options or SearchOptions(), text)
        return found.estimate(self, most)

    def localize(self, capture: Capture | Sequence[Frame], **options: Any) -> PoseEstimate:  # noqa: ANN401
        """Return scene and pose of a capture: retrieval, then a pose in each of the best, one by one.

        Parameters, result and errors: `placegraph.indoor.library.localize.localize`.
        """
        from placegraph.indoor.library.localize import localize

        return localize(self, capture, **options)


@dataclass(frozen=True, eq=False)
class ScenePosterior:
    """Posterior over all scenes, by frames or a text."""

    shares: NDArray[np.float64]  # (n,) probability of each
    elsewhere: float
    total: NDArray[np.float64]  # (n,) score of each
    query: Query | Sentence
    options: SearchOptions
    seconds: dict[str, float]
    stats: dict[str, Any] = field(default_factory=dict)

    def mode(self, library: SceneCollection, row: int) -> SceneMode:
        """Return a scene as a mode."""
        share = float(self.shares[row])
        earth = tuple(replace(p, probability=p.probability * share) for p in library.earth(row))
        explain = partial(library.explain, row, self.query, self.options)
        return SceneMode(library.name(row), share, float(self.total[row]), earth, explain=explain)

    def estimate(self, library: SceneCollection, most: int) -> SceneEstimate:
        """Return the likeliest scenes."""
        rows = tuple(np.argsort(-self.shares, kind="stable")[:most].tolist())
        modes = tuple(self.mode(library, row) for row in rows)
        status, reason = decide_scene(modes, self.elsewhere)
        left = () if isinstance(self.query, Query) else self.query.ignored
        if left:
            reason += f" Not used: {'; '.join(f'{i.text!r} ({i.reason})' for i in left)}."
        if library.missing:
            reason += f" {library.missing:,} scenes were not searched: {' '.join(library.notes)}"
        seconds = {k: round(v, 5) for k, v in self.seconds.items()}
        stats = {"seconds": seconds, "rows": rows} | self.stats
        return SceneEstimate(status, modes, reason, self.elsewhere, stats, map=library)


def infer_from_frames(
    library: SceneCollection,
    capture: Capture | Sequence[Frame],
    frames: slice | Sequence[int] | None,
    options: SearchOptions,
    text: Sentence | None = None,
) -> ScenePosterior:
    """Return the posterior of a capture and a text; `SceneCollection.search` says more."""
    exact = options.method == "cosines"
    chosen = chosen_frames(capture, frames)
    if not exact:
        chosen = [chosen[i] for i in spread(len(chosen), options.max_frames)]
    start = perf_counter()
    query = encode_frames(chosen, library.encoders, exact=exact)
    return infer_from_query(library, query, options, text, {"encoding": perf_counter() - start})


def infer_from_query(
    library: SceneCollection,
    query: Query,
    options: SearchOptions,
    text: Sentence | None = None,
    seconds: Mapping[str, float] | None = None,
) -> ScenePosterior:
    """Return the posterior of encoded frames and a text.

    Scores beyond the S scenes are those of `load_decoys`, which stand for all other homes: what cannot be
    told from a few dozen is not known. A scene that cannot be searched counts as such a home.
    """
    found = library.score_frames(query, options)
    ratios = np.zeros(len(library)) if text is None else library.score_text(text)
    count, missing = len(ratios), library.missing
    logs = found.total / found.temperature
    logs[:count] += ratios
    others = len(logs) - count
    logs[count:] += np.log((DOUBT * (count + missing + FEW) + missing) / max(1, others))
    shares = np.exp(logs - logs.max())
    shares /= shares.sum()
    return ScenePosterior(
        shares[:count], float(shares[count:].sum()), found.total[:count], query, options,
        {**(seconds or {}), **found.seconds}, {"frames": len(query)},
    )  # fmt: skip


def infer_from_text(library: SceneCollection, text: str) -> ScenePosterior:
    """Return the posterior of a text; `SceneCollection.search` says more."""
    start = perf_counter()
    sentence = read(text)
    if not sentence.statements:
        ignored = "; ".join(f"{i.text!r}: {i.reason}" for i in sentence.ignored)
        raise OptionError(
            f"{text!r} does not describe a place{(f' ({ignored})' if ignored else '')}; "
            "mention a room, its objects, their number, or their relations."
        )
    ratios = library.score_text(sentence)
    # being in none of the scenes is as likely as the average one makes it; so is each that is missing
    every = len(ratios) + library.missing
    off = np.log(UNKNOWN / (1.0 - UNKNOWN) * every + library.missing)
    shares = np.exp(np.append(ratios, off) - max(ratios.max(), off))
    shares /= shares.sum()
    seconds = {"text": perf_counter() - start}
    return ScenePosterior(
        shares[:-1], float(shares[-1]), ratios, sentence, SearchOptions(), seconds
    )


def explain_frames(
    index: Index, place: int, signature: Signature, query: Query, options: SearchOptions
) -> tuple[Evidence, ...]:
    """Return the evidence of each object of scene `place` of an index, and of what it does not have."""
    own = np.flatnonzero(index.owner == place)
    first, last = int(index.starts[own[0]]), int(index.starts[own[-1] + 1])
    rows = np.arange(first, last)
    share = index.share[rows] / len(own)
    gained, seen = np.zeros(last - first), np.zeros(last - first)
    missed = lost = 0.0
    for s in query.parts:
        r = s.ratios(index.vocabularies[s.key].of_objects(rows), options)[: last - first].T
        parts = share * r
        mixture = np.log((1.0 - options.wrong) * parts.sum(axis=1) + options.wrong)
        weight = s.word_weights(len(query), options)
        patches = np.bincount(s.word, minlength=len(s.words))
        fits = mixture > 0
        owner = parts[fits].argmax(axis=1)
        np.add.at(gained, owner, (weight * mixture)[fits])
        np.add.at(seen, owner, patches[fits])
        missed += float(patches[~fits].sum())
        lost += float((weight * mixture)[~fits].sum())
    graph, order = signature.graph, np.argsort(signature.part, kind="stable")
    out = []
    for i in np.argsort(-gained, kind="stable")[:_EXPLAINED]:
        if gained[i] > 0:
            row = order[i]
            ref = ObjectRef(graph.ids[row], graph.labels[row], graph.names[row])
            text = f"{graph.labels[row]} seen in {int(seen[i])} patches"
            out.append(Evidence(text, "for", float(gained[i]), (ref,)))
    if missed:
        out.append(Evidence(f"{int(missed)} patches match no object", "against", lost))
    return tuple(out)
