"""What somebody says of a place leans the first particles, and the answer."""

import numpy as np
import pytest

from placegraph.core.estimate import Status
from placegraph.errors import OptionError
from placegraph.indoor.map.map_kernels import AZIMUTHS
from placegraph.indoor.mapping.merge import merge_scenes
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.pose.prior import LogPrior, Prior
from placegraph.indoor.pose.window import PoseQuery, observe


@pytest.fixture(scope="module")
def twins(room):
    """Two of the same room side by side: nothing that is seen tells them apart."""
    return merge_scenes({"left": room, "right": room})


def test_a_sentence_leans_towards_where_it_is_true(room):
    table = room.visibility(PoseSearchOptions())
    leaning = LogPrior.of(room, table, "next to the sofa", None)
    assert leaning.logs.shape == (len(table), AZIMUTHS)
    sofa = room.graph.positions[room.graph.labels.index("sofa"), :2]
    away = np.linalg.norm(table.positions[:, :2] - sofa, axis=1)
    near, far = (leaning.logs[rows].mean() for rows in (away < 1.3, away > 3.0))
    assert near > far + 0.5
    poses = np.column_stack([table.positions, np.zeros(len(table))])[:5]
    np.testing.assert_allclose(leaning.at(poses), leaning.logs[:5, 0])
    assert {e.verdict for e in leaning.evidence(poses[0])} <= {"for", "against", "silent"}


def test_a_sentence_about_nothing_here_is_told(room):
    table = room.visibility(PoseSearchOptions())
    with pytest.raises(OptionError, match="mentions nothing on this map"):
        LogPrior.of(room, table, "next to the swimming pool", None)


def test_a_prior_far_off_the_map_prefers_no_place():
    across = np.column_stack([np.linspace(0.0, 20.0, 21), np.zeros(21), np.full(21, 1.5)])
    yaws = np.array([0.0, np.pi])
    near, far = (Prior(x, 0.0, yaw=0.0, spread=10.0).log(across, yaws) for x in (0.0, 200.0))
    assert near[0, 0] == pytest.approx(0.0)
    assert near[0, 0] - near[-1, 0] > 1.5
    assert near[0, 0] - near[0, 1] > 2.5
    assert np.ptp(far) < 0.01
    # a height that is off everywhere tells storeys apart, and leaves the rest as it is
    storeys = across + np.array([0.0, 0.0, 3.0])
    high = Prior(0.0, 0.0, z=60.0, spread=2.0).log(np.concatenate([across, storeys]), yaws)
    assert high[21, 0] == pytest.approx(0.0)
    assert high[21, 0] - high[0, 0] > 0.9


def test_a_wide_prior_climbs_with_the_camera(room, walk):
    prior = Prior(0.0, 0.0, z=1.0, yaw=0.2, spread=3.0)
    window = observe(PoseQuery.of(room, walk, frames=slice(0, 2), prior=prior))
    window.poses[-1] = window.poses[0] + np.array([0.0, 0.0, 3.0, 0.5])
    moved = Prior(0.0, 0.0, z=4.0, yaw=0.7, spread=3.0)
    wanted = LogPrior.of(room, window.table, None, None, moved).logs
    np.testing.assert_allclose(window.log_prior.logs, wanted, atol=1e-5)


@pytest.mark.parametrize("shares", [[1.0], [0.0, 0.0], [-1.0, 2.0], [np.nan, 1.0]])
def test_shares_are_one_for_each_scene(twins, shares):
    with pytest.raises(OptionError, match="shares"):
        LogPrior.of(twins, twins.visibility(PoseSearchOptions()), None, shares)


def test_a_scene_without_a_share_gets_no_particles(twins):
    table = twins.visibility(PoseSearchOptions())
    leaning = LogPrior.of(twins, table, None, [0.0, 1.0])
    ((rows, share),) = leaning.parts
    assert share == 1.0
    assert {twins.scene_at(p[:2]) for p in table.positions[rows]} == {1}


def test_shares_decide_between_twins(twins, walk):
    right = twins.localize(walk, shares=[0.0, 1.0], refine=False)
    assert right.best.scene == "right"
    open_ = twins.localize(walk, refine=False)
    assert open_.status is not Status.OK


def test_a_description_is_evidence(room, walk):
    estimate = room.localize(walk, description="in the study", refine=False)
    plain = room.localize(walk, refine=False)
    assert "study" in estimate.evidence[0].statement
    np.testing.assert_allclose(estimate.best.map_from_camera, plain.best.map_from_camera, atol=0.05)


def test_looks_alone_make_no_pose_sure(room, walk):
    options = PoseSearchOptions(depth=False, colour=False)
    estimate = room.localize(walk, encoder="appearance", options=options, refine=False)
    assert estimate.status is not Status.OK
