"""The observation model of `score_kernels` for NVIDIA Warp: the same equations, in four steps.

Every ray is traced and compared by a thread of its own (`shade`). What it finds is summed without
atomics, over the 16 samples of a tile (`sum_tiles`) and over those of a patch (`sum_patches`), and
then over the frame (`finish`), so that the same poses get the same scores every time.
"""

import warp as wp

from placegraph.indoor.likelihood.warp_colours_kernels import (
    LANES,
    TONES,
    correlation,
    step,
    tone,
)
from placegraph.indoor.rays.warp_kernels import Surface

FARTHEST = wp.constant(wp.float32(3.0e38))
SUMS = wp.constant(23)
"""A tile's sums: depth, hits, SSIM times hits, and the moments of `score_kernels._steps` and
`score_kernels._tones`."""
NO_COLOUR = wp.constant(wp.float32(-1.0))  # lightness of a ray that hits nothing


@wp.struct
class Noise:
    """`view.Noise`."""

    gaussian: int
    depth_floor: float
    depth_slope: float
    depth_gain: float
    near_cost: float
    far_cost: float
    depth_weight: float
    colour_weight: float
    tone_weight: float
    depth_clip: float


@wp.struct
class View:
    """`view.View`, and its samples sorted by patch: those of patch p are `samples[starts[p]:]`."""

    directions: wp.array(dtype=wp.vec3)
    patch: wp.array(dtype=wp.int32)
    semantic: wp.array2d(dtype=wp.float32)
    weight: wp.array(dtype=wp.float32)
    depth: wp.array(dtype=wp.float32)
    usual_depth: wp.array(dtype=wp.float32)
    colour: wp.array(dtype=wp.vec3)
    footprint: float
    has_semantic: int
    has_depth: int
    has_colour: int
    samples: wp.array(dtype=wp.int32)
    starts: wp.array(dtype=wp.int32)
    number: float
    """Samples in the image."""
    readings: float
    """Samples with depth."""
    patches: float
    """Patches that have samples and weight."""


@wp.func
def depth_term(expected: float, measured: float, noise: Noise) -> float:
    """`score_kernels._depth`."""
    if noise.gaussian != 0:
        off = wp.abs(expected - measured)
        if noise.depth_clip > 0.0:
            off = wp.min(off / noise.depth_clip, 1.0)
        return off
    error = (expected - measured) / (noise.depth_floor + noise.depth_slope * measured)
    cost = noise.far_cost
    if error > 0.0:
        cost = noise.near_cost
    good = 1.0 / (1.0 + error * error)
    return good * noise.depth_gain - (1.0 - good) * cost


@wp.func
def opponent_at(surface: Surface, triangle: int, u: float, v: float, footprint: float) -> wp.vec3:
    """`surface.opponent` of `surface.colour_at`; weights `u`, `v` of corners 1 and 2."""
    a = surface.triangles[triangle, 0]
    b = surface.triangles[triangle, 1]
    c = surface.triangles[triangle, 2]
    w = 1.0 - u - v
    texture = surface.texture_of[triangle]
    level = int(0)
    texels = surface.texels_per_metre[triangle] * footprint
    while texels > 1.5 and level < surface.levels.shape[1] - 1:
        texels = texels * 0.5
        level = level + 1
    width = surface.levels[texture, level, 1]
    height = surface.levels[texture, level, 2]
    x = w * surface.uv[a, 0] + u * surface.uv[b, 0] + v * surface.uv[c, 0]
    y = w * surface.uv[a, 1] + u * surface.uv[b, 1] + v * surface.uv[c, 1]
    column = wp.min(int((x - wp.floor(x)) * float(width)), width - 1)
    row = wp.min(int((y - wp.floor(y)) * float(height)), height - 1)
    texel = surface.levels[texture, level, 0] + row * width + column
    rgb = wp.vec3(0.0, 0.0, 0.0)
    for k in range(3):
        mixed = (
            w * float(surface.colours[a, k])
            + u * float(surface.colours[b, k])
            + v * float(surface.colours[c, k])
        )
        rgb[k] = mixed * float(surface.texels[texel, k]) / 65025.0
    total = rgb[0] + rgb[1] + rgb[2]
    shade = 1.0 / (total + 0.06)
    return wp.vec3(total, (rgb[0] - rgb[2]) * shade, (2.0 * rgb[1] - rgb[0] - rgb[2]) * shade)


@wp.kernel(enable_backward=False)
def shade(
    mesh: wp.uint64,
    positions: wp.array(dtype=wp.vec3),
    turns: wp.array(dtype=wp.vec2),
    surface: Surface,
    view: View,
    noise: Noise,
    semantic: wp.array2d(dtype=wp.float32),
    depth: wp.array2d(dtype=wp.float32),
    colour: wp.array2d(dtype=wp.vec3),
):
    """Pose n, sample r: its semantic ratio, its depth term, and the colour it should have."""
    n, r = wp.tid()
    patch = view.patch[r]
    depth[n, r] = 0.0
    colour[n, r] = wp.vec3(NO_COLOUR, 0.0, 0.0)
    if patch < 0:
        return
    d = view.directions[r]
    c = turns[n][0]
    s = turns[n][1]
    along = wp.vec3(c * d[0] - s * d[1], s * d[0] + c * d[1], d[2])
    hit = wp.mesh_query_ray(mesh, positions[n], along, FARTHEST)
    thing = view.semantic.shape[1] - 1
    far = float(0.0)
    if hit.result:
        thing = surface.object_of[hit.face]
        far = hit.t
    semantic[n, r] = view.semantic[patch, thing]
    # what the map does not show is 0 in its depth image
    if view.has_depth != 0 and view.depth[r] > 0.0 and (hit.result or noise.gaussian != 0):
        depth[n, r] = depth_term(far, view.depth[r], noise) - view.usual_depth[r]
    if view.has_colour != 0 and hit.result:
        # Warp's weights are of corners 0 and 1
        v = 1.0 - hit.u - hit.v
        colour[n, r] = opponent_at(surface, hit.face, hit.v, v, far * view.footprint)


@wp.kernel(enable_backward=False)
def sum_tiles(
    view: View,
    depth: wp.array2d(dtype=wp.float32),
    colour: wp.array2d(dtype=wp.vec3),
    sums: wp.array3d(dtype=wp.float32),
):
    """Pose n, tile t: sums over its 16 samples, colours, their steps, and the SSIM of lightness."""
    n, t = wp.tid()
    far = float(0.0)
    hits = float(0.0)
    q1 = wp.vec3(0.0)
    r1 = wp.vec3(0.0)
    q2 = wp.vec3(0.0)
    r2 = wp.vec3(0.0)
    qr = wp.vec3(0.0)
    for lane in range(LANES):
        sample = t * LANES + lane
        far = far + depth[n, sample]
        shown = colour[n, sample]
        if shown[0] >= 0.0:
            seen = view.colour[sample]
            hits = hits + 1.0
            q1 = q1 + seen
            r1 = r1 + shown
            q2 = q2 + wp.cw_mul(seen, seen)
            r2 = r2 + wp.cw_mul(shown, shown)
            qr = qr + wp.cw_mul(seen, shown)
    ssim = float(0.0)
    if hits >= 2.0:
        c1 = 9.0e-4
        c2 = 81.0e-4
        mq = q1[0] / hits
        mr = r1[0] / hits
        vq = q2[0] / hits - mq * mq
        vr = r2[0] / hits - mr * mr
        cov = qr[0] / hits - mq * mr
        ssim = (2.0 * mq * mr + c1) * (2.0 * cov + c2)
        ssim = ssim / ((mq * mq + mr * mr + c1) * (vq + vr + c2))
    for c in range(3):
        sums[n, t, TONES + 5 * c] = q1[c]
        sums[n, t, TONES + 5 * c + 1] = r1[c]
        sums[n, t, TONES + 5 * c + 2] = q2[c]
        sums[n, t, TONES + 5 * c + 3] = r2[c]
        sums[n, t, TONES + 5 * c + 4] = qr[c]
    sums[n, t, 0] = far
    sums[n, t, 1] = hits
    sums[n, t, 2] = ssim * hits
    pairs = float(0.0)
    both = float(0.0)
    qq = float(0.0)
    rr = float(0.0)
    along = float(0.0)
    for lane in range(LANES):
        here = t * LANES + lane
        for way in range(2):
            there = here + 1 + 3 * way
            inside = (way == 0 and lane % 4 != 3) or (way == 1 and lane < LANES - 4)
            if inside and view.patch[here] >= 0 and view.patch[there] >= 0:
                pairs = pairs + 1.0
                if colour[n, here][0] >= 0.0 and colour[n, there][0] >= 0.0:
                    both = both + 1.0
                    q = step(view.colour[here], view.colour[there])
                    r = step(colour[n, here], colour[n, there])
                    qq = qq + wp.dot(q, q)
                    rr = rr + wp.dot(r, r)
                    along = along + wp.dot(q, r)
    sums[n, t, 3] = pairs
    sums[n, t, 4] = both
    sums[n, t, 5] = qq
    sums[n, t, 6] = rr
    sums[n, t, 7] = along


@wp.kernel(enable_backward=False)
def sum_patches(
    view: View,
    noise: Noise,
    semantic: wp.array2d(dtype=wp.float32),
    said: wp.array2d(dtype=wp.float32),
):
    """Pose n, patch p: what it says of the shares of objects it should see (`score_kernels._semantic`)."""
    n, p = wp.tid()
    first = view.starts[p]
    last = view.starts[p + 1]
    said[n, p] = 0.0
    if last > first and view.weight[p] > 0.0:
        seen = float(0.0)
        for k in range(first, last):
            seen = seen + semantic[n, view.samples[k]]
        mean = seen / float(last - first)
        if noise.gaussian != 0:
            said[n, p] = mean
        else:
            said[n, p] = view.weight[p] * wp.log(mean)


@wp.kernel(enable_backward=False)
def finish(
    view: View,
    noise: Noise,
    sums: wp.array3d(dtype=wp.float32),
    said: wp.array2d(dtype=wp.float32),
    scores: wp.array2d(dtype=wp.float32),
):
    """Pose n: its scores (`score_kernels.score_poses`)."""
    n = wp.tid()
    total = float(0.0)
    if view.has_semantic != 0:
        for p in range(said.shape[1]):
            total = total + said[n, p]
        if noise.gaussian != 0:
            total = total / wp.max(view.patches, 1.0)
    scores[n, 0] = total
    far = float(0.0)
    hits = float(0.0)
    ssim = float(0.0)
    for t in range(sums.shape[1]):
        far = far + sums[n, t, 0]
        hits = hits + sums[n, t, 1]
        ssim = ssim + sums[n, t, 2]
    scores[n, 3] = 0.0
    if noise.gaussian != 0:
        scores[n, 1] = 0.0
        if view.readings > 0.0:
            scores[n, 1] = 2.0 * (1.0 - far / view.readings)
        scores[n, 2] = wp.max(0.0, 2.0 * ssim / wp.max(view.number, 1.0))
    else:
        scores[n, 1] = noise.depth_weight * far / wp.max(view.number, 1.0)
        scores[n, 2] = noise.colour_weight * correlation(sums, n)
        if view.has_colour != 0 and view.has_depth != 0:
            scores[n, 3] = noise.tone_weight * tone(sums, n, hits) / wp.max(view.number, 1.0)
