from dataclasses import replace

import numpy as np
import pytest

from placegraph.outdoor.city import build_city
from placegraph.outdoor.network.network import EncodedCity
from placegraph_lab.tables.named.outdoor_matchers import (
    MatcherRunner,
    advantage,
    advantages,
    methods,
    recalls,
    report,
)
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
    PRINTED_ALONE,
    PRINTED_EDITS,
    RELATIONAL,
    RetrieveMatcher,
    matcher,
)
from placegraph_lab.tables.outdoor.metrics import Answer, Protocol, of_answers
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


PLAIN = Protocol(anywhere=True)


def row(city, method, distances, protocol=PLAIN):
    """Row whose best places are this far off; within 10 m, the cell is the right one."""
    answers = [Answer(np.array([d]), (d <= 10.0,), 0.001) for d in distances]
    return of_answers(city, protocol, method, answers)


@pytest.fixture
def rows():
    found = []
    for city, far in (("a", 100.0), ("b", 40.0)):
        found += [
            row(city, FUSED, [5.0] * 8 + [far] * 2),
            row(city, RELATIONAL, [5.0] * 7 + [30.0] * 3),
            row(city, PRINTED_ALONE, [5.0] * 2 + [60.0] * 8),
            row(city, PRINTED, [5.0] * 3 + [60.0] * 7),
        ]
    found.append(row("b", PRINTED_EDITS, [5.0, 300.0]))
    return found


def test_differences_are_paired_and_a_mean_of_cities(rows):
    rng = np.random.default_rng(0)
    lead = advantage(rows, FUSED, RELATIONAL, "exact", rng)
    assert lead.mean == pytest.approx(0.1)
    assert lead.low <= 0.1 <= lead.high
    assert advantage(rows, FUSED, RELATIONAL, "50 m", rng).mean == pytest.approx(-0.1)
    # of edit distance only the first two queries of one city are known
    assert advantage(rows, FUSED, PRINTED_EDITS, "exact", rng).mean == pytest.approx(0.5)


def test_tables_hold_every_matcher_and_the_paper(rows):
    table = advantages(rows, np.random.default_rng(0))
    assert {r["measure"] for r in table} == {"exact", "50 m"}
    assert {(r["first"], r["second"]) for r in table} == {
        (PRINTED, PRINTED_ALONE), (PRINTED, PRINTED_EDITS),
        (RELATIONAL, PRINTED), (FUSED, RELATIONAL),
    }  # fmt: skip
    text = report(rows, table)
    everywhere, _, slow = text.partition("#### Recall@1/3/5, the exact cell, 2 queries")
    for method in (FUSED, RELATIONAL, PRINTED_ALONE, "*paper: transformer, OSM*"):
        assert f"| {method} " in everywhere
    assert f"| {PRINTED_EDITS} " not in everywhere
    assert f"| {PRINTED_EDITS} " in slow
    assert ".80/.80/.80" in everywhere
    assert ".22/.39/.48" in everywhere
    assert "+0.100" in text
    assert "| a: " in text


def test_recalls_are_means_over_seeds_with_wider_intervals(rows):
    """Two seeds, of which one finds all and one nothing, are half right, and nobody knows the third."""
    rng = np.random.default_rng(0)
    again = [row(city, PRINTED, [60.0] * 10) for city in "ab"]
    sure = [row(city, RELATIONAL, [5.0] * 10) for city in "ab"]
    found = {r["method"]: r for r in recalls([*rows, *again], rng) if r["title"]}
    assert found[PRINTED]["seeds"] == 2
    assert found[PRINTED]["recall"][1].mean == pytest.approx(0.15)
    assert found[PRINTED]["recall"][1].low == 0.0
    assert found[RELATIONAL]["recall"][1].low > 0.4
    (only,) = recalls(sure, rng)
    assert only["recall"][5] == (1.0, 1.0, 1.0)
    text = report([*rows, *again], [], recalls([*rows, *again], rng))
    (line,) = (line for line in text.splitlines() if ".15 (.00 to" in line)
    cells = [cell.strip() for cell in line.strip("| ").split("|")]
    assert cells[:3] == [PRINTED, "6 statements, no noise", "2"]
    lead = advantage([*rows, *again], RELATIONAL, PRINTED, "exact", rng)
    assert lead.mean == pytest.approx(0.7 - 0.15)


def test_a_network_of_the_table_is_the_last_row(rows):
    assert methods([*rows, row("a", "mine", [5.0])])[-1] == "mine"
