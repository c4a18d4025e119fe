"""In which scene was it? The protocol of Table 5: recall among 10 and 50 scenes, by length.

Every query belongs to one place. It is searched among that place and 9, or 49, others drawn at
random, and among 50 others without it, where the right answer is that it is none of them. What is
timed is searching alone: what encoders say of the frames is known before.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import rotation_z
from placegraph.indoor.encode import Encoder, encode_objects
from placegraph.indoor.library import SceneLibrary
from placegraph.indoor.library.library import Entry
from placegraph.indoor.library.search import SearchOptions, encode_frames, score_scenes
from placegraph.indoor.library.signature import TURNS, Index, Signature, compute_signature
from placegraph.io.capture.capture import Capture
from placegraph_lab.tables.runner import INDOOR, WORLDS, Journal, code_key
from placegraph_lab.tables.scene.places import (
    NOISY,
    ROWS,
    EncodedWalk,
    Place,
    Walk,
    all_encoded,
    encoder_of,
    replay,
)

LENGTHS = (1, 5, 10, 25, 50)  # frames of a query
EVERY = {
    1: 25,
    5: 25,
    10: 25,
    25: 25,
    50: 50,
}  # frames from one query of a walk to the next, by length
POOLS = {"10": 10, "50": 50}  # scenes searched, the right one among them
ABSENT = "absent"  # A pool of 50 scenes without the right one
_EQUAL = 1e-6  # relative: sums in other orders differ by less


@dataclass(frozen=True)
class Answer:
    """Result of one query, beside the truth."""

    query: str
    place: str
    changed: bool
    frames: int
    rank: int  # of the right scene, from 1 on, where no other is as good; 0: it is not there
    tied: int  # scenes as good as the right one, itself among them
    right: float  # probability of the right scene
    probability: float  # of the scene named first
    elsewhere: float  # probability of being in none of the scenes
    status: str
    milliseconds: float  # of searching, all frames encoded


@dataclass(frozen=True)
class Ranking:
    """Scenes, likeliest first."""

    names: tuple[str, ...]
    scores: tuple[float, ...]
    probabilities: tuple[float, ...]
    elsewhere: float
    status: str  # empty of a method that does not judge itself


class Searcher(Protocol):
    """Anything that finds scenes."""

    def search(self, capture: Capture) -> Ranking:
        """Scenes that a capture may have been taken in."""


class Cosines:
    """The paper's score (Sec. 4), compiled as in `SearchOptions(method="cosines")`.

    Sum over frames of the mean over patches of the best cosine over the scene's nodes. It makes no
    probabilities.
    """

    def __init__(self, library: SceneLibrary) -> None:
        self._names, self._encoders = library.names, library.encoders
        signatures = [library.entry(name).signature for name in library]
        self._index = Index.of(signatures, [e.key for e in self._encoders])

    def search(self, capture: Capture) -> Ranking:
        """Scenes by their score."""
        query = encode_frames(list(capture), self._encoders, exact=True)
        total = score_scenes(self._index, query, SearchOptions(method="cosines")).total
        order = np.argsort(-total, kind="stable")
        return Ranking(
            tuple(self._names[i] for i in order),
            tuple(total[order].tolist()),
            tuple(0.0 for _ in order),
            0.0,
            "",
        )


class LibrarySearch:
    """`SceneLibrary.search`."""

    def __init__(self, library: SceneLibrary, options: SearchOptions) -> None:
        self._library, self._options = library, options

    def search(self, capture: Capture) -> Ranking:
        """Scenes by their posterior."""
        estimate = self._library.search(capture, options=self._options, most=len(self._library))
        return Ranking(
            tuple(mode.scene for mode in estimate.modes),
            tuple(mode.score for mode in estimate.modes),
            tuple(mode.probability for mode in estimate.modes),
            estimate.elsewhere,
            estimate.status.name,
        )


METHODS: dict[str, SearchOptions] = {
    "paper": SearchOptions(method="cosines"),
    "ours": SearchOptions(),
    "without rarity": SearchOptions(rarity=False),
    "without geometry": SearchOptions(geometry=False),
    "without odometry": SearchOptions(odometry=False),
}
"""Options of the library."""


def searcher(library: SceneLibrary, method: str) -> Searcher:
    if METHODS[method].method == "cosines":
        return Cosines(library)
    _ = library.index
    return LibrarySearch(library, METHODS[method])


class Scenes:
    """Signatures of all places, by as many encoders as were asked for."""

    def __init__(self, places: Iterable[Place]) -> None:
        self._places = tuple(places)
        self.signatures: dict[str, Signature] = {}

    @property
    def names(self) -> list[str]:
        return [place.name for place in self._places]

    def know(self, encoder: Encoder) -> None:
        """Vectors of an encoder beside those there are."""
        for place in self._places:
            known = self.signatures.get(place.name)
            if known is None:
                made = compute_signature(place.scene, [encoder], place.pictures)
                self.signatures[place.name] = made
            elif encoder.key not in known.vectors:
                new = encode_objects(encoder, place.scene, place.pictures)
                vectors = {**known.vectors, encoder.key: new}
                self.signatures[place.name] = replace(known, vectors=vectors)

    def library(self, names: Iterable[str], encoders: Sequence[Encoder]) -> SceneLibrary:
        return library_of({name: self.signatures[name] for name in names}, encoders)


def library_of(signatures: Mapping[str, Signature], encoders: Sequence[Encoder]) -> SceneLibrary:
    made = SceneLibrary(encoders)
    for name, signature in signatures.items():
        vectors = {e.key: signature.vectors[e.key] for e in encoders}
        made.insert(name, Entry(replace(signature, vectors=vectors), Path(f"{name}.scene")))
    return made


def kilobytes(library: SceneLibrary) -> float:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "all.library"
        library.save(path)
        return path.stat().st_size / 1e3 / len(library)


def pool(place: str, names: Sequence[str], kind: str) -> list[str]:
    """Scenes that queries of a place are searched among: the same ones whatever the encoder.

    The 10 are among the 50; the order says nothing of which is right. Where there are fewer scenes,
    all of them.
    """
    rng = np.random.default_rng(crc32(place.encode()))
    others = [str(name) for name in rng.permutation([n for n in names if n != place])]
    size = POOLS.get(kind, max(POOLS.values()))
    if kind == ABSENT:
        return others[:size]
    return [str(name) for name in rng.permutation([place, *others[: size - 1]])]


def queries(walk: Walk, length: int) -> Iterator[tuple[str, Capture]]:
    for first in range(0, len(walk.capture) - length + 1, EVERY[length]):
        yield f"{walk.name} {first}:{first + length}", walk.capture[first : first + length]


def ask(searcher: Searcher, walk: Walk, query: str, capture: Capture) -> Answer:
    """Search, and hold the answer against the truth."""
    start = time.perf_counter()
    found = searcher.search(capture)
    seconds = time.perf_counter() - start
    rank, tied, right = 0, 0, 0.0
    if walk.place in found.names:
        row, all_ = found.names.index(walk.place), np.array(found.scores)
        equal = np.isclose(all_, all_[row], rtol=_EQUAL, atol=0.0)
        rank, tied = 1 + int((~equal & (all_ > all_[row])).sum()), int(equal.sum())
        right = found.probabilities[row]
    return Answer(
        query=query,
        place=walk.place,
        changed=walk.changed,
        frames=len(capture),
        rank=rank,
        tied=tied,
        right=right,
        probability=found.probabilities[0],
        elsewhere=found.elsewhere,
        status=found.status,
        milliseconds=1e3 * seconds,
    )


def hit(answer: Answer, k: int) -> float:
    if not answer.rank:
        return 0.0
    return min(1.0, max(0.0, (k - answer.rank + 1) / answer.tied))


def recall(answers: Sequence[Answer], k: int) -> float:
    """Share of answers that have the right scene among the first k; NaN of none."""
    return float(np.mean([hit(a, k) for a in answers])) if answers else float("nan")


WHOLE = ("paper", "ours")
"""Methods that are asked in every pool; the others, ablations, are asked among 50."""
ABLATED = (NOISY,)  # rows that are asked without parts of the method, too


@dataclass(frozen=True)
class Row:
    name: str
    answers: dict[tuple[str, str, int], list[Answer]]  # by method, pool and length
    encoding: float  # milliseconds of a frame; the median
    kilobytes: float  # of a scene in a library's file
    objects: float  # of a scene


class Study:
    """Places, walks, and what was asked about them.

    `places`, `walks`: scenes, and what is asked about them; `cache`: folder for vectors; `journal`:
    where answers are written down; `tell`: is told what is being done; `named`: makes the encoder of a
    part of a row.
    """

    def __init__(
        self,
        places: Sequence[Place],
        walks: Sequence[Walk],
        cache: Path,
        journal: Journal,
        tell: Callable[[str], None] = lambda _: None,
        named: Callable[[str], Encoder] = encoder_of,
    ) -> None:
        self.places, self.walks, self.cache, self.journal = places, walks, cache, journal
        self.tell, self.named = tell, named
        names = {name for walk in walks for name in walk.capture.label_names.values()}
        self.vocabulary = sorted(names)
        """All that label images of any walk say."""
        self._scenes = Scenes(places)

    def row(self, name: str) -> Row:
        encoders, walks = self._encode_walks(name)
        code = code_key((*INDOOR, *WORLDS, "placegraph_lab/tables/scene"))
        base = f"{code} {' '.join(e.key for e in encoders)} {name} {len(self.places)}"
        answers: dict[tuple[str, str, int], list[Answer]] = {}
        by_place: dict[str, list[EncodedWalk]] = {}
        for known in walks:
            by_place.setdefault(known.walk.place, []).append(known)
        for place, own in by_place.items():
            self.tell(f"{name}: {place}")
            for kind, methods in _methods_by_pool(name).items():
                names = pool(place, self._rivals(place), kind)
                library = self._scenes.library(names, encoders)
                for method in methods:
                    for answer in self._of(own, library, f"{base} {method} {kind}", method):
                        answers.setdefault((method, kind, answer.frames), []).append(answer)
        return Row(
            name,
            answers,
            encoding=1e3 * float(np.median([known.seconds for known in walks])),
            kilobytes=kilobytes(self._scenes.library(self._scenes.names, encoders)),
            objects=float(np.mean([len(p.scene) for p in self.places])),
        )

    def _encode_walks(self, name: str) -> tuple[list[Encoder], list[EncodedWalk]]:
        parts = ROWS.get(name, (name,))
        encoders = [self.named(part) for part in parts]
        self.tell(f"{name}: {len(self.places)} scenes, {len(self.walks)} walks")
        for encoder in encoders:
            self._scenes.know(encoder)
        found = (
            all_encoded(walk, parts, encoders, self.vocabulary, self.cache) for walk in self.walks
        )
        return [replay(e) for e in encoders], [known for known in found if known is not None]

    def _rivals(self, place: str) -> list[str]:
        room = next(p.room for p in self.places if p.name == place)
        return [p.name for p in self.places if p.name == place or not room or p.room != room]

    def _of(
        self, walks: Sequence[EncodedWalk], library: SceneLibrary, base: str, method: str
    ) -> Iterable[Answer]:
        asked = None
        for walk in (known.walk for known in walks):
            for length in LENGTHS:
                for name, capture in queries(walk, length):
                    key = f"{base} {name}"
                    if key not in self.journal:
                        if asked is None:
                            asked = searcher(library, method)
                            asked.search(capture)  # compiled code is loaded
                        self.journal.put(key, ask(asked, walk, name, capture))
                    yield Answer(**self.journal[key])


def _methods_by_pool(row: str) -> dict[str, tuple[str, ...]]:
    found: dict[str, tuple[str, ...]] = dict.fromkeys(POOLS, WHOLE)
    if row in ABLATED:
        found["50"] = tuple(METHODS)
    return {**found, ABSENT: ("ours",)}


VARIED = 0.5  # share of a variation's objects that are exchanged
MOVED = 0.2  # standard deviation of where its objects are [m]
APART = 0.2
"""Length of what is added to each vector of what things look like; the vectors of labels are few by
nature, and stay."""


def draw_variations(
    signatures: Mapping[str, Signature], count: int, rng: np.random.Generator
) -> dict[str, Signature]:
    """Further scenes by name: like those there are, but turned, and a share of their objects others."""
    known = list(signatures.values())
    stock = Stock.of(known)
    return {
        f"variation {i + 1}": stock.variation(known[int(rng.integers(len(known)))], rng)
        for i in range(count)
    }


@dataclass(frozen=True)
class Stock:
    """All objects of some scenes, to be exchanged for those of others."""

    labels: tuple[str, ...]  # (M,)
    vectors: Mapping[str, NDArray[np.float32]]  # (M, d) by the key of the encoder

    @classmethod
    def of(cls, signatures: Sequence[Signature]) -> Stock:
        keys = signatures[0].vectors
        return cls(
            tuple(label for s in signatures for label in s.graph.labels),
            {key: np.concatenate([s.vectors[key] for s in signatures]) for key in keys},
        )

    def variation(self, signature: Signature, rng: np.random.Generator) -> Signature:
        """A scene like this, but turned, and a share of its objects others."""
        base = turn_signature(signature, rng)
        named = list(base.graph.labels)
        rows = np.flatnonzero(rng.random(len(base)) < VARIED)
        others = rng.integers(len(self.labels), size=len(rows))
        vectors = {}
        for key, own in base.vectors.items():
            own[rows] = self.vectors[key][others]
            vectors[key] = own if key.startswith("labels") else _astray(own, rng)
        for row, other in zip(rows.tolist(), others.tolist(), strict=True):
            named[row] = self.labels[other]
        graph = replace(base.graph, labels=tuple(named))
        return replace(base, graph=graph, vectors=vectors)


def _astray(vectors: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Unit vectors (N, d) near these; what is zero stays."""
    size = APART / np.sqrt(vectors.shape[1])
    moved = vectors + rng.normal(0.0, size, vectors.shape) * vectors.any(axis=1, keepdims=True)
    lengths = np.linalg.norm(moved, axis=1, keepdims=True)
    return (moved / np.maximum(lengths, 1e-9)).astype(np.float32)


def turn_signature(signature: Signature, rng: np.random.Generator) -> Signature:
    """Signature of the same scene turned by a quarter or more, its objects moved and in any order.

    A library's file that holds both can then not save what they have in common.
    """
    quarters, count, graph = int(rng.integers(4)), len(signature), signature.graph
    rotation = np.round(rotation_z(quarters * np.pi / 2))
    order = rng.permutation(count)
    rank = np.empty(count + 1, np.int64)
    rank[order], rank[count] = np.arange(count), count
    positions = graph.positions @ rotation.T + rng.normal(0.0, MOVED, (count, 3))
    extents = None if graph.extents is None else np.abs(graph.extents @ rotation.T)[order]
    places = signature.places @ rotation[:2, :2].T
    return replace(
        signature,
        graph=replace(
            graph,
            ids=tuple(graph.ids[k] for k in order),
            labels=tuple(graph.labels[k] for k in order),
            names=tuple(graph.names[k] for k in order),
            positions=positions[order],
            extents=extents,
            sources=rank[graph.sources],
            targets=rank[graph.targets],
        ),
        attributes=tuple(signature.attributes[k] for k in order),
        vectors={key: v[order] for key, v in signature.vectors.items()},
        part=signature.part[order],
        share=signature.share[order],
        places=places.astype(np.float32),
        panoramas=np.roll(
            rank[signature.panoramas].astype(np.uint16), quarters * TURNS // 4, axis=2
        ),
    )
