# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled scores of scenes: all of them by what they hold, few of them by where it is seen."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.core.threads import run_parallel as in_threads

NEIGHBOURS = 4
"""Places that a camera near one of them may be nearer to, in what it sees: behind a wall is another
room."""
MAX_NEIGHBOUR_DISTANCE = 1.2
"""Places farther from each other than this are not beside each other [m]."""
MAX_PLACE_DISTANCE = 1.5  # Farther from all places than this is off the map [m]
CELL = 0.25  # Edge of the cells of ground that share their nearest place [m]
MAX_GROUND_DISTANCE = 300.0
"""Ground further than this from a unit's first place is off the map [m]: 70 MB of cells hold the rest."""
SLIP = 1.0  # What being at the next place, or turned by one bin more, costs [nat]


def sum_best_cosines(cosines, code, starts, weight):
    """Sum over words of weight (W,) times the best of cosines (W, U) over each scene's objects.

    `code`: (M,) column of each object; `starts`: (S + 1,) first object of each scene.
    """
    out = np.empty(len(starts) - 1, np.float64)
    in_threads(_sum_best_cosines, len(out), cosines, code, starts, weight, out)
    return out


@kernel(fastmath=True, error_model="numpy")
def _sum_best_cosines(cosines, code, starts, weight, out, first, last):
    for s in range(first, last):
        total = 0.0
        for w in range(len(weight)):
            best = np.float32(-1.0)
            for i in range(starts[s], starts[s + 1]):
                best = max(best, cosines[w, code[i]])
            total += weight[w] * best
        out[s] = total


def score_mixtures(ratio, code, share, starts, weight, wrong):
    """Score words with weights (W,) in each scene (S,), as a mixture of its objects [log-likelihood].

    `ratio`: (U, W) how much likelier a word is of an object than of anything; `share`: (M,) of each object.
    """
    out = np.empty(len(starts) - 1, np.float64)
    in_threads(_score_mixtures, len(out), ratio, code, share, starts, weight, wrong, out)
    return out


@kernel(fastmath=True, error_model="numpy")
def _score_mixtures(ratio, code, share, starts, weight, wrong, out, first, last):
    words = ratio.shape[1]
    for s in range(first, last):
        mean = _mix_ratios(ratio, code, share, starts[s], starts[s + 1])
        total = 0.0
        for w in range(words):
            total += weight[w] * np.log(np.float32(1.0 - wrong) * mean[w] + np.float32(wrong))
        out[s] = total


@kernel(fastmath=True)
def mix_ratios(ratio, code, share, starts, chosen):
    """Mix the ratios (C, W) by which words are likelier in chosen units (C,) than anywhere."""
    out = np.empty((len(chosen), ratio.shape[1]), np.float32)
    for c, s in enumerate(chosen):
        out[c] = _mix_ratios(ratio, code, share, starts[s], starts[s + 1])
    return out


@kernel(fastmath=True)
def _mix_ratios(ratio, code, share, first, last):
    words = ratio.shape[1]
    mean = np.zeros(words, np.float32)
    for i in range(first, last):
        row, part = ratio[code[i]], share[i]
        for w in range(words):
            mean[w] += part * row[w]
    return mean


@kernel
def count_agreeing(words, shapes):
    """Count the neighbours, of eight, that agree with each patch (P,); grids of shapes (T, 2)."""
    out = np.zeros(len(words), np.int32)
    first = 0
    for rows, columns in shapes:
        for y in range(rows):
            for x in range(columns):
                at = first + y * columns + x
                for v in range(max(0, y - 1), min(rows, y + 2)):
                    for u in range(max(0, x - 1), min(columns, x + 2)):
                        out[at] += words[first + v * columns + u] == words[at]
                out[at] -= 1
        first += rows * columns
    return out


@kernel
def hash_rows(bits):
    """Hash each row of bits (P, d) uint32 to 64 bits; equal rows have the same hash."""
    out = np.empty(len(bits), np.uint64)
    for p in range(len(bits)):
        factor, total = np.uint64(1), np.uint64(0)
        for k in range(bits.shape[1]):
            factor *= np.uint64(0x9E3779B97F4A7C15)
            mixed = (np.uint64(bits[p, k]) + np.uint64(0x632BE5AB)) * factor
            total += mixed ^ (mixed >> np.uint64(29))
        out[p] = total
    return out


@kernel(fastmath=True)
def sum_groups(vectors, group, count):
    """Sum (count, d) of the vectors (P, d) of each group (P,)."""
    out = np.zeros((count, vectors.shape[1]), np.float32)
    for p in range(len(vectors)):
        row = out[group[p]]
        for k in range(vectors.shape[1]):
            row[k] += vectors[p, k]
    return out


@kernel(fastmath=True)
def add_log_likelihoods(evidence, bin_of, word, weight, logs):
    """Add to the rows of bins (B, O + 1) what patches (P,) tell, weight times rows of logs (W, O)."""
    mass = np.zeros((len(evidence), len(logs)), np.float32)
    for i in range(len(word)):
        mass[bin_of[i], word[i]] += weight[i]
    for b in range(len(evidence)):
        row = evidence[b]
        for w in range(len(logs)):
            share, log = mass[b, w], logs[w]
            if share > 0.0:
                for o in range(len(log)):
                    row[o] += share * log[o]


def score_paths(bins, steps, off, chosen, code, index):
    """Score a path in chosen units (C,): log of the mean likelihood over all its starts.

    `bins`: evidence (B, O + 1) of the patches of a bin of a frame for each object in sight, and for
    none; its azimuth relative to the camera (B,), its elevation (B,), first bin of each frame (T + 1,).
    `steps`: (T, 3) x, y [m] and bins of yaw from the reference frame; `off`: (T,) evidence of a frame
    beyond the map; `code`: (M,) column of each object.
    """
    out = np.empty(len(chosen), np.float64)
    units = chosen, index.starts, code, index.panoramas, index.place_starts, index.places
    in_threads(_score_paths, len(out), *bins, steps, off, *units, out)
    return out


@kernel(fastmath=True, error_model="numpy")
def _score_paths(
    evidence, bin_turn, bin_band, frame_starts, steps, off,
    chosen, object_starts, code, panoramas, place_starts, places, out, start, end,
):  # fmt: skip
    turns = panoramas.shape[2]
    unit = 2.0 * np.pi / turns
    for c in range(start, end):
        s = chosen[c]
        first, last = place_starts[s], place_starts[s + 1]
        own = code[object_starts[s] : object_starts[s + 1]]
        column = _unroll_columns(panoramas[first:last], own, evidence.shape[1] - 1)
        at = places[first:last]
        near, ground = _find_neighbours(at), _find_nearest(at)
        # of each place the cell that it lies in, from the ground's corner
        cells = (at - at[0]) / np.float32(CELL) + np.float32(len(ground) // 2 + 0.5)
        total = np.zeros((last - first, turns))
        score = np.empty((last - first, turns), np.float32)
        for t in range(len(frame_starts) - 1):
            score[:] = 0.0
            for b in range(frame_starts[t], frame_starts[t + 1]):
                bin_evidence = evidence[b]
                for p in range(last - first):
                    ring, row = column[p, bin_band[b], bin_turn[b] :], score[p]
                    for h in range(turns):
                        row[h] += bin_evidence[ring[h]]
            score = _blur_scores(score, near)
            for h in range(turns):
                yaw = h * unit
                dx = (np.cos(yaw) * steps[t, 0] - np.sin(yaw) * steps[t, 1]) / CELL
                dy = (np.sin(yaw) * steps[t, 0] + np.cos(yaw) * steps[t, 1]) / CELL
                turned = (h + int(np.round(steps[t, 2]))) % turns
                for p in range(last - first):
                    x, y = cells[p, 0] + dx, cells[p, 1] + dy
                    inside = 0 <= x < len(ground) and 0 <= y < len(ground)
                    q = ground[int(x), int(y)] if inside else np.int32(-1)
                    total[p, h] += score[q, turned] if q >= 0 else off[t]
        top = total.max()
        mean = 0.0
        for p in range(last - first):
            for h in range(turns):
                mean += np.exp(total[p, h] - top)
        out[c] = top + np.log(mean / total.size)


@kernel
def _unroll_columns(panoramas, own, unmapped):
    count, bands, turns = panoramas.shape
    out = np.empty((count, bands, 2 * turns), np.uint32)  # unsigned: no index is checked
    for p in range(count):
        for band in range(bands):
            for a in range(turns):
                seen = panoramas[p, band, a]
                out[p, band, a] = own[seen] if seen < len(own) else unmapped
                out[p, band, a + turns] = out[p, band, a]
    return out


@kernel
def _find_nearest(places):
    """Find the nearest place of each cell of the ground (X, X); -1: off the map."""
    reach = 0.0
    for p in range(len(places)):
        for axis in range(2):
            reach = max(reach, abs(places[p, axis] - places[0, axis]))
    reach = min(reach, MAX_GROUND_DISTANCE)
    half, around = int((reach + MAX_PLACE_DISTANCE) / CELL) + 1, int(MAX_PLACE_DISTANCE / CELL)
    out = np.full((2 * half + 1, 2 * half + 1), -1, np.int32)
    least = np.full(out.shape, MAX_PLACE_DISTANCE * MAX_PLACE_DISTANCE)
    for q in range(len(places)):
        x, y = places[q, 0] - places[0, 0], places[q, 1] - places[0, 1]
        u, v = int(np.round(x / CELL)) + half, int(np.round(y / CELL)) + half
        for i in range(max(0, u - around - 1), min(2 * half + 1, u + around + 2)):
            for j in range(max(0, v - around - 1), min(2 * half + 1, v + around + 2)):
                away = (x - (i - half) * CELL) ** 2 + (y - (j - half) * CELL) ** 2
                if away < least[i, j]:
                    out[i, j], least[i, j] = q, away
    return out


@kernel
def _find_neighbours(places):
    """Find rows (P, NEIGHBOURS) of the places nearest to each, itself first; -1 where there are fewer."""
    count = len(places)
    out = np.full((count, NEIGHBOURS), -1, np.int64)
    for p in range(count):
        away = np.empty(count)
        for q in range(count):
            away[q] = (places[q, 0] - places[p, 0]) ** 2 + (places[q, 1] - places[p, 1]) ** 2
        for k in range(min(NEIGHBOURS, count)):
            q = int(np.argmin(away))
            if away[q] > MAX_NEIGHBOUR_DISTANCE * MAX_NEIGHBOUR_DISTANCE:
                break
            out[p, k] = q
            away[q] = 1e30
    return out


@kernel(fastmath=True)
def _blur_scores(score, near):
    """Take the best score (P, turns) of each place and heading, and of its neighbours less a penalty."""
    count, turns = score.shape
    turned = np.empty_like(score)
    for p in range(count):
        row, out = score[p], turned[p]
        for h in range(1, turns - 1):
            out[h] = max(row[h], max(row[h - 1], row[h + 1]) - np.float32(SLIP))
        out[0] = max(row[0], max(row[-1], row[1]) - np.float32(SLIP))
        out[-1] = max(row[-1], max(row[-2], row[0]) - np.float32(SLIP))
    best = turned.copy()
    for p in range(count):
        row = best[p]
        for k in range(1, near.shape[1]):
            if near[p, k] >= 0:
                beside_it = turned[near[p, k]]
                for h in range(turns):
                    row[h] = max(row[h], beside_it[h] - np.float32(SLIP))
    return best
