# mypy: allow-untyped-defs, allow-incomplete-defs
"""Kernels that score poses: rays of a view, cast from many poses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.jit import kernel
from placegraph.core.threads import run_parallel
from placegraph.indoor.map.map_kernels import opponent_colour, sample_colour
from placegraph.indoor.rays.trace_kernels import (
    DIRECTION,
    FAR,
    LANES,
    NONE,
    ORIGIN,
    TRIANGLE,
    U,
    V,
    new_packet,
    trace16,
)

SEMANTIC, DEPTH, COLOUR, TONE = range(4)
"""Columns of scores: of images their steps of colour and, beside depth, their tones."""

STEEPEST = np.array([0.1, 0.02, 0.02], np.float32)
"""Steps of `surface.opponent` between neighbouring samples count no more than this: a bright window
or a dark gap says no more of a place than the outline of a table."""
FLAT = np.float32(0.01)
"""Mean square of steps, as shares of `STEEPEST`, that is taken for noise: bare walls say nothing."""
_STILL = 1e-4  # variance of colours below which there is none to compare


_PACKED = 6
"""Least number of poses near each other whose rays are traced together, sample by sample."""

_part = kernel(fastmath=True, error_model="numpy", _nrt=False)
"""Decorator of parts of `_score`, which allocate nothing."""


class Hits(NamedTuple):
    """Hits of the R rays of a view, from each of K poses, at most 16."""

    triangles: NDArray[np.int32]
    """(K, R); -1: none."""
    distances: NDArray[np.float32]
    """(K, R) depth [m]; 0: nothing is hit."""
    is_hit: NDArray[np.float32]
    """(K, R) 1 or 0."""
    colours: NDArray[np.float32]
    """(K, 3, R) `opponent_colour` of the map where something is hit, if the view has colours."""


def score_poses(tracer, surface, poses, view, noise):
    """Score poses (N, 4) float64 x, y, z [m], yaw [rad] against one view: (N, 4) float32.

    Columns: semantic, depth, colour, tone; log-likelihood ratios against a place the map does not
    know or, under ``gaussian``, the paper's scores in [0, 2] (Sec. 3.3, 3.4), which has no tone.
    """
    scores = np.zeros((len(poses), 4), np.float32)
    groups = -(-len(poses) // LANES)
    run_parallel(_score, groups, tracer, surface, poses, view, noise, scores)
    return scores


def show_view(tracer, surface, pose, view, noise):
    """Return the scores (4,) of a pose (4,), and what the map shows there.

    Triangles (R,) int32, -1: none; depths (R,) [m] and colours (3, R), `opponent_colour`, both 0 where
    nothing is hit; colours are 0 if the view has none.
    """
    scores = np.zeros((1, 4), np.float32)
    hits = _score(tracer, surface, pose[None], view, noise, scores, 0, 1)
    return scores[0], hits.triangles[0], hits.distances[0], hits.colours[0]


@kernel(error_model="numpy")
def _score(tracer, surface, poses, view, noise, scores, first, last):
    """Fill the rows of scores (N, 4) of groups `first` to `last` of 16 poses; return the last `Hits`."""
    size, rays, eyes = len(view.patch), new_packet(), np.empty((5, LANES), np.float32)
    shape = (min(LANES, len(poses)), size)
    hits = Hits(
        np.full(shape, NONE, np.int32),
        np.zeros(shape, np.float32),
        np.zeros(shape, np.float32),
        np.zeros((shape[0], 3, size), np.float32),
    )
    pairs, steps = np.zeros((2, size), np.float32), np.zeros((2, 3, size), np.float32)
    count = np.zeros((2, len(view.weight)), np.float32)
    votes = np.zeros(view.semantic.shape if noise.gaussian else (0, 0), np.int32)
    semantic, depth, colour = view.terms
    _find_steps(view, pairs, steps)
    samples = max(1, (view.patch >= 0).sum())
    for start in range(first * LANES, min(last * LANES, len(poses)), LANES):
        number = min(LANES, len(poses) - start)
        _trace(tracer, surface, poses[start : start + number], view, rays, eyes, hits)
        for k in range(number):
            out, is_hit, colours = scores[start + k], hits.is_hit[k], hits.colours[k]
            if semantic and noise.gaussian:
                out[SEMANTIC] = _patch_similarity(hits.triangles[k], surface, view, votes)
            elif semantic:
                out[SEMANTIC] = _semantic(hits.triangles[k], surface, view, count)
            if depth:
                out[DEPTH] = _depth(hits.distances[k], is_hit, view, noise, samples)
            if colour and noise.gaussian:
                out[COLOUR] = _ssim(is_hit, colours, view) / samples
            elif colour:
                out[COLOUR] = noise.colour_weight * _correlation(is_hit, colours, pairs, steps)
                if depth:
                    out[TONE] = noise.tone_weight * _tone(is_hit, colours, view) / samples
    return hits


@kernel(fastmath=True, error_model="numpy")
def _trace(tracer, surface, poses, view, rays, eyes, hits):
    """Trace the rays of a view from each of K poses (K, 4).

    The rays of a packet should be alike: they are those of one sample from all poses, or those of one tile
    from one pose, whichever differ less. `eyes`: (5, 16) which is filled with positions, cosines and sines.
    """
    packet, ints, valid = rays
    extent = 0.0  # largest angle between rays of one sample to surfaces 2 m away [rad]
    for k in range(LANES):  # the last pose fills its packets
        pose, one = poses[min(k, len(poses) - 1)], poses[0]
        eyes[0, k], eyes[1, k], eyes[2, k] = pose[0], pose[1], pose[2]
        eyes[3, k], eyes[4, k] = np.cos(pose[3]), np.sin(pose[3])
        away = max(abs(pose[0] - one[0]), abs(pose[1] - one[1]), abs(pose[2] - one[2]))
        extent = max(extent, abs(pose[3] - one[3]) + 0.5 * away)
    if len(poses) >= _PACKED and extent < 4.0 * view.footprint:
        for sample in range(len(view.patch)):
            if view.patch[sample] >= 0:
                for lane in range(LANES):
                    _aim(packet, lane, eyes, lane, view.directions[sample])
                trace16(tracer, packet, ints, valid)
                for lane in range(len(poses)):
                    _keep_hit(packet, ints, lane, surface, view, lane, sample, hits)
        return
    for k in range(len(poses)):
        for first in range(0, len(view.patch), LANES):
            for lane in range(LANES):
                _aim(packet, lane, eyes, k, view.directions[first + lane])
            trace16(tracer, packet, ints, valid)
            for lane in range(LANES):
                _keep_hit(packet, ints, lane, surface, view, k, first + lane, hits)


@_part
def _aim(packet, ray, eyes, k, direction):
    """Aim a ray of a packet at a sample from pose `k`."""
    x, y, z = direction
    cos, sin = eyes[3, k], eyes[4, k]
    packet[ORIGIN, ray] = eyes[0, k]
    packet[ORIGIN + 1, ray] = eyes[1, k]
    packet[ORIGIN + 2, ray] = eyes[2, k]
    packet[DIRECTION, ray] = cos * x - sin * y
    packet[DIRECTION + 1, ray] = sin * x + cos * y
    packet[DIRECTION + 2, ray] = z
    packet[FAR, ray] = np.inf


@_part
def _keep_hit(packet, ints, ray, surface, view, k, sample, hits):
    """Keep the hit of a ray of a packet as that of a sample from pose `k`."""
    triangle = ints[TRIANGLE, ray] if view.patch[sample] >= 0 else NONE
    hits.triangles[k, sample] = triangle
    hits.is_hit[k, sample] = triangle >= 0
    hits.distances[k, sample] = packet[FAR, ray] if triangle >= 0 else np.float32(0.0)
    if triangle >= 0 and view.terms[COLOUR]:
        width = packet[FAR, ray] * np.float32(view.footprint)
        shown = sample_colour(surface, triangle, packet[U, ray], packet[V, ray], width)
        shown = opponent_colour(shown[0], shown[1], shown[2])
        for c in range(3):
            hits.colours[k, c, sample] = shown[c]


@_part
def _object(triangle, surface, view):
    """Return the column of `view.semantic` of a triangle; the last one: the map ends there."""
    return surface.object_of[triangle] if triangle >= 0 else view.semantic.shape[1] - 1


@_part
def _semantic(triangles, surface, view, count):
    """Sum over patches of the log of their mean ratio: a patch sees its objects by their shares."""
    count[:] = 0.0
    for r in range(len(triangles)):
        patch = view.patch[r]
        if patch >= 0:
            count[0, patch] += view.semantic[patch, _object(triangles[r], surface, view)]
            count[1, patch] += np.float32(1.0)
    total = np.float32(0.0)
    for patch in range(len(view.weight)):
        if count[1, patch] > 0 and view.weight[patch] > 0:
            total += view.weight[patch] * np.log(count[0, patch] / count[1, patch])
    return total


@kernel
def _patch_similarity(triangles, surface, view, votes):
    """Return s of Sec. 3.3: the sum of cosine + 1 over patches that agree, divided by all patches.

    A patch sees the object that most of its rays hit; of equals, that of the lowest row. It agrees if
    that is its most similar object. Silent patches and patches without a ray count as disagreeing.
    `votes`: (P + 1, N + 1) rays of each patch by object, which is overwritten. Returns 0 to 2.
    """
    patches = len(view.weight) - 1  # the last one is for samples that lie in no patch
    votes[:] = 0
    for r in range(len(triangles)):
        if view.patch[r] >= 0:
            votes[view.patch[r], _object(triangles[r], surface, view)] += 1
    total = 0.0
    for patch in range(patches):
        best = votes[patch].argmax()
        if votes[patch, best] and view.weight[patch] > 0:
            total += view.semantic[patch, best]
    return total / max(1, patches)


@_part
def _depth(distances, is_hit, view, noise, samples):
    """Return the score of depth: by the paper's error (Sec. 3.4), or by Cauchy's tails."""
    total, readings = 0.0, 0
    for r in range(len(distances)):
        measured = view.depth[r]
        is_read = view.patch[r] >= 0 and measured > 0
        readings += is_read
        if noise.gaussian:  # what the map does not show is 0 in its depth image
            error = abs(distances[r] - measured)
            if noise.depth_clip > 0:
                error = min(error / np.float32(noise.depth_clip), np.float32(1.0))
            total += float(error) if is_read else 0.0
        else:
            error = distances[r] - measured
            cost = np.float32(noise.near_cost) if error > 0 else np.float32(noise.far_cost)
            error /= np.float32(noise.depth_floor) + np.float32(noise.depth_slope) * measured
            good = np.float32(1.0) / (np.float32(1.0) + error * error)
            ratio = good * np.float32(noise.depth_gain) - (np.float32(1.0) - good) * cost
            total += float(is_hit[r] * (ratio - view.background_depth[r])) if is_read else 0.0
    if noise.gaussian:
        return 2.0 * (1.0 - total / readings) if readings else 0.0
    return noise.depth_weight * total / samples


@_part
def _step(here, there, steepest):
    """A step as a share of the steepest that counts, in [-1, 1]."""
    return min(max((there - here) / steepest, np.float32(-1.0)), np.float32(1.0))


@_part
def _find_steps(view, pairs, steps):
    """Find pairs (2, R) of each sample with that to the right and below, 1 if in its tile and the image.

    Write also the steps of the view's colours (2, 3, R) from the sample to the other.
    """
    for r in range(len(view.patch)):
        lane = r % LANES
        for way in range(2):
            is_last = lane % 4 == 3 if way == 0 else lane >= LANES - 4
            to = r + (1 if way == 0 else 4)
            if not is_last and view.patch[r] >= 0 and view.patch[to] >= 0:
                pairs[way, r] = 1.0
                for c in range(3):
                    steps[way, c, r] = _step(view.colour[r, c], view.colour[to, c], STEEPEST[c])


@_part
def _correlation(is_hit, colours, pairs, steps):
    """-log(1 - rho^2) / 2 of the steps of colour: what one pair of neighbours tells [nat].

    Correlation, not difference: exposure and contrast are not known. Times the share of pairs that
    hit.
    """
    both = qq = rr = qr = np.float32(0.0)
    for way in range(2):
        to = 1 if way == 0 else 4
        for c in range(3):
            for i in range(len(is_hit) - to):
                pair, q = pairs[way, i] * is_hit[i] * is_hit[i + to], steps[way, c, i]
                r = _step(colours[c, i], colours[c, i + to], STEEPEST[c])
                both, qq = both + pair, qq + pair * q * q
                rr, qr = rr + pair * r * r, qr + pair * q * r
    if both < 3 * LANES:
        return 0.0
    flat = both * FLAT
    rho = qr / np.sqrt((qq + flat) * (rr + flat))
    rho = min(max(rho, 0.0), 0.99)
    return -0.5 * np.log(1.0 - rho * rho) * both / (3.0 * pairs.sum())


@_part
def _tone(is_hit, colours, view):
    """-log(1 - rho^2) / 2 of colours, the mean of their channels, times the samples that hit [nat].

    A channel's gain and offset are free: a lamp's brightness and colour are not known.
    """
    hits, total = is_hit.sum(), 0.0
    if hits < LANES:
        return 0.0
    for c in range(3):
        q = r = qq = rr = qr = 0.0
        for i in range(len(is_hit)):
            x, y = is_hit[i] * view.colour[i, c], is_hit[i] * colours[c, i]
            q, r, qq, rr, qr = q + x, r + y, qq + x * x, rr + y * y, qr + x * y
        q, r = q / hits, r / hits
        vq, vr = qq / hits - q * q, rr / hits - r * r
        if vq > _STILL and vr > _STILL:
            rho = min(max((qr / hits - q * r) / np.sqrt(vq * vr), 0.0), 0.99)
            total -= np.log(1.0 - rho * rho) / 6.0
    return total * hits


@_part
def _ssim(is_hit, colours, view):
    """Return the sum of SSIM of the lightness of tiles (Sec. 3.4) times their samples that hit, doubled.

    SSIM lies in [-1, 1]. What the map does not show agrees with nothing; the sum is at least 0.
    """
    # Wang et al. 2004 with K1 = .01, K2 = .03; lightness runs from 0 to 3
    c1, c2, total = 9e-4, 81e-4, 0.0
    for first in range(0, len(is_hit), LANES):
        hits = q1 = q2 = r1 = r2 = qr = 0.0
        for i in range(first, first + LANES):
            q, r = np.float64(view.colour[i, 0] * is_hit[i]), np.float64(colours[0, i] * is_hit[i])
            hits += is_hit[i]
            q1, r1, q2, r2, qr = q1 + q, r1 + r, q2 + q * q, r2 + r * r, qr + q * r
        if hits > 1:
            mq, mr = q1 / hits, r1 / hits
            vq, vr, cov = q2 / hits - mq * mq, r2 / hits - mr * mr, qr / hits - mq * mr
            below = (mq * mq + mr * mr + c1) * (vq + vr + c2)
            total += hits * (2 * mq * mr + c1) * (2 * cov + c2) / below
    return max(0.0, 2.0 * total)


_LEVEL, _APART = 0.9, 0.06
"""Least cosine of two normals, and largest distance from the first plane [m], of samples on one surface."""
_BRIGHT = 2.85
"""Sum of the three channels, of 3, from which on a sample is overexposed."""


@kernel(error_model="numpy")
def sum_surface_steps(pose, view, normals, triangles, distances, colours):
    """Sum squares of the view's steps of colour, of the map's, their products, and pairs times channels.

    Pairs are neighbours on one surface of the map. A place that looks like another has its shapes, and
    so the steps at their edges; it rarely has the marks on its walls and floors. `triangles`, `distances`
    and `colours`: what `show_view` returns at a pose (4,).
    """
    pairs, steps = np.zeros((2, len(triangles))), np.zeros((2, 3, len(triangles)))
    sums, cos, sin = np.zeros(4), np.cos(pose[3]), np.sin(pose[3])
    _find_steps(view, pairs, steps)
    for way in range(2):
        for i in np.flatnonzero(pairs[way]):
            to = i + (1 if way == 0 else 4)
            is_dark = view.colour[i, 0] < _BRIGHT and view.colour[to, 0] < _BRIGHT
            if not is_dark or triangles[i] < 0 or triangles[to] < 0:
                continue
            normal, other = normals[triangles[i]], normals[triangles[to]]
            x, y, z = distances[to] * view.directions[to] - distances[i] * view.directions[i]
            away = normal[0] * (cos * x - sin * y) + normal[1] * (sin * x + cos * y) + normal[2] * z
            if (normal * other).sum() > _LEVEL and abs(away) < _APART:
                for c in range(3):
                    q, r = steps[way, c, i], _step(colours[c, i], colours[c, to], STEEPEST[c])
                    sums[0] += q * q
                    sums[1] += r * r
                    sums[2] += q * r
                    sums[3] += 1.0
    return sums
