# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled search of vectors: all of them, or the likeliest lists; see `embedded` and `lists`.

Rows are unit vectors as float32, or as int8 in steps that differ by column; then the query has been
multiplied by the steps. Everything is numpy arrays; shapes: C rows, D numbers, Q queries, L lists.
"""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel

_FAST = {"reassoc", "contract", "nsz"}  # sums in any order; infinity keeps its meaning


@kernel(inline="always")
def _dot(row, query):
    total = np.float32(0.0)
    for d in range(len(query)):
        total += np.float32(row[d]) * query[d]
    return total


@kernel(inline="always")
def _inside(position, box):
    """Whether longitude and latitude lie in west, south, east, north, edges included."""
    west, south, east, north = box
    if not south <= position[1] <= north:
        return False
    if west > east:  # across the date line
        return position[0] >= west or position[0] <= east
    return west <= position[0] <= east


@kernel(fastmath=_FAST)
def _scan(rows, ids, positions, box, query, found, similarity, filled):
    """Put rows into the `filled` best so far, best first, equal ones by id; how many there are."""
    n = len(found)
    for i in range(len(rows)):
        s = _dot(rows[i], query)
        if filled == n and (s < similarity[-1] or (s == similarity[-1] and ids[i] > found[-1])):
            continue
        # Only what would be among the best is asked where it is.
        if len(box) and not _inside(positions[i], box):
            continue
        j = filled if filled < n else n - 1
        filled = j + 1
        while j > 0 and (
            similarity[j - 1] < s or (similarity[j - 1] == s and found[j - 1] > ids[i])
        ):
            similarity[j] = similarity[j - 1]
            found[j] = found[j - 1]
            j -= 1
        similarity[j] = s
        found[j] = ids[i]
    return filled


@kernel
def search_all(rows, ids, positions, box, queries, found, similarity):
    """Exact neighbours: every row with every query.

    rows (C, D) float32 or int8, ids (C,) int64, positions (C, 2) and box (4,) or (0,) in the same
    unit, queries (Q, D) float32; found (Q, n) and similarity (Q, n), prefilled, are written.
    """
    for q in range(len(queries)):
        _scan(rows, ids, positions, box, queries[q], found[q], similarity[q], 0)


@kernel
def search_lists(rows, ids, starts, centers, center_queries, probes, queries, found, similarity):
    """Neighbours among the rows of the `probes` lists whose centres are nearest to the query.

    Rows of list l are rows[starts[l]:starts[l + 1]]; centers (L, D) float32, center_queries (Q, D)
    are the queries unscaled. Fewer than n rows in these lists: further lists are opened.
    """
    lists = len(centers)
    numbers = np.arange(lists)
    positions, box = np.zeros((0, 2), np.int32), np.zeros(0)
    order = np.empty(min(2 * probes, lists), np.int64)
    nearness = np.empty(len(order), np.float32)
    for q in range(len(queries)):
        _scan(centers, numbers, positions, box, center_queries[q], order, nearness, 0)
        filled = 0
        for p in range(len(order)):
            if p >= probes and filled == found.shape[1]:
                break
            a, b = starts[order[p]], starts[order[p] + 1]
            filled = _scan(
                rows[a:b], ids[a:b], positions, box, queries[q], found[q], similarity[q], filled
            )
