# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled search of vectors: every row is compared with the query (Eq. 11-13).

Rows are unit vectors as float32, or as int8 in steps that differ by column; then the query has been
multiplied by the steps. Everything is numpy arrays; shapes: C rows, D numbers, Q queries.
"""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel

_FAST = {"reassoc", "contract", "nsz"}  # sums in any order; infinity keeps its meaning


@kernel(inline=True)
def _dot(row, query):
    total = np.float32(0.0)
    for d in range(len(query)):
        total += np.float32(row[d]) * query[d]
    return total


@kernel(inline=True)
def _inside(position, box):
    """Tell whether longitude and latitude lie in west, south, east, north, edges included."""
    west, south, east, north = box
    if not south <= position[1] <= north:
        return False
    if west > east:  # across the date line
        return position[0] >= west or position[0] <= east
    return west <= position[0] <= east


@kernel(fastmath=_FAST)
def _scan(rows, ids, positions, box, query, nearest, similarity):
    """Put the best rows into `nearest`, best first, equal ones by id."""
    n, filled = len(nearest), 0
    for i in range(len(rows)):
        s = _dot(rows[i], query)
        if filled == n and (s < similarity[-1] or (s == similarity[-1] and ids[i] > nearest[-1])):
            continue
        # Only what would be among the best is asked where it is.
        if len(box) and not _inside(positions[i], box):
            continue
        j = filled if filled < n else n - 1
        filled = j + 1
        while j > 0 and (
            similarity[j - 1] < s or (similarity[j - 1] == s and nearest[j - 1] > ids[i])
        ):
            similarity[j] = similarity[j - 1]
            nearest[j] = nearest[j - 1]
            j -= 1
        similarity[j] = s
        nearest[j] = ids[i]


@kernel
def search_all(rows, ids, positions, box, queries, nearest, similarity):
    """Find exact neighbours: every row with every query.

    rows (C, D) float32 or int8, ids (C,) int64, positions (C, 2) and box (4,) or (0,) in the same
    unit, queries (Q, D) float32; nearest (Q, n) and similarity (Q, n), prefilled, are written.
    """
    for q in range(len(queries)):
        _scan(rows, ids, positions, box, queries[q], nearest[q], similarity[q])
