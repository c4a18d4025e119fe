import numpy as np
import pytest
from tests.cities import _write_world

from placegraph.outdoor.city import build_city
from placegraph_lab.worlds.shards import write_shards

ZOOM = 15
KINDS = (
    {"amenity": "bench"}, {"natural": "tree"}, {"amenity": "cafe"}, {"shop": "bakery"},
    {"amenity": "post_box"}, {"highway": "street_lamp"}, {"leisure": "playground"},
)  # fmt: skip


def town():
    rng = np.random.default_rng(3)
    kinds = rng.choice(7, size=(101, 76), p=(0.3, 0.3, 0.1, 0.1, 0.05, 0.1, 0.05))
    nodes = [(24.0 * x, 24.0 * y, KINDS[kinds[x, y]]) for x in range(101) for y in range(76)]
    nodes += [
        (310.0, 333.0, {"amenity": "theatre", "name": "Rex"}),
        (2110.0, 1330.0, {"tourism": "museum", "name": "Museum of Salt"}),
        (1210.0, 909.0, {"man_made": "lighthouse", "name": "Old Light"}),
    ]
    n = len(nodes)
    nodes += [(x, 20.0, {}) for x in (0.0, 2400.0)] + [(25.0, y, {}) for y in (0.0, 1800.0)]
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
    import shutil

    return shutil.copytree(sharded, tmp_path / "WORLD")


THREE = "The bakery is on the north of the cafe. The cafe is on the east of the bench. "
TEXTS = (
    THREE + "The post box is on the south of the bench.",
    "Rex is north of me. A bench is east of me.",
    "The Museum of Salt is on the west of a tree. A cafe is south of the tree.",
    "I am on Long Street. A playground is north of me.",
    "A post box is north of me. A playground is east of me. A bakery is south of me. There is no cafe.",
    "The Old Light is 300 m west of me. A bakery is north of me.",
    # 350 m and more, where shards overlap by 150 m: whoever asks reads the neighbours' rare things
    "The Museum of Salt is far away in the east. A bakery is north of me. A cafe is east of me.",
)


def shards_of(world):
    return world.planets["WORLD"]
