"""Runs the retrieval benchmark: every row, method, pool and length; answers are written down."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from placegraph.evaluate.journal import fingerprint
from placegraph.evaluate.scene_retrieval import (
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
)
from placegraph.evaluate.scene_retrieval_scale import Scale, measure
from placegraph.evaluate.scene_retrieval_vectors import Replay, code_of, encoded, encoder_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    from placegraph.evaluate.journal import Journal
    from placegraph.evaluate.scene_retrieval_places import Place, Walk
    from placegraph.evaluate.scene_retrieval_vectors import Encoded

SEARCHING = (
    "indoor/library/*.py", "indoor/relations.py", "indoor/rooms*.py",
    "indoor/panoramas.py", "indoor/visibility.py", "indoor/sequence.py",
    "evaluate/scene_retrieval.py",
)  # fmt: skip
"""Code that decides what answers are."""
WHOLE = ("paper", "ours")
"""Methods that are asked in every pool; the ablations are asked among 50."""


@dataclass(frozen=True)
class Row:
    """What one encoder came to."""

    name: str
    answers: dict[tuple[str, str, int], list[Answer]]
    """By method, pool and length."""
    encoding: float
    """Milliseconds of a frame; the median."""
    kilobytes: float
    """Of a scene in a library's file."""
    objects: float
    """Of a scene."""


class Study:
    """Places, walks, and what was asked about them.

    Parameters
    ----------
    places, walks
        Scenes, and what is asked about them.
    cache
        Folder for vectors.
    journal
        Where answers are written down.
    tell
        Is told what is being done.

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
        self._rows: dict[str, tuple[Replay, Scenes, list[Encoded]]] = {}  # the last one

    def row(self, name: str) -> Row:
        """Ask about every walk with one encoder; raises as `encoder_of` does."""
        replay, scenes, walks = self._known(name)
        answers: dict[tuple[str, str, int], list[Answer]] = {}
        by_place: dict[str, list[Encoded]] = {}
        for known in walks:
            by_place.setdefault(known.walk.place, []).append(known)
        for place, own in by_place.items():
            self.tell(f"{name}: {place}")
            for method, kind in _asked():
                for answer in self._of(place, own, name, replay, scenes, method, kind):
                    answers.setdefault((method, kind, answer.frames), []).append(answer)
        return Row(
            name,
            answers,
            encoding=1e3 * float(np.median([known.seconds for known in walks])),
            kilobytes=kilobytes(scenes.library(scenes.names, replay)),
            objects=float(np.mean([len(p.scene) for p in self.places])),
        )

    def scale(self, name: str, rng: np.random.Generator, scenes: int) -> list[Scale]:
        """Search a library of so many scenes with one encoder."""
        replay, known, walks = self._known(name)
        self.tell(f"{name}: {scenes:,} scenes")
        return measure(name, known.signatures, replay, walks, rng, scenes=scenes)

    def _known(self, name: str) -> tuple[Replay, Scenes, list[Encoded]]:
        """Encoder of a row, signatures by it, and what it says of the walks that it can encode."""
        if name not in self._rows:
            encoder = encoder_of(name)
            self.tell(f"{name}: {len(self.places)} scenes, {len(self.walks)} walks")
            walks = [
                known
                for walk in self.walks
                if (known := encoded(walk, name, encoder, self.vocabulary, self.cache)) is not None
            ]
            self._rows = {name: (Replay(encoder), Scenes(self.places, [encoder]), walks)}
        return self._rows[name]

    def _of(
        self,
        place: str,
        walks: Sequence[Encoded],
        row: str,
        replay: Replay,
        scenes: Scenes,
        method: str,
        kind: str,
    ) -> Iterable[Answer]:
        """Answers to all queries of one place."""
        wanted = [
            (known.walk, name, capture)
            for known in walks
            for length in LENGTHS
            for name, capture in queries(known.walk, length)
        ]
        names = pool(place, scenes.names, kind)
        code = fingerprint((*SEARCHING, *code_of(row)))
        base = f"{code} {replay.key} {row} {method} {kind} {len(scenes.names)}"
        searcher = None
        for walk, name, capture in wanted:
            key = f"{base} {name}"
            if key not in self.journal:
                if searcher is None:
                    searcher = scenes.searcher(names, replay, method)
                    searcher.search(capture)  # compiled code is loaded
                self.journal.put(key, ask(searcher, walk, name, capture).to_dict())
            yield Answer(**self.journal[key])


def _asked() -> list[tuple[str, str]]:
    """Methods and the pools that they are asked in."""
    return [
        *((method, kind) for method in WHOLE for kind in POOLS),
        *((method, "50") for method in METHODS if method not in WHOLE),
        ("ours", ABSENT),
    ]
