"""Padded arrays of many graphs at once: what the equations of the network are written in."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.likelihood.query import Query
from placegraph.outdoor.network.graphs import PlaceGraphs, TextGraphs
from placegraph.outdoor.network.graphs_kernels import agreement, place_relations, text_relations

Floats = NDArray[np.float32]


Rows = NDArray[np.int64]


class NodeWords(NamedTuple):
    """Words of N nodes, as CSR; `at` says where the nodes stand in the padded arrays."""

    starts: Rows
    """(N,) first word of a node; the last one ends with the words."""
    words: Rows
    weights: Floats
    at: Rows
    """(N,) graph * size + node."""


class GraphBatch(NamedTuple):
    """B padded graphs of `size` nodes; node 0 is the speaker, or the centre."""

    nodes: Floats
    """(B, size, F): texts have (is here, log count), places (is here, kind (3), offset (2) and
    distance, all / 25 m)."""
    mask: Floats
    """(B, size) 1 where there is a node."""
    relations: Floats
    """(B, R, size, size) `CHANNELS` of node i to node j."""
    words: NodeWords


def text_batch(texts: TextGraphs, rows: Rows) -> GraphBatch:
    """Padded texts `rows` (B,)."""
    rows = np.asarray(rows, np.int64)
    counts = texts.starts[rows + 1] - texts.starts[rows]
    size = int(counts.max())
    node, at = entries(texts.starts[rows], counts, size)
    nodes = np.zeros((len(rows), size, 2), np.float32)
    nodes[:, 0, 0] = 1.0
    nodes.reshape(-1, 2)[at, 1] = texts.counts[node]
    return GraphBatch(
        nodes,
        mask_of(counts, size),
        text_relations(texts.edge_starts, texts.ends, texts.channels, texts.negated, rows, size),
        _words(texts.word_starts, texts.words, texts.weights, node, at),
    )


def place_batch(places: PlaceGraphs, rows: Rows) -> GraphBatch:
    """Padded places `rows` (B,)."""
    rows = np.asarray(rows, np.int64)
    counts = places.starts[rows + 1] - places.starts[rows]
    size = int(counts.max(initial=0)) + 1
    thing, at = entries(places.starts[rows], counts, size, skip=1)
    nodes = np.zeros((len(rows), size, 7), np.float32)
    nodes[:, 0, 0] = 1.0
    flat = nodes.reshape(-1, 7)
    flat[at, 1 + places.kinds[thing]] = 1.0
    flat[at, 4:6] = places.offsets[thing] / 25.0
    flat[at, 6] = np.hypot(flat[at, 4], flat[at, 5])
    return GraphBatch(
        nodes,
        mask_of(counts + 1, size),
        place_relations(places.starts, places.offsets, places.kinds, rows, size),
        _words(places.word_starts, places.words, places.weights, thing, at),
    )


def entries(starts: Rows, counts: Rows, size: int, *, skip: int = 0) -> tuple[Rows, Rows]:
    """Nodes of graphs with these first nodes and counts, and where they stand when padded."""
    graph = np.repeat(np.arange(len(starts)), counts)
    within = np.arange(len(graph)) - np.repeat(np.cumsum(counts) - counts, counts)
    return starts[graph] + within, graph * size + within + skip


def mask_of(counts: Rows, size: int) -> Floats:
    """Ones (B, size) where each of B graphs has a node."""
    return (np.arange(size) < counts[:, None]).astype(np.float32)


def _words(
    starts: Rows, words: NDArray[np.integer[Any]], weights: Floats, nodes: Rows, at: Rows
) -> NodeWords:
    counts = starts[nodes + 1] - starts[nodes]
    some = counts > 0
    nodes, at, counts = nodes[some], at[some], counts[some]
    entry, _ = entries(starts[nodes], counts, 0)
    return NodeWords(np.cumsum(counts) - counts, words[entry].astype(np.int64), weights[entry], at)


def agreements(
    texts: TextGraphs,
    places: PlaceGraphs,
    text_rows: Rows,
    place_rows: Rows,
    words: WordFits,
    size: tuple[int, int],
) -> Floats:
    """How well things of places fit mentions of texts, (P, n, m); the speaker fits the centre."""
    return agreement(
        texts.starts, text_rows, words.starts, words.tokens, words.weights,
        places.starts, place_rows, places.word_starts, places.words, places.weights,
        *size, len(places.vocabulary),
    )  # fmt: skip


class Fits(NamedTuple):
    """How well words of the map's vocabulary fit the nodes of N text nodes, as CSR."""

    starts: Rows
    """(N + 1,)"""
    tokens: NDArray[np.int32]
    weights: Floats


def fits_of(texts: TextGraphs, queries: Sequence[Query]) -> Fits:
    """Words of the map that each text node may stand for, as relational matching reads them."""
    starts, tokens, weights = [0], [], []
    for q, query in enumerate(queries):
        for mention in texts.mentions[texts.starts[q] : texts.starts[q + 1]]:
            a, b = query.mentions.starts[mention - 2 : mention] if mention >= 2 else (0, 0)
            tokens.append(query.mentions.tokens[a:b])
            weights.append(query.mentions.weights[a:b])
            starts.append(starts[-1] + int(b - a))
    return Fits(
        np.array(starts, np.int64),
        np.concatenate([np.zeros(0, np.int32), *tokens]),
        np.concatenate([np.zeros(0, np.float32), *weights]),
    )


class WordFits(NamedTuple):
    """How well words of a map fit N text nodes, as CSR, and how rare these are there."""

    starts: Rows
    """(N + 1,)"""
    tokens: NDArray[np.int32]
    """Rows of the places' vocabulary."""
    weights: Floats
    rarity: Floats
    """(N,) minus log share of the map's things that a node may be, / 10; 0 of the speaker."""


def word_fits(fits: Fits, counts: Rows, total: int) -> WordFits:
    """`WordFits` from how well words fit, and how many (counts (T,)) of the `total` things bear them."""
    starts, tokens, weights = fits
    mass = np.concatenate(([0.0], np.cumsum(weights * counts[tokens])))
    share = (mass[starts[1:]] - mass[starts[:-1]]) / max(1, total)
    rarity = -np.log(np.clip(share, 1e-5, 1.0)) / 10.0
    rarity[starts[1:] == starts[:-1]] = 0.0
    return WordFits(starts, tokens, weights, rarity.astype(np.float32))
