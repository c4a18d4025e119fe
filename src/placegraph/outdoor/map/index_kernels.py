# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `index`."""

from __future__ import annotations

import numpy as np

from placegraph.compiled import kernel

EMPTY_BOX = 0x7F7F8181 - (1 << 32) if 0x7F7F8181 >= 1 << 31 else 0x7F7F8181
"""Packed box that contains nothing: west and south 127, east and north -127."""


@kernel(inline="always")
def pack_box(west, south, east, north):
    """Four numbers from -127 to 127 in one int32."""
    low = ((west & 255) << 24) | ((south & 255) << 16) | ((east & 255) << 8) | (north & 255)
    return np.int32(low if low < 1 << 31 else low - (1 << 32))


@kernel(inline="always")
def unpack_box(box):
    """West, south, east and north of a packed box."""
    box = np.int64(box)
    return box >> 24, (box << 40) >> 56, (box << 48) >> 56, (box << 56) >> 56


@kernel(inline="always")
def join_boxes(a, b):
    """Smallest packed box around two."""
    aw, as_, ae, an = unpack_box(a)
    bw, bs, be, bn = unpack_box(b)
    return pack_box(min(aw, bw), min(as_, bs), max(ae, be), max(an, bn))


@kernel
def _postings(starts, objects, offsets, sight, token_starts, token_values, token_weights, n_tokens):
    sizes = np.zeros(n_tokens + 1, np.int64)
    last = np.full(n_tokens, -1, np.int64)
    for view in range(len(starts) - 1):
        for e in range(starts[view], starts[view + 1]):
            for t in range(token_starts[objects[e]], token_starts[objects[e] + 1]):
                token = token_values[t]
                if last[token] != view:
                    last[token] = view
                    sizes[token + 1] += 1
    bounds = np.cumsum(sizes)
    fill = bounds[:-1].copy()
    views = np.empty(bounds[-1], np.int32)
    mass = np.zeros(bounds[-1], np.float32)
    boxes = np.empty(bounds[-1], np.int32)
    last[:] = -1
    for view in range(len(starts) - 1):
        for e in range(starts[view], starts[view + 1]):
            for t in range(token_starts[objects[e]], token_starts[objects[e] + 1]):
                token = token_values[t]
                if last[token] != view:
                    last[token] = view
                    views[fill[token]] = view
                    boxes[fill[token]] = EMPTY_BOX
                    fill[token] += 1
                p = fill[token] - 1
                mass[p] += sight[e] * token_weights[t]
                west, south = int(np.floor(offsets[e, 0])), int(np.floor(offsets[e, 1]))
                east, north = int(np.ceil(offsets[e, 0])), int(np.ceil(offsets[e, 1]))
                boxes[p] = join_boxes(boxes[p], pack_box(west, south, east, north))
    return bounds, views, mass, boxes
