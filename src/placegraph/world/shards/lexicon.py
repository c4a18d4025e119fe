"""Words of a world: read once against the whole, whichever shards they lead to."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from placegraph.outdoor.map.blocks import Blocks
from placegraph.outdoor.map.names import NameIndex

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from placegraph.outdoor.language.vocabulary import Vocabulary
    from placegraph.world.shards.table import WordTable

    Gather = Callable[[NDArray[np.int64]], "list[Thing]"]


@dataclass(frozen=True, eq=False)
class Thing:
    """An object that is rare enough to be spoken of from out of sight, wherever its shard is."""

    osm_type: int
    osm_id: int
    kind: int
    label: str
    name: str
    words: tuple[str, ...]
    """Labels, and names behind a tilde, that it bears."""
    parts: tuple[NDArray[np.float64], ...]
    """Lines or rings, each (n, 2) longitude, latitude [deg]."""
    center: NDArray[np.float64]
    """(2,) longitude, latitude [deg]."""
    extent: float
    """How far it reaches from its centre [m]; what reaches beyond 1 km is walked in sight."""


@dataclass(eq=False)
class Things:
    """Things that were gathered for one query, by row."""

    labels: tuple[str, ...]
    """All labels of the world."""
    rows: list[Thing]

    @property
    def kind(self) -> NDArray[np.uint8]:
        """(N,) POINT, LINE or AREA."""
        return np.array([thing.kind for thing in self.rows], np.uint8)

    def label(self, i: int) -> str:
        """Most specific label of a thing."""
        return self.rows[i].label


@dataclass(frozen=True, eq=False)
class Words:
    """The vocabulary of a world, made once."""

    table: WordTable

    @cached_property
    def vocabulary(self) -> Vocabulary:
        """What words mean: the shipped vocabulary, and every tag value of the world."""
        from placegraph.outdoor.language.vocabulary import Vocabulary

        return Vocabulary.default().of_map(self.table.labels)

    @cached_property
    def name_index(self) -> NameIndex:
        """Proper names of the world."""
        return NameIndex.build(self.table)

    @cached_property
    def label_index(self) -> dict[str, list[int]]:
        """Tokens by label and by ``key=*``."""
        from placegraph.outdoor.map.objects import index_of

        return index_of(self.table.labels)

    def block_length(self, bearing: float | None) -> float:
        """How long a block is [m]: as anywhere, since it differs from town to town."""
        return Blocks().length(bearing)

    def reads(self, word: int) -> str:
        """What a token reads: a label, or a name behind a tilde."""
        n = len(self.table.labels)
        return self.table.labels[word] if word < n else f"~{self.table.names[word - n]}"


@dataclass(frozen=True, eq=False)
class Gathering:
    """A `Lexicon` of one query: words of the world, and the rare things that it speaks of."""

    words: Words
    gather: Gather
    """Fetches the things that bear tokens from the shards that hold them."""
    objects: Things

    @property
    def label_index(self) -> dict[str, list[int]]:
        """Tokens by label."""
        return self.words.label_index

    @property
    def name_index(self) -> NameIndex:
        """Proper names."""
        return self.words.name_index

    def frequency(self, tokens: NDArray[np.int32], weights: NDArray[np.float32]) -> float:
        """Share of all things in sight, over all viewpoints of the world."""
        return float(weights @ self.words.table.shares[tokens])

    def borne(self, tokens: NDArray[np.int32]) -> NDArray[np.int64]:
        """How many things (K,) bear each of these tokens."""
        return np.asarray(self.words.table.counts[tokens])

    def bearers(self, tokens: NDArray[np.int32]) -> list[NDArray[np.int64]]:
        """Rows of `objects`, which grows by those that were not asked for before."""
        known = {(t.osm_type, t.osm_id): i for i, t in enumerate(self.objects.rows)}
        found: dict[str, set[int]] = {self.words.reads(int(token)): set() for token in tokens}
        for thing in self.gather(np.asarray(tokens, np.int64)):
            row = known.setdefault((thing.osm_type, thing.osm_id), len(known))
            if row == len(self.objects.rows):
                self.objects.rows.append(thing)
            for word in thing.words:
                if word in found:
                    found[word].add(row)
        return [np.array(sorted(found[self.words.reads(int(t))]), np.int64) for t in tokens]
