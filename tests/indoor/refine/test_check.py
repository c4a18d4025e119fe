"""Held-back samples: what is held back, and whether they tell better poses from worse."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.geometry import Camera
from placegraph.indoor.refine.check import BLOCKS, Gain, depth_gain, held_back, image_gain
from placegraph.indoor.refine.depth import Surfaces, readings
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
def test_gains_are_mean_over_standard_error(better, count, seed):
    rng = np.random.default_rng(seed)
    before = rng.random(count)
    after = before + better + 0.1 * rng.normal(size=count)
    gain, loss = Gain.of(before, after), Gain.of(after, before)
    z = (after - before).mean() / ((after - before).std() / math.sqrt(count))
    assert gain.z == pytest.approx(z, rel=1e-3)
    assert loss.z == pytest.approx(-z, rel=1e-3)
    assert gain.before == pytest.approx(before.mean())
    assert gain.after == pytest.approx(after.mean())


def test_no_sample_and_no_difference_are_no_gain():
    nothing = Gain.of(np.zeros(0), np.zeros(0))
    assert nothing.z == 0.0
    assert math.isnan(nothing.before)
    same = np.random.default_rng(0).random(50)
    assert Gain.of(same, same).z == 0.0


# ------------------------------------------------------------------------------------ depth


@pytest.fixture(scope="module")
def held(exact):
    return [readings(f, f.depth(), 1500, phase=1) for f in exact.capture]


@pytest.mark.parametrize("metres", [0.02, 0.05, 0.2])
def test_depth_tells_the_better_trajectory(room, exact, held, kit, metres):
    surfaces = Surfaces.of(room)
    worse = kit.moved(exact.poses, (metres, metres, 0.0))
    gain = depth_gain(surfaces, held, worse, exact.poses)
    loss = depth_gain(surfaces, held, exact.poses, worse)
    assert gain.z > 5.0
    assert loss.z == pytest.approx(-gain.z)
    assert gain.after > 0.98
    assert 0.0 <= gain.before < gain.after


def test_frames_without_depth_are_left_out(room, exact, held, kit):
    surfaces = Surfaces.of(room)
    worse = kit.moved(exact.poses, (0.05, 0.0, 0.0))
    some = [h if t < 2 else None for t, h in enumerate(held)]
    first = depth_gain(surfaces, held[:2], worse[:2], exact.poses[:2])
    assert depth_gain(surfaces, some, worse, exact.poses) == first
    none = depth_gain(surfaces, [None], worse[:1], exact.poses[:1])
    assert none.z == 0.0
    assert math.isnan(none.after)


def test_where_the_map_ends_is_as_bad_as_can_be(room, exact, held, kit):
    away = kit.moved(exact.poses, (200.0, 0.0, 0.0))
    assert depth_gain(Surfaces.of(room), held, exact.poses, away).after == 0.0


# ----------------------------------------------------------------------------------- images


@pytest.mark.parametrize("degrees", [2.0, 8.0])
def test_images_tell_the_better_trajectory(room, walk, exact, kit, degrees):
    """Photographs of the drawn room in other light, against renderings of its map."""
    renderer, frames = Renderer(room), list(walk)
    queries = [f.rgb() for f in frames]
    worse = kit.moved(exact.poses, (0.05, 0.05, 0.0), (0.0, 0.0, degrees))
    gain = image_gain(renderer, frames, queries, worse, exact.poses)
    loss = image_gain(renderer, frames, queries, exact.poses, worse)
    assert gain.z > 3.0
    assert loss.z == pytest.approx(-gain.z)
    assert gain.after > gain.before


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
        image_gain(renderer, [frame], [image.astype(np.uint8)], worse, pose)
        for image in (query, other, np.where(near[..., None], 90, query))
    )
    assert gain.z > 3.0
    assert gain == same
    assert none.z == 0.0


@pytest.mark.parametrize("level", [0, 128, 255])
def test_blank_images_say_nothing(room, walk, exact, kit, level):
    frames = list(walk)[:2]
    blank = [np.full_like(f.rgb(), level) for f in frames]
    worse = kit.moved(exact.poses[:2], (0.1, 0, 0))
    gain = image_gain(Renderer(room), frames, blank, worse, exact.poses[:2])
    assert gain.z == 0.0
    assert math.isnan(gain.before)
