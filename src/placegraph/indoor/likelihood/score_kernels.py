# mypy: allow-untyped-defs, allow-incomplete-defs
"""Kernels that score poses: rays of a view, cast from many poses."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.core.threads import run_parallel
from placegraph.indoor.map.map_kernels import opponent_colour, sample_colour
from placegraph.indoor.rays.trace_kernels import (
    DIRECTION,
    FAR,
    LANES,
    ORIGIN,
    TRIANGLE,
    U,
    V,
    new_packet,
    trace16,
)

SEMANTIC, DEPTH, COLOUR, TONE = range(4)
"""Columns of scores: of images their steps of colour and, beside depth, their tones."""

_FEW = 8
"""So few poses are scored sooner than other threads wake."""

STEEPEST = np.array([0.1, 0.02, 0.02], np.float32)
"""Steps of `surface.opponent` between neighbouring samples count no more than this: a bright window
or a dark gap says no more of a place than the outline of a table."""
FLAT = np.float32(0.01)
"""Mean square of steps, as shares of `STEEPEST`, that is taken for noise: bare walls say nothing."""
_STILL = 1e-4  # variance of colours below which there is none to compare


def score_poses(tracer, surface, poses, view, noise):
    """Score poses (N, 4) float64 x, y, z [m], yaw [rad] against one view: (N, 4) float32.

    Columns: semantic, depth, colour, tone; log-likelihood ratios against a place the map does not
    know or, under ``gaussian``, the paper's scores in [0, 2] (Sec. 3.3, 3.4), which has no tone.
    """
    scores = np.zeros((len(poses), 4), np.float32)
    if len(poses) <= _FEW:
        _score(tracer, surface, poses, view, noise, scores, 0, len(poses))
    else:
        run_parallel(_score, len(poses), tracer, surface, poses, view, noise, scores)
    return scores


@kernel(fastmath=True, error_model="numpy")
def _score(tracer, surface, poses, view, noise, scores, first, last):
    """Fill rows `first` to `last` of scores (N, 4)."""
    patches = len(view.weight)
    packet, ints, valid = new_packet()
    patch_sums = np.zeros(patches, np.float32)
    count = np.zeros(patches, np.float32)
    objects = view.semantic.shape[1]
    voted = noise.gaussian and view.terms[SEMANTIC]
    ray_objects = np.zeros(len(view.directions) if voted else 0, np.int32)
    votes = np.zeros((patches, objects) if voted else (0, 0), np.int32)
    map_colours, hit = np.zeros((LANES, 3), np.float32), np.zeros(LANES, np.bool_)
    steps, tones = np.zeros(5, np.float64), np.zeros((3, 6), np.float64)
    for k in range(first, last):
        patch_sums[:] = 0.0
        count[:] = 0.0
        steps[:] = 0.0
        tones[:] = 0.0
        far = np.float32(0.0)
        readings = 0
        missed = 0.0
        ssim = 0.0
        tiles = len(view.directions) // LANES
        for tile in range(tiles):
            aim(packet, poses[k], view.directions, tile * LANES)
            trace16(tracer, packet, ints, valid)
            for lane in range(LANES):
                r = tile * LANES + lane
                patch = view.patch[r]
                if patch < 0:
                    continue
                triangle = ints[TRIANGLE, lane]
                seen_object = objects - 1
                if triangle >= 0:
                    seen_object = surface.object_of[triangle]
                if voted:
                    ray_objects[r] = seen_object
                    votes[patch, seen_object] += 1
                else:
                    patch_sums[patch] += view.semantic[patch, seen_object]
                count[patch] += np.float32(1.0)
                if view.terms[DEPTH] and view.depth[r] > 0:
                    readings += 1
                    if triangle >= 0 or noise.gaussian:
                        # what the map does not show is 0 in its depth image
                        expected = packet[FAR, lane] if triangle >= 0 else np.float32(0.0)
                        far += _depth(expected, view.depth[r], noise)
                        far -= view.background_depth[r]
            if noise.gaussian:  # tiles are summed in double precision
                missed += float(far)
                far = np.float32(0.0)
                if view.terms[COLOUR]:
                    ssim += _ssim(tile, packet, ints, surface, view)
            elif view.terms[COLOUR]:
                _show(tile, packet, ints, surface, view, map_colours, hit)
                _steps(tile, view, map_colours, hit, steps)
                if view.terms[DEPTH]:
                    _tones(tile, view, map_colours, hit, tones)
        if voted:
            scores[k, SEMANTIC] = _patch_similarity(votes, ray_objects, view)
        elif view.terms[SEMANTIC]:
            scores[k, SEMANTIC] = _semantic(patch_sums, count, view.weight)
        samples = np.float32(0.0)
        for patch in range(patches):
            samples += count[patch]
        if noise.gaussian:
            if readings:
                scores[k, DEPTH] = 2.0 * (1.0 - missed / readings)
            if samples:
                # SSIM lies in [-1, 1]; what the map does not show agrees with nothing
                scores[k, COLOUR] = max(0.0, 2.0 * ssim / samples)
        else:
            scores[k, DEPTH] = np.float32(noise.depth_weight) * far / samples
            scores[k, COLOUR] = np.float32(noise.colour_weight) * _correlation(steps)
            scores[k, TONE] = np.float32(noise.tone_weight) * _tone(tones) / samples


@kernel(inline=True)
def aim(packet, pose, directions, first):
    """Fill a packet with the rays of one tile from one pose."""
    c, s = np.float32(np.cos(pose[3])), np.float32(np.sin(pose[3]))
    for lane in range(LANES):
        x, y, z = directions[first + lane]
        packet[ORIGIN, lane] = pose[0]
        packet[ORIGIN + 1, lane] = pose[1]
        packet[ORIGIN + 2, lane] = pose[2]
        packet[DIRECTION, lane] = c * x - s * y
        packet[DIRECTION + 1, lane] = s * x + c * y
        packet[DIRECTION + 2, lane] = z
        packet[FAR, lane] = np.inf


@kernel(inline=True, fastmath=True)
def _semantic(patch_sums, count, weight):
    """Sum over patches of the log of their mean ratio: a patch sees its objects by their shares."""
    total = np.float32(0.0)
    for patch in range(len(patch_sums)):
        if count[patch] > 0 and weight[patch] > 0:
            total += weight[patch] * np.log(patch_sums[patch] / count[patch])
    return total


@kernel
def _patch_similarity(votes, ray_objects, view):
    """Return s of Sec. 3.3: the sum of cosine + 1 over patches that agree, divided by all patches.

    A patch sees the object that most of its rays hit; of equals, that of the lowest row. It agrees if
    that is its most similar object. Silent patches and patches without a ray count as disagreeing.
    `votes`: (P + 1, N + 1) rays of each patch by object, cleared on return; `ray_objects`: (R,)
    object of each ray. Returns 0 to 2.
    """
    patches = len(view.weight) - 1  # the last one is for samples that lie in no patch
    best = np.full(patches, -1, np.int32)
    for r in range(len(ray_objects)):
        patch = view.patch[r]
        if 0 <= patch < patches and view.weight[patch] > 0:
            won = best[patch]
            lead = votes[patch, ray_objects[r]] - (votes[patch, won] if won >= 0 else 0)
            if lead > 0 or (lead == 0 and ray_objects[r] < won):
                best[patch] = ray_objects[r]
    total = 0.0
    for patch in range(patches):
        if best[patch] >= 0:
            total += view.semantic[patch, best[patch]]
    for r in range(len(ray_objects)):
        if view.patch[r] >= 0:
            votes[view.patch[r], ray_objects[r]] = 0
    return np.float32(total / max(1, patches))


@kernel(inline=True, fastmath=True)
def _depth(expected, measured, noise):
    """One reading: the paper's error (Sec. 3.4), or a log-likelihood with Cauchy's tails."""
    if noise.gaussian:
        error = abs(expected - measured)
        if noise.depth_clip > 0:
            error = min(error / np.float32(noise.depth_clip), np.float32(1.0))
        return error
    error = (expected - measured) / (
        np.float32(noise.depth_floor) + np.float32(noise.depth_slope) * measured
    )
    cost = np.float32(noise.near_cost) if error > 0 else np.float32(noise.far_cost)
    good = np.float32(1.0) / (np.float32(1.0) + error * error)
    return good * np.float32(noise.depth_gain) - (np.float32(1.0) - good) * cost


@kernel(inline=True, fastmath=True)
def _show(tile, packet, ints, surface, view, map_colours, hit):
    """Fill the map's colours (16, 3) at the samples of a tile, where `hit` (16,)."""
    for lane in range(LANES):
        triangle = ints[TRIANGLE, lane]
        hit[lane] = triangle >= 0 and view.patch[tile * LANES + lane] >= 0
        if hit[lane]:
            red, green, blue = _map_colour(packet, lane, triangle, surface, view)
            map_colours[lane, 0], map_colours[lane, 1], map_colours[lane, 2] = red, green, blue


@kernel(inline=True, fastmath=True)
def _tones(tile, view, map_colours, hit, moments):
    """Add the colours of a tile to a frame's moments (3, 6) of each channel."""
    for lane in range(LANES):
        if not hit[lane]:
            continue
        for c in range(3):
            q, r = view.colour[tile * LANES + lane, c], map_colours[lane, c]
            moments[c, 0] += q
            moments[c, 1] += r
            moments[c, 2] += q * q
            moments[c, 3] += r * r
            moments[c, 4] += q * r
            moments[c, 5] += 1.0


@kernel(inline=True, fastmath=True)
def _steps(tile, view, map_colours, hit, moments):
    """Add steps of colour between neighbours of a tile to a frame's moments.

    Moments: pairs of neighbours in the image, those of them that hit, and over these the sums of
    squares of the image's steps, of the map's, and of their products.
    """
    pairs = both = 0
    qq = rr = qr = np.float32(0.0)
    for lane in range(LANES):
        sample = tile * LANES + lane
        for way in range(2):  # to the right, and down
            if (way == 0 and lane % 4 == 3) or (way == 1 and lane >= LANES - 4):
                continue
            to = 1 if way == 0 else 4
            if view.patch[sample] < 0 or view.patch[sample + to] < 0:
                continue
            pairs += 1
            if not (hit[lane] and hit[lane + to]):
                continue
            both += 1
            for c in range(3):
                q = _step(view.colour[sample, c], view.colour[sample + to, c], STEEPEST[c])
                r = _step(map_colours[lane, c], map_colours[lane + to, c], STEEPEST[c])
                qq, rr, qr = qq + q * q, rr + r * r, qr + q * r
    moments[0] += pairs
    moments[1] += both
    moments[2] += qq
    moments[3] += rr
    moments[4] += qr


@kernel(inline=True, fastmath=True)
def _step(here, there, steepest):
    """A step as a share of the steepest that counts, in [-1, 1]."""
    return min(max((there - here) / steepest, np.float32(-1.0)), np.float32(1.0))


@kernel(inline=True, fastmath=True)
def _map_colour(packet, ray, triangle, surface, view):
    """`opponent_colour` of what one ray hits."""
    width = packet[FAR, ray] * np.float32(view.footprint)
    red, green, blue = sample_colour(surface, triangle, packet[U, ray], packet[V, ray], width)
    return opponent_colour(red, green, blue)


@kernel(inline=True, fastmath=True)
def _ssim(tile, packet, ints, surface, view):
    """SSIM of a tile's lightness (Sec. 3.4), times its samples that hit."""
    hits = 0
    q1 = q2 = r1 = r2 = qr = 0.0
    for lane in range(LANES):
        triangle = ints[TRIANGLE, lane]
        sample = tile * LANES + lane
        if triangle < 0 or view.patch[sample] < 0:
            continue
        hits += 1
        q = np.float64(view.colour[sample, 0])
        r = np.float64(_map_colour(packet, lane, triangle, surface, view)[0])
        q1, r1, q2, r2, qr = q1 + q, r1 + r, q2 + q * q, r2 + r * r, qr + q * r
    if hits < 2:
        return 0.0
    n = float(hits)
    # Wang et al. 2004 with K1 = .01, K2 = .03; lightness runs from 0 to 3
    c1, c2 = 9e-4, 81e-4
    mq, mr = q1 / n, r1 / n
    vq, vr, cov = q2 / n - mq * mq, r2 / n - mr * mr, qr / n - mq * mr
    return n * (2 * mq * mr + c1) * (2 * cov + c2) / ((mq * mq + mr * mr + c1) * (vq + vr + c2))


@kernel(inline=True, fastmath=True)
def _correlation(moments):
    """-log(1 - rho^2) / 2 of the steps of colour: what one pair of neighbours tells [nat].

    Correlation, not difference: exposure and contrast are not known. Times the share of pairs that
    hit.
    """
    pairs, both, qq, rr, qr = moments
    if both < LANES:
        return np.float32(0.0)
    flat = 3.0 * both * FLAT
    rho = qr / np.sqrt((qq + flat) * (rr + flat))
    rho = min(max(rho, 0.0), 0.99)
    return np.float32(-0.5 * np.log(1.0 - rho * rho) * both / pairs)


@kernel(inline=True, fastmath=True)
def _tone(moments):
    """-log(1 - rho^2) / 2 of colours, the mean of their channels, times the samples that hit [nat].

    A channel's gain and offset are free: a lamp's brightness and colour are not known.
    """
    hits, total = moments[0, 5], 0.0
    if hits < LANES:
        return np.float32(0.0)
    for c in range(3):
        q, r = moments[c, 0] / hits, moments[c, 1] / hits
        vq, vr = moments[c, 2] / hits - q * q, moments[c, 3] / hits - r * r
        if vq > _STILL and vr > _STILL:
            rho = min(max((moments[c, 4] / hits - q * r) / np.sqrt(vq * vr), 0.0), 0.99)
            total -= np.log(1.0 - rho * rho) / 6.0
    return np.float32(total * hits)


@kernel
def show_view(tracer, surface, pose, view):
    """Return triangles (R,) int32, -1: none, depths (R,) [m] and colours (R, 3) of the map at a pose (4,).

    Colours are `opponent_colour`, 0 where nothing is hit or the view has no colours.
    """
    n = len(view.directions)
    triangles = np.empty(n, np.int32)
    distances = np.empty(n, np.float32)
    colours, hit = np.zeros((n, 3), np.float32), np.zeros(LANES, np.bool_)
    packet, ints, valid = new_packet()
    for tile in range(n // LANES):
        aim(packet, pose, view.directions, tile * LANES)
        trace16(tracer, packet, ints, valid)
        for lane in range(LANES):
            triangles[tile * LANES + lane] = ints[TRIANGLE, lane]
            distances[tile * LANES + lane] = packet[FAR, lane]
        if view.terms[COLOUR]:
            shown = colours[tile * LANES : (tile + 1) * LANES]
            _show(tile, packet, ints, surface, view, shown, hit)
    return triangles, distances, colours
