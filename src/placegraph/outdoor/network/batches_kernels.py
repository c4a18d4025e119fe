# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `batches`."""

from __future__ import annotations

import numpy as np

from placegraph.compiled import kernel
from placegraph.outdoor.network.relations_kernels import place_relations


@kernel
def _agreement(
    text_starts, texts, fit_starts, fit_tokens, fit_weights,
    place_starts, places, word_starts, words, weights, n, m, n_words,
):  # fmt: skip
    """How well things of a place fit mentions of a text, (P, n, m); the speaker fits the centre."""
    out = np.zeros((len(texts), n, m), np.float32)
    fits = np.zeros((n, n_words), np.float32)
    last = -1
    for p in range(len(texts)):
        first = text_starts[texts[p]]
        many = text_starts[texts[p] + 1] - first
        if texts[p] != last:
            if last >= 0:
                for a in range(text_starts[last], text_starts[last + 1]):
                    for k in range(fit_starts[a], fit_starts[a + 1]):
                        fits[a - text_starts[last], fit_tokens[k]] = 0.0
            for a in range(many):
                for k in range(fit_starts[first + a], fit_starts[first + a + 1]):
                    fits[a, fit_tokens[k]] = fit_weights[k]
            last = texts[p]
        out[p, 0, 0] = 1.0
        begin = place_starts[places[p]]
        for i in range(place_starts[places[p] + 1] - begin):
            for w in range(word_starts[begin + i], word_starts[begin + i + 1]):
                for a in range(1, many):
                    fit = fits[a, words[w]] * weights[w]
                    if fit > out[p, a, i + 1]:
                        out[p, a, i + 1] = fit
    return out


@kernel
def _holds(edge_starts, channels, texts, starts, offsets, kinds, places, s, m):
    """How far things i and j of a place stand as a statement says, (P, S, m, m)."""
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
