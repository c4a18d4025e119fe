import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.search.locate import (
    find_evidence,
    name_bearing,
    quote_statement,
    score_positions,
)
from placegraph.outdoor.search.request import parse

BAKERY, BENCH, FOUNTAIN, PARK = "shop=bakery", "amenity=bench", "amenity=fountain", "leisure=park"


@pytest.fixture
def world(build_world, at):
    """Bakery north, bench west, park around; a town of other things far to the east."""
    park = [(-40, -40, {}), (40, -40, {}), (40, 40, {}), (-40, 40, {})]
    things = [(0, 15, {"shop": "bakery", "name": "Kern"}), (-12, 0, {"amenity": "bench"})]
    town = [(500 + 30 * i, 30 * j, {"natural": "tree"}) for i in range(8) for j in range(8)]
    town += [(900, 900, {"amenity": "fountain"}), (920, 900, {"shop": "bakery", "name": "Brot"})]
    city = build_world([*park, *things, *town], [([0, 1, 2, 3, 0], {"leisure": "park"})])
    return city, at(city, (0, 0))


@pytest.fixture
def judge(world, make_description):
    """Evidence of statements at the viewpoint."""
    city, position = world
    return lambda *statements: find_evidence(
        position, city, compile_query(make_description(*statements), city)
    )


def test_what_is_true_speaks_for(judge):
    north, west, inside = judge(
        (BAKERY, "north", "me"), (BENCH, "west", "me"), ("me", "inside", PARK)
    )
    for evidence, osm in ((north, "node/5"), (west, "node/6"), (inside, "way/1")):
        assert evidence.verdict == "for"
        assert evidence.weight > 1
        assert [o.id for o in evidence.objects] == [osm]
        assert evidence.note == ""
    assert (north.objects[0].label, north.objects[0].name) == (BAKERY, "Kern")


def test_what_lies_elsewhere_speaks_against(judge):
    south, between = judge((BAKERY, "south", "me"), (BENCH, "north", BAKERY))
    assert south.verdict == between.verdict == "against"
    assert south.note == "from here it lies to the north"
    assert between.note == "from here it lies to the southwest"
    assert {o.id for o in between.objects} == {"node/5", "node/6"}


def test_what_is_not_there_speaks_against(judge):
    [missing] = judge((FOUNTAIN, "near", BENCH))
    assert missing.verdict == "against"
    assert missing.objects == ()
    assert missing.note == "nothing in sight fits it"


def test_what_is_denied(judge):
    false, true = judge(
        (BAKERY, "visible", "me", {"negated": True}), (FOUNTAIN, "visible", "me", {"negated": True})
    )
    assert false.verdict == "against"
    assert false.note == "but it is present"
    assert false.objects[0].id == "node/5"
    assert true.verdict in ("for", "silent")


def test_what_cannot_be_used_is_silent_and_comes_last(judge):
    zoo = ("tourism=zoo", "north", "me")
    bakery, last = judge(zoo, (BAKERY, "north", "me"))
    assert bakery.verdict == "for"
    assert [e.verdict for e in judge(zoo)] == ["silent"]
    assert (last.verdict, last.weight, last.objects) == ("silent", 0.0, ())
    assert "not on the map" in last.note


def test_a_place_where_nothing_is(world, make_description):
    city, _ = world
    query = compile_query(make_description((BAKERY, "north", "me"), (BENCH, "west", BAKERY)), city)
    for evidence in find_evidence(np.array([-9000.0, 9000.0]), city, query):
        assert evidence.verdict == "against"
        assert evidence.objects == ()


def test_statements_in_words(world, make_description):
    city, _ = world
    description = make_description(
        (BAKERY, "north", "me"),
        ("me", "near", BENCH, {"negated": True}),
        (BENCH, "between", "Kern", {"target2": BAKERY}),
        (BENCH, "southwest", "Kern", {"text": "The bench is south-west of Kern"}),
    )
    query = compile_query(description, city)
    words = [quote_statement(s, query) for s in description.statements]
    assert words == [
        "bakery is north of me", "I am not near bench", "bench is between Kern and bakery",
        "The bench is south-west of Kern",
    ]  # fmt: skip


@given(st.floats(-10, 10))
def test_winds(angle):
    names = ["north", "northeast", "east", "southeast", "south", "southwest", "west", "northwest"]
    off = [abs((angle - i * np.pi / 4 + np.pi) % (2 * np.pi) - np.pi) for i in range(8)]
    assert off[names.index(name_bearing(angle))] <= np.pi / 8 + 1e-9


def test_positions_that_lie_far_apart_are_judged_each_by_itself(harbour):
    query = compile_query(parse(harbour, "A bakery is north of me."), harbour)
    here, away = np.zeros(2), np.full(2, 30_000.0)  # from where nothing is in sight
    both, served = score_positions(np.array([here, away]), harbour, query)
    assert both[0] == pytest.approx(score_positions(here[None], harbour, query)[0][0])
    assert both[1] == pytest.approx(score_positions(away[None], harbour, query)[0][0])
    assert (served[1] == -1).all()
