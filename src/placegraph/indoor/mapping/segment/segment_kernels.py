# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled kernels of cutting: levelled normals, joining over light edges, samples that touch."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel


@kernel
def find(root, i):
    """Return root of i in a forest `root` (N,), whose paths are halved on the way."""
    while root[i] != i:
        root[i] = root[root[i]]
        i = root[i]
    return i


@kernel
def smooth(normals, lab, areas, pairs, turned, rounds):
    """Return normals and colours (F, 3), each the mean of its own and of neighbours that bend < 45 deg.

    Weights are areas, a neighbour's at most the face's own: a large face stays as it is.
    """
    n, c = normals.copy(), lab.copy()
    for _ in range(rounds):
        ns, cs = n * areas.reshape(-1, 1), c * areas.reshape(-1, 1)
        weight = areas.copy()
        for p in range(len(pairs)):
            i, j = pairs[p]
            sign = -1.0 if turned[p] else 1.0
            cosine = (n[i, 0] * n[j, 0] + n[i, 1] * n[j, 1] + n[i, 2] * n[j, 2]) * sign
            if cosine < 0.707:
                continue
            shade = 0.0
            for k in range(3):
                shade += (c[i, k] - c[j, k]) ** 2
            w = min(areas[i], areas[j])
            v = w if shade < 400.0 else 0.0  # edges of colour stay sharp
            for k in range(3):
                ns[i, k] += w * sign * n[j, k]
                ns[j, k] += w * sign * n[i, k]
                cs[i, k] += v * c[j, k]
                cs[j, k] += v * c[i, k]
            weight[i] += v
            weight[j] += v
        for i in range(len(n)):
            length = np.sqrt(ns[i, 0] ** 2 + ns[i, 1] ** 2 + ns[i, 2] ** 2)
            for k in range(3):
                if length > 0:
                    n[i, k] = ns[i, k] / length
                c[i, k] = cs[i, k] / weight[i]
    return n, c


@kernel
def join(pairs, weights, order, areas, scale, least):
    """Return patch (F,) of every face: Felzenszwalb and Huttenlocher's joining over ascending weights.

    Two patches become one over a pair whose weight is at most what each has inside, plus `scale`
    [weight * m2] over its area; patches smaller than `least` [m2] join in any case. A weight that is
    not finite never joins.
    """
    root = np.arange(len(areas))
    size = areas.copy()
    inside = np.zeros(len(areas))
    for p in order:
        w = weights[p]
        if not np.isfinite(w):
            break
        a, b = find(root, pairs[p, 0]), find(root, pairs[p, 1])
        if a == b:
            continue
        if w <= inside[a] + scale / size[a] and w <= inside[b] + scale / size[b]:
            low, high = min(a, b), max(a, b)
            root[high] = low
            size[low] += size[high]
            inside[low] = w
    for p in order:  # what is too small to be told joins its likest neighbour
        if not np.isfinite(weights[p]):
            break
        a, b = find(root, pairs[p, 0]), find(root, pairs[p, 1])
        if a != b and min(size[a], size[b]) < least:
            low, high = min(a, b), max(a, b)
            root[high] = low
            size[low] += size[high]
    for i in range(len(root)):
        root[i] = find(root, i)
    return root


@kernel
def connect(count, pairs):
    """Return lowest member (N,) of the connected part of each of `count` nodes."""
    root = np.arange(count)
    for p in range(len(pairs)):
        a, b = find(root, pairs[p, 0]), find(root, pairs[p, 1])
        if a != b:
            root[max(a, b)] = min(a, b)
    for i in range(count):
        root[i] = find(root, i)
    return root


@kernel
def sample_counts(points, corners, step):
    """Count the parts (F,) into which each side of a face is cut so that none exceeds `step`."""
    parts = np.empty(len(corners), np.int64)
    for f in range(len(corners)):
        longest = 0.0
        for k in range(3):
            a, b = corners[f, k], corners[f, (k + 1) % 3]
            d = 0.0
            for axis in range(3):
                d += (points[a, axis] - points[b, axis]) ** 2
            longest = max(longest, d)
        parts[f] = max(int(np.ceil(np.sqrt(longest) / step)), 1)
    return parts


@kernel
def samples(points, corners, parts):
    """Return points (S, 3) spread over faces, and the face (S,) of each: n^2 where a side has n parts."""
    total = 0
    for f in range(len(corners)):
        total += parts[f] * parts[f]
    spots = np.empty((total, 3))
    face = np.empty(total, np.int64)
    at = 0
    for f in range(len(corners)):
        a, b, c = corners[f]
        n = parts[f]
        for i in range(n):
            for j in range(2 * (n - i) - 1):
                # centres of the small triangles of a row, in turn upright and upside down
                u = (i + (1 + j % 2) / 3.0) / n
                v = (j // 2 + (1 + j % 2) / 3.0) / n
                for k in range(3):
                    spots[at, k] = (
                        points[a, k]
                        + u * (points[b, k] - points[a, k])
                        + v * (points[c, k] - points[a, k])
                    )
                face[at] = f
                at += 1
    return spots, face


@kernel
def cell_keys(spots, low, cell, shape):
    """Return key (S,) of the cube of side `cell` that holds each point."""
    keys = np.empty(len(spots), np.int64)
    for s in range(len(spots)):
        key = 0
        for k in range(3):
            key = key * shape[k] + int((spots[s, k] - low[k]) / cell) + 1
        keys[s] = key
    return keys


@kernel
def find_touching(spots, group, order, keys, shape, reach):
    """Return rows (K, 2) of samples of different groups within `reach`.

    Of each sample and each other group only the nearest counts. `order` sorts the samples by their
    `keys`, which come sorted; cells are as large as `reach`, `shape` cells a side.
    """
    found_a, found_b, far = [0], [0], [0.0]
    for s in range(len(order)):
        i = order[s]
        here = len(found_a)
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                want = keys[s] + (dx * shape[1] + dy) * shape[2] - 1
                at = np.searchsorted(keys, want)
                while at < len(keys) and keys[at] <= want + 2:
                    j = order[at]
                    at += 1
                    if group[j] == group[i]:
                        continue
                    d = 0.0
                    for k in range(3):
                        d += (spots[i, k] - spots[j, k]) ** 2
                    if d > reach * reach:
                        continue
                    t = here
                    while t < len(found_a) and group[found_b[t]] != group[j]:
                        t += 1
                    if t == len(found_a):
                        found_a.append(i)
                        found_b.append(j)
                        far.append(d)
                    elif d < far[t] or (d == far[t] and j < found_b[t]):
                        found_b[t], far[t] = j, d
    rows = np.empty((len(found_a) - 1, 2), np.int64)
    for t in range(1, len(found_a)):
        rows[t - 1, 0], rows[t - 1, 1] = found_a[t], found_b[t]
    return rows


@kernel
def nearest(queries, spots):
    """Return row (N,) of the point of `spots` (S, 3) that is nearest to each point asked for (N, 3)."""
    out = np.zeros(len(queries), np.int64)
    for i in range(len(queries)):
        best = np.inf
        for s in range(len(spots)):
            d = 0.0
            for k in range(3):
                d += (queries[i, k] - spots[s, k]) ** 2
            if d < best:
                best, out[i] = d, s
    return out


@kernel
def elect(starts, labels, shares, patch, table, pairs, links, before, of_patch, of_neighbours):
    """Label (F,) with the highest score of each face; `before` (F,) are the neighbours', -1: none.

    `starts` (F + 1,), `labels` and `shares` (K,) are votes by face, `table` (N, L) those of
    patches, `links` (P,) weigh pairs. Candidates are what the face, its patch and its neighbours
    name.
    """
    count = len(before)
    degree = np.zeros(count + 1, np.int64)
    whole = np.zeros(count)
    for p in range(len(pairs)):
        for k in range(2):
            degree[pairs[p, k] + 1] += 1
            whole[pairs[p, k]] += links[p]
    first = np.cumsum(degree)
    fill = first[:-1].copy()
    other = np.empty(2 * len(pairs), np.int64)
    link = np.empty(2 * len(pairs))
    for p in range(len(pairs)):
        for k in range(2):
            i = pairs[p, k]
            other[fill[i]], link[fill[i]] = pairs[p, 1 - k], links[p]
            fill[i] += 1
    favourite = np.empty(len(table), np.int64)
    for n in range(len(table)):
        favourite[n] = np.argmax(table[n]) if table[n].max() > 0 else -1
    out = before.copy()
    for i in range(count):
        best, most = -1, 0.0
        own, near = starts[i + 1] - starts[i], first[i + 1] - first[i]
        for c in range(own + near + 1):
            if c < own:
                candidate = labels[starts[i] + c]
            elif c < own + near:
                candidate = before[other[first[i] + c - own]]
            else:
                candidate = favourite[patch[i]]
            if candidate < 0 or candidate == best:
                continue
            score = of_patch * table[patch[i], candidate]
            for v in range(starts[i], starts[i + 1]):
                if labels[v] == candidate:
                    score += shares[v]
            support = 0.0
            for e in range(first[i], first[i + 1]):
                if before[other[e]] == candidate:
                    support += link[e]
            if whole[i] > 0:
                score += of_neighbours * support / whole[i]
            if score > most or (score == most and best >= 0 and candidate < best):
                best, most = candidate, score
        if best >= 0:
            out[i] = best
    return out
