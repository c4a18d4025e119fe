from collections import Counter

import numpy as np

from placegraph_lab.tables.outdoor.places import read_raw
from placegraph_lab.tables.outdoor.tiling import tile


def tiles(town, tmp_path, copies, seed=0):
    out = tmp_path / f"tiled_{copies}_{seed}.osm.pbf"
    tile([town], out, copies, seed)
    return read_raw(out), out


def test_copies_hold_as_much_and_keep_apart(town, tmp_path):
    city = read_raw(town)
    four, _ = tiles(town, tmp_path, 4)
    assert len(four) == 4 * len(city)
    assert np.bincount(four.kind).tolist() == (4 * np.bincount(city.kind)).tolist()
    assert Counter(four.labels[i] for i in four.label) == {
        label: 4 * n for label, n in Counter(city.labels[i] for i in city.label).items()
    }
    size = np.ptp(city.center, axis=0)
    assert (np.ptp(four.center, axis=0) > 2.0 * size).all()
    assert (np.ptp(four.center, axis=0) < 2.0 * size + 700.0).all()


def test_a_country_of_extracts_in_turn(town, tmp_path):
    whole, out = len(read_raw(town)), tmp_path / "country.osm.pbf"
    nodes = tile([town, town], out, 3, seed=0)
    made, first = read_raw(out), out.read_bytes()
    assert 2.0 * whole < len(made) <= 3 * whole
    assert tile([town, town], out, 3, seed=0) == nodes
    assert out.read_bytes() == first
    tile([town, town], out, 3, seed=1)
    assert out.read_bytes() != first
