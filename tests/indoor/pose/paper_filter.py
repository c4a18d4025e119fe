"""SG2Loc's particle filter in plain NumPy, from the paper's text (Sec. 3.1-3.5, Eq. 1-2).

Slow, in double precision, and its code is its own: nothing here comes from placegraph, whose filter is
compared with it. Where the text is open, it is our reading, as `docs/indoor.md` says, and both share it:
SSIM of lightness over tiles of 4 x 4 samples, an empty rendering as depth 0, the yaws of the boxes, and
bins, epsilon and delta of KLD. A pose is x, y, z [m], yaw [rad].
"""

from collections import defaultdict
from dataclasses import dataclass
from itertools import product
from math import ceil, pi, sqrt
from statistics import NormalDist

import numpy as np

HEIGHTS = (1.5, 1.6, 1.7, 1.8)  # Sec. 3.1
CELL = 0.2  # Sec. 3.1
PER_CELL = 3  # Sec. 3.1
NOISE = np.array([0.05, 0.05, 0.05, 0.05])  # Sec. 3.2: three in metres, one in radians
SIGMA = 0.2  # Sec. 3.3
LAMBDA = (1.0, 1.0)  # Eq. 2: all are weighted equally
STRIDES, BOXES = (20, 8, 4), (None, 1.6, 0.8)  # Sec. 3.5
TURNS = (None, pi / 4, pi / 8)  # not printed
EPSILON, DELTA = 0.1, 0.05  # not printed
BINS = np.array([0.2, 0.2, 0.2, pi / 18])  # not printed
FEWEST = 2500  # Sec. 5: roughly 2,500 particles


@dataclass
class World:
    """Coarse meshes of objects."""

    corners: np.ndarray  # (T, 3, 3) [m]
    object_of: np.ndarray  # (T,)
    colours: np.ndarray  # (T, 3, 3) of corners, 0 to 1


@dataclass
class Image:
    """One frame of an upright camera."""

    focal: float
    depth: np.ndarray  # (H, W) [m], 0: no reading
    rgb: np.ndarray  # (H, W, 3) 0 to 255
    best: np.ndarray  # (n, m) object that each patch is most similar to; -1: it says nothing
    cosine: np.ndarray  # (n, m) and how similar

    def at(self, stride):
        """Columns and rows of pixels at the centres of cells, and rays (R, 3): right, down, ahead."""
        h, w = self.depth.shape
        v, u = np.mgrid[stride / 2 : h : stride, stride / 2 : w : stride]
        ones = np.ones(u.size)
        rays = [(u.ravel() - w / 2) / self.focal, (v.ravel() - h / 2) / self.focal, ones]
        return u.ravel(), v.ravel(), np.stack(rays, axis=1)


def plus(poses, step):
    """Poses (N, 4) after a step (4,) or (N, 4) in their own frames: ahead, left, up, turn."""
    poses, step = np.atleast_2d(poses), np.atleast_2d(step)
    c, s = np.cos(poses[:, 3]), np.sin(poses[:, 3])
    ahead, left = step[:, 0], step[:, 1]
    moved = [c * ahead - s * left, s * ahead + c * left, step[:, 2], step[:, 3]]
    out = poses + np.stack(np.broadcast_arrays(*moved), axis=1)
    out[:, 3] = (out[:, 3] + pi) % (2 * pi) - pi
    return out


def back(pose, steps):
    """Pose (4,) of the first frame that steps (T, 4), of which the first is none, lead from."""
    for step in steps[:0:-1]:
        yaw = pose[3] - step[3]
        c, s = np.cos(yaw), np.sin(yaw)
        away = np.array([c * step[0] - s * step[1], s * step[0] + c * step[1], step[2]])
        pose = np.append(pose[:3] - away, yaw)
    return pose


def start(cells, floor, rng):
    """`PER_CELL` poses in each free cell (K, 2), by its centre, at each height, yaws at random."""
    out = []
    for (x, y), height, _ in product(cells, HEIGHTS, range(PER_CELL)):
        dx, dy = rng.uniform(-CELL / 2, CELL / 2, 2)
        out.append([x + dx, y + dy, floor + height, rng.uniform(-pi, pi)])
    return np.array(out)


def predict(poses, step, noise):
    """Eq. 1: s (+) (t + w), w (N, 4)."""
    return plus(poses, step + noise)


def cast(world, poses, rays):
    """Nearest triangle (N, R), depth along the optical axis, and weights of corners 1 and 2."""
    c, s, zero = np.cos(poses[:, 3]), np.sin(poses[:, 3]), np.zeros(len(poses))
    right, down = np.stack([s, -c, zero], 1), np.stack([zero, zero, zero - 1], 1)
    ahead = np.stack([c, s, zero], 1)
    along = np.einsum("ra,nab->nrb", rays, np.stack([right, down, ahead], axis=1))
    shape = along.shape[:2]
    nearest, depth = np.full(shape, -1), np.full(shape, np.inf)
    weights = np.zeros((2, *shape))
    for t, (a, b, corner) in enumerate(world.corners):  # Moeller and Trumbore
        e1, e2, from_a = b - a, corner - a, poses[:, :3] - a
        q = np.cross(from_a, e1)
        det = along @ np.cross(e2, e1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.einsum("nrb,nb->nr", along, np.cross(e2, from_a)) / det
            v = np.einsum("nrb,nb->nr", along, q) / det
            far = (q @ e2)[:, None] / det
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (far > 0) & (far < depth)
        nearest[hit], depth[hit] = t, far[hit]
        weights[0][hit], weights[1][hit] = u[hit], v[hit]
    return nearest, depth, weights


def similarity(world, image, stride, nearest):
    """s in [0, 2] (Sec. 3.3): a patch is assigned one object, that of most of its rays.

    Shifted cosines are summed where that is the predicted one, and divided by the number of all patches.
    """
    u, v, _ = image.at(stride)
    h, w = image.depth.shape
    n, m = image.best.shape
    patch = (v * n / h).astype(int) * m + (u * m / w).astype(int)
    seen = np.where(nearest >= 0, world.object_of[nearest], world.object_of.max() + 1)
    total = np.zeros(len(nearest))
    for p, (predicted, cosine) in enumerate(zip(image.best.flat, image.cosine.flat, strict=True)):
        if predicted < 0 or not (patch == p).any():
            continue
        for k, rays in enumerate(seen[:, patch == p]):
            if np.bincount(rays).argmax() == predicted:
                total[k] += cosine + 1.0
    return total / (n * m)


def depth_score(image, stride, depth):
    """Twice 1 - L1 of the depth images, where the input has a reading; an empty rendering is 0."""
    u, v, _ = image.at(stride)
    measured = image.depth[v.astype(int), u.astype(int)]
    shown = np.where(np.isfinite(depth), depth, 0.0)
    return 2.0 * (1.0 - np.abs(shown - measured)[:, measured > 0].mean(axis=1))


def small(rgb, stride):
    """R + G + B (h, w), 0 to 3, of an image averaged over cells; Pillow rounds rows, then columns."""
    h, w, _ = rgb.shape
    rows = np.floor(rgb.reshape(h, w // stride, stride, 3).mean(axis=2) + 0.5)
    both = np.floor(rows.reshape(h // stride, stride, w // stride, 3).mean(axis=1) + 0.5)
    return both.sum(axis=2) / 255.0


def ssim_score(world, image, stride, nearest, weights):
    """Twice SSIM (Wang et al. 2004) of lightness over windows of 4 x 4 samples; at least 0."""
    seen = small(image.rgb, stride)
    u, v = weights
    shares = np.stack([1.0 - u - v, u, v], axis=-1)
    colour = np.einsum("nrk,nrkc->nrc", shares, world.colours[nearest])
    shown = colour.sum(axis=2).reshape(-1, *seen.shape)
    hit = (nearest >= 0).reshape(shown.shape)
    c1, c2 = (0.01 * 3) ** 2, (0.03 * 3) ** 2
    total = np.zeros(len(shown))
    for n in range(len(shown)):
        for y, x in product(range(0, seen.shape[0], 4), range(0, seen.shape[1], 4)):
            window = (slice(y, y + 4), slice(x, x + 4))
            a, b = seen[window][hit[n][window]], shown[n][window][hit[n][window]]
            if len(a) > 1:
                cov = np.mean((a - a.mean()) * (b - b.mean()))
                same = (2 * a.mean() * b.mean() + c1) * (2 * cov + c2)
                same /= (a.mean() ** 2 + b.mean() ** 2 + c1) * (a.var() + b.var() + c2)
                total[n] += len(a) * same
    return np.maximum(0.0, 2.0 * total / seen.size)


def likelihood(s, depth=None, colour=None):
    """Log of Eq. 2, or of Sec. 3.3 with the semantic score alone: each term can reach 2."""
    target, reached = 2.0, np.asarray(s, float)
    for weight, score in zip(LAMBDA, (depth, colour), strict=True):
        if score is not None:
            target, reached = target + 2.0 * weight, reached + weight * score
    return -((target - reached) ** 2) / (2.0 * SIGMA**2)


def update(weights, logs):
    """w L, normalised."""
    new = weights * np.exp(logs - logs.max())
    return new / new.sum()


def occupied(poses, weights):
    """Bins of the state histogram in which resampling would put a particle."""
    mass = defaultdict(float)
    for pose, weight in zip(poses, weights, strict=True):
        x, y, z, yaw = (int(np.floor(a / b)) for a, b in zip(pose, BINS, strict=True))
        mass[x, y, z, yaw % 36] += weight
    return sum(m > 0.5 / len(poses) for m in mass.values())


def kld(bins):
    """n after Fox (2001), whose factor k - 1 Sec. 3.5 does not print."""
    if bins < 2:
        return 1
    z, a = NormalDist().inv_cdf(1 - DELTA), 2 / (9 * (bins - 1))
    return ceil((bins - 1) / (2 * EPSILON) * (1 - a + sqrt(a) * z) ** 3)


def stratified(poses, weights, uniform):
    """One particle from each of n equal shares of the weight, by n numbers in [0, 1)."""
    rows, row, reached = [], 0, weights[0]
    for i, u in enumerate(uniform):
        point = (i + u) / len(uniform) * weights.sum()
        while point >= reached and row < len(weights) - 1:
            row += 1
            reached += weights[row]
        rows.append(row)
    return poses[rows]


def boxed(first, number, count, rng):
    """Poses (count, 4) of a later pass, in its box around the MLE, carried back to the first frame."""
    reach = np.array([BOXES[number] / 2] * 3 + [TURNS[number]])
    return first + rng.uniform(-1, 1, (count, 4)) * reach


def heaviest(poses, weights):
    """The maximum likelihood estimate (4,)."""
    return max(zip(weights, poses, strict=True), key=lambda pair: pair[0])[1]


def run(world, images, steps, first, rng, terms=("semantic",), fewest=FEWEST):
    """The MLE (4,) of the last frame after the last pass, and the number of particles at each frame."""
    counts, poses = [], first
    for number, stride in enumerate(STRIDES):
        if number:
            poses = boxed(back(mle, steps), number, fewest, rng)  # noqa: F821
        weights = np.full(len(poses), 1 / len(poses))
        for t, image in enumerate(images):
            if t:
                most = None if number == 0 else fewest
                count = max(fewest, kld(occupied(poses, weights)))
                poses = stratified(poses, weights, rng.random(min(count, most or count)))
                weights = np.full(len(poses), 1 / len(poses))
                poses = predict(poses, steps[t], rng.normal(size=poses.shape) * NOISE)
            nearest, depth, corner = cast(world, poses, image.at(stride)[2])
            scores = [similarity(world, image, stride, nearest), None, None]
            if "depth" in terms:
                scores[1] = depth_score(image, stride, depth)
            if "colour" in terms:
                scores[2] = ssim_score(world, image, stride, nearest, corner)
            weights = update(weights, likelihood(*scores))
            counts.append(len(poses))
        mle = heaviest(poses, weights)
    return mle, counts
