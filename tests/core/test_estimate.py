"""The one result type: the best mode, evidence when asked for, and JSON that any reader takes."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.estimate import (
    CityEstimate,
    Evidence,
    ObjectRef,
    PassRecord,
    Place,
    PoseEstimate,
    PoseMode,
    Refinement,
    Status,
)
from placegraph.core.geometry import level_from_camera, pose_matrix

CHAIR = ObjectRef("17", "chair", "")
CAFE = ObjectRef("way/4711", "amenity=cafe", "Adler", 9.5, 47.1)


def strict(estimate):
    """What a reader gets that knows no NaN: a round trip through JSON."""
    return json.loads(json.dumps(estimate.to_dict(), allow_nan=False))


def pose_mode(pose, probability=1.0, **changes):
    matrix = pose_matrix(pose, level_from_camera((0.1, 1.0, 0.2)))
    fields = {
        "map_from_camera": matrix,
        "pose": np.array(pose, float),
        "covariance": np.diag([0.01, 0.02, 0.03, 0.004]),
        "probability": probability,
        "scene": "flat",
        "scene_from_camera": matrix,
    }
    return PoseMode(**fields | changes)


@pytest.fixture
def posed():
    """An indoor estimate of two modes, as the localizer gives it."""
    evidence = (
        Evidence("chair 17", "for", 3.5, (CHAIR,)),
        Evidence("depth", "against", 0.2, note="20% of the readings lie on the map's surfaces"),
    )
    modes = (
        pose_mode((1, 2, 1.6, math.pi / 2), 0.8, explain=lambda: evidence),
        pose_mode((4, 2, 1.6, -0.5), 0.2),
    )
    return PoseEstimate(
        status=Status.OK,
        modes=modes,
        reason="One pose fits.",
        trajectory=np.stack([m.map_from_camera for m in modes]),
        frames=np.array([3, 7]),
        stats={"seconds": {"search": 0.12}, "particles": [[576, 85], [60]], "device": "cpu"},
        history=(PassRecord(20.0, ((3, np.zeros((5, 4)), np.full(5, 0.2)),)),),
    )


def test_a_pose_and_its_evidence_as_json(posed):
    got = strict(posed)
    keys = {
        "status", "reason", "remainder", "modes", "frames", "trajectory", "stats", "refinement",
        "calibration",
    }  # fmt: skip
    assert set(got) == keys
    assert got["refinement"] is None
    assert (got["status"], got["reason"]) == ("OK", "One pose fits.")
    assert got["frames"] == [3, 7]
    np.testing.assert_array_equal(got["trajectory"], posed.trajectory)
    assert got["stats"] == posed.stats
    first, second = got["modes"]
    assert (first["x"], first["y"], first["z"]) == (1, 2, 1.6)
    assert first["yaw_deg"] == pytest.approx(90)
    assert (first["probability"], first["scene"]) == (0.8, "flat")
    np.testing.assert_array_equal(first["map_from_camera"], posed.best.map_from_camera)
    np.testing.assert_array_equal(first["covariance"], posed.best.covariance)
    assert second["evidence"] == []
    chair, depth = strict(posed)["modes"][0]["evidence"]
    assert chair == {
        "statement": "chair 17",
        "verdict": "for",
        "weight": 3.5,
        "objects": [{"id": "17", "label": "chair", "name": ""}],
        "note": "",
    }
    assert depth["objects"] == []
    assert depth["note"].startswith("20%")


def test_evidence_is_found_when_asked_for_and_once():
    asked = []

    def explain():
        asked.append(1)
        return (Evidence("chair 17", "for", 3.5),)

    mode = pose_mode((0, 0, 1, 0), explain=explain)
    estimate = PoseEstimate(Status.OK, (mode, pose_mode((1, 0, 1, 0))), "")
    assert not asked
    assert estimate.evidence == mode.evidence == estimate.best.evidence
    assert asked == [1]
    assert estimate.modes[1].evidence == ()


@pytest.mark.parametrize("kind", [PoseEstimate, CityEstimate])
def test_nothing_found_is_an_answer(kind):
    estimate = kind(Status.LOST, (), "Nothing fits.")
    assert estimate.best is None
    assert estimate.evidence == ()
    got = strict(estimate)
    if kind is PoseEstimate:
        assert (estimate.trajectory.shape, estimate.frames.shape) == ((0, 4, 4), (0,))
        assert got["trajectory"] == []
    assert (got["status"], got["modes"], got["reason"]) == ("LOST", [], "Nothing fits.")


def test_a_city_as_json():
    evidence = (Evidence("A café is north of me", "for", 2.0, (CAFE,)),)
    place = Place(9.5, 47.1, 0.9, "cell-7", np.diag([4.0, 9.0]), explain=lambda: evidence)
    estimate = CityEstimate(Status.AMBIGUOUS, (place,), "Two places fit.")
    got = strict(estimate)
    assert got["understood"] is None
    (mode,) = got["modes"]
    assert mode["covariance"] == [[4, 0], [0, 9]]
    assert (mode["longitude"], mode["latitude"], mode["probability"]) == (9.5, 47.1, 0.9)
    assert mode["evidence"][0]["objects"] == [
        {"id": "way/4711", "label": "amenity=cafe", "name": "Adler", "longitude": 9.5, "latitude": 47.1}
    ]  # fmt: skip
    assert estimate.best is place


def test_a_refinement_as_json(posed):
    refined = Refinement(False, "No image was matched.", posed.modes[1], posed.trajectory, {"n": 1})
    got = strict(replace(posed, refinement=refined))["refinement"]
    assert (got["accepted"], got["reason"], got["stats"]) == (
        False,
        "No image was matched.",
        {"n": 1},
    )
    assert got["coarse"] == strict(posed)["modes"][1]


def test_a_place_has_one_spread_in_whatever_axes():
    axes = np.array([[1.0, 1.0], [-1.0, 1.0]]) / np.sqrt(2.0)
    place = Place(0.0, 0.0, 1.0, "c", axes.T @ np.diag([144.0, 25.0]) @ axes)
    assert place.spread == pytest.approx(12.0)
