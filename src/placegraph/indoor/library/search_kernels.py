# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled scores of scenes: all of them by what they hold, few of them by where it is seen."""

from __future__ import annotations

import numpy as np

from placegraph.compiled import kernel
from placegraph.threads import share as in_threads

NEIGHBOURS = 4
"""Places that a camera near one of them may be nearer to, in what it sees: behind a wall is another
room."""
NEAR = 1.2
"""Places farther from each other than this are not beside each other [m]."""
OFF = 1.5
"""Farther from all places than this is off the map [m]."""
CELL = 0.25
"""Edge of the cells of ground that share their nearest place [m]."""
SLIP = 1.0
"""What being at the next place, or turned by one bin more, costs [nat]."""


def best_cosines(cosines, code, starts, weight):
    """Sum over words of weight (W,) times the best of cosines (W, U) over each scene's objects.

    `code`: (M,) column of each object; `starts`: (S + 1,) first object of each scene.
    """
    out = np.empty(len(starts) - 1, np.float64)
    in_threads(_best_cosines, len(out), cosines, code, starts, weight, out)
    return out


@kernel(fastmath=True, error_model="numpy")
def _best_cosines(cosines, code, starts, weight, out, first, last):
    for s in range(first, last):
        total = 0.0
        for w in range(len(weight)):
            best = np.float32(-1.0)
            for i in range(starts[s], starts[s + 1]):
                best = max(best, cosines[w, code[i]])
            total += weight[w] * best
        out[s] = total


def held(ratio, code, share, starts, weight, wrong):
    """Log-likelihood (S,) of words with weights (W,) in each scene, a mixture of its objects.

    `ratio`: (U, W) how much likelier a word is of an object than of anything; `share`: (M,).
    """
    out = np.empty(len(starts) - 1, np.float64)
    in_threads(_held, len(out), ratio, code, share, starts, weight, wrong, out)
    return out


@kernel(fastmath=True, error_model="numpy")
def _held(ratio, code, share, starts, weight, wrong, out, first, last):
    words = ratio.shape[1]
    for s in range(first, last):
        mean = _mixture(ratio, code, share, starts[s], starts[s + 1])
        total = 0.0
        for w in range(words):
            total += weight[w] * np.log(np.float32(1.0 - wrong) * mean[w] + np.float32(wrong))
        out[s] = total


@kernel(fastmath=True)
def mixtures(ratio, code, share, starts, chosen):
    """How much likelier words are in chosen units (C,) than anywhere (C, W); as of `held`."""
    out = np.empty((len(chosen), ratio.shape[1]), np.float32)
    for c, s in enumerate(chosen):
        out[c] = _mixture(ratio, code, share, starts[s], starts[s + 1])
    return out


@kernel(fastmath=True)
def _mixture(ratio, code, share, first, last):
    words = ratio.shape[1]
    mean = np.zeros(words, np.float32)
    for i in range(first, last):
        row, part = ratio[code[i]], share[i]
        for w in range(words):
            mean[w] += part * row[w]
    return mean


@kernel(fastmath=True)
def add_told(told, bin_of, word, weight, logs):
    """Add weight (P,) times what the words (P,) of patches tell, rows of logs (W, O), to their bins."""
    for i in range(len(word)):
        row, said, share = told[bin_of[i]], logs[word[i]], weight[i]
        for o in range(len(row)):
            row[o] += share * said[o]


def along_ways(
    told, bin_turn, bin_band, frame_starts, chosen, object_starts, code, panoramas, place_starts,
    places, steps, unknown,
):  # fmt: skip
    """Log of the mean likelihood over all starts of a way, for chosen scenes (C,).

    Parameters
    ----------
    told
        (B, U) what the patches of a bin of a frame say of each object's column, summed [nat].
    bin_turn, bin_band
        (B,) azimuth relative to the camera, and elevation, of these bins.
    frame_starts
        (T + 1,) first bin of each frame.
    chosen
        (C,) rows of scenes.
    object_starts, code
        (S + 1,), (M,) as of `best_cosines`.
    panoramas, place_starts, places
        (K, bands, turns) objects of their scene, (S + 1,), (K, 2) [m].
    steps
        (T, 3) x, y [m] and bins of yaw from the reference frame to each.
    unknown
        (T,) what a frame is taken to say of a direction, and of a place, that is not mapped.

    """
    out = np.empty(len(chosen), np.float64)
    scenes = chosen, object_starts, code, panoramas, place_starts, places
    frames = told, bin_turn, bin_band, frame_starts, steps, unknown
    in_threads(_along_ways, len(out), *frames, *scenes, out)
    return out


@kernel(fastmath=True, error_model="numpy")
def _along_ways(
    told, bin_turn, bin_band, frame_starts, steps, unknown,
    chosen, object_starts, code, panoramas, place_starts, places, out, begin, end,
):  # fmt: skip
    turns = panoramas.shape[2]
    unit = 2.0 * np.pi / turns
    for c in range(begin, end):
        s = chosen[c]
        first, last = place_starts[s], place_starts[s + 1]
        own = code[object_starts[s] : object_starts[s + 1]]
        column = _columns(panoramas[first:last], own, told.shape[1])
        at = places[first:last]
        near, ground = _neighbours(at), _nearest(at)
        total = np.zeros((last - first, turns))
        score = np.empty((last - first, turns), np.float32)
        said = np.empty(told.shape[1] + 1, np.float32)
        for t in range(len(frame_starts) - 1):
            score[:] = 0.0
            bins = frame_starts[t + 1] - frame_starts[t]
            for b in range(frame_starts[t], frame_starts[t + 1]):
                said[:-1] = told[b]
                said[-1] = unknown[t] / bins
                for p in range(last - first):
                    ring, row = column[p, bin_band[b], bin_turn[b] :], score[p]
                    for h in range(turns):
                        row[h] += said[ring[h]]
            score = _blurred(score, near)
            for h in range(turns):
                yaw = h * unit
                dx = np.cos(yaw) * steps[t, 0] - np.sin(yaw) * steps[t, 1]
                dy = np.sin(yaw) * steps[t, 0] + np.cos(yaw) * steps[t, 1]
                turned = (h + int(np.round(steps[t, 2]))) % turns
                for p in range(last - first):
                    q = _place(ground, at[p, 0] + dx - at[0, 0], at[p, 1] + dy - at[0, 1])
                    total[p, h] += score[q, turned] if q >= 0 else unknown[t]
        top = total.max()
        mean = 0.0
        for p in range(last - first):
            for h in range(turns):
                mean += np.exp(total[p, h] - top)
        out[c] = top + np.log(mean / total.size)


@kernel
def _columns(panoramas, own, unmapped):
    """Column of what each bin of panoramas (P, bands, turns) shows, twice around."""
    count, bands, turns = panoramas.shape
    out = np.empty((count, bands, 2 * turns), np.int32)
    for p in range(count):
        for band in range(bands):
            for a in range(turns):
                seen = panoramas[p, band, a]
                out[p, band, a] = own[seen] if seen < len(own) else unmapped
                out[p, band, a + turns] = out[p, band, a]
    return out


@kernel
def _nearest(places):
    """Nearest place of each cell of the ground (X, Y) around the first of them; -1: off the map."""
    reach = 0.0
    for p in range(len(places)):
        for axis in range(2):
            reach = max(reach, abs(places[p, axis] - places[0, axis]))
    half = int((reach + OFF) / CELL) + 1
    out = np.empty((2 * half + 1, 2 * half + 1), np.int32)
    for i in range(2 * half + 1):
        x = places[0, 0] + (i - half) * CELL
        for j in range(2 * half + 1):
            y = places[0, 1] + (j - half) * CELL
            nearest, least = -1, OFF * OFF
            for q in range(len(places)):
                away = (places[q, 0] - x) ** 2 + (places[q, 1] - y) ** 2
                if away < least:
                    nearest, least = q, away
            out[i, j] = nearest
    return out


@kernel
def _place(ground, x, y):
    """Place nearest to a point beside the first place [m]; -1: off the map."""
    half = len(ground) // 2
    i, j = int(np.round(x / CELL)) + half, int(np.round(y / CELL)) + half
    inside = 0 <= i < len(ground) and 0 <= j < len(ground)
    return ground[i, j] if inside else np.int32(-1)


@kernel
def _neighbours(places):
    """Rows (P, NEIGHBOURS) of the places nearest to each, itself first; -1 where there are fewer."""
    count = len(places)
    out = np.full((count, NEIGHBOURS), -1, np.int64)
    for p in range(count):
        away = np.empty(count)
        for q in range(count):
            away[q] = (places[q, 0] - places[p, 0]) ** 2 + (places[q, 1] - places[p, 1]) ** 2
        for k in range(min(NEIGHBOURS, count)):
            q = int(np.argmin(away))
            if away[q] > NEAR * NEAR:
                break
            out[p, k] = q
            away[q] = 1e30
    return out


@kernel(fastmath=True)
def _blurred(score, near):
    """Best of scores (P, turns) at each place and heading, or one place or bin beside it."""
    count, turns = score.shape
    turned = np.empty_like(score)
    for p in range(count):
        for h in range(turns):
            left = score[p, h - 1 if h else turns - 1]
            right = score[p, h + 1 if h + 1 < turns else 0]
            turned[p, h] = max(score[p, h], max(left, right) - np.float32(SLIP))
    out = turned.copy()
    for p in range(count):
        for k in range(1, near.shape[1]):
            q = near[p, k]
            if q >= 0:
                for h in range(turns):
                    out[p, h] = max(out[p, h], turned[q, h] - np.float32(SLIP))
    return out
