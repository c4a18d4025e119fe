"""What is believed of a refinement, what is refused, and why."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.indoor.refine.correspondences import Sights
from placegraph.indoor.refine.fit import Lags
from placegraph.indoor.refine.judge import (
    BENT,
    FARTHEST,
    FARTHEST_BLIND,
    NOTHING,
    _late,
    judged,
    moved,
)
from placegraph.indoor.refine.options import RefineOptions
from placegraph.indoor.refine.refiner import Fitted, Refiner

pytestmark = pytest.mark.usefixtures("one_thread")
SOME = SimpleNamespace(poses=None, lags=None)  # a solution: its numbers are not looked at


@pytest.fixture
def refiner(room, walk):
    """Refiner of the walk through the drawn room, by its options: `refiner(**options)`."""

    def made(frames=slice(None), depth=True, colour=True, **options):
        chosen = list(walk)[frames]
        return Refiner(
            room,
            chosen,
            [f.depth() if depth else None for f in chosen],
            [f.rgb() if colour else None for f in chosen],
            RefineOptions(**options),
            None,
        )

    return made


def fitted(poses, matches=0):
    """A trajectory as if it had been fitted, with some matches in its first frame."""
    seen = [Sights.none()] * len(poses)
    camera = Camera(100, 100, 100.0, 100.0, 50.0, 50.0)
    seen[0] = Sights.of(np.zeros((matches, 3)), np.zeros((matches, 2)), camera, 1.0)
    return Fitted(poses, SOME, seen, np.eye(6))


def test_the_true_way_is_believed_and_a_worse_one_is_not(refiner, exact, kit):
    off = kit.moved(exact.poses, (0.05, 0.05, 0.0), (0, 0, 2.0))
    found = judged(refiner(), off, fitted(exact.poses))
    assert found.accepted
    assert found.reason == "Refined by depth."
    held = found.stats["held_back"]
    assert set(held) == {"depth", "images"}
    assert held["depth"]["gain"] > 10.0
    assert held["depth"]["z"] > 3.0
    assert found.stats["shift_m"] == pytest.approx(0.0707, abs=1e-3)
    assert found.stats["turn_deg"] == pytest.approx(2.0, abs=1e-2)
    refused = judged(refiner(), exact.poses, fitted(off))
    assert not refused.accepted
    assert refused.reason.startswith("Not refined: held-back pixels")
    assert refused.stats["held_back"]["depth"]["z"] == pytest.approx(-held["depth"]["z"], abs=0.02)


def test_weak_images_have_no_veto(refiner, exact, kit):
    """Images taken from where the coarse pose is, and so noisy that they hardly show it."""
    off = kit.moved(exact.poses, (0.05, 0.05, 0.0), (0, 0, 2.0))
    one, rng = refiner(), np.random.default_rng(0)
    shown = [one.renderer.render(p, f.camera).colour for p, f in zip(off, one.frames, strict=True)]
    noise = [rng.normal(0, 60, image.shape) for image in shown]
    one.queries = [np.uint8(np.clip(i + n, 0, 255)) for i, n in zip(shown, noise, strict=True)]
    found = judged(one, off, fitted(exact.poses))
    assert found.stats["held_back"]["images"]["gain"] < 0.0
    assert found.accepted


def test_where_images_mislead_depth_alone_is_believed(refiner, exact, kit):
    """Colours that are not calibrated to depth pull a joint fit away: held-back samples say so."""
    off = kit.moved(exact.poses, (0.08, 0.0, 0.0))
    pulled = replace(fitted(off, 40), by_depth=fitted(exact.poses))
    start = kit.moved(exact.poses, (0.05, 0.05, 0.0), (0, 0, 2.0))
    found = judged(refiner(), start, pulled)
    assert found.accepted
    assert found.fitted is pulled.by_depth
    assert found.reason == "Refined by depth."
    better = replace(fitted(exact.poses, 40), by_depth=fitted(off))
    assert judged(refiner(), start, better).fitted is better


def test_depth_stands_in_for_a_joint_fit_that_went_astray(refiner, exact, kit):
    start = kit.moved(exact.poses, (0.05, 0.05, 0.0))
    astray = replace(fitted(kit.moved(exact.poses, (3.0, 0, 0)), 40), by_depth=fitted(exact.poses))
    found = judged(refiner(), start, astray)
    assert found.accepted
    assert found.fitted is astray.by_depth


def test_what_changes_nothing_is_not_called_better(refiner, exact):
    assert not judged(refiner(), exact.poses, fitted(exact.poses.copy())).accepted


@pytest.mark.parametrize(
    ("shift", "turn", "says"),
    [
        ((1.05 * FARTHEST[0], 0, 0), (0, 0, 0), "1.1 m and 0 degrees away"),
        ((0, 0, 0), (0, 0, 1.05 * np.degrees(FARTHEST[1])), "another place"),
    ],
)
def test_another_place_is_no_refinement(refiner, exact, kit, shift, turn, says):
    """Even if it is the right one: the filter did not find it."""
    start = kit.moved(exact.poses, shift, turn)
    found = judged(refiner(check=False), start, fitted(exact.poses))
    assert not found.accepted
    assert says in found.reason
    near = kit.moved(exact.poses, 0.9 * np.array(shift), 0.9 * np.array(turn))
    assert judged(refiner(check=False), near, fitted(exact.poses)).accepted


def test_where_a_frame_decides_it_may_be_anywhere(refiner, exact, kit):
    """Sec. 3.6: the pose with most inliers is the answer."""
    start = kit.moved(exact.poses, (2.0, 0, 0), (0, 0, 90.0))
    paper = refiner(depth=False, images=True, joint=False, check=False)
    assert judged(paper, start, fitted(exact.poses, 40)).accepted


@pytest.mark.parametrize("axis", ["shift", "turn"])
def test_images_alone_do_not_carry_as_far(refiner, exact, kit, axis):
    """0.6 m or 0.4 rad are another place without depth; with it they are not."""
    way, turn = FARTHEST_BLIND
    assert way < FARTHEST[0]
    assert turn < FARTHEST[1]

    def found(share, *, depth):
        off = (share * way, 0, 0) if axis == "shift" else (0, 0, 0)
        turned = (0, 0, share * np.degrees(turn)) if axis == "turn" else (0, 0, 0)
        one = refiner(depth=depth, check=False)
        return judged(one, kit.moved(exact.poses, off, turned), fitted(exact.poses, 40))

    refused = found(1.05, depth=False)
    assert not refused.accepted
    assert "another place" in refused.reason
    assert found(0.95, depth=False).accepted
    assert found(1.05, depth=True).accepted


def test_a_bent_way_is_refused(refiner, exact, kit):
    """Frames that jump to and fro by 5 cm were not taken on a walk whose odometry is known."""
    zigzag = np.stack(
        [kit.moved(p, (0, 0.05 * (-1) ** t, 0)) for t, p in enumerate(exact.poses)]
    )  # fmt: skip
    found = judged(refiner(), exact.poses, fitted(zigzag))
    assert not found.accepted
    assert "odometry" in found.reason
    assert found.stats["motion"] > BENT
    assert "held_back" not in found.stats
    whole = judged(refiner(), kit.moved(exact.poses, (0.05, 0.05, 0)), fitted(exact.poses))
    assert whole.stats["motion"] < 1.5


def test_one_frame_has_no_way_to_bend(refiner, exact, kit):
    one = exact.poses[:1]
    found = judged(refiner(slice(0, 1)), kit.moved(one, (0.05, 0.05, 0)), fitted(one))
    assert found.stats["motion"] == 0.0
    assert found.accepted


def test_without_depth_a_few_matches_are_nothing(refiner, exact, kit):
    off = kit.moved(exact.poses, (0.03, 0.03, 0))
    blind = refiner(depth=False)
    for matches, says in ((0, NOTHING), (5, "only 5 matches")):
        found = judged(blind, off, fitted(exact.poses, matches))
        assert not found.accepted
        assert says in found.reason
    found = judged(blind, off, Fitted(off, None, [], np.full((6, 6), np.nan)))
    assert NOTHING in found.reason


def test_images_alone_must_convince_more(refiner, exact, kit):
    off = kit.moved(exact.poses, (0.05, 0.05, 0.0), (0, 0, 6.0))
    found = judged(refiner(depth=False), off, fitted(exact.poses, 40))
    assert found.accepted
    assert found.reason == "Refined by 40 matches of images."
    assert set(found.stats["held_back"]) == {"images"}
    refused = judged(refiner(depth=False), exact.poses, fitted(off, 40))
    assert not refused.accepted


def test_nothing_held_back_is_no_proof(refiner, exact, kit):
    off = kit.moved(exact.poses, (0.03, 0.03, 0))
    found = judged(refiner(depth=False, colour=False), off, fitted(exact.poses, 40))
    assert not found.accepted
    assert "no held-back pixel" in found.reason


def test_who_asks_for_no_check_gets_none(refiner, exact, kit):
    worse = kit.moved(exact.poses, (0.2, 0, 0))
    found = judged(refiner(check=False), exact.poses, fitted(worse))
    assert found.accepted
    assert found.reason == "Refined by depth, unchecked."


@pytest.mark.parametrize("degrees", [0.0, 1.0, 90.0, 179.0])
def test_moved(kit, degrees):
    pose = kit.standing(1.0, 2.0, 30.0)
    shift, turn = moved(pose, kit.moved(pose, (0.3, 0.0, -0.4), (0, degrees, 0)))
    assert shift == pytest.approx(0.5)
    assert np.degrees(turn) == pytest.approx(degrees, abs=1e-6)


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
    told = _late(refiner, SimpleNamespace(lags=lags))
    assert said in told
    assert bool(told) == bool(said)
