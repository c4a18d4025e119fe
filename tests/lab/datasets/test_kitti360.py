import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.geometry import LocalPlane
from placegraph_lab.datasets.kitti360pose import WORLD

ORIGIN = (8.4295857, 48.9843445)


def as_in_the_kit(lon, lat):
    scale, er = np.cos(ORIGIN[1] * np.pi / 180.0), 6378137.0

    def mercator(lon, lat):
        return scale * lon * np.pi * er / 180, scale * er * np.log(np.tan((90 + lat) * np.pi / 360))

    return np.subtract(mercator(lon, lat), mercator(*ORIGIN))


lonlats = st.tuples(st.floats(8.3, 8.6), st.floats(48.9, 49.1))


@given(lonlats)
def test_the_frame_is_that_of_the_kit(lonlat):
    assert WORLD.to_plane(lonlat) == pytest.approx(as_in_the_kit(*lonlat), abs=1e-6)


@given(st.lists(lonlats, min_size=1, max_size=4))
def test_there_and_back(found):
    lonlat = np.array(found)
    assert WORLD.to_lonlat(WORLD.to_plane(lonlat)) == pytest.approx(lonlat, abs=1e-11)


def test_metres_are_metres_near_the_origin():
    assert WORLD.to_plane(ORIGIN) == pytest.approx([0.0, 0.0], abs=1e-9)
    true = LocalPlane(*ORIGIN).to_plane(WORLD.to_lonlat((1000.0, 1000.0)))
    assert true == pytest.approx([1000.0, 1000.0], rel=4e-3)
