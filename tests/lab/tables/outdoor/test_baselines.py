import numpy as np
import pytest

from placegraph_lab.tables.outdoor.baselines import Bag
from placegraph_lab.tables.outdoor.nearby import Bins
from placegraph_lab.tables.outdoor.places import read_raw
from placegraph_lab.tables.outdoor.queries import Query, SpokenStatement, load, make_queries

TREE, BENCH, FOUNTAIN = {"natural": "tree"}, {"amenity": "bench"}, {"amenity": "fountain"}


def query(*statements):
    return Query("", 0.0, 0.0, tuple(SpokenStatement(*s, "", "") for s in statements))


@pytest.fixture
def park(write_world):
    """Two places with a tree and a bench, mirrored; a third with a fountain too."""
    nodes = [(0.0, 0.0, TREE), (0.0, 10.0, BENCH), (300.0, 0.0, BENCH), (300.0, 10.0, TREE)]
    nodes += [(600.0, 0.0, TREE), (610.0, 0.0, BENCH), (605.0, 5.0, FOUNTAIN)]
    return Bins.of(read_raw(write_world(nodes)))


def test_rarity_is_the_logarithm_of_the_share(park):
    bag = Bag.of(park, "labels", reach=50.0)
    held = {
        name: set(bag.cells[bag.starts[i] : bag.starts[i + 1]].tolist())
        for i, name in enumerate(park.city.labels)
    }
    asked = query(("bench", "south", "fountain"))
    cells = len(bag.centers)
    expected = np.zeros(cells)
    for name in ("bench", "fountain"):
        expected[list(held[name])] += np.log(cells / len(held[name]))
    assert bag.scores(asked) == pytest.approx(expected, abs=1e-6)


def recall(path, kind, n, **options):
    """Share of queries whose exact cell comes first."""
    bins = load(path)
    queries = make_queries(path, n=n)
    bag = Bag.of(bins, kind, **options)
    truth = bins.city.plane.to_plane([(q.longitude, q.latitude) for q in queries])
    found = np.array([bins.city.plane.to_plane(bag.locate(q, top=1))[0] for q in queries])
    return (np.abs(found - truth).max(1) <= 25.0).mean()


def test_bags_are_as_good_as_quoted(shared):
    """The triple bag of methods.md finds the exact cell of .59 of its queries in Monaco."""
    path = shared / "data/osm/monaco_2025.osm.pbf"
    triples = recall(path, "triples", 150)
    assert triples == pytest.approx(0.59, abs=0.08)
    assert recall(path, "labels", 150) < triples - 0.1
    assert recall(path, "triples", 150, reach=30.0, longest=25.0) > triples
