import numpy as np
import pytest

from placegraph.core.geometry import angle_between, bearing
from placegraph_lab.tables.named.outdoor_track import FARTHEST, METHODS, NEAREST, follow, make_walks
from placegraph_lab.tables.outdoor.metrics import distances
from placegraph_lab.tables.outdoor.queries import load


@pytest.fixture(scope="module")
def walks(town):
    return make_walks(town, n=30, seed=4)


def true_ways(walk, plane):
    lonlat = [(s.query.longitude, s.query.latitude) for s in walk.steps]
    return np.diff(plane.to_plane(lonlat), axis=0)


def test_places_lie_as_far_apart_as_they_should(walks, town):
    plane = load(town).city.plane
    assert {len(walk.steps) for walk in walks} == {3, 4, 5}
    errors, turns = [], []
    for k, walk in enumerate(walks):
        for way, step in zip(true_ways(walk, plane), walk.steps[1:], strict=True):
            assert NEAREST - 1e-6 <= np.hypot(*way) <= FARTHEST + 1e-6
            assert len(step.query.statements) == 2
            errors.append((np.subtract(step.measured, way)) / np.hypot(*way))
        angles = bearing(true_ways(walk, plane))
        turns.append((k % 2, np.max(angle_between(angles[1:], angles[:-1]))))
    assert 0.02 < np.std(errors) < 0.04
    assert max(turn for bent, turn in turns if not bent) < 0.9
    assert np.mean([turn for bent, turn in turns if bent]) > 1.0


def test_all_methods_answer_and_the_way_helps(walks, harbour):
    right = dict.fromkeys(METHODS, 0)
    for walk in walks[:10]:
        for method in METHODS:
            estimate, seconds = follow(harbour, walk, method)
            one = method in METHODS[:2]
            assert len(seconds) == (1 if one else 2 * len(walk.steps) - 1)
            best = estimate.best
            if best is not None:
                at = np.array([[best.longitude, best.latitude]])
                right[method] += distances(at, walk.last.longitude, walk.last.latitude)[0] <= 50.0
    assert right["track, measured"] > right["last place alone"]
    assert right["track, measured"] > right["all as one text"]
