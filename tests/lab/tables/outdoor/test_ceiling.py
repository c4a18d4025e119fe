import pytest

from placegraph_lab.tables.named.outdoor_recall import Contest, ceiling, oracle
from placegraph_lab.tables.outdoor.nearby import Bins
from placegraph_lab.tables.outdoor.places import read_raw
from placegraph_lab.tables.outdoor.queries import Query, SpokenStatement

TREE, BENCH, FOUNTAIN = {"natural": "tree"}, {"amenity": "bench"}, {"amenity": "fountain"}
PLACE = [(0.0, 0.0, TREE), (0.0, 10.0, BENCH)]


def at(east, place=PLACE):
    return [(east + e, n, tags) for e, n, tags in place]


def ask(bins, *statements, osm="node/1"):
    """A query whose truth is at an object."""
    here = bins.city.plane.to_lonlat(bins.city.center[bins.city.rows[osm]]).tolist()
    return Query("", *here, tuple(SpokenStatement(*s, "", "") for s in statements))


def test_three_places_alike_share_the_first_rank(write_world):
    bins = Bins.of(read_raw(write_world([*at(0.0), *at(300.0), *at(600.0)])))
    contest = Contest.of(bins, [ask(bins, ("bench", "north", "tree"))])
    found = ceiling(contest, 50.0)
    assert (found.better.tolist(), found.tied.tolist()) == ([0], [2])
    assert [found.recall(k) for k in (1, 2, 3, 5)] == pytest.approx([1 / 3, 2 / 3, 1.0, 1.0])
    assert ceiling(contest, 25.0).tied[0] >= 2  # both can be seen from more than one place


def test_the_oracle_prefers_the_place_with_less_to_say(write_world):
    rich = [*PLACE, (5.0, 5.0, FOUNTAIN), (-5.0, 5.0, {"shop": "kiosk"})]
    bins = Bins.of(read_raw(write_world([*at(0.0), *at(300.0, rich)])))
    poor_truth = ask(bins, ("bench", "north", "tree"), osm="node/1")
    rich_truth = ask(bins, ("bench", "north", "tree"), osm="node/3")
    distance = oracle(Contest.of(bins, [poor_truth, rich_truth]))
    assert distance.shape == (2, 5)
    assert distance[0, 0] < 30.0  # the poor place comes first, whichever is the truth
    assert distance[1, 0] == pytest.approx(300.0, abs=30.0)
    assert distance[1, :].min() < 30.0
