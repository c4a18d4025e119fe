"""A small town cut into shards."""

import pytest
from tests.cities import _write_world

from placegraph.outdoor.city import build_city
from placegraph_lab.tables.outdoor.shards import write_shards

ZOOM = 14
KINDS = (
    {"amenity": "bench"}, {"natural": "tree"}, {"amenity": "cafe"}, {"shop": "bakery"},
    {"amenity": "post_box"}, {"highway": "street_lamp"}, {"leisure": "playground"},
)  # fmt: skip


def town():
    """Things every 60 m over 3.6 km, streets, and a few that are unique."""
    nodes = [
        (60.0 * x, 60.0 * y, KINDS[(3 * x + 5 * y + x * y) % 7])
        for x in range(61)
        for y in range(31)
    ]
    nodes += [
        (310.0, 330.0, {"amenity": "theatre", "name": "Rex"}),
        (3310.0, 1330.0, {"tourism": "museum", "name": "Museum of Salt"}),
        (1800.0, 900.0, {"man_made": "lighthouse", "name": "Old Light"}),
    ]
    n = len(nodes)
    nodes += [(x, 20.0, {}) for x in (0.0, 3600.0)] + [(25.0, y, {}) for y in (0.0, 1800.0)]
    ways = [((n, n + 1), {"highway": "residential", "name": "Long Street"}),
            ((n + 2, n + 3), {"highway": "footway"})]  # fmt: skip
    return nodes, ways


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    return build_city(_write_world(folder / "town.osm", *town()), folder / "town.city")


@pytest.fixture(scope="session")
def sharded(whole, tmp_path_factory):
    folder = tmp_path_factory.mktemp("world") / "WORLD"
    write_shards(whole, folder, ZOOM)
    return folder


@pytest.fixture
def world(sharded, tmp_path):
    """A copy that a test may damage."""
    import shutil

    return shutil.copytree(sharded, tmp_path / "WORLD")
