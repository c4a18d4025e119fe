import json

import pytest

from placegraph.core.geometry import LocalPlane
from placegraph.errors import InputError
from placegraph_lab.tables.outdoor.metrics import distances
from placegraph_lab.tables.outdoor.places import (
    AREA,
    LINE,
    POINT,
    Baselines,
    is_area,
    landmarks,
    read_raw,
    read_records,
)


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({"building": "yes"}, True), ({"leisure": "park"}, True),
        ({"highway": "residential"}, False), ({"highway": "pedestrian", "area": "yes"}, True),
        ({"barrier": "fence"}, False), ({"leisure": "track", "area": "no"}, False),
        ({"railway": "station"}, True), ({"natural": "coastline"}, False),
        ({"natural": "water"}, True), ({"name": "Nothing"}, False),
    ],
)  # fmt: skip
def test_closed_ways_are_lines_or_areas_by_their_tags(tags, expected):
    assert is_area(tags) is expected


SQUARE = [(0.0, 0.0), (20.0, 0.0), (20.0, 20.0), (0.0, 20.0)]


def test_kinds_and_centres(write_world):
    corners = [(e, n, {}) for e, n in SQUARE]
    path = write_world(
        [*corners, (100.0, 0.0, {}), (130.0, 40.0, {}), (50.0, 50.0, {"natural": "tree"})],
        [
            ([0, 1, 2, 3, 0], {"building": "yes", "name": "Town  Hall"}),
            ([0, 1, 2, 3, 0], {"barrier": "fence"}),
            ([4, 5], {"highway": "path"}),
        ],
    )
    city = read_raw(path)
    row = city.rows
    assert [city.kind[row[o]] for o in ("way/1", "way/2", "way/3", "node/7")] == [
        AREA, LINE, LINE, POINT,
    ]  # fmt: skip
    tree = city.center[row["node/7"]]
    assert city.center[row["way/1"]] - tree == pytest.approx([-40.0, -40.0], abs=0.02)
    assert city.center[row["way/3"]] - tree == pytest.approx([65.0, -30.0], abs=0.02)
    assert city.labels[city.named[row["way/1"]]] == "Town_Hall"
    assert city.labels[city.label[row["way/1"]]] == "building"


def test_only_what_touches_the_bounds_is_cached(write_world):
    nodes = [(0.0, 0.0, {"shop": "books"}), (900.0, 100.0, {"shop": "toys"}), (100.0, 900.0, {})]
    path = write_world(nodes, [([0, 2], {"highway": "path"}), ([1, 2], {"highway": "steps"})])
    plane = LocalPlane(10.0, 50.0)
    low, high = plane.to_lonlat([(-50.0, -50.0), (50.0, 50.0)])
    assert sorted(read_raw(path, (*low, *high)).osm) == ["node/1", "way/1"]
    low, high = plane.to_lonlat([(400.0, 200.0), (500.0, 300.0)])  # the box of the steps alone
    with pytest.raises(InputError, match="no tagged object there"):
        read_raw(path, (*(low - 1.0), *(high - 1.0)))
    assert read_raw(path, (*low, *high)).osm == ("way/2",)


def test_points_are_listed_latitude_first(tmp_path):
    path = tmp_path / "records.jsonl"
    row = {
        "content": "by the bank",
        "rvs_goal_point": [50.0, 10.0],
        "rvs_start_point": [50.1, 10.1],
        "landmarks": {"near_pivot": [[50.2, 10.2], "bank"], "end_point": [[50.2, 10.2], "bank"]},
    }
    path.write_text(json.dumps(row), encoding="utf-8")
    (found,) = read_records(path)
    assert (found.goal, found.start) == ((10.0, 50.0), (10.1, 50.1))
    assert landmarks([found]) == [("bank", 10.2, 50.2)]
    path.write_text('{"content": "x"}\n', encoding="utf-8")
    with pytest.raises(InputError, match="line 1"):
        read_records(path)
    with pytest.raises(InputError, match=r"missing\.jsonl"):
        read_records(tmp_path / "missing.jsonl")


def test_baselines_are_as_good_as_quoted(shared):
    """The issue quotes .29/.47 within 100/250 m for the rarest landmark nearest to the start."""
    told = read_records(shared / "data/text/rvs_pittsburgh.jsonl")
    assert len(told) == 1023
    simple = Baselines(landmarks(told))
    off = []
    for r in told:
        place = simple.rarest_near(r)
        off.append(float("inf") if place is None else distances(place, *r.goal)[0])
    assert sum(d <= 100.0 for d in off) / len(off) == pytest.approx(0.29, abs=0.04)
    assert sum(d <= 250.0 for d in off) / len(off) == pytest.approx(0.47, abs=0.04)
