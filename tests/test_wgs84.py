"""The ellipsoid: there and back to a micrometre anywhere, poles and date line too."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.geometry import WGS84_A, LocalPlane
from placegraph.wgs84 import ecef_from_enu, ecef_from_geodetic, geodetic_from_ecef

places = st.tuples(st.floats(-180, 180), st.floats(-90, 90), st.floats(-1e5, 1e5))


@given(places)
def test_there_and_back_to_a_micrometre(place):
    ecef = ecef_from_geodetic(place)
    back = geodetic_from_ecef(ecef)
    assert np.abs(ecef_from_geodetic(back) - ecef).max() < 1e-6
    assert abs(back[1] - place[1]) < 1e-10
    assert abs(back[2] - place[2]) < 1e-6


@pytest.mark.parametrize(
    ("place", "ecef"),
    [
        ((0, 0, 0), (WGS84_A, 0, 0)),
        ((180, 0, 10), (-WGS84_A - 10, 0, 0)),
        ((77, 90, 5), (0, 0, 6_356_757.314245)),
        # as PROJ has it (EPSG:4979 to 4978)
        ((8.5, 47.3, 400.0), (4_285_907.494674, 640_533.166769, 4_664_740.889652)),
    ],
)
def test_places_that_are_known(place, ecef):
    assert np.allclose(ecef_from_geodetic(place), ecef, rtol=0, atol=1e-3)


@given(places)
def test_axes_are_a_frame_and_up_is_up(place):
    axes = ecef_from_enu(*place[:2])
    assert np.allclose(axes @ axes.T, np.eye(3))
    assert np.linalg.det(axes) > 0
    higher = ecef_from_geodetic((*place[:2], place[2] + 1.0)) - ecef_from_geodetic(place)
    assert np.allclose(higher, axes[:, 2], atol=1e-8)


@given(st.floats(-180, 180), st.floats(-80, 80), st.floats(-500, 500), st.floats(-500, 500))
def test_the_plane_of_a_city_touches_here(lon, lat, east, north):
    ecef = ecef_from_geodetic((lon, lat, 0.0)) + ecef_from_enu(lon, lat) @ (east, north, 0.0)
    on_plane = LocalPlane(lon, lat).to_plane(geodetic_from_ecef(ecef)[:2])
    assert np.allclose(on_plane, (east, north), atol=0.25)
