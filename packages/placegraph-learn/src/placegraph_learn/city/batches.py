"""Pairs of texts and places in padded arrays: what PyTorch learns from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from placegraph.outdoor.city import CityMap
from placegraph.outdoor.network.graphs import (
    Floats,
    GraphBatch,
    NodeWords,
    PlaceGraphs,
    Rows,
    SubwordBags,
    TextGraphs,
    WordFits,
    WordVectors,
    compute_agreements,
    list_nodes,
    make_mask,
    make_word_fits,
)
from placegraph.outdoor.network.network_kernels import CHANNELS
from placegraph.outdoor.search.posterior import NUM_RERANKED
from placegraph_learn.city.city_kernels import holds_as_said, literal
from placegraph_learn.city.descriptions import AT, NEARBY, ExamplePool
from placegraph_learn.city.network import Graphs, Network, Pairs, Scores, Truth

if TYPE_CHECKING:
    from placegraph_learn.city.cell_lessons import CellLessons


class PairBatch(NamedTuple):
    """P pairs of a text and a place."""

    text: Rows
    """(P,) row of the texts."""
    place: Rows
    """(P,) row of the places."""
    agreement: Floats
    """(P, n, m) how well a thing fits a mention by its words."""
    rarity: Floats
    """(P, n) how rare a mention is on the map, 0 to about 1."""
    ends: Rows
    """(P, S, 2) source and target of the statements."""
    channels: Floats
    """(P, S, R + 1) channels, and whether it is negated."""
    spoken: Floats
    """(P, S) 1 where there is a statement."""
    holds: Floats
    """(P, S, m, m) how far things i and j of the place stand as the statement says."""
    literal: Floats
    """(P, S, LITERAL) what a statement says if words alone decide; see `literal`."""


def pair_batch(
    texts: TextGraphs,
    places: PlaceGraphs,
    text_rows: Rows,
    place_rows: Rows,
    pairs: tuple[Rows, Rows],
    words: WordFits,
) -> PairBatch:
    """Return pairs of the texts and places of two batches.

    `pairs` are rows of the batches, `words` how well words of the map fit the nodes of the texts.
    """
    text, place = pairs
    n = int((texts.starts[text_rows + 1] - texts.starts[text_rows]).max())
    m = int((places.starts[place_rows + 1] - places.starts[place_rows]).max(initial=0)) + 1
    counts = texts.edge_starts[text_rows + 1] - texts.edge_starts[text_rows]
    s = max(1, int(counts.max()))
    edge, at = list_nodes(texts.edge_starts[text_rows], counts, s)
    ends = np.zeros((len(text_rows), s, 2), np.int64)
    channels = np.zeros((len(text_rows), s, len(CHANNELS) + 1), np.float32)
    ends.reshape(-1, 2)[at] = texts.ends[edge]
    channels.reshape(-1, len(CHANNELS) + 1)[at] = np.column_stack(
        [texts.channels[edge], texts.negated[edge]]
    )
    nodes = texts.starts[text_rows + 1] - texts.starts[text_rows]
    node, at = list_nodes(texts.starts[text_rows], nodes, n)
    rarity = np.zeros((len(text_rows), n), np.float32)
    rarity.reshape(-1)[at] = words.rarity[node]
    agreement = compute_agreements(texts, places, text_rows[text], place_rows[place], words, (n, m))
    holds = holds_as_said(
        texts.edge_starts, texts.channels, text_rows[text],
        places.starts, places.offsets, places.kinds, place_rows[place], s, m,
    )  # fmt: skip
    things = places.starts[place_rows + 1] - places.starts[place_rows]
    sizes = things[place] + 1
    said_literally = literal(
        agreement, holds, rarity[text], ends[text], channels[text], counts[text], sizes
    )
    return PairBatch(
        text,
        place,
        agreement,
        rarity[text],
        ends[text],
        channels[text],
        make_mask(counts, s)[text],
        holds,
        said_literally,
    )


@dataclass(frozen=True, eq=False)
class Lessons:
    """A pool with the city it was made from."""

    city: CityMap
    pool: ExamplePool
    subwords: float = 1.0
    """Weight of subwords of the network's `Shape`."""
    word_vectors: WordVectors | None = None
    """Word vectors that stand for the words they know."""

    @cached_property
    def text_bags(self) -> SubwordBags:
        """Parts of the words of the texts."""
        return SubwordBags.of(self.pool.texts.vocabulary, self.subwords, self.word_vectors)

    @cached_property
    def place_bags(self) -> SubwordBags:
        """Parts of the words of the map."""
        return SubwordBags.of(self.city.words, self.subwords, self.word_vectors)

    @cached_property
    def right(self) -> NDArray[np.int8]:
        """(Q, K) `pool.right`, where matching would have come upon the viewpoint by itself.

        The wrong ones of a pool are those that relational matching likes best. Right ones that it
        does not like must not stand beside them: the network would learn to contradict it.
        """
        pool = self.pool
        scores = np.where(np.isfinite(pool.scores), pool.scores, -np.inf)
        liked = np.argsort(np.argsort(-scores, axis=1), axis=1) < NUM_RERANKED
        found = liked & np.isfinite(scores)
        return np.where((pool.right == 1) & ~found, np.int8(-1), pool.right)

    def batch(self, rows: Rows, chosen: NDArray[np.bool_]) -> Batch:
        """Return texts `rows` (Q,) with the viewpoints `chosen` (Q, K) of theirs."""
        pool, city = self.pool, self.city
        texts, slots = np.nonzero(chosen & (pool.views[rows] >= 0))
        views = pool.views[rows][texts, slots]
        places = PlaceGraphs.of_views(city, views)
        every = np.arange(len(places))
        fits = pool.word_weights
        words = make_word_fits(fits, *city.word_counts)
        off = np.abs(city.views.positions[views][None] - pool.positions[rows][:, None]).max(2)
        return Batch(
            pool.texts.batch(rows),
            places.batch(every),
            pair_batch(pool.texts, places, rows, every, (texts, every), words),
            slots,
            self.right[rows][texts, slots],
            np.where(off <= AT, 1, np.where(off <= NEARBY, -1, 0)),
            pool.scores[rows][texts, slots],
        )

    def draw(self, n: int, share: float, rng: Generator) -> tuple[Rows, NDArray[np.bool_]]:
        """Return rows (n,) of texts, and a share of the viewpoints of each, a right one among them."""
        rows = np.sort(rng.choice(len(self.pool), min(n, len(self.pool)), replace=False))
        right = self.right[rows] == 1
        chosen = rng.random(right.shape) < share
        chosen[np.arange(len(rows)), np.argmax(right * rng.random(right.shape), axis=1)] = True
        return rows, chosen


class Batch(NamedTuple):
    """Padded arrays of texts, places and pairs, and what is right."""

    texts: GraphBatch
    places: GraphBatch
    pairs: PairBatch
    slots: Rows
    """(P,) which of its text's viewpoints a place is."""
    right: NDArray[np.int8]
    """(P,) 1, 0, or -1 for neither."""
    everywhere: NDArray[np.int64]
    """(Q, P) the same of every text and every place."""
    relational: NDArray[np.float32]
    """(P,) log-likelihood ratio of relational matching, NaN where it was not asked."""

    def truth(self, device: str) -> Truth:
        """Return the right answers, as tensors."""
        right = self.right.astype(np.int64)
        arrays = (self.pairs.text, right, self.everywhere, self.relational)
        return Truth(*(torch.from_numpy(a).to(device) for a in arrays))


def forward(network: Network, lessons: Lessons | CellLessons, batch: Batch, device: str) -> Scores:
    """Return the network's scores of a batch."""
    texts = _graphs(network, batch.texts, lessons.text_bags, device)
    places = _graphs(network, batch.places, lessons.place_bags, device)
    of_text, of_place = network.encoders()
    t, e_t = of_text(texts)
    m, e_m = of_place(places)
    pairs = Pairs(*(torch.from_numpy(np.ascontiguousarray(a)).to(device) for a in batch.pairs))
    logit, cosine, residual = network.match((t, texts.mask), (m, places.mask), pairs)
    return Scores(logit, cosine, e_t @ e_m.T, residual)


def _graphs(network: Network, batch: GraphBatch, bags: SubwordBags, device: str) -> Graphs:
    arrays = (batch.nodes, batch.mask, batch.relations)
    nodes, mask, relations = (torch.from_numpy(a).to(device) for a in arrays)
    return Graphs(nodes, _words(network, batch.words, bags, mask), mask, relations)


def _words(network: Network, words: NodeWords, bags: SubwordBags, mask: Tensor) -> Tensor:
    """Return summed vectors of the words of every node, (B, n, d)."""
    used, row = np.unique(words.words, return_inverse=True)
    counts = bags.starts[used + 1] - bags.starts[used]
    part, _ = list_nodes(bags.starts[used], counts, 0)
    device = mask.device

    def tensor(array: NDArray[np.generic]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(device)

    vectors = network.words(
        tensor(bags.buckets[part]),
        tensor(np.cumsum(counts) - counts),
        tensor(bags.weights[part]),
        None if bags.means is None else tensor(bags.means[used]),
    )
    nodes = F.embedding_bag(
        tensor(row), vectors, tensor(words.starts), mode="sum",
        per_sample_weights=tensor(words.weights),
    )  # fmt: skip
    padded = nodes.new_zeros(mask.numel(), nodes.shape[1])
    return padded.index_copy(0, tensor(words.at), nodes).reshape(*mask.shape, -1)
