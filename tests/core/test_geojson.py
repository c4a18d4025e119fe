"""Estimates in the words of geography: what is known, and what is not."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.estimate import (
    CityEstimate,
    Evidence,
    ObjectRef,
    Place,
    PoseEstimate,
    PoseMode,
    SceneEstimate,
    SceneMode,
    Status,
)  # fmt: skip
from placegraph.core.geo import Anchor
from placegraph.core.geojson import SHARE
from placegraph.core.geometry import LocalPlane, level_from_camera, pose_matrix
from placegraph.errors import GeoPoseError

CAFE = Evidence(
    "A café is near", "for", 2.0, (ObjectRef("node/1", "amenity=cafe", "Adler", 9.5, 47.1),)
)
MUTE = Evidence("depth", "for", 0.9, note="90% lie on surfaces")
HERE = Anchor(9.5, 47.1, 450.0, 0.3, np.eye(4) * 1e-4, "Library", "way/7", "1", 0.75)


def posed(*anchors):
    matrix = pose_matrix([3.0, 4.0, 1.6, math.pi / 2], level_from_camera((0, 1, 0)))
    earth = tuple(a.pose(matrix, np.eye(6) * 1e-4, probability=0.8, room="study") for a in anchors)
    mode = PoseMode(
        matrix,
        np.zeros(4),
        np.eye(6) * 1e-4,
        0.8,
        "flat",
        matrix,
        earth,
        explain=lambda: (CAFE, MUTE),
    )
    return PoseEstimate(Status.OK, (mode,), "One place fits.")


def heard(longitude=9.5):
    place = Place(longitude, 47.1, 0.9, "cell-7", np.diag([400.0, 100.0]), explain=lambda: (CAFE,))
    return CityEstimate(Status.OK, (place,), "One place fits.")


def strict(plain):
    return json.loads(json.dumps(plain, allow_nan=False))


def test_a_pose_from_images_is_a_geopose():
    said = strict(posed(HERE).geopose())
    assert set(said["position"]) == {"lat", "lon", "h"}
    assert math.hypot(*said["quaternion"].values()) == pytest.approx(1.0)
    assert said["unknown"] == []
    assert said["probability"] == pytest.approx(0.6)
    assert said["accuracy"]["position"] == pytest.approx(math.sqrt(1e-4 * (2 + 25 / 3)), rel=0.1)
    assert (said["status"], said["reason"]) == ("OK", "One place fits.")


def test_a_sentence_pretends_neither_height_nor_orientation():
    said = strict(heard().geopose())
    assert said["position"] == {"lat": 47.1, "lon": 9.5, "h": 0.0}
    assert said["quaternion"] == {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    assert said["unknown"] == ["height", "orientation"]
    assert said["accuracy"] == {"position": pytest.approx(math.sqrt(250.0)), "orientation": None}


@pytest.mark.parametrize(
    ("estimate", "named"),
    [
        (posed(), r"'flat' has no place on Earth.*`placegraph scene anchor`"),
        (
            SceneEstimate(Status.OK, (SceneMode("flat", 0.9, 3.0),), "It fits."),
            "'flat' has no place",
        ),
        (PoseEstimate(Status.LOST, (), "It is dark."), "no pose: It is dark"),
    ],
)
def test_no_pose_on_earth_is_said_with_its_mend(estimate, named):
    with pytest.raises(GeoPoseError, match=named):
        estimate.geopose()
    if estimate.modes:
        with pytest.raises(GeoPoseError, match=named):
            estimate.geojson()
    else:
        assert estimate.geojson()["features"] == []


def test_modes_ellipses_and_evidence_are_features():
    other = replace(HERE, heading=HERE.heading + math.pi, probability=0.25)
    said = strict(posed(HERE, other).geojson())
    kinds = [f["properties"]["kind"] for f in said["features"]]
    assert kinds == ["mode", "ellipse"] * 2 + ["evidence"] * 2
    first = said["features"][0]["properties"]
    assert (first["mode"], first["candidate"], first["probability"]) == (1, 1, pytest.approx(0.6))
    assert (first["room"], first["building"], first["osm"], first["level"]) == (
        "study", "Library", "way/7", "1",
    )  # fmt: skip
    assert len(said["features"][0]["geometry"]["coordinates"]) == 3
    cafe, mute = said["features"][-2:]
    assert cafe["geometry"]["coordinates"] == [9.5, 47.1]
    assert (cafe["properties"]["id"], cafe["properties"]["verdict"]) == ("node/1", "for")
    assert mute["geometry"] is None


@pytest.mark.parametrize("longitude", [9.5, 179.9999])
def test_an_ellipse_holds_its_share(longitude):
    said = strict(heard(longitude).geojson())
    point, ellipse = said["features"][:2]
    assert len(point["geometry"]["coordinates"]) == 2
    (ring,) = ellipse["geometry"]["coordinates"]
    assert ring[0] == ring[-1]
    ring = np.array(ring)
    assert np.ptp(ring[:, 0]) < 1  # it does not run around the world
    plane = LocalPlane(longitude, 47.1)
    axes = np.abs(plane.to_plane(ring)).max(axis=0)
    assert np.allclose(axes, np.sqrt(-2 * math.log(1 - SHARE)) * np.array([20, 10]), rtol=0.01)
    x, y = ring[:-1].T
    assert (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() > 0  # counter-clockwise
