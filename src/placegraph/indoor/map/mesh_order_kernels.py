# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled loops of `placegraph.indoor.map.mesh_order`."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel

_LOOK = 64  # vertices of more triangles than this are walked around as the triangles lie


@kernel
def code(rows, codes):
    """Write how far each row (N,) is below the number of those met in order so far."""
    high = 0
    for i in range(len(rows)):
        codes[i] = high - rows[i]
        high += rows[i] == high


@kernel
def fan_order(corners, vertices):
    """Order (T,) of triangles (T, 3), new number (V,) of each vertex or -1, and how many are used.

    Vertices wait in the order in which they were met; around each its triangles follow, each beside
    the one before where there is such a one.
    """
    first = np.zeros(vertices + 1, np.int64)
    for t in range(len(corners)):
        for k in range(3):
            first[corners[t, k] + 1] += 1
    for v in range(vertices):
        first[v + 1] += first[v]
    around = np.empty(3 * len(corners), np.int64)
    place = first[:-1].copy()
    for t in range(len(corners)):
        for k in range(3):
            v = corners[t, k]
            around[place[v]] = t
            place[v] += 1
    done = np.zeros(len(corners), np.bool_)
    order = np.empty(len(corners), np.int64)
    number = np.full(vertices, -1)
    queue = np.empty(vertices, np.int64)
    n, count, head, seed = 0, 0, 0, 0
    while n < len(corners):
        if head == count:  # a part is done
            while done[seed]:
                seed += 1
            for k in range(3):
                v = corners[seed, k]
                if number[v] < 0:
                    number[v] = count
                    queue[count] = v
                    count += 1
            done[seed] = True
            order[n] = seed
            n += 1
            continue
        v = queue[head]
        head += 1
        last = -1
        row = first[v]
        near = first[v + 1] - first[v] <= _LOOK
        while True:
            t = -1
            if near:
                best = -1
                for j in range(first[v], first[v + 1]):
                    if done[around[j]]:
                        continue
                    score = 0
                    for k in range(3):
                        w = corners[around[j], k]
                        if w != v:
                            score += 4 if w == last else number[w] >= 0
                    if score > best:
                        best, t = score, around[j]
            else:
                while row < first[v + 1] and done[around[row]]:
                    row += 1
                t = around[row] if row < first[v + 1] else -1
            if t < 0:
                break
            done[t] = True
            order[n] = t
            n += 1
            for k in range(3):
                w = corners[t, k]
                if number[w] < 0:
                    number[w] = count
                    queue[count] = w
                    count += 1
            newest = -1
            for k in range(3):
                w = corners[t, k]
                if w != v and number[w] > newest:
                    newest, last = number[w], w
    return order, number, count
