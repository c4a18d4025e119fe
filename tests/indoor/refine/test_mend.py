"""Which answer counts, once the camera is mended."""

from types import SimpleNamespace

import numpy as np
import pytest

from placegraph.core.estimate import PoseEstimate, Status
from placegraph.indoor.refine.calibrate import COUNT, PLACE
from placegraph.indoor.refine.mend import Mend


def answer(reason):
    told = SimpleNamespace(accepted=True)
    return PoseEstimate(Status.OK, (), reason, refinement=told)


@pytest.mark.parametrize(
    ("way", "status", "words"), [(0.06, Status.OK, "after"), (0.57, Status.AMBIGUOUS, "is late")]
)
def test_cameras_of_one_device_stand_side_by_side(walk, way, status, words):
    values = np.zeros(COUNT)
    values[PLACE[0]] = way
    asked = SimpleNamespace(frames=list(walk)[-1:])
    chosen = Mend(values, np.zeros(COUNT)).chosen(asked, answer("before"), answer("after"))
    assert chosen.status is status
    assert words in chosen.reason
    assert f"{100 * way:.0f} cm" in chosen.reason
