from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.geojson import contains_points
from placegraph.world import AnchorFit
from placegraph.world.outlines import find_footprints
from placegraph_lab.tables.named.scene_anchor import (
    BUILDINGS,
    WALKS,
    ask,
    extract,
    house,
    report,
    right,
    score_candidates,
)


@pytest.fixture(scope="module")
def home():
    return house(0, 2)


def test_a_building_lies_around_its_home(home, tmp_path):
    floor = home.scene.bounds[:, :2]
    assert (home.outline.min(axis=0) < floor[0]).all() or np.ptp(home.outline, axis=0).min() > 2.0
    rooms = home.flat.room_of
    cells = np.argwhere(rooms >= 0)
    points = np.array([home.flat.corner(r + 0.5, c + 0.5) for r, c in cells.tolist()])
    for ring in (home.outline, home.part):
        if ring is not None:
            assert contains_points(points, [ring]).all()
    rng = np.random.default_rng(0)
    file = extract(home, home.outline, tmp_path / "a.osm", rng, entrance=True)
    (drawn,) = find_footprints(file, "House")
    there = home.stands.to_map(
        drawn.base.to_earth(np.c_[drawn.rings[0], np.zeros(len(drawn.rings[0]))])
    )
    assert np.abs(there[:-1, :2] - home.outline[:-1]).max() < 3.0
    assert len(drawn.entrances) == len(home.doors) == 1


def test_the_truth_is_right_and_a_turn_is_not(home):
    turned = replace(home.stands, heading=home.stands.heading + np.pi, probability=0.5)
    far = replace(home.stands.shift_origin((3.0, 0, 0)), probability=0.5)
    true = replace(home.stands, covariance=np.eye(4) * 0.01)
    (found,) = score_candidates(home, AnchorFit((true,), ()))["candidates"]
    assert right(found)
    assert found["chi2"] < 1e-6
    for wrong in (turned, far):
        anchor = replace(wrong, covariance=np.eye(4) * 0.01)
        (found,) = score_candidates(home, AnchorFit((anchor,), ()))["candidates"]
        assert not right(found)
    assert found["metres"] == pytest.approx(3.0, abs=1e-3)


def test_rows_are_asked_and_told(home, tmp_path):
    asked = [ask(home, row, tmp_path, 1) for row in (*BUILDINGS, *WALKS)]
    asked = [a for a in asked if a is not None]
    assert {a["row"].split(",")[0] for a in asked if a["row"] in BUILDINGS} == {home.shape}
    assert {*WALKS} <= {a["row"] for a in asked}
    around = next(a for a in asked if a["row"] == "fixes around the house")
    assert around["candidates"][0]["metres"] < 6.0
    told = report(asked)
    assert "fixes around the house" in told
    assert ask(home, "fixes around the house", tmp_path, 1)["candidates"] == around["candidates"]
