# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled search of panoramas for the things spoken of: from where, in which direction, how near."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel


@kernel
def look_for(objects, ranges, slot, level, slots):
    """Find where things are seen from each position.

    `objects`, `ranges`: (K, E, A) of the panoramas; `slot`: (N + 1,) of each object, -1 of those
    that are not looked for; `level`: (E, 256) horizontal distance of stored ranges [m].
    Returns `near` (J, K) float32 [m], infinite where unseen, `at` (J, K) the azimuth bin there, and
    `cut` (J, K) whether the thing goes on below what the panorama shows.
    """
    count, bands, azimuths = objects.shape
    near = np.full((slots, count), np.inf, np.float32)
    at = np.zeros((slots, count), np.int16)
    cut = np.zeros((slots, count), np.bool_)
    for e in range(bands):
        for a in range(azimuths):
            for k in range(count):  # neighbours in memory
                j = slot[objects[k, e, a]]
                if j < 0:
                    continue
                d = level[e, ranges[k, e, a]]
                if d < near[j, k]:
                    near[j, k], at[j, k] = d, a
                if e == 0:
                    cut[j, k] = True
    return near, at, cut


@kernel
def look_around_for(objects, ranges, weight, fit):
    """Return the agreement (K, A) of the view in each direction with an object: the best of `weight` x `fit`.

    `weight`: (N + 1,) how well each object is the thing; `fit`: (E, 256) how well ranges fit.
    """
    count, bands, azimuths = objects.shape
    out = np.zeros((count, azimuths), np.float32)
    for e in range(bands):
        for a in range(azimuths):
            for k in range(count):
                w = weight[objects[k, e, a]]
                if w > 0.0:
                    out[k, a] = max(out[k, a], w * fit[e, ranges[k, e, a]])
    return out


@kernel
def dilate_profile(profile, shift, window):
    """Return the best of a profile (K, A) around each heading (K, A), turned by `shift` bins.

    `window`: (2 W + 1,) how well bins beside the direction said still fit it.
    """
    count, azimuths = profile.shape
    half = len(window) // 2
    out = np.zeros((count, azimuths), np.float32)
    for k in range(count):
        for b in range(azimuths):
            value = profile[k, b]
            if value <= 0.0:
                continue
            for o in range(-half, half + 1):
                a = (b - shift - o) % azimuths
                out[k, a] = max(out[k, a], value * window[half + o])
    return out


@kernel
def vote_rooms(objects, ranges, room, weight, rooms):
    """Return the share (K, rooms) of what is seen that is of each room; `weight`: (256,) by range."""
    count, bands, azimuths = objects.shape
    out = np.zeros((count, rooms), np.float32)
    for k in range(count):
        total = np.float32(1e-6)
        for e in range(bands):
            for a in range(azimuths):
                r = room[objects[k, e, a]]
                if r >= 0:
                    w = weight[ranges[k, e, a]]
                    out[k, r] += w
                    total += w
        for r in range(rooms):
            out[k, r] /= total
    return out
