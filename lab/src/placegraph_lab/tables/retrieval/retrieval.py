"""In which scene was it? The protocol of Table 5: recall among 10 and 50 scenes, by length.

Every query belongs to one place. It is searched among that place and 9, or 49, others drawn at
random, and among 50 others without it, where the right answer is that it is none of them. What is
timed is searching alone: what encoders say of the frames is known before.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol
from zlib import crc32

import numpy as np

from placegraph.indoor.encode import Encoder, vectors_of
from placegraph.indoor.library import SceneLibrary
from placegraph.indoor.library.library import Entry
from placegraph.indoor.library.search import SearchOptions, encode, scores
from placegraph.indoor.library.signature import Index, Signature, signature_of
from placegraph.io.capture.capture import Capture

if TYPE_CHECKING:
    from placegraph_lab.tables.retrieval.retrieval_places import Place, Walk

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
    """What a search said of one query, beside the truth."""

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

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings."""
        return asdict(self)


@dataclass(frozen=True)
class Found:
    """Scenes, likeliest first."""

    names: tuple[str, ...]
    scores: tuple[float, ...]
    probabilities: tuple[float, ...]
    elsewhere: float
    status: str  # empty of a method that does not judge itself


class Searcher(Protocol):
    """Anything that finds scenes."""

    def search(self, capture: Capture) -> Found:
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

    def search(self, capture: Capture) -> Found:
        """Scenes by their score."""
        query = encode(list(capture), self._encoders, exact=True)
        total = scores(self._index, query, SearchOptions(method="cosines")).total
        order = np.argsort(-total, kind="stable")
        return Found(
            tuple(self._names[i] for i in order),
            tuple(total[order].tolist()),
            tuple(0.0 for _ in order),
            0.0,
            "",
        )


class Ours:
    """`SceneLibrary.search`."""

    def __init__(self, library: SceneLibrary, options: SearchOptions) -> None:
        self._library, self._options = library, options

    def search(self, capture: Capture) -> Found:
        """Scenes by their posterior."""
        estimate = self._library.search(capture, options=self._options, most=len(self._library))
        return Found(
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
    """Method that searches a library, warm: its columns are made."""
    if METHODS[method].method == "cosines":
        return Cosines(library)
    _ = library.index
    return Ours(library, METHODS[method])


class Scenes:
    """Signatures of all places, by as many encoders as were asked for."""

    def __init__(self, places: Iterable[Place]) -> None:
        self._places = tuple(places)
        self.signatures: dict[str, Signature] = {}

    @property
    def names(self) -> list[str]:
        """Names of all places."""
        return [place.name for place in self._places]

    def know(self, encoder: Encoder) -> None:
        """Vectors of an encoder beside those there are."""
        for place in self._places:
            known = self.signatures.get(place.name)
            if known is None:
                self.signatures[place.name] = signature_of(place.scene, [encoder])
            elif encoder.key not in known.vectors:
                vectors = {**known.vectors, encoder.key: vectors_of(encoder, place.scene, ())}
                self.signatures[place.name] = replace(known, vectors=vectors)

    def library(self, names: Iterable[str], encoders: Sequence[Encoder]) -> SceneLibrary:
        """Library of some scenes."""
        return library_of({name: self.signatures[name] for name in names}, encoders)


def library_of(signatures: Mapping[str, Signature], encoders: Sequence[Encoder]) -> SceneLibrary:
    """Library of scenes whose maps are not there: it can be searched and saved."""
    made = SceneLibrary(encoders)
    for name, signature in signatures.items():
        vectors = {e.key: signature.vectors[e.key] for e in encoders}
        made.insert(name, Entry(replace(signature, vectors=vectors), Path(f"{name}.scene")))
    return made


def kilobytes(library: SceneLibrary) -> float:
    """Size of a library's file, by scene."""
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
    """Name and frames of the queries of a walk."""
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
    """Chance that the right scene is among the first k, those as good as it being in any order."""
    if not answer.rank:
        return 0.0
    return min(1.0, max(0.0, (k - answer.rank + 1) / answer.tied))


def recall(answers: Sequence[Answer], k: int) -> float:
    """Share of answers that have the right scene among the first k; NaN of none."""
    return float(np.mean([hit(a, k) for a in answers])) if answers else float("nan")
