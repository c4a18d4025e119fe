"""Held-back samples: what is held back, and whether they tell better poses from worse."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.geometry import Camera
from placegraph.indoor.refine.correspondences import (
    BLOCKS,
    PointMatches,
    Surfaces,
    held_back,
    sample_readings,
)
from placegraph.indoor.refine.fit import Lags
from placegraph.indoor.refine.refinement import (
    BENT,
    FARTHEST,
    FARTHEST_BLIND,
    NOTHING,
    _describe_lags,
    confirm_fit,
    depth_evidence,
    image_evidence,
    standard_errors,
)
from placegraph.indoor.refine.refiner import FittedTrajectory
from placegraph.indoor.render import Renderer

pytestmark = pytest.mark.usefixtures("one_thread")


@given(st.integers(30, 2000), st.integers(0, 99))
def test_a_quarter_of_an_image_is_held_back_in_blocks(width, seed):
    rng = np.random.default_rng(seed)
    pixels = rng.uniform(0, [width, 0.75 * width], (2000, 2))
    camera = Camera(width, max(1, 3 * width // 4), 100.0, 100.0, 10.0, 10.0)
    held = held_back(pixels, camera)
    assert 0.1 < held.mean() < 0.35
    # neighbours of a held-out point, a hundredth of a block away, mostly are too
    near = held_back(pixels + 0.01 * width / BLOCKS, camera)
    assert np.mean(near[held]) > 0.95
    # the same share of the image whatever its size
    large = Camera(640, 480, 100.0, 100.0, 10.0, 10.0)
    np.testing.assert_array_equal(held, held_back(pixels / width * 640.0, large))


@given(st.floats(0.001, 0.3), st.integers(20, 400), st.integers(0, 99))
def test_how_sure_a_gain_is_its_mean_over_its_standard_error(better, count, seed):
    gains = better + 0.1 * np.random.default_rng(seed).normal(size=count)
    assert standard_errors(gains) == pytest.approx(
        gains.mean() / gains.std() * math.sqrt(count), rel=1e-3
    )
    assert standard_errors(-gains) == -standard_errors(gains)
    assert standard_errors(np.zeros(0)) == standard_errors(np.zeros(50)) == 0.0


@pytest.fixture(scope="module")
def held(exact):
    return [sample_readings(f, f.depth(), 1500, phase=1) for f in exact.capture]


@pytest.mark.parametrize("metres", [0.02, 0.2])
def test_depth_tells_the_better_trajectory(room, exact, held, kit, metres):
    surfaces = Surfaces.of(room)
    worse = kit.moved(exact.poses, (metres, metres, 0.0))
    gain = depth_evidence(surfaces, held, [worse, exact.poses])
    loss = depth_evidence(surfaces, held, [exact.poses, worse])
    assert standard_errors(gain.gain(1)) > 5.0
    np.testing.assert_allclose(gain.gain(1), -loss.gain(1), atol=1e-9)
    assert gain.samples > 100
    ways = [worse, exact.poses, kit.moved(exact.poses, (-0.05, 0.0, 0.0))]
    assert np.argmax(depth_evidence(surfaces, held, ways).blocks.sum(axis=1)) == 1
    # frames without depth tell nothing
    some = [h if t < 2 else None for t, h in enumerate(held)]
    first = depth_evidence(surfaces, held[:2], [worse[:2], exact.poses[:2]])
    assert depth_evidence(surfaces, some, [worse, exact.poses]).samples == first.samples
    none = depth_evidence(surfaces, [None], [worse[:1], exact.poses[:1]])
    assert (none.samples, none.gain(1).sum()) == (0, 0.0)


def test_noise_that_neighbours_share_counts_once(room, exact, held, kit):
    surfaces, rng = Surfaces.of(room), np.random.default_rng(0)
    better = kit.moved(exact.poses, (0.01, 0.0, 0.0))

    def compute_gain(noise):
        off = [replace(h, depth=np.float32(h.depth + (h.depth > 0) * noise(h))) for h in held]
        return depth_evidence(surfaces, off, [better, exact.poses]).gain(1).sum()

    alone = compute_gain(lambda h: rng.normal(0, 0.02, len(h.depth)))
    shared = compute_gain(lambda _: rng.normal(0, 0.02))
    assert abs(shared) < 0.5 * alone


@pytest.mark.parametrize("degrees", [2.0, 8.0])
def test_images_tell_the_better_trajectory(room, walk, exact, kit, degrees):
    renderer, frames = Renderer(room), list(walk)
    queries = [f.rgb() for f in frames]
    worse = kit.moved(exact.poses, (0.05, 0.05, 0.0), (0.0, 0.0, degrees))
    gain = image_evidence(renderer, frames, queries, [worse, exact.poses]).gain(1)
    loss = image_evidence(renderer, frames, queries, [exact.poses, worse]).gain(1)
    assert standard_errors(gain) > 3.0
    np.testing.assert_allclose(gain, -loss, atol=1e-9)


def test_only_held_back_blocks_are_looked_at(room, exact, kit):
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
    assert standard_errors(gain.gain(1)) > 2.0
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


SOME = SimpleNamespace(poses=None, lags=None)  # a solution: its numbers are not looked at


def fitted(poses, matches=0):
    """A trajectory as if it had been fitted, with some matches in its first frame."""
    seen = [PointMatches.empty()] * len(poses)
    camera = Camera(100, 100, 100.0, 100.0, 50.0, 50.0)
    seen[0] = PointMatches.of(np.zeros((matches, 3)), np.zeros((matches, 2)), camera, 1.0)
    return FittedTrajectory(poses, SOME, seen, np.eye(6))


def test_the_true_way_is_believed_and_a_worse_one_is_not(refiner, exact, kit):
    off = kit.moved(exact.poses, (0.05, 0.05, 0.0), (0, 0, 2.0))
    found = confirm_fit(refiner(), off, fitted(exact.poses))
    assert found.accepted
    assert found.reason == "Refined by depth."
    held = found.stats["held_back"]
    assert set(held) == {"depth", "images"}
    assert held["depth"]["gain"] > 10.0
    assert held["depth"]["z"] > 3.0
    assert found.stats["shift_m"] == pytest.approx(0.0707, abs=1e-3)
    assert found.stats["turn_deg"] == pytest.approx(2.0, abs=1e-2)
    refused = confirm_fit(refiner(), exact.poses, fitted(off))
    assert not refused.accepted
    assert refused.reason.startswith("Not refined: held-out pixels")
    assert refused.stats["held_back"]["depth"]["z"] == pytest.approx(-held["depth"]["z"], abs=0.02)
    unchecked = confirm_fit(refiner(check=False), exact.poses, fitted(off))
    assert (unchecked.accepted, unchecked.reason) == (True, "Refined by depth, unchecked.")
    assert not confirm_fit(refiner(), exact.poses, fitted(exact.poses.copy())).accepted


def test_weak_images_have_no_veto(refiner, exact, kit):
    off = kit.moved(exact.poses, (0.05, 0.05, 0.0), (0, 0, 2.0))
    one, rng = refiner(), np.random.default_rng(0)
    shown = [one.renderer.render(p, f.camera).colour for p, f in zip(off, one.frames, strict=True)]
    noise = [rng.normal(0, 60, image.shape) for image in shown]
    one.queries = [np.uint8(np.clip(i + n, 0, 255)) for i, n in zip(shown, noise, strict=True)]
    found = confirm_fit(one, off, fitted(exact.poses))
    assert found.stats["held_back"]["images"]["gain"] < 0.0
    assert found.accepted


def test_where_images_mislead_depth_alone_is_believed(refiner, exact, kit):
    off = kit.moved(exact.poses, (0.08, 0.0, 0.0))
    pulled = replace(fitted(off, 40), by_depth=fitted(exact.poses))
    start = kit.moved(exact.poses, (0.05, 0.05, 0.0), (0, 0, 2.0))
    found = confirm_fit(refiner(), start, pulled)
    assert found.accepted
    assert found.candidate is pulled.by_depth
    assert found.reason == "Refined by depth."
    better = replace(fitted(exact.poses, 40), by_depth=fitted(off))
    assert confirm_fit(refiner(), start, better).candidate is better
    astray = replace(fitted(kit.moved(exact.poses, (3.0, 0, 0)), 40), by_depth=fitted(exact.poses))
    found = confirm_fit(refiner(), start, astray)
    assert found.accepted
    assert found.candidate is astray.by_depth


@pytest.mark.parametrize("depth", [True, False])
@pytest.mark.parametrize("axis", ["shift", "turn"])
def test_another_place_is_no_refinement(refiner, exact, kit, axis, depth):
    way, turn = FARTHEST if depth else FARTHEST_BLIND
    assert np.less(FARTHEST_BLIND, FARTHEST).all()

    def confirm(share):
        shift = (share * way, 0, 0) if axis == "shift" else (0, 0, 0)
        turned = (0, 0, share * np.degrees(turn)) if axis == "turn" else (0, 0, 0)
        start = kit.moved(exact.poses, shift, turned)
        return confirm_fit(refiner(depth=depth, check=False), start, fitted(exact.poses, 40))

    refused = confirm(1.05)
    assert not refused.accepted
    assert "another place" in refused.reason
    assert confirm(0.9).accepted
    # where a frame decides, as in the paper (Sec. 3.6), it may be anywhere
    paper = refiner(depth=False, images=True, joint=False, check=False)
    start = kit.moved(exact.poses, (2.0, 0, 0), (0, 0, 90.0))
    assert confirm_fit(paper, start, fitted(exact.poses, 40)).accepted


def test_a_bent_way_is_refused(refiner, exact, kit):
    zigzag = np.stack(
        [kit.moved(p, (0, 0.05 * (-1) ** t, 0)) for t, p in enumerate(exact.poses)]
    )  # fmt: skip
    found = confirm_fit(refiner(), exact.poses, fitted(zigzag))
    assert not found.accepted
    assert "odometry" in found.reason
    assert found.stats["motion"] > BENT
    assert "held_back" not in found.stats
    whole = confirm_fit(refiner(), kit.moved(exact.poses, (0.05, 0.05, 0)), fitted(exact.poses))
    assert whole.stats["motion"] < 1.5
    one = exact.poses[:1]  # one frame has no way to bend
    start = kit.moved(one, (0.05, 0.05, 0))
    found = confirm_fit(refiner(frames=slice(0, 1)), start, fitted(one))
    assert (found.stats["motion"], found.accepted) == (0.0, True)


def test_images_alone_must_convince_more(refiner, exact, kit):
    off = kit.moved(exact.poses, (0.05, 0.05, 0.0), (0, 0, 6.0))
    found = confirm_fit(refiner(depth=False), off, fitted(exact.poses, 40))
    assert found.accepted
    assert found.reason == "Refined by 40 matches of images."
    assert set(found.stats["held_back"]) == {"images"}
    refused = confirm_fit(refiner(depth=False), exact.poses, fitted(off, 40))
    assert not refused.accepted
    # a pose known to decimetres does not contradict a fit beside it, which landmarks confirm
    same, one = fitted(exact.poses.copy(), 40), refiner(depth=False)
    one.landmark_matches = 15
    assert not confirm_fit(one, exact.poses, same).accepted
    one.loose = 0.04 * np.eye(3)
    assert confirm_fit(one, exact.poses, same).accepted
    assert not confirm_fit(one, exact.poses, fitted(off, 40)).accepted, "held-out pixels refuse it"
    nothing = FittedTrajectory(off, None, [], np.full((6, 6), np.nan))
    for few, colour, says in (
        (fitted(exact.poses, 0), True, NOTHING),
        (fitted(exact.poses, 5), True, "only 5 matches"),
        (nothing, True, NOTHING),
        (fitted(exact.poses, 40), False, "no held-out pixel"),
    ):
        found = confirm_fit(refiner(depth=False, colour=colour), off, few)
        assert not found.accepted
        assert says in found.reason


@pytest.mark.parametrize(
    ("stamps", "lag", "speed", "said"),
    [
        ([0.0, 0.1, 0.2], 0.035, 0.3, "depth was taken 0.035 s after its stamp"),
        ([0.0, 0.1, 0.2], -0.035, 0.3, "depth was taken 0.035 s before its stamp"),
        ([0.0, 1.0, 2.0], 0.4, 0.3, "depth was taken 0.4 frames after its stamp"),
        ([0.0, 1.5, 3.0], 0.4, 0.3, "depth was taken 0.4 s after its stamp"),
        ([0.0, 0.1, 0.2], 0.035, 0.1, ""),  # 3.5 mm
    ],
)
def test_a_lag_is_told_with_its_sign_and_unit_where_it_matters(stamps, lag, speed, said):
    refiner = SimpleNamespace(frames=[SimpleNamespace(stamp=s) for s in stamps])
    twist = np.tile([speed, 0, 0, 0, 0, 0.01], (3, 1))
    lags = Lags(np.array([lag, 0.0]), np.full(2, 1e-4), twist, 0.03)
    told = _describe_lags(refiner, SimpleNamespace(lags=lags))
    assert said in told
    assert bool(told) == bool(said)
