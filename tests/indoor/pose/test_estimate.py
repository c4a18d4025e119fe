"""Probabilities of poses, by the likelihood and by how far frames fit there."""

import numpy as np
import pytest

from placegraph.indoor.pose.estimate import weigh_by_confidence


def test_the_likeliest_pose_is_not_where_frames_do_not_fit():
    """Depth alone put cameras of the office before bare walls, whatever the colours said."""
    shares = np.array([0.9, 0.08, 0.015, 0.005])
    got = weigh_by_confidence(shares, np.array([-8.2, 1.3, -8.0]))
    assert got.argmax() == 1
    assert got[1] > 0.95
    assert got[3] <= min(got[0], got[2])  # nobody looked
    np.testing.assert_allclose(weigh_by_confidence(shares, np.full(3, 5.0)), shares)
    np.testing.assert_allclose(
        weigh_by_confidence(shares, np.full(3, -np.inf)), shares
    )  # labels alone
    assert got.sum() == pytest.approx(1.0)
