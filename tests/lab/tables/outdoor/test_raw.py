import pytest

from placegraph.core.geometry import LocalPlane
from placegraph.errors import InputError
from placegraph_lab.tables.outdoor.places import AREA, LINE, POINT, is_area, read_raw


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({"building": "yes"}, True),
        ({"leisure": "park"}, True),
        ({"highway": "residential"}, False),
        ({"highway": "pedestrian", "area": "yes"}, True),
        ({"barrier": "fence"}, False),
        ({"leisure": "track", "area": "no"}, False),
        ({"railway": "station"}, True),
        ({"natural": "coastline"}, False),
        ({"natural": "water"}, True),
        ({"name": "Nothing"}, False),
    ],
)
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
