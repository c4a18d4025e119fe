"""What colours and their steps tell, from the sums that `warp_kernels` makes of tiles."""

import warp as wp

LANES = wp.constant(16)
STEPS = wp.constant(3)
"""Where a tile's moments of steps begin among its sums ..."""
TONES = wp.constant(8)
"""... and where those of tones do, five of each channel."""
STEEPEST = wp.constant(wp.vec3(0.1, 0.02, 0.02))
"""`score_kernels.STEEPEST`."""
FLAT = wp.constant(wp.float64(0.01))  # `score_kernels.FLAT`
STILL = wp.constant(wp.float64(1.0e-4))  # `score_kernels._STILL`

Moments = wp.types.vector(length=5, dtype=wp.float64)


@wp.func
def step(here: wp.vec3, there: wp.vec3) -> wp.vec3:
    """`score_kernels._step` of all channels."""
    one = wp.vec3(1.0, 1.0, 1.0)
    return wp.max(wp.min(wp.cw_div(there - here, STEEPEST), one), -one)


@wp.func
def moments(sums: wp.array3d(dtype=wp.float32), n: int, first: int) -> Moments:
    """Of pose n: five sums of tiles, from `first` on, over all tiles."""
    total = Moments()
    for t in range(sums.shape[1]):
        for k in range(5):
            total[k] = total[k] + wp.float64(sums[n, t, first + k])
    return total


@wp.func
def told(rho: wp.float64) -> wp.float64:
    """-log(1 - rho^2) of a correlation."""
    cut = wp.clamp(rho, wp.float64(0.0), wp.float64(0.99))
    return -wp.log(wp.float64(1.0) - cut * cut)


@wp.func
def correlation(sums: wp.array3d(dtype=wp.float32), n: int) -> float:
    """`score_kernels._correlation` of pose n."""
    m = moments(sums, n, STEPS)
    if m[1] < wp.float64(LANES):
        return 0.0
    flat = wp.float64(3.0) * m[1] * FLAT
    rho = m[4] / wp.sqrt((m[2] + flat) * (m[3] + flat))
    return float(wp.float64(0.5) * told(rho) * m[1] / m[0])


@wp.func
def tone(sums: wp.array3d(dtype=wp.float32), n: int, hits: float) -> float:
    """`score_kernels._tone` of pose n."""
    if hits < float(LANES):
        return 0.0
    total = wp.float64(0.0)
    for c in range(3):
        m = moments(sums, n, TONES + 5 * c) / wp.float64(hits)
        vq = m[2] - m[0] * m[0]
        vr = m[3] - m[1] * m[1]
        if vq > STILL and vr > STILL:
            total = total + told((m[4] - m[0] * m[1]) / wp.sqrt(vq * vr))
    return float(total / wp.float64(6.0)) * hits
