"""An inverted index over labels, looks and relations of many scenes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from math import log
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.language.likeness import EXACT, fits, kind_by_name, kinds_of, likenesses
from placegraph.indoor.language.seen import COLUMNS
from placegraph.indoor.map.floor import label_words
from placegraph.indoor.map.structure import WORDS, nameless

if TYPE_CHECKING:
    from placegraph.indoor.language.described import Described, Triple


Floats = NDArray[np.float64]


_PLAIN = 0.25
"""How much a wall is spoken of, against a chair."""


class Found(NamedTuple):
    """What of the words that were asked for each unit (U,) has."""

    exact: NDArray[np.float64]
    """How many that are what was asked for."""
    kin: NDArray[np.float64]
    """How many that are that, or kin of it."""
    best: NDArray[np.float32]
    """How well the best of them fits."""
    entries: NDArray[np.int64]
    """Entries of the postings that fit at all."""


class Postings(NamedTuple):
    """In which units a word is, and how often: the entries of word w are starts[w] : starts[w + 1]."""

    starts: NDArray[np.int64]
    units: NDArray[np.int32]
    counts: NDArray[np.float32]

    @property
    def words(self) -> NDArray[np.int64]:
        """(E,) word of each entry."""
        return np.repeat(np.arange(len(self.starts) - 1), np.diff(self.starts))

    def many(self, weights: NDArray[np.float32], total: int) -> Found:
        """How many of the words each of `total` units has.

        `weights`: (W,) how well each word fits what is asked for.
        """
        words = np.flatnonzero(weights > 0.0)
        sizes = self.starts[words + 1] - self.starts[words]
        entries = np.arange(sizes.sum()) + np.repeat(
            self.starts[words] - np.cumsum(sizes) + sizes, sizes
        )
        rows, counts, weight = (
            self.units[entries],
            self.counts[entries],
            weights[words].repeat(sizes),
        )
        best = np.zeros(total, np.float32)
        np.maximum.at(best, rows, weight)
        exact = np.bincount(rows, counts * (weight >= EXACT), total).astype(np.float64)
        return Found(exact, np.bincount(rows, counts, total).astype(np.float64), best, entries)


class Columns(NamedTuple):
    """All units of an index, as arrays."""

    labels: tuple[str, ...]
    relations: tuple[str, ...]
    of_labels: Postings
    of_triples: Postings
    triples: NDArray[np.int64]
    """(T, 3) rows of labels, relations, labels: subject, how, and target of each."""
    looks: NDArray[np.float32]
    """(E, C) looks of the entries of `of_labels` (`seen.COLUMNS`)."""
    room_looks: Floats
    """(U, C) of the rooms."""
    much: Floats
    """(U,) how much there is to speak of."""
    rooms: NDArray[np.float64]
    """(U, R) expected number of rooms of each kind (`kinds.table`)."""
    whole: NDArray[np.bool_]
    """(U,)"""
    scene: NDArray[np.int32]
    """(U,) row of the scene of each unit, ascending."""
    scenes: int
    """How many."""

    def fits(self, asked: str) -> NDArray[np.float32]:
        """How well (L,) the labels fit what is asked for."""
        return fits(asked, self.labels)


def columns_of(scenes: Sequence[Sequence[Described]]) -> Columns:
    """The units of scenes as arrays."""
    flat = [unit for scene in scenes for unit in scene]
    label_row: dict[str, int] = {}
    triple_row: dict[Triple, int] = {}
    relation_row: dict[str, int] = {}
    of_labels = _postings([unit.labels for unit in flat], label_row)
    of_triples = _postings([unit.triples for unit in flat], triple_row)
    triples = [
        (label_row[a], relation_row.setdefault(r, len(relation_row)), label_row[b])
        for a, r, b in triple_row
    ]
    scene = np.repeat(np.arange(len(scenes), dtype=np.int32), [len(s) for s in scenes])
    return Columns(
        labels=tuple(label_row),
        relations=tuple(relation_row),
        of_labels=of_labels,
        of_triples=of_triples,
        triples=np.array(triples, np.int64).reshape(-1, 3),
        looks=_looks(flat, tuple(label_row)),
        room_looks=np.array([unit.room for unit in flat]).reshape(-1, len(COLUMNS)),
        much=np.array([_much(unit) for unit in flat]),
        rooms=_rooms(flat, tuple(label_row), of_labels, scene),
        whole=np.array([unit.whole for unit in flat], np.bool_),
        scene=scene,
        scenes=len(scenes),
    )


def _rooms(
    flat: Sequence[Described], labels: Sequence[str], of_labels: Postings, scene: NDArray[np.int32]
) -> NDArray[np.float64]:
    """Expected number (U, R) of rooms of each kind; of a whole the sum of its rooms'."""
    held = [of_labels.many(likeness, len(flat)).best for likeness in likenesses(labels).T]
    out = kinds_of(np.stack(held, axis=1), np.array([unit.undivided for unit in flat], np.bool_))
    for row, unit in enumerate(flat):
        if unit.name:
            out[row] = kind_by_name(unit.name, out[row])
    whole = np.array([unit.whole for unit in flat], np.bool_)
    for kind in range(out.shape[1]):
        sums = np.bincount(scene[~whole], out[~whole, kind], int(scene.max(initial=-1)) + 1)
        out[whole, kind] = sums[scene[whole]]
    return out


def _looks(flat: Sequence[Described], labels: Sequence[str]) -> NDArray[np.float32]:
    """Looks (E, C) in the order of the entries of `_postings`: by label, then by unit."""
    of: dict[str, list[Floats]] = {label: [] for label in labels}
    nothing = np.full(len(COLUMNS), np.nan)
    for unit in flat:
        for label in unit.labels:
            of[label].append(unit.looks.get(label, nothing))
    found = [own for listed in of.values() for own in listed]
    return np.array(found, np.float32).reshape(-1, len(COLUMNS))


def _much(unit: Described) -> float:
    """How much there is to speak of: many things of a kind are little more than one."""
    return 1.0 + sum((1.0 + log(count)) * _spoken_of(label) for label, count in unit.labels.items())


@cache
def _spoken_of(label: str) -> float:
    words = label_words(label)
    return 0.0 if nameless(label) else _PLAIN if words[-1] in WORDS else 1.0


def _postings(counts: Sequence[dict[Any, int]], row_of: dict[Any, int]) -> Postings:
    """Postings of words by the units that have them; `row_of` is filled."""
    words = [row_of.setdefault(word, len(row_of)) for own in counts for word in own]
    many = [count for own in counts for count in own.values()]
    unit = np.repeat(np.arange(len(counts), dtype=np.int32), [len(own) for own in counts])
    word = np.array(words, np.int64)
    order = np.argsort(word, kind="stable")
    starts = np.searchsorted(word[order], np.arange(len(row_of) + 1))
    return Postings(starts, unit[order], np.array(many, np.float32)[order])
