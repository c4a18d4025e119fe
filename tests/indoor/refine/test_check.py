"""Held-back samples: what is held back, and whether they tell better poses from worse."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.geometry import Camera
from placegraph.indoor.refine.check import (
    BLOCKS,
    depth_evidence,
    held_back,
    image_evidence,
    surely,
)
from placegraph.indoor.refine.correspondences import Surfaces, readings
from placegraph.indoor.render import Renderer

pytestmark = pytest.mark.usefixtures("one_thread")


@given(st.integers(30, 2000), st.integers(0, 99))
def test_a_quarter_of_an_image_is_held_back_in_blocks(width, seed):
    rng = np.random.default_rng(seed)
    pixels = rng.uniform(0, [width, 0.75 * width], (2000, 2))
    camera = Camera(width, max(1, 3 * width // 4), 100.0, 100.0, 10.0, 10.0)
    held = held_back(pixels, camera)
    assert 0.1 < held.mean() < 0.35
    # neighbours of a held-back point, a hundredth of a block away, mostly are too
    near = held_back(pixels + 0.01 * width / BLOCKS, camera)
    assert np.mean(near[held]) > 0.95
    # the same share of the image whatever its size
    large = Camera(640, 480, 100.0, 100.0, 10.0, 10.0)
    np.testing.assert_array_equal(held, held_back(pixels / width * 640.0, large))


@given(st.floats(0.001, 0.3), st.integers(20, 400), st.integers(0, 99))
def test_how_sure_a_gain_is_its_mean_over_its_standard_error(better, count, seed):
    gains = better + 0.1 * np.random.default_rng(seed).normal(size=count)
    assert surely(gains) == pytest.approx(gains.mean() / gains.std() * math.sqrt(count), rel=1e-3)
    assert surely(-gains) == -surely(gains)


def test_no_block_and_no_difference_are_no_gain():
    assert surely(np.zeros(0)) == 0.0
    assert surely(np.zeros(50)) == 0.0


# ------------------------------------------------------------------------------------ depth


@pytest.fixture(scope="module")
def held(exact):
    return [readings(f, f.depth(), 1500, phase=1) for f in exact.capture]


@pytest.mark.parametrize("metres", [0.02, 0.05, 0.2])
def test_depth_tells_the_better_trajectory(room, exact, held, kit, metres):
    surfaces = Surfaces.of(room)
    worse = kit.moved(exact.poses, (metres, metres, 0.0))
    gain = depth_evidence(surfaces, held, [worse, exact.poses])
    loss = depth_evidence(surfaces, held, [exact.poses, worse])
    assert surely(gain.gain(1)) > 5.0
    np.testing.assert_allclose(gain.gain(1), -loss.gain(1), atol=1e-9)
    assert gain.samples > 100


def test_of_several_trajectories_the_best_is_likeliest(room, exact, held, kit):
    ways = [kit.moved(exact.poses, (off, 0.0, 0.0)) for off in (0.1, 0.05, 0.0, -0.05)]
    found = depth_evidence(Surfaces.of(room), held, ways)
    assert np.argmax(found.blocks.sum(axis=1)) == 2


def test_frames_without_depth_tell_nothing(room, exact, held, kit):
    surfaces = Surfaces.of(room)
    worse = kit.moved(exact.poses, (0.05, 0.0, 0.0))
    some = [h if t < 2 else None for t, h in enumerate(held)]
    first = depth_evidence(surfaces, held[:2], [worse[:2], exact.poses[:2]])
    assert depth_evidence(surfaces, some, [worse, exact.poses]).samples == first.samples
    none = depth_evidence(surfaces, [None], [worse[:1], exact.poses[:1]])
    assert none.samples == 0
    assert none.gain(1).sum() == 0.0


def test_noise_that_neighbours_share_counts_once(room, exact, held, kit):
    """Readings that are off in whole frames by chance say less than as many that err alone."""
    surfaces, rng = Surfaces.of(room), np.random.default_rng(0)
    better = kit.moved(exact.poses, (0.01, 0.0, 0.0))

    def told(noise):
        off = [replace(h, depth=np.float32(h.depth + (h.depth > 0) * noise(h))) for h in held]
        return depth_evidence(surfaces, off, [better, exact.poses]).gain(1).sum()

    alone = told(lambda h: rng.normal(0, 0.02, len(h.depth)))
    shared = told(lambda _: rng.normal(0, 0.02))
    assert abs(shared) < 0.5 * alone


# ----------------------------------------------------------------------------------- images


@pytest.mark.parametrize("degrees", [2.0, 8.0])
def test_images_tell_the_better_trajectory(room, walk, exact, kit, degrees):
    """Photographs of the drawn room in other light, against renderings of its map."""
    renderer, frames = Renderer(room), list(walk)
    queries = [f.rgb() for f in frames]
    worse = kit.moved(exact.poses, (0.05, 0.05, 0.0), (0.0, 0.0, degrees))
    gain = image_evidence(renderer, frames, queries, [worse, exact.poses]).gain(1)
    loss = image_evidence(renderer, frames, queries, [exact.poses, worse]).gain(1)
    assert surely(gain) > 3.0
    np.testing.assert_allclose(gain, -loss, atol=1e-9)


def test_only_held_back_blocks_are_looked_at(room, exact, kit):
    """What stands in the other blocks may be anything."""
    camera = Camera(640, 360, 460.0, 460.0, 320.0, 180.0)
    pose, worse = exact.poses[:1], kit.moved(exact.poses[:1], (0, 0, 0), (0, 0, 2.0))
    (frame,) = kit.frames(room, pose, camera)
    query = frame.rgb()
    v, u = np.mgrid[:360, :640]
    held = held_back(np.stack([u, v], axis=-1).reshape(-1, 2) + 0.5, camera).reshape(360, 640)
    near = held.copy()  # windows reach a little beyond their block
    for j in range(-20, 21, 4):
        for i in range(-20, 21, 4):
            near |= np.roll(held, (j, i), (0, 1))
    assert 0.2 < near.mean() < 0.8
    other = np.where(near[..., None], query, np.random.default_rng(0).integers(0, 255, query.shape))
    renderer = Renderer(room)
    gain, same, none = (
        image_evidence(renderer, [frame], [image.astype(np.uint8)], [worse, pose])
        for image in (query, other, np.where(near[..., None], 90, query))
    )
    assert surely(gain.gain(1)) > 2.0
    np.testing.assert_array_equal(gain.blocks, same.blocks)
    assert none.samples == 0


@pytest.mark.parametrize("image", [0, 128, 255, None])
def test_blank_and_missing_images_say_nothing(room, walk, exact, kit, image):
    frames = list(walk)[:2]
    blank = [None if image is None else np.full_like(f.rgb(), image) for f in frames]
    worse = kit.moved(exact.poses[:2], (0.1, 0, 0))
    found = image_evidence(Renderer(room), frames, blank, [worse, exact.poses[:2]])
    assert found.samples == 0
    assert found.gain(1).sum() == 0.0
