"""`FilterOptions.paper()` against `paper_filter`, an independent implementation: by steps, and whole.

Every step agrees to 1e-6, although rays are cast in single precision here.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import ks_2samp, kstest
from tests.indoor.conftest import view_frames
from tests.indoor.pose import paper_filter as theirs

from placegraph.core.geometry import Camera, between, compose, pose_matrix, wrap_angle
from placegraph.indoor.encode import Patches
from placegraph.indoor.likelihood.score import Scorer, model_of
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.pose.particle_filter import (
    ParticleFilter,
    Particles,
    draw_uniform_start,
    kld_bound,
    kld_count,
    propagate,
    resample,
)
from placegraph.indoor.pose.window import PoseQuery, Window
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.frame import Frame

pytestmark = pytest.mark.usefixtures("one_thread")
PAPER = FilterOptions.paper()
FOCAL, WIDTH, HEIGHT = 100.0, 160, 80
GRID = (4, 8)
UPRIGHT = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
TRUE = np.array([[1.1, 1.0, 1.6, 0.5], [1.35, 1.15, 1.6, 0.7], [1.55, 1.4, 1.6, 0.95]])
STEPS = np.concatenate([np.zeros((1, 4)), between(TRUE[:-1], TRUE[1:])])
FURNITURE = (
    ((0, 0, 0), (4, 3, 2.5)), ((3.3, 0.2, 0), (3.9, 1.6, 0.8)), ((0.1, 2.3, 0), (1.2, 2.9, 1.9)),
    ((2.2, 2.6, 0.9), (3.2, 2.95, 1.7)), ((1.9, 0.05, 0), (2.8, 0.5, 1.2)),
)  # fmt: skip


@pytest.fixture(scope="module")
def scene(boxes):
    """A room with four pieces of furniture; each wall is an object, and corners are painted."""
    model = boxes({f"thing{i}": box for i, box in enumerate(FURNITURE)})
    rng = np.random.default_rng(5)
    vertices = np.asarray(model.vertices)
    triangles = np.asarray(model.triangles)
    objects = np.concatenate([np.arange(12) // 2, np.repeat(np.arange(6, 10), 12)])
    mesh = Mesh.plain(vertices, triangles, objects, rng.integers(0, 256, vertices.shape))
    names = [str(i) for i in range(10)]
    return SceneMap.create(mesh, names, names, floor=0.0)


@pytest.fixture(scope="module")
def world(scene):
    """What the other implementation is given of the room."""
    mesh = scene.mesh
    return theirs.World(
        mesh.vertices[mesh.triangles].astype(float),
        mesh.object_of,
        mesh.colours[mesh.triangles] / 255.0,
    )


def rendered(world, pose, rng):
    """Image of the room: of nine patches one is wrong and one silent, every tenth reading is missing."""
    blank = np.zeros((HEIGHT, WIDTH))
    image = theirs.Image(FOCAL, blank, blank, np.zeros(GRID, int), rng.uniform(0.3, 0.9, GRID))
    nearest, depth, (u, v) = theirs.cast(world, pose[None], image.at(1)[2])
    image.depth = np.round(depth[0].reshape(blank.shape), 3).astype(np.float32).astype(float)
    image.depth[rng.random(blank.shape) < 0.1] = 0.0
    # samples lie between pixels: either side of them reads the same
    image.depth[:, 2::2], image.depth[2::2] = image.depth[:, 1:-1:2], image.depth[1:-1:2]
    shares = np.stack([1 - u - v, u, v], axis=-1)[0]
    colour = np.einsum("rk,rkc->rc", shares, world.colours[nearest[0]]) * 255
    tiles = colour.reshape(HEIGHT // 4, 4, WIDTH // 4, 4, 3).mean(axis=(1, 3))
    image.rgb = np.round(tiles).repeat(4, axis=0).repeat(4, axis=1).astype(np.uint8)
    things = world.object_of[nearest[0]].reshape(4, HEIGHT // 4, 8, WIDTH // 8)
    for row, column in np.ndindex(GRID):
        seen = np.bincount(things[row, :, column].ravel(), minlength=10)
        chance = rng.random() * 9
        image.best[row, column] = rng.integers(10) if chance < 1 else seen.argmax()
        image.best[row, column] = -1 if chance > 8 else image.best[row, column]
    image.cosine = image.cosine.astype(np.float32).astype(float)
    return image


@pytest.fixture(scope="module")
def images(world):
    rng = np.random.default_rng(1)
    return [rendered(world, pose, rng) for pose in TRUE]


@pytest.fixture(scope="module")
def frames(images):
    """The same as frames, with odometry in a frame of its own."""
    camera = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    level = np.stack([UPRIGHT] * len(TRUE))
    odometry = pose_matrix(between(TRUE[0], TRUE), level)
    return [
        Frame.from_arrays(
            image.rgb, camera, depth=image.depth, odometry=at, gravity=(0, 1, 0), stamp=t, index=t
        )
        for t, (image, at) in enumerate(zip(images, odometry, strict=True))
    ]


class Told:
    """Map encoder that says what the images' patches are most similar to."""

    def __init__(self, images):
        self.images = images

    def encode(self, frame):
        image = self.images[frame.index]
        table = np.full((image.best.size, 10), -0.2, np.float32)
        rows = np.arange(image.best.size, dtype=np.int32)
        table[rows, image.best.ravel()] = image.cosine.ravel()
        rows = np.where(image.best.ravel() < 0, -1, rows)
        return Patches(frame.camera, image.best.shape, rows, table)


def scattered(rng, count):
    return rng.uniform((0.3, 0.7, 1.0, -np.pi), (3.1, 2.1, 1.8, np.pi), (count, 4))


def test_the_start(scene, rng):
    """Sec. 3.1: the same cells and heights, three poses each; the rest is uniform in both."""
    window = Window(PoseQuery(scene=scene, options=PAPER), Scorer(scene, PAPER.likelihood), [])
    table = window.table
    cells = np.unique(table.positions[:, :2], axis=0)
    ours, other = (
        draw_uniform_start(window, window.options, rng),
        theirs.start(cells, scene.floors[0], rng),
    )

    def count_particles(poses):
        cell = np.floor((poses[:, :2] - table.origin) / theirs.CELL)
        columns = np.column_stack([cell, poses[:, 2].round(6)])
        return np.unique(columns, axis=0, return_counts=True)

    for a, b in zip(count_particles(ours), count_particles(other), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    for axis in (0, 1, 3):
        size = theirs.CELL if axis < 2 else 2 * np.pi
        within = [
            (p[:, axis] - (table.origin[axis] if axis < 2 else -np.pi)) % size
            for p in (ours, other)
        ]
        assert ks_2samp(*within).pvalue > 0.001
        assert kstest(within[0] / size, "uniform").pvalue > 0.001


def test_a_grid_of_heights_gets_no_others(scene, rng):
    """Table 7, *Uniform sampling*: a grid of 0.2 m upwards, too; two heights are a span."""
    for heights, expected in (
        ((1.4, 1.6, 1.8, 2.0), (1.4, 1.6, 1.8, 2.0)),
        ((1.4, 2.0), (1.4, *theirs.HEIGHTS, 2.0)),
    ):
        options = replace(PAPER, heights=heights)
        window = Window(
            PoseQuery(scene=scene, options=options), Scorer(scene, PAPER.likelihood), []
        )
        told, counts = np.unique(
            draw_uniform_start(window, options, rng)[:, 2].round(6), return_counts=True
        )
        np.testing.assert_allclose(told - scene.floors[0], expected, atol=1e-6)
        assert np.ptp(counts) == 0


def test_silent_patches_are_counted(scene, images, frames):
    """Sec. 3.3 divides by all patches, so the scores of two halves add up to that of both."""
    (view,) = view_frames(scene, frames[:1], PAPER, Told(images), 4.0)
    score = Scorer(scene, PAPER.likelihood).terms
    whole = float(score(TRUE[:1], view)[0, 0])
    parts = np.arange(len(view.weight)) % 2
    halves = [view._replace(weight=(view.weight * (parts == k)).astype("f4")) for k in (0, 1)]
    assert sum(float(score(TRUE[:1], half)[0, 0]) for half in halves) == pytest.approx(whole, 1e-6)


@pytest.mark.parametrize("grid", [(14, 14), (9, 16), (3, 5)])
@pytest.mark.parametrize("stride", theirs.STRIDES)
def test_grids_of_patches_that_rays_do_not_fill(grid, stride, scene, world, images, frames, rng):
    """Those of Sec. 3.1 and 3.3, and one that no stride divides; half of the patches are silent."""
    best = np.where(rng.random(grid) < 0.5, -1, rng.integers(10, size=grid))
    cosine = rng.uniform(0.3, 0.9, grid).astype(np.float32).astype(float)
    asked = [replace(images[0], best=best, cosine=cosine)]
    (view,) = view_frames(scene, frames[:1], PAPER, Told(asked), float(stride))
    poses = scattered(rng, 40)
    scores = Scorer(scene, PAPER.likelihood).terms(poses, view)[:, 0]
    nearest, *_ = theirs.cast(world, poses, asked[0].at(stride)[2])
    expected = theirs.similarity(world, asked[0], stride, nearest)
    np.testing.assert_allclose(scores, expected, rtol=0, atol=1e-6)
    assert np.ptp(expected) > 0.01


@pytest.mark.parametrize(("stride", "samples"), [(20.0, 48 * 28), (8.0, 120 * 68)])
def test_passes_sample_large_images_as_finely_as_printed(stride, samples, scene):
    """Images of 3RScan: 960 / 20 columns of rays, in whole tiles of 4 x 4, not 640 / 20."""
    camera = Camera(960, 540, 600.0, 600.0, 480.0, 270.0)
    depth = np.full((540, 960), 1.5, np.float32)
    still = Frame.from_arrays(
        np.zeros((540, 960, 3), np.uint8), camera, depth=depth, gravity=(0, 1, 0)
    )
    coarse = FilterOptions.coarse()
    first = replace(coarse.passes[0], stride=stride)
    few = replace(coarse, passes=(first,), spacing=1.0, per_cell=1, heights=(1.6,))
    estimate = scene.localize([still], options=few.only(depth=True), refine=False, seed=0)
    assert estimate.stats["rays"] == samples * estimate.stats["poses_scored"]


def test_equation_1(rng):
    poses, step = scattered(rng, 50), np.array([0.3, -0.1, 0.05, 0.4])
    ours = propagate(poses, step, PAPER.motion, np.random.default_rng(3))
    noise = np.random.default_rng(3).normal(size=poses.shape) * theirs.NOISE
    away = ours - theirs.predict(poses, step, noise)
    away[:, 3] = wrap_angle(away[:, 3])
    np.testing.assert_allclose(away, 0.0, atol=1e-12)


@pytest.mark.parametrize("stride", [*theirs.STRIDES, 1])
def test_scores_of_semantics_depth_and_colour(stride, scene, world, images, frames, rng):
    """Sec. 3.3 and 3.4, at the strides of the passes and at full resolution."""
    model = model_of(PAPER.likelihood)
    seen = view_frames(scene, frames, PAPER, Told(images), float(stride))
    poses = np.concatenate([TRUE, scattered(rng, 24 if stride > 1 else 2)])
    ours = [Scorer(scene, PAPER.likelihood).terms(poses, view) for view in seen]
    for scores, view, image in zip(ours, seen, images, strict=True):
        nearest, depth, corner = theirs.cast(world, poses, image.at(stride)[2])
        semantic = theirs.similarity(world, image, stride, nearest)
        metres = theirs.depth_score(image, stride, depth)
        colour = theirs.ssim_score(world, image, stride, nearest, corner)
        expected = np.stack([semantic, metres, colour], axis=1)
        np.testing.assert_allclose(scores[:, :3], expected, rtol=0, atol=1e-6)
        assert not scores[:, 3].any()  # the paper knows no tones
        logs = model.combine_terms(scores.astype(float), view.terms)
        np.testing.assert_allclose(
            logs, theirs.likelihood(*scores[:, :3].astype(float).T), rtol=1e-12
        )
        alone = model.combine_terms(scores.astype(float), np.array([True, False, False]))
        np.testing.assert_allclose(alone, theirs.likelihood(scores[:, 0]), rtol=1e-12)


def test_weights_bins_and_resampling(rng):
    """Sec. 3.3 and 3.5, from the same random numbers."""
    poses = np.concatenate([scattered(rng, 150), TRUE[0] + 0.1 * rng.normal(size=(250, 4))])
    poses[:, 3] = wrap_angle(poses[:, 3])
    weights, logs = np.full(400, 1 / 400), -rng.exponential(3.0, 400)
    ours, _ = Particles.uniform(poses).reweight(logs)
    other = theirs.update(weights, logs)
    np.testing.assert_allclose(ours.weights, other, atol=1e-12)
    wanted = theirs.kld(theirs.occupied(poses, other))
    assert kld_count(ours, PAPER) == wanted
    assert [kld_bound(k, 0.1, 0.95) for k in range(1, 400)] == [
        theirs.kld(k) for k in range(1, 400)
    ]
    drawn = resample(ours, wanted, np.random.default_rng(8)).poses
    uniform = np.random.default_rng(8).random(wanted)
    np.testing.assert_array_equal(drawn, theirs.stratified(poses, other, uniform))
    filter_ = ParticleFilter(None, PAPER, rng, ours, 100_000)
    filter_.resample()
    assert len(filter_.particles) == max(wanted, theirs.FEWEST)


def test_an_estimate_is_carried_back(rng):
    """Sec. 3.5: to the first frame, where the next pass begins."""
    for pose in scattered(rng, 20):
        first = compose(pose, between(TRUE[-1], TRUE[0]))
        away = theirs.back(pose, STEPS) - first
        away[3] = wrap_angle(away[3])
        np.testing.assert_allclose(away, 0.0, atol=1e-9)
        there = first[None]
        for step in STEPS[1:]:
            there = theirs.plus(there, step)
        np.testing.assert_allclose(there[0, :3], pose[:3], atol=1e-9)


@pytest.mark.all
@pytest.mark.parametrize("terms", [("semantic",), ("semantic", "depth")], ids=str)
def test_whole_runs_err_alike(terms, scene, world, images, frames):
    few = 120
    options = replace(PAPER, spacing=0.5, per_cell=1, min_particles=few).only(
        **dict.fromkeys(terms, True)
    )
    first, *later = options.passes
    options = replace(options, passes=(first, *(replace(p, particles=few) for p in later)))
    cells = np.unique(scene.visibility(options).positions[:, :2], axis=0)
    ours, other, counts = [], [], []
    for seed in range(40):
        estimate = scene.localize(
            frames, encoder=Told(images), options=options, refine=False, seed=seed
        )
        ours.append(estimate.best.pose)
        rng = np.random.default_rng(1000 + seed)
        start = np.column_stack(
            [
                np.repeat(cells, 4, axis=0),
                np.tile(theirs.HEIGHTS, len(cells)),
                np.zeros(4 * len(cells)),
            ]
        )
        start[:, :2] += rng.uniform(-0.25, 0.25, (len(start), 2))
        start[:, 3] = rng.uniform(-np.pi, np.pi, len(start))
        pose, counted = theirs.run(world, images, STEPS, start, rng, terms, few)
        other.append(pose)
        counts.append((sum(map(sum, estimate.stats["particles"])), sum(counted)))
    assert ks_2samp(*(np.array(counts).T)).pvalue > 0.001

    def errors(poses):
        away = np.array(poses) - TRUE[-1]
        return np.linalg.norm(away[:, :3], axis=1), np.abs(wrap_angle(away[:, 3]))

    for a, b in zip(errors(ours), errors(other), strict=True):
        assert ks_2samp(a, b).pvalue > 0.01, (np.median(a), np.median(b))
