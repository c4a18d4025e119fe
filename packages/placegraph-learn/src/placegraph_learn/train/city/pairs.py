"""Pairs of texts and places in padded arrays: what PyTorch learns from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from placegraph.outdoor.network.batches import Floats, Rows, WordFits, agreements, entries, mask_of
from placegraph.outdoor.network.graphs import PlaceGraphs, TextGraphs
from placegraph.outdoor.network.graphs_kernels import CHANNELS
from placegraph_learn.train.city.pairs_kernels import holds_as_said, literal


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
    said: Floats
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
    """Pairs of the texts and places of two batches.

    `pairs` are rows of the batches, `words` how well words of the map fit the nodes of the texts.
    """
    text, place = pairs
    n = int((texts.starts[text_rows + 1] - texts.starts[text_rows]).max())
    m = int((places.starts[place_rows + 1] - places.starts[place_rows]).max(initial=0)) + 1
    counts = texts.edge_starts[text_rows + 1] - texts.edge_starts[text_rows]
    s = max(1, int(counts.max()))
    edge, at = entries(texts.edge_starts[text_rows], counts, s)
    ends = np.zeros((len(text_rows), s, 2), np.int64)
    said = np.zeros((len(text_rows), s, len(CHANNELS) + 1), np.float32)
    ends.reshape(-1, 2)[at] = texts.ends[edge]
    said.reshape(-1, len(CHANNELS) + 1)[at] = np.column_stack(
        [texts.channels[edge], texts.negated[edge]]
    )
    nodes = texts.starts[text_rows + 1] - texts.starts[text_rows]
    node, at = entries(texts.starts[text_rows], nodes, n)
    rarity = np.zeros((len(text_rows), n), np.float32)
    rarity.reshape(-1)[at] = words.rarity[node]
    agreement = agreements(texts, places, text_rows[text], place_rows[place], words, (n, m))
    holds = holds_as_said(
        texts.edge_starts, texts.channels, text_rows[text],
        places.starts, places.offsets, places.kinds, place_rows[place], s, m,
    )  # fmt: skip
    things = places.starts[place_rows + 1] - places.starts[place_rows]
    sizes = things[place] + 1
    said_literally = literal(
        agreement, holds, rarity[text], ends[text], said[text], counts[text], sizes
    )
    return PairBatch(
        text,
        place,
        agreement,
        rarity[text],
        ends[text],
        said[text],
        mask_of(counts, s)[text],
        holds,
        said_literally,
    )
