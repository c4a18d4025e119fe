"""Runs the retrieval benchmark: every row, method, pool and length; answers are written down."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from placegraph.indoor.encode import Encoder
from placegraph.indoor.library import SceneLibrary
from placegraph_lab.tables.retrieval.retrieval import (
    ABSENT,
    LENGTHS,
    METHODS,
    POOLS,
    Answer,
    Scenes,
    ask,
    kilobytes,
    pool,
    queries,
    searcher,
)
from placegraph_lab.tables.retrieval.retrieval_places import Place, Walk
from placegraph_lab.tables.retrieval.retrieval_scale import Scale, measure
from placegraph_lab.tables.retrieval.retrieval_vectors import (
    NOISY,
    ROWS,
    Encoded,
    all_encoded,
    encoder_of,
    replay,
)
from placegraph_lab.tables.runner import INDOOR, WORLDS, Journal, code_key

WHOLE = ("paper", "ours")
"""Methods that are asked in every pool; the others, ablations, are asked among 50."""
ABLATED = (NOISY,)  # rows that are asked without parts of the method, too


@dataclass(frozen=True)
class Row:
    """What one encoder came to."""

    name: str
    answers: dict[tuple[str, str, int], list[Answer]]  # by method, pool and length
    encoding: float  # milliseconds of a frame; the median
    kilobytes: float  # of a scene in a library's file
    objects: float  # of a scene


class Study:
    """Places, walks, and what was asked about them.

    `places`, `walks`: scenes, and what is asked about them; `cache`: folder for vectors; `journal`:
    where answers are written down; `tell`: is told what is being done.
    """

    def __init__(
        self,
        places: Sequence[Place],
        walks: Sequence[Walk],
        cache: Path,
        journal: Journal,
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.places, self.walks, self.cache, self.journal = places, walks, cache, journal
        self.tell = tell
        names = {name for walk in walks for name in walk.capture.label_names.values()}
        self.vocabulary = sorted(names)
        """All that label images of any walk say."""
        self._scenes = Scenes(places)

    def row(self, name: str) -> Row:
        """Ask about every walk with one encoder; raises as `encoder_of` does."""
        encoders, walks = self._known(name)
        code = code_key((*INDOOR, *WORLDS, "placegraph_lab/tables/retrieval"))
        base = f"{code} {' '.join(e.key for e in encoders)} {name} {len(self.places)}"
        answers: dict[tuple[str, str, int], list[Answer]] = {}
        by_place: dict[str, list[Encoded]] = {}
        for known in walks:
            by_place.setdefault(known.walk.place, []).append(known)
        for place, own in by_place.items():
            self.tell(f"{name}: {place}")
            for kind, methods in _asked(name).items():
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

    def scale(self, name: str, rng: np.random.Generator, scenes: int) -> list[Scale]:
        """Search a library of so many scenes with one encoder."""
        encoders, walks = self._known(name)
        self.tell(f"{name}: {scenes:,} scenes")
        return measure(name, self._scenes.signatures, encoders, walks, rng, scenes=scenes)

    def _known(self, name: str) -> tuple[list[Encoder], list[Encoded]]:
        """Encoders of a row, known to all scenes, and what they say of the walks."""
        encoders = [encoder_of(part) for part in ROWS[name]]
        self.tell(f"{name}: {len(self.places)} scenes, {len(self.walks)} walks")
        for encoder in encoders:
            self._scenes.know(encoder)
        found = (
            all_encoded(walk, ROWS[name], encoders, self.vocabulary, self.cache)
            for walk in self.walks
        )
        return [replay(e) for e in encoders], [known for known in found if known is not None]

    def _rivals(self, place: str) -> list[str]:
        """A place and all of other rooms."""
        room = next(p.room for p in self.places if p.name == place)
        return [p.name for p in self.places if p.name == place or not room or p.room != room]

    def _of(
        self, walks: Sequence[Encoded], library: SceneLibrary, base: str, method: str
    ) -> Iterable[Answer]:
        """Answers to all queries of one place."""
        asked = None
        for walk in (known.walk for known in walks):
            for length in LENGTHS:
                for name, capture in queries(walk, length):
                    key = f"{base} {name}"
                    if key not in self.journal:
                        if asked is None:
                            asked = searcher(library, method)
                            asked.search(capture)  # compiled code is loaded
                        self.journal.put(key, ask(asked, walk, name, capture).to_dict())
                    yield Answer(**self.journal[key])


def _asked(row: str) -> dict[str, tuple[str, ...]]:
    """Pools, and the methods that are asked in each."""
    found: dict[str, tuple[str, ...]] = dict.fromkeys(POOLS, WHOLE)
    if row in ABLATED:
        found["50"] = tuple(METHODS)
    return {**found, ABSENT: ("ours",)}
