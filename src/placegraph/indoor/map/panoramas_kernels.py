# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `panoramas`."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from placegraph.compiled import kernel
from placegraph.indoor.map.surface_kernels import colour_at, opponent
from placegraph.indoor.rays.layout import DIRECTION, FAR, LANES, ORIGIN, TRIANGLE, U, V
from placegraph.indoor.rays.packets_kernels import new_packet, trace16
from placegraph.threads import share

if TYPE_CHECKING:
    from numpy.typing import NDArray


AZIMUTHS = 72


ELEVATIONS = 20


STEP = 2.0 * np.pi / AZIMUTHS
"""Bin of azimuth, and step of headings [rad]: 5 degrees."""


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


def scan_headings(panoramas, mapped, patch, band, azimuth, semantic, depth, colour, colour_weight):
    """Log-likelihood (K, A): for each sample, its bin's column turned through all headings."""
    out = np.empty((len(panoramas.objects), AZIMUTHS), np.float32)
    samples = mapped, patch, band, azimuth, semantic, depth, colour, colour_weight
    share(_scan_headings, len(out), panoramas, *samples, out)
    return out


@kernel(fastmath=True, error_model="numpy")
def _scan_headings(
    panoramas, mapped, patch, band, azimuth, semantic, depth, colour, colour_weight, out, first, last
):  # fmt: skip
    """Fill rows `first` to `last` of out (K, A)."""
    samples = len(patch)
    sums = np.zeros((3, 2), np.float32)
    for s in range(len(colour)):
        for c in range(3):
            sums[c, 0] += colour[s, c]
            sums[c, 1] += colour[s, c] * colour[s, c]
    for k in range(first, last):
        whole = mapped[k]
        total = np.zeros(AZIMUTHS, np.float32)
        hits = np.zeros(AZIMUTHS, np.float32)
        m = np.zeros((3, 5, AZIMUTHS), np.float32)
        for s in range(samples):
            shift = azimuth[s]
            for part in range(2):
                # heading a looks at azimuth a + shift: two runs without a modulo in the loop
                begin, end = (0, AZIMUTHS - shift) if part == 0 else (AZIMUTHS - shift, AZIMUTHS)
                offset = shift if part == 0 else shift - AZIMUTHS
                ranges = panoramas.ranges[k, band[s]]
                if len(semantic):
                    objects = panoramas.objects[k, band[s]]
                    says = semantic[patch[s]]
                    for a in range(begin, end):
                        total[a] += says[objects[a + offset]]
                if len(depth):
                    costs = depth[s]
                    for a in range(begin, end):
                        total[a] += costs[ranges[a + offset]]
                if len(colour) and whole:
                    for c in range(3):
                        q = colour[s, c]
                        column = panoramas.colours[k, band[s], c]
                        for a in range(begin, end):
                            r = np.float32(column[a + offset])
                            m[c, 1, a] += r
                            m[c, 3, a] += r * r
                            m[c, 4, a] += q * r
                elif len(colour):
                    for a in range(begin, end):
                        hits[a] += np.float32(ranges[a + offset] != NOTHING)
                    for c in range(3):
                        q = colour[s, c]
                        column = panoramas.colours[k, band[s], c]
                        for a in range(begin, end):
                            there = np.float32(ranges[a + offset] != NOTHING)
                            r = np.float32(column[a + offset]) * there
                            m[c, 0, a] += q * there
                            m[c, 1, a] += r
                            m[c, 2, a] += q * q * there
                            m[c, 3, a] += r * r
                            m[c, 4, a] += q * r
        if len(colour) and whole:  # sums of the image alone: the same everywhere
            hits[:] = samples
            for c in range(3):
                m[c, 0] = sums[c, 0]
                m[c, 2] = sums[c, 1]
        if len(colour):
            _add_correlation(total, hits, m, colour_weight / np.float32(samples))
        for a in range(AZIMUTHS):
            out[k, a] = total[a]


@kernel(fastmath=True, error_model="numpy")
def _add_correlation(total, hits, m, weight):
    """Add what the colours tell (`score._correlation`) to all headings of one position."""
    for a in range(AZIMUTHS):
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
    """Add to each pose of the reference frame what `scan` says of it moved by `step`."""
    grid = positions, layer_of, index, origin, spacing, step
    share(_add_moved, len(positions), total, scan, unknown, *grid)


@kernel
def _add_moved(
    total, scan, unknown, positions, layer_of, index, origin, spacing, step, first, last
):  # fmt: skip
    """Add to rows `first` to `last`."""
    _, nx, ny = index.shape
    cosines, sines = np.cos(np.arange(AZIMUTHS) * STEP), np.sin(np.arange(AZIMUTHS) * STEP)
    turn = int(np.round(step[3] / STEP))
    for k in range(first, last):
        for a in range(AZIMUTHS):
            c, s = cosines[a], sines[a]
            x = positions[k, 0] + c * step[0] - s * step[1]
            y = positions[k, 1] + s * step[0] + c * step[1]
            i = int(np.floor((x - origin[0]) / spacing))
            j = int(np.floor((y - origin[1]) / spacing))
            row = -1
            if 0 <= i < nx and 0 <= j < ny:
                row = index[layer_of[k], i, j]
            if row >= 0:
                total[k, a] += scan[row, (a + turn) % AZIMUTHS]
            else:
                total[k, a] += unknown
