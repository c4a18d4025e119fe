# mypy: allow-untyped-defs, allow-incomplete-defs
"""How the nodes of graphs stand to each other: soft versions of Eq. 6, for texts and for places.

The four winds are Eq. 6 with a blurred diagonal: a thing that lies north-east is half north of
here and half east.
"""

from __future__ import annotations

import numpy as np

from placegraph.compiled import kernel

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
                    x2, y2 = dx * dx, dy * dy
                    total = x2 * x2 + y2 * y2
                    a, b = (NORTH, SOUTH) if dy > 0.0 else (SOUTH, NORTH)
                    out[k, a, i, j] = out[k, b, j, i] = y2 * y2 / total
                    a, b = (EAST, WEST) if dx > 0.0 else (WEST, EAST)
                    out[k, a, i, j] = out[k, b, j, i] = x2 * x2 / total
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
