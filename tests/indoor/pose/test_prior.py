"""What somebody says of a place leans the first particles, and the answer."""

import numpy as np
import pytest

from placegraph.core.estimate import Status
from placegraph.errors import OptionError
from placegraph.indoor.map.map_kernels import AZIMUTHS
from placegraph.indoor.mapping.merge import merge_scenes
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.pose.prior import LogPrior


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
