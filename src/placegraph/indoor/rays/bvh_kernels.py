# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `bvh`."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel

BINS = 16
"""Bins an axis, at most, when a split is sought."""


CAPACITY = 8
"""A leaf holds at most so many triangles: their number less one takes three bits of a reference."""


TRAVERSE = 1.0
"""Cost of walking through a node, in triangles met."""


DEEP = 40
"""From this depth on, nodes are halved by number: with 2^28 triangles a path has under 72 nodes."""


STACK = 72


@kernel(error_model="numpy")
def _boxes(vertices, triangles):
    """(T, 6) low x y z, high x y z."""
    boxes = np.empty((len(triangles), 6), np.float32)
    for i in range(len(triangles)):
        a, b, c = triangles[i, 0], triangles[i, 1], triangles[i, 2]
        for k in range(3):
            x, y, z = vertices[a, k], vertices[b, k], vertices[c, k]
            boxes[i, k] = min(x, y, z)
            boxes[i, k + 3] = max(x, y, z)
    return boxes


@kernel(error_model="numpy")
def _fill(vertices, triangles, order, corners, rows):
    for slot in range(len(order)):
        row = order[slot]
        for c in range(3):
            for k in range(3):
                corners[12 * slot + 3 * c + k] = vertices[triangles[row, c], k]
        rows[12 * slot + 9] = row


@kernel(error_model="numpy")
def _half_area(box):
    x = np.float64(box[3] - box[0])
    y = np.float64(box[4] - box[1])
    z = np.float64(box[5] - box[2])
    return x * y + y * z + z * x


@kernel(error_model="numpy")
def _clear(box):
    for k in range(3):
        box[k] = np.inf
        box[k + 3] = -np.inf


@kernel(error_model="numpy")
def _grow(box, other):
    for k in range(3):
        box[k] = min(box[k], other[k])
        box[k + 3] = max(box[k + 3], other[k + 3])


@kernel(error_model="numpy")
def _bin(box, axis, low, scale, n_bins):
    """Bin of a box by (twice) its centre."""
    return min(n_bins - 1, int((box[axis] + box[axis + 3] - low[axis]) * scale[axis]))


@kernel(error_model="numpy")
def _best_split(boxes, start, stop, low, scale, n_bins, bins, counts, right):
    """Cost (areas times numbers), axis (-1: none) and first right bin of the best split."""
    for axis in range(3):
        for b in range(n_bins):
            counts[axis, b] = 0
            _clear(bins[axis, b])
    for i in range(start, stop):
        for axis in range(3):
            b = _bin(boxes[i], axis, low, scale, n_bins)
            counts[axis, b] += 1
            _grow(bins[axis, b], boxes[i])
    best, best_axis, best_bin = np.inf, -1, 0
    box = np.empty(6, np.float32)
    for axis in range(3):
        if scale[axis] == 0.0:
            continue
        _clear(box)
        number = 0
        for b in range(n_bins - 1, 0, -1):
            if counts[axis, b]:
                number += counts[axis, b]
                _grow(box, bins[axis, b])
            right[b] = number * _half_area(box) if number else 0.0
        _clear(box)
        number = 0
        for b in range(1, n_bins):
            if counts[axis, b - 1]:
                number += counts[axis, b - 1]
                _grow(box, bins[axis, b - 1])
            if 0 < number < stop - start:
                cost = number * _half_area(box) + right[b]
                if cost < best:
                    best, best_axis, best_bin = cost, axis, b
    return best, best_axis, best_bin


@kernel(error_model="numpy")
def _partition(boxes, order, start, stop, axis, at, low, scale, n_bins):
    """Bring triangles of bins before `at` to the front; returns where the others start."""
    i, j = start, stop - 1
    while i <= j:
        if _bin(boxes[i], axis, low, scale, n_bins) < at:
            i += 1
        else:
            for k in range(6):
                boxes[i, k], boxes[j, k] = boxes[j, k], boxes[i, k]
            order[i], order[j] = order[j], order[i]
            j -= 1
    return i


@kernel(error_model="numpy")
def _split_all(boxes, order, nodes, links):
    """Split [0, T) into leaves, sorting `boxes` and `order`; returns the number of nodes."""
    bins = np.empty((3, BINS, 6), np.float32)
    counts = np.empty((3, BINS), np.int64)
    right = np.empty(BINS, np.float64)
    low, scale = np.empty(3, np.float32), np.empty(3, np.float32)
    box, centres = np.empty(6, np.float32), np.empty(6, np.float32)
    tasks = np.empty((2 * STACK, 5), np.int64)  # start, stop, depth, parent, side
    tasks[0] = 0, len(order), 0, -1, 0
    waiting, used = 1, 0
    while waiting:
        waiting -= 1
        start, stop, depth, parent, side = tasks[waiting]
        number = stop - start
        _clear(box)
        _clear(centres)
        for i in range(start, stop):
            _grow(box, boxes[i])
            for k in range(3):
                c = boxes[i, k] + boxes[i, k + 3]
                centres[k] = min(centres[k], c)
                centres[k + 3] = max(centres[k + 3], c)
        if parent >= 0:
            for k in range(6):
                nodes[16 * parent + 6 * side + k] = box[k]
        cost, axis, at = np.inf, -1, 0
        n_bins = min(BINS, 4 + number // 4)
        if number > 1 and depth < DEEP:
            for k in range(3):
                low[k] = centres[k]
                span = centres[k + 3] - centres[k]
                # an extent too small or too large to divide into bins does not help
                scale[k] = n_bins / span if 1e-30 < span < 1e30 else 0.0
            cost, axis, at = _best_split(
                boxes, start, stop, low, scale, n_bins, bins, counts, right
            )
        whole = number * _half_area(box)
        stays = number <= CAPACITY and whole <= cost + TRAVERSE * _half_area(box)
        if number == 1 or (stays and parent >= 0):
            leaf = ~np.int32(start * 8 + number - 1)
            if parent >= 0:
                links[16 * parent + 12 + side] = leaf
            else:  # one triangle only: the root has it on both sides
                used = 1
                for k in range(12):
                    nodes[k] = box[k % 6]
                links[12] = links[13] = leaf
            continue
        middle = (start + stop) // 2
        if axis >= 0:
            middle = _partition(boxes, order, start, stop, axis, at, low, scale, n_bins)
        if parent >= 0:
            links[16 * parent + 12 + side] = used
        tasks[waiting] = middle, stop, depth + 1, used, 1
        tasks[waiting + 1] = start, middle, depth + 1, used, 0
        waiting += 2
        used += 1
    return used
