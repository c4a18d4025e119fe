import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.geometry import level_from_camera, pose_matrix, rotation_from_quaternion
from placegraph_lab.tables.indoor.metrics import (
    NEAR,
    Answer,
    is_honest,
    mean_particles,
    measure,
    rotation_error,
    score,
)
from placegraph_lab.tables.runner import Journal, plain

LEVEL = level_from_camera([0.05, 0.99, 0.1])


def at(x=0.0, y=0.0, z=1.6, yaw_deg=0.0):
    return pose_matrix([x, y, z, math.radians(yaw_deg)], LEVEL)


def mode(pose, probability=0.9, sigma=0.1):
    return SimpleNamespace(
        map_from_camera=pose, probability=probability, covariance=np.eye(6) * sigma**2
    )


def estimate(status, *modes, particles=None):
    stats = {} if particles is None else {"particles": particles}
    best, status = modes[0] if modes else None, SimpleNamespace(name=status)
    return SimpleNamespace(status=status, modes=modes, best=best, stats=stats)


def answer(position=0.05, rotation=1.0, status="OK", **more):
    fields = {
        "window": "seq01 5:10", "place": "seq01", "changed": False, "coverage": None,
        "probability": 0.9, "among_modes": position <= NEAR[0] and rotation <= NEAR[1],
        "whitened": (0.5, -0.5, 0.5, -0.5, 0.5, -0.5), "frames": 5, "seconds": 1.0,
    }  # fmt: skip
    return Answer(position=position, rotation=rotation, status=status, **(fields | more))


LOST = {"position": math.inf, "rotation": 180.0, "status": "LOST", "probability": 0.0}


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3), st.floats(0, 180))
def test_the_angle_is_the_geodesic_one(axis, degrees):
    if np.linalg.norm(axis) < 0.1:
        axis = [1.0, 0.0, 0.0]
    half = math.radians(degrees) / 2
    turn = np.append(math.sin(half) * np.array(axis) / np.linalg.norm(axis), math.cos(half))
    other = at(3, yaw_deg=77)
    other[:3, :3] = other[:3, :3] @ rotation_from_quaternion(turn)
    assert rotation_error(at(3, yaw_deg=77), other) == pytest.approx(degrees, abs=1e-6)
    assert rotation_error(other, at(3, yaw_deg=77)) == pytest.approx(degrees, abs=1e-6)


def test_an_estimate_is_measured():
    two = estimate(
        "AMBIGUOUS", mode(at(5), 0.6), mode(at(0.3, yaw_deg=5), 0.3), particles=[[10, 40], [10]]
    )
    got = measure(two, at(), seconds=0.5, frames=5, window="w", place="p")
    assert (got.position, got.rotation) == pytest.approx((5.0, 0.0), abs=1e-6)
    assert (got.status, got.probability, got.among_modes) == ("AMBIGUOUS", 0.6, True)
    assert got.whitened == pytest.approx((-50.0, 0.0, 0.0, 0.0, 0.0, 0.0), abs=1e-6)
    assert got.particles == 20.0
    none = measure(estimate("LOST"), at(), seconds=0.5, frames=5)
    assert not none.has_pose
    assert (none.rotation, none.probability) == (180.0, 0.0)
    assert (none.among_modes, none.whitened) == (False, ())
    assert math.isnan(none.particles)
    assert math.isnan(mean_particles({"particles": [[]]}))


def test_status_is_weighed_against_the_truth():
    false = answer(14.0, 179.0, among_modes=False)
    torn = answer(14.0, 179.0, status="AMBIGUOUS", among_modes=True)
    blind = answer(14.0, 179.0, status="AMBIGUOUS", among_modes=False)
    shy = answer(0.05, 1.0, status="LOST")
    lost = answer(**LOST)
    honest = [is_honest(a) for a in (answer(), false, torn, blind, shy, lost)]
    assert honest == [True, False, True, False, False, True]
    s = score([answer(), false, torn, blind, shy, lost])
    assert (s.right, s.false_ok, s.honest) == pytest.approx((1 / 2, 1 / 6, 1 / 2))
    assert s.among_modes == pytest.approx(3 / 6)
    assert s.worst == (
        "seq01 5:10 OK 14.00 m 179 deg",
        "seq01 5:10 AMBIGUOUS 14.00 m 179 deg",
        "seq01 5:10 AMBIGUOUS 14.00 m 179 deg",
    )


def test_answers_are_cached_as_they_are_and_scores_are_json(tmp_path):
    for one in (answer(particles=12), answer(**LOST, whitened=())):
        Journal(tmp_path / "a.jsonl").put("a", one)
        again = Answer(**Journal(tmp_path / "a.jsonl")["a"])
        assert (again.position, again.rotation) == (one.position, one.rotation)
        assert math.isnan(again.particles) == math.isnan(one.particles)
    lost = json.loads(json.dumps(plain(score([answer(**LOST, whitened=())])), allow_nan=False))
    assert (lost["median"], lost["recall"], lost["right"]) == ([None, 180.0], [0.0] * 4, None)
