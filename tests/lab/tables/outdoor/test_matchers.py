from dataclasses import replace

import numpy as np
import pytest

from placegraph.outdoor.city import build_city
from placegraph.outdoor.network.network import EncodedCity
from placegraph_lab.tables.named.outdoor_matchers import MatcherRunner
from placegraph_lab.tables.outdoor.extracts import (
    EXTRACTS,
    Extract,
    in_held_out_tiles,
    unseen_queries,
)
from placegraph_lab.tables.outdoor.matchers import (
    FUSED,
    MATCHERS,
    PRINTED,
    PRINTED_EDITS,
    RELATIONAL,
    RetrieveMatcher,
    matcher,
)
from placegraph_lab.tables.outdoor.metrics import Protocol
from placegraph_lab.tables.outdoor.queries import load, make_queries
from placegraph_lab.tables.runner import Journal
from placegraph_learn.city.descriptions import is_evaluation


@pytest.fixture(scope="module")
def city(harbour, network, make_network):
    """The shipped town, read by networks of random weights: this is about what goes where."""
    city = replace(harbour)
    city.__dict__["encoded"] = EncodedCity(city, network)
    city.__dict__["encoded_as_printed"] = EncodedCity(city, make_network(printed=True))
    return city


@pytest.fixture(scope="module")
def bins(town):
    return load(town)


def check(places, city, top):
    assert 0 < len(places.cells) <= top
    assert places.positions.shape == (len(places.cells), 2)
    for cell, at in zip(places.cells, city.plane.to_plane(places.positions), strict=True):
        assert cell in city.cells
        assert city.cells.nearest(at) == cell


@pytest.mark.parametrize("name", MATCHERS)
@pytest.mark.parametrize("setting", ["none", "names", "speaker"])
def test_matchers_rank_cells(city, bins, town, name, setting):
    found = matcher(name, city, bins, setting)
    if isinstance(found, RetrieveMatcher):
        found = replace(found, timeout=0.01)
    for query in make_queries(town, n=4, setting=setting):
        places = found.rank(query, 5)
        check(places, city, 5)
        if name not in (RELATIONAL, FUSED):  # these rank positions, several may lie in one cell
            assert len(set(places.cells)) == 5


def test_slow_matchers_get_some_queries_and_answers_are_asked_once(city, town, tmp_path):
    shown, told = (PRINTED_EDITS, PRINTED), []
    asking = MatcherRunner(
        shown, 4, 2, ("monaco",), 0, Journal(tmp_path / "a.jsonl"), lambda: told.append(1)
    )
    protocols = [Protocol(anywhere=True), Protocol()]
    rows = asking.rows(Extract("monaco", town), city, town, protocols)
    assert [(r.method, r.protocol.anywhere, len(r.answers)) for r in rows] == [
        (PRINTED_EDITS, True, 2), (PRINTED, True, 4), (PRINTED, False, 4),
    ]  # fmt: skip
    assert len(told) == 4
    other = replace(asking, journal=Journal(tmp_path / "a.jsonl"))
    assert [r.to_dict() for r in other.rows(Extract("monaco", town), city, town, protocols)] == [
        r.to_dict() for r in rows
    ]
    assert asking.query_count("toronto", protocols[0], PRINTED_EDITS) == 0


def off_center(city, query):
    """Metres to the nearest centre of the grid."""
    grid = city.cells.grid
    at = city.plane.to_plane((query.longitude, query.latitude)) - (grid.east, grid.north)
    return np.hypot(*(at - grid.stride * np.round(at / grid.stride)))


def test_queries_of_trained_cities_stand_in_held_out_tiles(shared, tmp_path):
    path = shared / "data/osm" / EXTRACTS["monaco"]
    city = build_city(path, tmp_path / "monaco.city")
    trained = unseen_queries(
        Extract("vancouver", path), city, path, n=40, seed=0, in_the_middle=True
    )
    unseen = unseen_queries(Extract("monaco", path), city, path, n=40, seed=0)
    assert max(off_center(city, q) for q in trained) <= 10.0 + 1e-3
    assert max(off_center(city, q) for q in unseen) > 20.0
    share = []
    for asked in (trained, unseen):
        lonlat = np.array([(q.longitude, q.latitude) for q in asked])
        inside = in_held_out_tiles(city)(lonlat)
        assert np.array_equal(inside, is_evaluation(*city.plane.to_plane(lonlat).T))
        share.append(inside.mean())
    assert share[0] == 1.0
    assert 0.0 < share[1] < 0.8
