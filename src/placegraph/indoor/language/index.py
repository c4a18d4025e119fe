"""Many scenes by text: an inverted index over labels and relations, and how rare each is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from placegraph.errors import OptionError
from placegraph.indoor.language.facts import units
from placegraph.indoor.language.kin import EXACT, fits
from placegraph.indoor.language.kinds import kind_by_name, kinds_of, likenesses

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from placegraph.graph import SceneGraph
    from placegraph.indoor.language.facts import Triple, Unit
    from placegraph.indoor.language.sentence import Sentence


class Found(NamedTuple):
    """What of the words that were asked for each unit (U,) has."""

    exact: NDArray[np.float64]
    """How many that are what was asked for."""
    kin: NDArray[np.float64]
    """How many that are that, or kin of it."""
    best: NDArray[np.float32]
    """How well the best of them fits."""


class Postings(NamedTuple):
    """In which units a word is, and how often: the entries of word w are starts[w] : starts[w + 1]."""

    starts: NDArray[np.int64]
    units: NDArray[np.int32]
    counts: NDArray[np.float32]

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
        return Found(exact, np.bincount(rows, counts, total).astype(np.float64), best)


class Columns(NamedTuple):
    """All units of an index, as arrays."""

    labels: tuple[str, ...]
    relations: tuple[str, ...]
    of_labels: Postings
    of_triples: Postings
    triples: NDArray[np.int64]
    """(T, 3) rows of labels, relations, labels: subject, how, and target of each."""
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


class TextIndex:
    """Finds scenes by text; scenes have rows as in a list.

    Parameters
    ----------
    graphs
        Scene graphs.
    rooms
        Of each graph the names of its objects' rooms (`Sentence.score`); of none if not given.
    """

    def __init__(
        self, graphs: Iterable[SceneGraph] = (), rooms: Iterable[Sequence[str]] | None = None
    ) -> None:
        self._scenes: list[list[Unit]] = []
        self._columns: Columns | None = None
        given = iter(rooms) if rooms is not None else None
        for graph in graphs:
            self.add(graph, next(given, ()) if given is not None else ())

    def __len__(self) -> int:
        return len(self._scenes)

    def add(self, graph: SceneGraph, rooms: Sequence[str] = ()) -> int:
        """Add a scene at the end and return its row; raises `OptionError` as `Sentence.score`."""
        return self.add_units(units(graph, rooms))

    def add_units(self, described: Sequence[Unit]) -> int:
        """Add a scene by what may be described of it (`facts.units`, `TextIndex.units`)."""
        self._scenes.append(list(described))
        self._columns = None
        return len(self._scenes) - 1

    def units(self, row: int) -> tuple[Unit, ...]:
        """What may be described of a scene: its rooms, and where there are several all of it."""
        return tuple(self._scenes[row])

    def remove(self, row: int) -> None:
        """Take a scene out; those after it move up. `OptionError` where there is none."""
        if not 0 <= row < len(self._scenes):
            raise OptionError(f"row is {row}; the index has {len(self._scenes)} scenes.")
        del self._scenes[row]
        self._columns = None

    def scores(self, sentence: Sentence) -> NDArray[np.float64]:
        """Log-likelihood ratio (n,) of each scene against the average of them [nat].

        All zero for a sentence that says nothing.
        """
        from placegraph.indoor.language.score import scene_scores

        return scene_scores(sentence, self.columns)

    def search(self, sentence: Sentence, most: int = 10) -> list[tuple[int, float]]:
        """Rows and scores of the best scenes, best first, the first of equal ones before."""
        scores = self.scores(sentence)
        order = np.argsort(-scores, kind="stable")[:most]
        return [(int(row), float(scores[row])) for row in order]

    @property
    def columns(self) -> Columns:
        """All scenes as arrays; made anew after `add` and `remove`."""
        if self._columns is None:
            self._columns = _columns(self._scenes)
        return self._columns


def rank(
    sentence: Sentence,
    graphs: Iterable[SceneGraph],
    rooms: Iterable[Sequence[str]] | None = None,
) -> NDArray[np.float64]:
    """How well each graph (n,) answers a sentence, rare things counting more: `TextIndex.scores`."""
    return TextIndex(graphs, rooms).scores(sentence)


def _columns(scenes: Sequence[Sequence[Unit]]) -> Columns:
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
        rooms=_rooms(flat, tuple(label_row), of_labels, scene),
        whole=np.array([unit.whole for unit in flat], np.bool_),
        scene=scene,
        scenes=len(scenes),
    )


def _rooms(
    flat: Sequence[Unit], labels: Sequence[str], of_labels: Postings, scene: NDArray[np.int32]
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


def _postings(counts: Sequence[dict[Any, int]], row_of: dict[Any, int]) -> Postings:
    """Postings of words by the units that have them; `row_of` is filled."""
    words = [row_of.setdefault(word, len(row_of)) for own in counts for word in own]
    many = [count for own in counts for count in own.values()]
    unit = np.repeat(np.arange(len(counts), dtype=np.int32), [len(own) for own in counts])
    word = np.array(words, np.int64)
    order = np.argsort(word, kind="stable")
    starts = np.searchsorted(word[order], np.arange(len(row_of) + 1))
    return Postings(starts, unit[order], np.array(many, np.float32)[order])
