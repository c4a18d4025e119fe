# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled part of `index_build`: what is said of the viewpoints of each tile."""

from __future__ import annotations

import numpy as np

from placegraph.compiled import kernel
from placegraph.outdoor.map.index_kernels import CROWDED, LEAST, SLOTS, STEP, grade_of, pack


@kernel
def runs_of(
    tile_starts, slots, starts, objects, offsets, sight, total, pairs,
    token_starts, token_values, token_weights, n_tokens,
):  # fmt: skip
    """Runs of a band: of each tile, and each token in sight there, its viewpoints and their postings.

    Viewpoints (W,) stand tile after tile, by rising slot; `starts`, `objects`, `offsets` and `sight`
    are what each has in sight. Returns columns of the runs (token, tile, slots, postings, grades of
    the largest masses against pairs and totals), and the postings (`pack`).
    """
    number = np.full(n_tokens, -1, np.int64)
    named = np.empty(256, np.int32)
    mass = np.zeros((256, SLOTS), np.float32)
    ends = np.zeros((256, SLOTS, 4), np.float32)
    run_token, run_tile = np.empty(1024, np.int32), np.empty(1024, np.uint32)
    run_slots, run_size = np.empty(1024, np.int64), np.empty(1024, np.uint8)
    run_pairs, run_total = np.empty(1024, np.uint8), np.empty(1024, np.uint8)
    posted = np.empty(8192, np.uint32)
    runs = postings = 0
    for tile in range(len(tile_starts) - 1):
        n = 0
        for view in range(tile_starts[tile], tile_starts[tile + 1]):
            slot = slots[view]
            for e in range(starts[view], starts[view + 1]):
                x, y = offsets[e]
                for t in range(token_starts[objects[e]], token_starts[objects[e] + 1]):
                    m = number[token_values[t]]
                    if m < 0:
                        if n == len(named):
                            named = np.concatenate((named, named))
                            mass = np.concatenate((mass, np.zeros_like(mass)))
                            ends = np.concatenate((ends, ends))
                        m = number[token_values[t]] = n
                        named[n] = token_values[t]
                        mass[n] = 0.0
                        n += 1
                    box = ends[m, slot]
                    if mass[m, slot] == 0.0:
                        box[0], box[1], box[2], box[3] = x, y, x, y
                    else:
                        box[0], box[1] = min(box[0], x), min(box[1], y)
                        box[2], box[3] = max(box[2], x), max(box[3], y)
                    mass[m, slot] += sight[e] * token_weights[t]
        if runs + n > len(run_token):
            more = max(n, len(run_token))
            run_token = np.concatenate((run_token, np.empty(more, np.int32)))
            run_tile = np.concatenate((run_tile, np.empty(more, np.uint32)))
            run_slots = np.concatenate((run_slots, np.empty(more, np.int64)))
            run_size = np.concatenate((run_size, np.empty(more, np.uint8)))
            run_pairs = np.concatenate((run_pairs, np.empty(more, np.uint8)))
            run_total = np.concatenate((run_total, np.empty(more, np.uint8)))
        if postings + n * SLOTS > len(posted):
            more = max(n * SLOTS, len(posted))
            posted = np.concatenate((posted, np.empty(more, np.uint32)))
        for m in range(n):
            number[named[m]] = -1
            bits, size, of_pairs, of_total = np.int64(0), 0, 1e-9, 1e-9
            for view in range(tile_starts[tile], tile_starts[tile + 1]):
                slot = slots[view]
                if mass[m, slot] == 0.0:
                    continue
                bits |= np.int64(1) << slot
                size += 1
                box = ends[m, slot]
                posted[postings] = pack(mass[m, slot], box[0], box[1], box[2], box[3])
                postings += 1
                # as the search will reckon them: masses rounded up, totals and pairs down
                kept = LEAST * np.exp(STEP * grade_of(mass[m, slot])) * 1.0001
                of_pairs = max(of_pairs, kept / np.sqrt(pairs[view] + CROWDED))
                of_total = max(of_total, kept / total[view])
            run_token[runs], run_tile[runs], run_slots[runs] = named[m], tile, bits
            run_size[runs] = size
            run_pairs[runs] = grade_of(of_pairs)
            run_total[runs] = grade_of(of_total)
            runs += 1
    return (
        run_token[:runs], run_tile[:runs], run_slots[:runs], run_size[:runs],
        run_pairs[:runs], run_total[:runs], posted[:postings],
    )  # fmt: skip
