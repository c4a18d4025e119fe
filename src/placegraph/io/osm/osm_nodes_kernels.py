# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `osm_nodes`: positions by id, and the lines that they make."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel


@kernel
def placed(first, bounds, words, ids):
    """Positions (K, 2) of nodes by id, and which are known; see `Nodes` for how `words` hold them.

    What is looked for often stands behind what was found last.
    """
    steps, known = np.zeros((len(ids), 2), np.int32), np.zeros(len(ids), np.bool_)
    chunk, at = 0, np.int64(-1)
    for k in range(len(ids) if len(first) else 0):
        if ids[k] < first[chunk] or (chunk + 1 < len(first) and ids[k] >= first[chunk + 1]):
            chunk, high = 0, len(first)
            while high - chunk > 1:
                middle = (chunk + high) >> 1
                if first[middle] <= ids[k]:
                    chunk = middle
                else:
                    high = middle
            at = np.int64(-1)
        begins, size = 3 * bounds[chunk], bounds[chunk + 1] - bounds[chunk]
        wanted = ids[k] - first[chunk]
        at += 1
        if at >= size or np.int64(words[begins + at]) & 0xFFFFFFFF != wanted:
            at, high = np.int64(0), size
            while high > at:
                middle = (at + high) >> 1
                if np.int64(words[begins + middle]) & 0xFFFFFFFF < wanted:
                    at = middle + 1
                else:
                    high = middle
            if at == size or np.int64(words[begins + at]) & 0xFFFFFFFF != wanted:
                continue
        known[k] = True
        steps[k, 0], steps[k, 1] = words[begins + size + 2 * at], words[begins + size + 2 * at + 1]
    return steps, known


@kernel
def sampled(first, bounds, words, every):
    """The first id of each chunk, and of `every` so many of its others one."""
    found, n = np.empty(len(first) + bounds[-1] // every, np.int64), 0
    for chunk in range(len(first)):
        for at in range(0, bounds[chunk + 1] - bounds[chunk], every):
            found[n] = first[chunk] + (np.int64(words[3 * bounds[chunk] + at]) & 0xFFFFFFFF)
            n += 1
    return found[:n]


@kernel
def between(first, bounds, words, low, high):
    """Ids and positions of all nodes from id `low` to before `high`, chunk after chunk."""
    ends, n = np.zeros((len(first), 2), np.int64), 0
    for chunk in range(len(first)):
        for side in range(2):
            wanted, at, end = (low, high)[side] - first[chunk], 0, bounds[chunk + 1] - bounds[chunk]
            while end > at:
                middle = (at + end) >> 1
                if np.int64(words[3 * bounds[chunk] + middle]) & 0xFFFFFFFF < wanted:
                    at = middle + 1
                else:
                    end = middle
            ends[chunk, side] = at
        n += ends[chunk, 1] - ends[chunk, 0]
    ids, steps, n = np.empty(n, np.int64), np.empty((n, 2), np.int32), 0
    for chunk in range(len(first)):
        begins, size = 3 * bounds[chunk], bounds[chunk + 1] - bounds[chunk]
        for at in range(ends[chunk, 0], ends[chunk, 1]):
            ids[n] = first[chunk] + (np.int64(words[begins + at]) & 0xFFFFFFFF)
            steps[n, 0] = words[begins + size + 2 * at]
            steps[n, 1] = words[begins + size + 2 * at + 1]
            n += 1
    return ids, steps


@kernel
def lines(starts, steps, known):
    """Points of ways of what is known of the positions of their nodes, as `read_osm` has them.

    Returns starts and points, and which ways lack some. What is whole has no point twice in a row; where
    one is missing, or all are one, all that are known stand.
    """
    made, points, n = np.zeros(len(starts), np.int64), np.empty_like(steps), 0
    lacks = np.zeros(len(starts) - 1, np.bool_)
    for way in range(len(starts) - 1):
        first = n
        for whole in (True, False):
            n = first
            for i in range(starts[way], starts[way + 1]):
                same = n > first and (points[n - 1] == steps[i]).all()
                if known[i] and not (whole and same):
                    points[n] = steps[i]
                    n += 1
                lacks[way] |= not known[i]
            lacks[way] |= n - first < 2
            if not lacks[way]:
                break
        made[way + 1] = n
    return made, points[:n], lacks
