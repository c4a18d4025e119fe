"""In which scene was it? The protocol of Table 5: recall among 10 and 50 scenes, by length.

Every query belongs to one place. It is searched among that place and 9, or 49, others drawn at
random, and among 50 others without it, where the right answer is that it is none of them. What is
timed is searching alone: what encoders say of the frames is known before.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol
from zlib import crc32

import numpy as np

from placegraph.errors import OptionError
from placegraph.estimate import Status
from placegraph.indoor.library import SceneLibrary
from placegraph.indoor.library.library import Entry
from placegraph.indoor.library.options import SearchOptions
from placegraph.indoor.library.signature import signature_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from placegraph.evaluate.scene_retrieval_places import Place, Walk
    from placegraph.formats.capture import Capture
    from placegraph.indoor.encode import Encoder
    from placegraph.indoor.library.signature import Signature

LENGTHS = (1, 5, 10, 25, 50)
"""Frames of a query."""
EVERY = {1: 25, 5: 25, 10: 25, 25: 25, 50: 50}
"""Frames from one query of a walk to the next, by length."""
POOLS = {"10": 10, "50": 50}
"""Scenes searched, the right one among them."""
ABSENT = "absent"
"""A pool of 50 scenes without the right one."""
MOST = 10
"""Ranks that are looked at."""


@dataclass(frozen=True)
class Answer:
    """What a search said of one query, beside the truth."""

    query: str
    place: str
    changed: bool
    frames: int
    rank: int
    """Of the right scene, from 1 on; 0: not among the first `MOST`."""
    right: float
    """Probability of the right scene."""
    probability: float
    """Of the scene named first."""
    elsewhere: float
    """Probability of being in none of the scenes."""
    status: str
    milliseconds: float
    """Of searching, all frames encoded."""

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings."""
        return asdict(self)


@dataclass(frozen=True)
class Found:
    """Scenes, likeliest first."""

    names: tuple[str, ...]
    probabilities: tuple[float, ...]
    elsewhere: float
    status: str


class Searcher(Protocol):
    """Anything that finds scenes."""

    def search(self, capture: Capture) -> Found:
        """Scenes that a capture may have been taken in."""


class PaperSum:
    """The paper's score (Sec. 4) as it stands there, in NumPy.

    Sum over frames of the mean over patches of the best cosine over the scene's nodes. It makes no
    probabilities: the best scene gets all, and nothing is ever ambiguous.
    """

    def __init__(self, encoder: Encoder, vectors: Mapping[str, NDArray[np.float32]]) -> None:
        self._encoder = encoder
        self._names = tuple(vectors)
        self._nodes = np.concatenate(list(vectors.values()))
        self._starts = np.cumsum([0, *(len(v) for v in vectors.values())])[:-1]

    def scores(self, capture: Capture) -> NDArray[np.float64]:
        """Score (S,) of each scene."""
        total = np.zeros(len(self._names))
        for frame in capture:
            image = self._encoder.patches(frame)
            if image is None:
                continue
            flat = image.reshape(-1, image.shape[2])
            said = flat[flat.any(axis=1)]
            if len(said):
                cosines = said @ self._nodes.T
                total += np.maximum.reduceat(cosines, self._starts, axis=1).mean(axis=0)
        return total

    def search(self, capture: Capture) -> Found:
        """Scenes by their score."""
        order = np.argsort(-self.scores(capture), kind="stable")[:MOST]
        return Found(
            tuple(self._names[i] for i in order),
            (1.0, *(0.0 for _ in order[1:])),
            0.0,
            Status.OK.name,
        )


class Ours:
    """`SceneLibrary.search`."""

    def __init__(self, library: SceneLibrary, options: SearchOptions) -> None:
        self._library, self._options = library, options

    def search(self, capture: Capture) -> Found:
        """Scenes by their posterior."""
        estimate = self._library.search(capture, options=self._options, most=MOST)
        return Found(
            tuple(mode.scene for mode in estimate.modes),
            tuple(mode.probability for mode in estimate.modes),
            estimate.elsewhere,
            estimate.status.name,
        )


METHODS: dict[str, SearchOptions | None] = {
    "paper": None,
    "ours": SearchOptions(),
    "without rarity": SearchOptions(rarity=False),
    "without geometry": SearchOptions(geometry=False),
    "without odometry": SearchOptions(odometry=False),
}
"""Options of the library; None: the paper's sum, by itself."""


class Scenes:
    """Signatures of all places, and the searchers made of some of them."""

    def __init__(self, places: Iterable[Place], encoders: Sequence[Encoder]) -> None:
        self.signatures: dict[str, Signature] = {
            place.name: signature_of(place.scene, encoders) for place in places
        }

    @property
    def names(self) -> list[str]:
        """Names of all places."""
        return list(self.signatures)

    def library(self, names: Iterable[str], encoder: Encoder) -> SceneLibrary:
        """Library of some scenes."""
        return library_of({name: self.signatures[name] for name in names}, encoder)

    def searcher(self, names: Sequence[str], encoder: Encoder, method: str) -> Searcher:
        """Method that searches some scenes, warm: its columns are made."""
        options = METHODS[method]
        if options is None:
            vectors = {name: self.signatures[name].vectors[encoder.key] for name in names}
            return PaperSum(encoder, vectors)
        library = self.library(names, encoder)
        _ = library.index
        return Ours(library, options)


def library_of(signatures: Mapping[str, Signature], encoder: Encoder) -> SceneLibrary:
    """Library of scenes whose maps are not there: it can be searched and saved."""
    made = SceneLibrary([encoder])
    for name, signature in signatures.items():
        made.insert(name, Entry(signature, Path(f"{name}.scene")))
    return made


def kilobytes(library: SceneLibrary) -> float:
    """Size of a library's file, by scene."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "all.library"
        library.save(path)
        return path.stat().st_size / 1e3 / len(library)


def pool(place: str, names: Sequence[str], kind: str) -> list[str]:
    """Scenes that queries of a place are searched among: the same ones whatever the encoder.

    The 10 are among the 50; the order says nothing of which is right.
    """
    rng = np.random.default_rng(crc32(place.encode()))
    others = [str(name) for name in rng.permutation([n for n in names if n != place])]
    size = POOLS.get(kind, max(POOLS.values()))
    if len(others) < size - (kind != ABSENT):
        raise OptionError(f"{len(names)} scenes are too few for a pool of {size}.")
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
    rank = found.names.index(walk.place) + 1 if walk.place in found.names else 0
    return Answer(
        query=query,
        place=walk.place,
        changed=walk.changed,
        frames=len(capture),
        rank=rank,
        right=found.probabilities[rank - 1] if rank else 0.0,
        probability=found.probabilities[0] if found.names else 0.0,
        elsewhere=found.elsewhere,
        status=found.status,
        milliseconds=1e3 * seconds,
    )


def recall(answers: Sequence[Answer], k: int) -> float:
    """Share of answers that have the right scene among the first k; NaN of none."""
    hits = [1 <= a.rank <= k for a in answers]
    return float(np.mean(hits)) if hits else float("nan")
