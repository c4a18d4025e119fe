"""Compiled parts of `sample`."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.outdoor.map.geometry_kernels import nearest_on_parts
from placegraph.outdoor.network.network_kernels import (
    CHANNEL_CHANCE,
    LITERAL,
    background_probability,
    place_relations,
    score_literally,
)

# mypy: allow-untyped-defs, allow-incomplete-defs


@kernel
def _nearest(kind, part_starts, point_starts, points, nearby, east, north):
    """Return nearest points (n, 2) of objects, seen from a position [m]."""
    out = np.empty((len(nearby), 2))
    for i in range(len(nearby)):
        o = nearby[i]
        x, y, _ = nearest_on_parts(part_starts, point_starts, points, kind[o], o, east, north)
        out[i] = x, y
    return out


# mypy: allow-untyped-defs, allow-incomplete-defs


@kernel
def holds_as_said(edge_starts, channels, texts, starts, offsets, kinds, places, s, m):
    """Return the agreement (P, S, m, m) of objects i and j of a place with a statement."""
    out = np.zeros((len(texts), s, m, m), np.float32)
    one = np.empty(1, np.int64)
    last = -1
    relations = np.zeros((1, 1, 1, 1), np.float32)
    for p in range(len(texts)):
        if places[p] != last:
            one[0] = last = places[p]
            relations = place_relations(starts, offsets, kinds, one, m)
        many = starts[places[p] + 1] - starts[places[p]] + 1
        first = edge_starts[texts[p]]
        for e in range(first, edge_starts[texts[p] + 1]):
            for r in range(channels.shape[1]):
                said = channels[e, r]
                if said > 0.0:
                    for i in range(many):
                        for j in range(many):
                            out[p, e - first, i, j] += said * relations[0, r, i, j]
    return out


@kernel(fastmath=True)
def literal(agreement, holds, rarity, ends, channels, counts, sizes):
    """Return the evidence (P, S, LITERAL) of statements for places if words alone decide (`score_literally`).

    `agreement` (P, n, m), `holds` (P, S, m, m), `rarity` (P, n), `ends` (P, S, 2), `channels`
    (P, S, R + 1) channels and negation, `counts` (P,) statements, `sizes` (P,) nodes of a place.
    """
    out = np.zeros((len(counts), holds.shape[1], LITERAL), np.float32)
    for p in range(len(counts)):
        for s in range(counts[p]):
            a, b = ends[p, s]
            background = background_probability(channels[p, s], rarity[p, a], rarity[p, b])
            score_literally(
                agreement[p, a], agreement[p, b], holds[p, s], sizes[p], background,
                min(a, b) == 0, channels[p, s, len(CHANNEL_CHANCE)] > 0.0, out[p, s],
            )  # fmt: skip
    return out
