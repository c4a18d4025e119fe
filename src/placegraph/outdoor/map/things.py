"""Things of an extract as columns: small enough to hold many, and put aside on disk as they are."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from placegraph.core.mapfile import spans, starts

STEPS = 1e7
"""Steps in a degree, in which OpenStreetMap has its coordinates."""
WORD, LIST, THING = "\x1f", "\x1e", "\x1d"
"""Between labels, and between names; between the two; between things. No text holds them."""
_CLEAN = str.maketrans({WORD: " ", LIST: " ", THING: " "})


class Thing(NamedTuple):
    """An element of OpenStreetMap with what it is called."""

    osm_type: int
    osm_id: int
    kind: int
    """POINT, LINE or AREA."""
    text: str
    """Its labels and its names, see `text_of`."""
    parts: Sequence[NDArray[np.float64]]
    """Lines or rings, each (n, 2) longitude, latitude [deg]."""


def text_of(labels: Iterable[str], names: Iterable[str]) -> str:
    """Labels and names in one string, which `words_of` takes apart."""
    said = WORD.join([n if n.isprintable() else n.translate(_CLEAN) for n in names])
    return WORD.join(labels) + LIST + said if said else WORD.join(labels)


def words_of(text: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Labels and names of a text."""
    labels, _, names = text.partition(LIST)
    return tuple(labels.split(WORD)), tuple(names.split(WORD)) if names else ()


@dataclass(frozen=True)
class Things:
    """Columns of things; row i of every column is one."""

    osm_type: NDArray[np.uint8]
    osm_id: NDArray[np.int64]
    kind: NDArray[np.uint8]
    part_starts: NDArray[np.int64]
    """(N + 1,) parts of a thing."""
    point_starts: NDArray[np.int64]
    """(P + 1,) points of a part."""
    steps: NDArray[np.int32]
    """(V, 2) longitude, latitude in steps of 1e-7 degrees."""
    texts: list[str]

    def __len__(self) -> int:
        return len(self.texts)

    @classmethod
    def of(cls, things: Sequence[Thing]) -> Self:
        """Columns of things; there must be one."""
        flat = [part for thing in things for part in thing.parts]
        return cls(
            np.array([thing.osm_type for thing in things], np.uint8),
            np.array([thing.osm_id for thing in things], np.int64),
            np.array([thing.kind for thing in things], np.uint8),
            starts([len(thing.parts) for thing in things]),
            starts([len(part) for part in flat]),
            np.rint(np.concatenate(flat) * STEPS).astype(np.int32),
            [thing.text for thing in things],
        )

    @classmethod
    def joined(cls, tables: Sequence[Things]) -> Self:
        """All things of some tables, one table after the other; there must be one."""
        return cls(
            np.concatenate([t.osm_type for t in tables]),
            np.concatenate([t.osm_id for t in tables]),
            np.concatenate([t.kind for t in tables]),
            starts(np.concatenate([np.diff(t.part_starts) for t in tables])),
            starts(np.concatenate([np.diff(t.point_starts) for t in tables])),
            np.concatenate([t.steps for t in tables]),
            [text for t in tables for text in t.texts],
        )

    def take(self, rows: NDArray[np.int64]) -> Self:
        """The things in these rows, in their order."""
        part_starts, parts = spans(self.part_starts, rows)
        point_starts, points = spans(self.point_starts, parts)
        texts = self.texts
        return type(self)(
            self.osm_type[rows], self.osm_id[rows], self.kind[rows], part_starts, point_starts,
            self.steps[points], [texts[row] for row in rows.tolist()],
        )  # fmt: skip

    @property
    def lonlat(self) -> NDArray[np.float64]:
        """Points (V, 2), longitude and latitude [deg]."""
        return self.steps / STEPS

    @property
    def first(self) -> NDArray[np.int64]:
        """(N + 1,) where the points of each thing begin."""
        return self.point_starts[self.part_starts]

    def ends(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """South-western and north-eastern corners (N, 2) of each thing [deg]."""
        first = self.first[:-1]
        low, high = np.minimum.reduceat(self.steps, first), np.maximum.reduceat(self.steps, first)
        return low / STEPS, high / STEPS

    def thing(self, row: int) -> Thing:
        """One of them."""
        first, last = self.part_starts[row : row + 2]
        bounds = self.point_starts[first : last + 1].tolist()
        parts = [self.steps[a:b] / STEPS for a, b in pairwise(bounds)]
        return Thing(
            int(self.osm_type[row]),
            int(self.osm_id[row]),
            int(self.kind[row]),
            self.texts[row],
            parts,
        )


def once(things: Things) -> Things:
    """Things once each, where extracts that touch hold the same ones: the longest version counts."""
    counts = np.diff(things.first)
    order = np.lexsort((-counts, things.osm_id, things.osm_type))
    same = (np.diff(things.osm_id[order]) == 0) & (np.diff(things.osm_type[order]) == 0)
    if not same.any():
        return things
    return things.take(np.sort(order[np.concatenate(([True], ~same))]))
