# mypy: allow-untyped-defs, allow-incomplete-defs
"""Which things a place has, how they stand to each other (Eq. 6, softened), how words fit them."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel

REACH = 34.0
"""Things nearer than this to its centre belong to a place: who stands 10 m aside sees them [m]."""


MOST_THINGS = 36
"""At most this many things of a place are read, the nearest ones."""


@kernel
def _nearest_things(starts, offsets, rows):
    """Entries of each row within reach, the nearest `MOST_THINGS`; starts (K + 1,), entries."""
    chosen = np.zeros(len(rows) + 1, np.int64)
    most = 0
    for k in range(len(rows)):
        most += min(MOST_THINGS, starts[rows[k] + 1] - starts[rows[k]])
    kept = np.empty(most, np.int64)
    n = 0
    for k in range(len(rows)):
        first, last = starts[rows[k]], starts[rows[k] + 1]
        distance = np.empty(last - first, np.float32)
        for e in range(first, last):
            x, y = offsets[e, 0], offsets[e, 1]
            d2 = x * x + y * y
            distance[e - first] = d2 if d2 <= REACH * REACH else np.float32(np.inf)
        order = np.argsort(distance, kind="mergesort")
        for i in order[:MOST_THINGS]:
            if distance[i] < np.inf:
                kept[n] = first + i
                n += 1
        chosen[k + 1] = n
    return chosen, kept[:n]


@kernel
def _gather(rows, starts, values, weights):
    """CSR entries of some rows, as CSR."""
    out = np.zeros(len(rows) + 1, np.int64)
    for i in range(len(rows)):
        out[i + 1] = out[i] + starts[rows[i] + 1] - starts[rows[i]]
    found = np.empty(out[-1], np.int32)
    weight = np.empty(out[-1], np.float32)
    for i in range(len(rows)):
        a, b = starts[rows[i]], starts[rows[i] + 1]
        found[out[i] : out[i + 1]] = values[a:b]
        weight[out[i] : out[i + 1]] = weights[a:b]
    return out, found, weight


CHANNELS = ("north", "south", "east", "west", "near", "inside", "contains", "along", "present")
"""Relations of two nodes: the first is ... (of) the second. `present`: both are there."""
NORTH, SOUTH, EAST, WEST, NEAR, INSIDE, CONTAINS, ALONG, PRESENT = range(len(CHANNELS))
OPPOSITE = np.array([SOUTH, NORTH, WEST, EAST, NEAR, CONTAINS, INSIDE, ALONG, PRESENT])
"""Channel seen from the other end."""
CLOSE = 12.0
"""Distance at which "near" is half true [m]."""
BESIDE = 15.0
"""Distance to a line that counts as along it [m]."""
POINT, LINE, AREA = 0, 1, 2


@kernel
def winds(x, y):
    """How far a vector (x, y) points north, south, east and west; they sum to 1."""
    out = np.zeros(4, np.float32)
    x2, y2 = x * x, y * y
    total = x2 * x2 + y2 * y2
    if total > 1e-12:
        out[NORTH if y > 0.0 else SOUTH] = y2 * y2 / total
        out[EAST if x > 0.0 else WEST] = x2 * x2 / total
    return out


@kernel
def place_relations(starts, offsets, kinds, rows, size):
    """How node i stands to node j of places `rows` (K,): (K, R, size, size) float32.

    Node 0 is the centre. Two things in one spot lie in no direction of each other.
    """
    out = np.zeros((len(rows), len(OPPOSITE), size, size), np.float32)
    for k in range(len(rows)):
        first = starts[rows[k]]
        n = 1 + starts[rows[k] + 1] - first
        for i in range(n):
            xi, yi = (offsets[first + i - 1, 0], offsets[first + i - 1, 1]) if i else (
                np.float32(0.0), np.float32(0.0)
            )  # fmt: skip
            for j in range(i):
                xj, yj = (offsets[first + j - 1, 0], offsets[first + j - 1, 1]) if j else (
                    np.float32(0.0), np.float32(0.0)
                )  # fmt: skip
                dx, dy = xi - xj, yi - yj
                d2 = dx * dx + dy * dy
                out[k, PRESENT, i, j] = out[k, PRESENT, j, i] = 1.0
                close = 1.0 / (1.0 + np.exp((np.sqrt(d2) - CLOSE) / 3.0))
                out[k, NEAR, i, j] = out[k, NEAR, j, i] = close
                if d2 > 0.25:
                    told = winds(dx, dy)
                    for wind in range(4):
                        out[k, wind, i, j] = out[k, OPPOSITE[wind], j, i] = told[wind]
                kind = kinds[first + i - 1]
                if j == 0 and kind == AREA and d2 == 0.0:  # the centre stands in i
                    out[k, INSIDE, 0, i] = out[k, CONTAINS, i, 0] = 1.0
                if j == 0 and kind == LINE and d2 <= BESIDE * BESIDE:
                    out[k, ALONG, 0, i] = out[k, ALONG, i, 0] = 1.0
    return out


@kernel
def text_relations(edge_starts, ends, channels, negated, rows, size):
    """What texts `rows` (Q,) say of their nodes: (Q, R, size, size) float32."""
    out = np.zeros((len(rows), len(OPPOSITE), size, size), np.float32)
    for q in range(len(rows)):
        for e in range(edge_starts[rows[q]], edge_starts[rows[q] + 1]):
            i, j = ends[e]
            for r in range(len(OPPOSITE)):
                said = channels[e, r] * (1.0 - 2.0 * negated[e])
                out[q, r, i, j] += said
                out[q, OPPOSITE[r], j, i] += said
    return out


@kernel
def agreement(
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
