# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `panoramas`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.jit import kernel
from placegraph.core.threads import share
from placegraph.indoor.map.surface_kernels import colour_at, opponent
from placegraph.indoor.rays.layout import DIRECTION, FAR, LANES, ORIGIN, TRIANGLE, U, V
from placegraph.indoor.rays.packets_kernels import new_packet, trace16

AZIMUTHS = 72


ELEVATIONS = 20


STEP = 2.0 * np.pi / AZIMUTHS
"""Bin of azimuth, and step of headings [rad]: 5 degrees."""


HEADINGS = 36
"""Headings of a camera that are looked up at each position: every other bin."""


FOLD = AZIMUTHS // HEADINGS


NEAREST, FARTHEST = 0.1, 30.0  # ranges are stored in 255 steps of their logarithm, 2.3 % each


NOTHING = 255


class Panoramas(NamedTuple):
    """K panoramas of E elevations and A azimuths."""

    objects: NDArray[np.uint16]
    """(K, E, A) row of the object; their number where the map ends."""
    ranges: NDArray[np.uint8]
    """(K, E, A) logarithmic; 255: the map ends."""
    colours: NDArray[np.uint8]
    """(K, E, 3, A) `surface.opponent`, scaled to bytes."""


_SCALE = np.array([85.0, 127.0, 63.0], np.float32)


_SHIFT = np.array([0.0, 127.0, 127.0], np.float32)


def look_around(tracer, surface, points, directions, objects):
    """Panoramas from points (K, 3)."""
    shape = (len(points), ELEVATIONS, AZIMUTHS)
    seen = np.full(shape, objects, np.uint16)
    ranges = np.full(shape, NOTHING, np.uint8)
    colours = np.zeros((len(points), ELEVATIONS, 3, AZIMUTHS), np.uint8)
    share(_look_around, len(points), tracer, surface, points, directions, seen, ranges, colours)
    return Panoramas(seen, ranges, colours)


@kernel(error_model="numpy")
def _look_around(tracer, surface, points, directions, seen, ranges, colours, first, last):
    """Fill panoramas `first` to `last`."""
    scale = np.float32(254.0 / np.log(FARTHEST / NEAREST))
    packet, ints, valid = new_packet()
    for k in range(first, last):
        for tile in range(len(directions) // LANES):
            for lane in range(LANES):
                for axis in range(3):
                    packet[ORIGIN + axis, lane] = points[k, axis]
                    packet[DIRECTION + axis, lane] = directions[tile * LANES + lane, axis]
                packet[FAR, lane] = np.inf
            trace16(tracer, packet, ints, valid)
            for lane in range(LANES):
                triangle = ints[TRIANGLE, lane]
                if triangle < 0:
                    continue
                e = tile // (AZIMUTHS // 4) * 4 + lane // 4
                a = tile % (AZIMUTHS // 4) * 4 + lane % 4
                seen[k, e, a] = surface.object_of[triangle]
                steps = np.log(packet[FAR, lane] / np.float32(NEAREST)) * scale
                ranges[k, e, a] = np.uint8(min(max(steps, np.float32(0)), np.float32(254)))
                red, green, blue = colour_at(
                    surface,
                    triangle,
                    packet[U, lane],
                    packet[V, lane],
                    packet[FAR, lane] * np.float32(STEP),
                )
                rendered = opponent(red, green, blue)
                for c in range(3):
                    byte = rendered[c] * _SCALE[c] + _SHIFT[c]
                    colours[k, e, c, a] = np.uint8(min(max(byte, np.float32(0)), np.float32(255)))


class Samples(NamedTuple):
    """S samples of T views, one view after the other, and the column of panoramas that each meets."""

    ends: NDArray[np.int64]
    """(T,) row behind the last sample of each view."""
    band: NDArray[np.int32]
    """(S,) band of elevation."""
    azimuth: NDArray[np.int32]
    """(S,) bin of azimuth, where the reference frame looks along bin 0."""
    patch: NDArray[np.int32]
    """(S,) row of `semantic`."""
    semantic: NDArray[np.float32]
    """(P, N + 1) log-likelihood of each object, and of none; no row: labels are not asked."""
    depth: NDArray[np.float32]
    """(S, 256) log-likelihood of each stored range; no row: depth is not asked."""
    colour: NDArray[np.float32]
    """(S, 3) on the scale of bytes; no row: colours are not asked."""


def scan_headings(panoramas, mapped, samples, colour_weight):
    """Log-likelihood (T, K, HEADINGS): for each sample, its column turned through all headings."""
    out = np.empty((len(samples.ends), len(panoramas.objects), HEADINGS), np.float32)
    share(_scan_headings, out.shape[1], panoramas, mapped, samples, colour_weight, out)
    return out


@kernel(fastmath=True, error_model="numpy")
def _scan_headings(panoramas, mapped, samples, colour_weight, out, first, last):
    """Fill columns `first` to `last` of out (T, K, HEADINGS).

    Panoramas are unrolled first, so that what the headings of one sample meet lies in one run.
    """
    # arrays are taken out of tuples once: each time costs more than a term
    ends, band, azimuth, patch = samples.ends, samples.band, samples.azimuth, samples.patch
    semantic, depth = samples.semantic, samples.depth
    all_objects, all_ranges, all_colours = panoramas.objects, panoramas.ranges, panoramas.colours
    objects = np.empty((ELEVATIONS * FOLD, 2 * HEADINGS), np.uint32)
    ranges = np.empty((ELEVATIONS * FOLD, 2 * HEADINGS), np.uint32)
    colours = np.empty((ELEVATIONS * FOLD, 4, 2 * HEADINGS), np.float32)
    moments = np.empty((3, 5, HEADINGS), np.float32)
    total = np.empty(HEADINGS, np.float32)
    coloured = len(samples.colour) > 0
    used = np.zeros(ELEVATIONS, np.bool_)
    for s in range(len(band)):
        used[band[s]] = True
    for k in range(first, last):
        for e in range(ELEVATIONS):
            if used[e]:
                _unroll(all_objects[k, e], objects[e * FOLD : (e + 1) * FOLD])
                _unroll(all_ranges[k, e], ranges[e * FOLD : (e + 1) * FOLD])
                if coloured:
                    shown = colours[e * FOLD : (e + 1) * FOLD]
                    _unroll_colours(all_colours[k, e], all_ranges[k, e], shown)
        begin = 0
        for t in range(len(ends)):
            total[:] = 0.0
            for s in range(begin, ends[t]):
                row = np.uint32(band[s] * FOLD + azimuth[s] % FOLD)
                shift, sample = np.uint32(azimuth[s] // FOLD), np.uint32(s)
                if len(semantic):
                    said = np.uint32(patch[s])
                    for a in range(np.uint32(HEADINGS)):
                        total[a] += semantic[said, objects[row, shift + a]]
                if len(depth):
                    for a in range(np.uint32(HEADINGS)):
                        total[a] += depth[sample, ranges[row, shift + a]]
            if coloured:
                part = begin, ends[t]
                _add_colours(total, colours, mapped[k], samples, part, moments, colour_weight)
            for a in range(HEADINGS):
                out[t, k, a] = total[a]
            begin = ends[t]


@kernel
def _unroll(columns, out):
    """Columns (A,) of a band, twice over, those of all headings beside each other (FOLD, 2 H)."""
    for fold in range(FOLD):
        for a in range(HEADINGS):
            out[fold, a] = out[fold, a + HEADINGS] = columns[a * FOLD + fold]


@kernel
def _unroll_colours(colours, ranges, out):
    """The same of colours (3, A), and whether anything is hit: (FOLD, 4, 2 H)."""
    for fold in range(FOLD):
        for a in range(HEADINGS):
            there = np.float32(ranges[a * FOLD + fold] != NOTHING)
            out[fold, 3, a] = out[fold, 3, a + HEADINGS] = there
            for c in range(3):
                shown = there * np.float32(colours[c, a * FOLD + fold])
                out[fold, c, a] = out[fold, c, a + HEADINGS] = shown


@kernel(fastmath=True, error_model="numpy")
def _add_colours(total, colours, whole, samples, part, m, colour_weight):
    """Add what the colours of one view tell to all headings of one position; m is room to work."""
    band, azimuth, colour = samples.band, samples.azimuth, samples.colour
    hits = np.zeros(HEADINGS, np.float32)
    m[:] = 0.0
    sums = np.zeros((3, 2), np.float32)
    for s in range(part[0], part[1]):
        row = np.uint32(band[s] * FOLD + azimuth[s] % FOLD)
        shift = np.uint32(azimuth[s] // FOLD)
        for c in range(np.uint32(3)):
            q = colour[s, c]
            for a in range(np.uint32(HEADINGS)):
                r = colours[row, c, shift + a]
                m[c, 1, a] += r
                m[c, 3, a] += r * r
                m[c, 4, a] += q * r
            if whole:  # sums of the image alone are the same everywhere
                sums[c, 0] += q
                sums[c, 1] += q * q
            else:
                for a in range(np.uint32(HEADINGS)):
                    there = colours[row, 3, shift + a]
                    m[c, 0, a] += q * there
                    m[c, 2, a] += q * q * there
        for a in range(np.uint32(HEADINGS)):
            hits[a] += colours[row, 3, shift + a]
    if whole:
        for c in range(3):
            m[c, 0] = sums[c, 0]
            m[c, 2] = sums[c, 1]
    _add_correlation(total, hits, m, colour_weight / np.float32(max(1, part[1] - part[0])))


@kernel(fastmath=True, error_model="numpy")
def _add_correlation(total, hits, m, weight):
    """Add what the colours tell (`score._correlation`) to all headings of one position."""
    for a in range(HEADINGS):
        n = hits[a]
        if n < LANES:
            continue
        told = np.float32(0.0)
        for c in range(3):
            q, r = m[c, 0, a] / n, m[c, 1, a] / n
            vq, vr = m[c, 2, a] / n - q * q, m[c, 3, a] / n - r * r
            if vq > 1.0 and vr > 1.0:
                rho = (m[c, 4, a] / n - q * r) / np.sqrt(vq * vr)
                rho = min(max(rho, np.float32(0.0)), np.float32(0.99))
                told -= np.log(np.float32(1.0) - rho * rho)
        total[a] += weight * n * told / np.float32(6.0)


def add_moved(total, scan, unknown, positions, layer_of, index, origin, spacing, step):
    """Add to each pose of the reference frame what `scan` says of it moved by `step` (3,) [m]."""
    grid = positions, layer_of, index, origin, spacing, step
    share(_add_moved, len(positions), total, scan, unknown, *grid)


@kernel
def _add_moved(
    total, scan, unknown, positions, layer_of, index, origin, spacing, step, first, last
):  # fmt: skip
    """Add to rows `first` to `last`."""
    _, nx, ny = index.shape
    turn = 2.0 * np.pi / HEADINGS
    for a in range(HEADINGS):
        c, s = np.cos(a * turn), np.sin(a * turn)
        along, across = c * step[0] - s * step[1], s * step[0] + c * step[1]
        for k in range(first, last):
            i = int(np.floor((positions[k, 0] + along - origin[0]) / spacing))
            j = int(np.floor((positions[k, 1] + across - origin[1]) / spacing))
            row = -1
            if 0 <= i < nx and 0 <= j < ny:
                row = index[layer_of[k], i, j]
            total[k, a] += scan[row, a] if row >= 0 else unknown
