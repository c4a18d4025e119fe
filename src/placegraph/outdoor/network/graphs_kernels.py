# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `graphs`."""

from __future__ import annotations

import numpy as np

from placegraph.compiled import kernel

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
