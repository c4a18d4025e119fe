# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `index_build`: where viewpoints are, and what is said of those of each tile."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.outdoor.map.index_kernels import (
    AREA,
    CROWDED,
    FINE,
    GRADES,
    SLOTS,
    grade_of,
    ones,
    pack,
)

POINT = 0


@kernel
def standing(tile_starts, seen, kind, enough, stride, found):
    """Slots (T,) of points that see `enough`, or a point object closer than `stride` [m].

    `seen` is what tiles have in sight (`InSight`); notes in `found` (N,) what those points see.
    """
    keep, total = np.zeros(len(tile_starts) - 1, np.int64), np.zeros(SLOTS, np.float32)
    for tile in range(len(tile_starts) - 1):
        total[:] = 0.0
        for r in range(tile_starts[tile], tile_starts[tile + 1]):
            bits, e, lone = seen.slots[r], seen.first[r], kind[seen.things[r]] == POINT
            while bits:
                lowest = bits & -bits
                bits ^= lowest
                total[ones(lowest - 1)] += seen.sight[e]
                x, y = seen.offsets[e]
                if lone and x * x + y * y < stride * stride:
                    keep[tile] |= lowest
                e += 1
        for slot in range(SLOTS):
            keep[tile] |= np.int64(total[slot] >= enough) << slot
        for r in range(tile_starts[tile], tile_starts[tile + 1]):
            if seen.slots[r] & keep[tile]:
                found[seen.things[r]] = True
    return keep


@kernel
def with_huts(tile_starts, seen, keep, stride, found):
    """Add to `keep` points closer than `stride` [m] to what was not `found`: in the hills, little else."""
    for tile in range(len(tile_starts) - 1):
        for r in range(tile_starts[tile], tile_starts[tile + 1]):
            bits, e = seen.slots[r], seen.first[r]
            while bits and not found[seen.things[r]]:
                x, y = seen.offsets[e]
                if x * x + y * y < stride * stride:
                    keep[tile] |= bits & -bits
                bits &= bits - 1
                e += 1


@kernel
def runs_of(tile_starts, seen, keep, core, kind, tokens, levels, n_labels, mass):
    """Runs of a band: of each tile, and each token in sight there, its viewpoints and their postings.

    `keep` (T,) are the slots of viewpoints, `core` (T,) those of them that are counted, `seen` what tiles
    have in sight. Adds to `mass` (tokens + 1,) what of each is in sight of all viewpoints, and of all
    things (the last). Returns columns of the runs (token, tile, slots, postings, grades of the largest
    masses against pairs and totals), and the postings (`pack`); totals and pairs of viewpoints; things of
    tiles, and how many; and what is counted: what `Seen` has of tokens and of all.
    """
    token_starts, token_values, token_weights = tokens
    number, named = np.full(len(mass) - 1, -1, np.int64), np.empty(256, np.int32)
    held, ends = np.zeros((256, SLOTS), np.float32), np.zeros((256, SLOTS, 4), np.float32)
    run_token, run_tile = np.empty(1024, np.int32), np.empty(1024, np.uint32)
    run_slots, run_size = np.empty(1024, np.int64), np.empty(1024, np.uint8)
    run_grades, posted = np.empty((1024, 2), np.uint8), np.empty(8192, np.uint32)
    totals, roots, views = np.empty(1024, np.uint8), np.empty(1024, np.uint16), 0
    things, n_things = np.empty(len(seen.things), np.int32), 0
    thing_counts = np.zeros(len(keep), np.uint32)
    counted, shares = np.zeros(len(mass) - 1), np.zeros(len(mass) - 1)
    peak = np.zeros(len(mass) - 1, np.float32)
    in_sight = spread = pull = 0.0
    # of each slot: all, apart from what one stands in, squares of that; divisors; shares of labels
    sums, against = np.zeros((4, SLOTS), np.float32), np.empty((2, SLOTS), np.float32)
    total, alone, squared, labelled = sums[0], sums[1], sums[2], sums[3]
    where, at, sight = (
        np.empty(SLOTS, np.int64),
        np.empty((SLOTS, 2), np.float32),
        np.empty(SLOTS, np.float32),
    )
    runs = postings = 0
    for tile in range(len(keep)):
        n = 0
        sums[:] = 0.0
        for r in range(tile_starts[tile], tile_starts[tile + 1]):
            bits, e, o, many = seen.slots[r], seen.first[r], seen.things[r], 0
            if not bits & keep[tile]:
                continue
            things[n_things] = o
            n_things += 1
            thing_counts[tile] += 1
            while bits:
                slot = ones((bits & -bits) - 1)
                bits &= bits - 1
                if keep[tile] >> slot & 1:
                    s, (x, y) = seen.sight[e], seen.offsets[e]
                    where[many], sight[many], at[many, 0], at[many, 1] = slot, s, x, y
                    many += 1
                    total[slot] += s
                    if (
                        kind[o] != AREA or x != 0.0 or y != 0.0
                    ):  # what one stands in lies in no direction
                        alone[slot] += s
                        squared[slot] += s * s
                e += 1
            for t in range(token_starts[o], token_starts[o + 1]):
                m = number[token_values[t]]
                if m < 0:
                    if n == len(named):
                        named = np.concatenate((named, named))
                        held = np.concatenate((held, held))
                        ends = np.concatenate((ends, ends))
                    m = number[token_values[t]] = n
                    named[n] = token_values[t]
                    held[n] = 0.0
                    n += 1
                for i in range(many):
                    x, y, box = at[i, 0], at[i, 1], ends[m, where[i]]
                    if held[m, where[i]] == 0.0:
                        box[0], box[1], box[2], box[3] = x, y, x, y
                    else:
                        box[0], box[1] = min(box[0], x), min(box[1], y)
                        box[2], box[3] = max(box[2], x), max(box[3], y)
                    held[m, where[i]] += sight[i] * token_weights[t]
        if views + SLOTS > len(totals):
            totals = np.concatenate((totals, np.empty_like(totals)))
            roots = np.concatenate((roots, np.empty_like(roots)))
        for slot in range(SLOTS):
            if keep[tile] >> slot & 1:
                grade = min(GRADES - 1, np.searchsorted(levels, total[slot], side="right") - 1)
                pairs = max(alone[slot] * alone[slot] - squared[slot], np.float32(0.0))
                totals[views] = max(0, grade)
                roots[views] = min(65535.0, np.floor(np.sqrt(pairs) * FINE))
                # as the search will reckon them: masses rounded up, totals and pairs down
                against[0, slot] = 1.0001 / np.sqrt((roots[views] / FINE) ** 2 + CROWDED)
                against[1, slot] = 1.0001 / levels[totals[views]]
                views += 1
                mass[-1] += total[slot]
                if core[tile] >> slot & 1:
                    in_sight += total[slot]
                    pull = max(pull, np.float64(total[slot]) ** 2 / (pairs + CROWDED))
        if runs + n > len(run_token):
            more = max(n, len(run_token))
            run_token = np.concatenate((run_token, np.empty(more, np.int32)))
            run_tile = np.concatenate((run_tile, np.empty(more, np.uint32)))
            run_slots = np.concatenate((run_slots, np.empty(more, np.int64)))
            run_size = np.concatenate((run_size, np.empty(more, np.uint8)))
            run_grades = np.concatenate((run_grades, np.empty((more, 2), np.uint8)))
        if postings + n * SLOTS > len(posted):
            posted = np.concatenate((posted, np.empty(max(n * SLOTS, len(posted)), np.uint32)))
        for m in range(n):
            token = named[m]
            number[token] = -1
            bits, size, of_pairs, of_total = np.int64(0), 0, np.float32(1e-9), np.float32(1e-9)
            for slot in range(SLOTS):
                much = held[m, slot]
                if much == 0.0:
                    continue
                bits |= np.int64(1) << slot
                size += 1
                box = ends[m, slot]
                posting = pack(much, box[0], box[1], box[2], box[3])
                posted[postings] = posting
                postings += 1
                kept = levels[posting >> 24]
                of_pairs = max(of_pairs, kept * against[0, slot])
                of_total = max(of_total, kept * against[1, slot])
                mass[token] += much
                if core[tile] >> slot & 1:
                    share = much / total[slot]
                    counted[token] += much
                    shares[token] += share
                    peak[token] = max(peak[token], share)
                    labelled[slot] += share if token < n_labels else np.float32(0.0)
            run_token[runs], run_tile[runs], run_slots[runs] = token, tile, bits
            run_size[runs] = size
            run_grades[runs, 0], run_grades[runs, 1] = grade_of(of_pairs), grade_of(of_total)
            runs += 1
        spread = max(spread, labelled.max())
    columns = (
        run_token[:runs],
        run_tile[:runs],
        run_slots[:runs],
        run_size[:runs],
        run_grades[:runs],
    )
    of_views = totals[:views], roots[:views], things[:n_things], thing_counts
    return columns, posted[:postings], of_views, (counted, shares, peak, in_sight, spread, pull)
