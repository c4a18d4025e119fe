import math

import numpy as np
import pytest

from placegraph.core.estimate import PoseEstimate, PoseMode, Refinement, Status
from placegraph.core.geometry import (
    Camera,
    level_from_camera,
    pose_matrix,
    rotation_from_vector,
    split_pose,
)
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame
from placegraph_lab.tables.indoor.refine import (
    measure_refined,
    refine_score,
    sigmas_of,
    spread,
)
from placegraph_lab.tables.indoor.windows import Window

LEVEL = level_from_camera([0.0, 1.0, 0.0])


def at(x=0.0, yaw_deg=0.0):
    return pose_matrix([x, 0.0, 1.6, math.radians(yaw_deg)], LEVEL)


def mode(pose, sigma=0.02):
    pose4, _ = split_pose(pose)
    return PoseMode(pose, pose4, np.eye(6) * sigma**2, 0.9, "", pose)


def estimate(pose, *, coarse=None, accepted=True, **stats):
    """Estimate at a pose; with `coarse`, one that was refined."""
    said = None
    if coarse is not None:
        said = Refinement(accepted, "So it is.", mode(coarse), coarse[None], stats)
    return PoseEstimate(Status.OK, (mode(pose),), "", refinement=said)


@pytest.fixture
def window():
    """Two frames whose last stands at the origin."""
    camera = Camera(8, 6, 10.0, 10.0, 4.0, 3.0)
    image = np.zeros((6, 8, 3), np.uint8)
    frames = [Frame.from_arrays(image, camera, stamp=i, index=i) for i in range(2)]
    return Window("seq01", Capture.from_frames(frames), at(), changed=True)


def test_one_estimate_gives_both_sides(window):
    seconds = {"depth": 0.2, "images": 0.3}
    got = measure_refined(
        estimate(at(0.01), coarse=at(0.3, 4.0), seconds=seconds), window, seconds=2
    )
    assert got.before == pytest.approx((0.3, 4.0))
    assert (got.after.position, got.after.rotation) == pytest.approx((0.01, 0.0), abs=1e-6)
    assert (got.accepted, got.reason, got.candidate) == (True, "So it is.", None)
    assert (got.refine_seconds, got.after.seconds) == (0.5, 2)
    assert got.sigmas == pytest.approx((-0.5, 0, 0, 0, 0, 0), abs=1e-6)
    assert not got.harmful
    assert not got.wrongly_refused


def test_what_was_wrongly_refused_is_known_where_the_pose_was_kept(window):
    refused = {"coarse": at(0.3), "accepted": False}
    stats = ({"candidate": at(0.01).tolist()}, {"candidate": at(0.01, 3.0).tolist()}, {})
    better, twisted, silent = (
        measure_refined(estimate(at(0.3), **refused, **more), window, seconds=1) for more in stats
    )
    assert [r.wrongly_refused for r in (better, twisted, silent)] == [True, False, False]
    assert refine_score([better, twisted]).wrongly_refused == 0.5
    assert math.isnan(refine_score([silent]).wrongly_refused)
    assert refine_score([better, silent]).accepted == 0.0


def test_the_spread_of_honest_covariances_is_normal(window, rng):
    mixing = rng.normal(size=(6, 6)) * np.array([[0.02, 0.03, 0.01, 0.01, 0.004, 0.02]]).T
    covariance = mixing @ mixing.T
    results = []
    for off in rng.multivariate_normal(np.zeros(6), covariance, 800):
        pose = at()
        pose[:3, 3] -= off[:3]
        pose[:3, :3] = rotation_from_vector(-off[3:]) @ pose[:3, :3]
        found = PoseMode(pose, split_pose(pose)[0], covariance, 0.9, "", pose)
        assert len(sigmas_of(found, window.truth)) == 6
        results.append(measure_refined(PoseEstimate(Status.OK, (found,), ""), window, seconds=1))
    s = spread(results)
    assert s["count"] == 800
    assert s["rms"] == pytest.approx([1.0] * 6, abs=0.08)
    for row, share in zip(s["within_sigma"].values(), (0.6827, 0.9545, 0.9973), strict=True):
        assert row == pytest.approx([share] * 6, abs=0.05)
    assert s["within_95_percent"] == pytest.approx(0.95, abs=0.02)
