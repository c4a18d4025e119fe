import numpy as np
import pytest

from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.search.request import parse

BENCHES = [(40.0 * i, 40.0 * j, {"amenity": "bench"}) for i in range(50) for j in range(50)]
LANDMARKS = [(10.0, 5.0, {"name": "Avenues"}), (120.0, 85.0, {"amenity": "bank", "name": "Dubs"})]


ENDS = [(200.0, 3.0, {}), (230.0, 3.0, {})]
STREET = ([0, 1], {"highway": "residential", "name": "The Street"})


@pytest.fixture
def city(build_world):
    return build_world([*ENDS, *BENCHES, *LANDMARKS], [STREET])


@pytest.mark.parametrize(
    ("text", "unknown"),
    [
        ("I am on King Street West. A bench is north of me.", ("King Street West",)),
        ("I am at Dubs. A bench is north of Dubs.", ()),
        ("I am by the Dubs and Avenues.", ()),
        ("A bench is north of the bank.", ()),
        ("Marble Bank is north of me, on Elm St. I see Marble Bank.", ("Marble Bank", "Elm St")),
    ],
)
def test_names_that_the_map_lacks_are_told(text, unknown, city):
    query = compile_query(parse(city, text), city)
    names = [query.description.mentions[node].name for node in sorted(query.by_kind)]
    assert tuple(dict.fromkeys(names)) == unknown


def test_what_stands_in_for_an_unknown_name_gets_no_credit_for_being_rare(city, score, at):
    """One landmark called "Avenues" was every street, one bank any bank."""
    for text in ("I am on King Street West.", "I am next to Marble Bank."):
        here = parse(city, text)
        for place in (*LANDMARKS, (210.0, 5.0)):
            assert score(city, here, at(city, place[:2]))[0][0] < 4.0, text


def test_one_is_in_a_quarter_though_its_name_is_drawn_as_a_point(build_world, score, at):
    quarter = (5.0, 5.0, {"place": "neighbourhood", "name": "Kips Bay"})
    city = build_world([quarter, *BENCHES])
    inside, near = (parse(city, f"I am {how} Kips Bay.") for how in ("in", "next to"))
    away = at(city, (240.0, 5.0))
    assert score(city, inside, away)[0][0] > score(city, near, away)[0][0] + 1.0
    assert score(city, inside, at(city, (5.0, 5.0)))[0][0] > score(city, inside, away)[0][0]


def test_a_side_of_a_park_may_be_in_it(build_world, score, at):
    corners = [(0.0, 0.0, {}), (200.0, 0.0, {}), (200.0, 200.0, {}), (0.0, 200.0, {})]
    park = ([*range(4), 0], {"leisure": "park", "name": "Elm Park"})
    city = build_world([*corners, *BENCHES], [park])
    north, south = ((100.0, 170.0), (100.0, 30.0))
    for text in ("I'm in Elm Park. North side.", "I'm on the north side of Elm Park."):
        found = parse(city, text)
        assert score(city, found, at(city, north))[0][0] > (
            score(city, found, at(city, south))[0][0] + 0.2
        ), text


def test_a_kind_written_small_is_no_name_that_binds(build_world):
    named = (400.0, 400.0, {"building": "yes", "name": "Field House"})
    hall = (20.0, 20.0, {"amenity": "bank", "name": "Dubs Hall"})
    city = build_world([*BENCHES, named, hall])
    assert parse(city, "I'm at Dubs Hall, by the field house.").mentions[-1].name == ""
    assert parse(city, "i'm at dubs hall, by the field house").mentions[-1].name == "field house"


def test_one_stands_at_the_place_of_a_thing_that_no_word_is_known_for(city):
    query = compile_query(parse(city, "I'm at the flurb near Dubs."), city)
    assert [(s.source, query.description.mentions[s.target].name) for s in query.used] == [
        (0, "Dubs")
    ]


def test_a_place_that_is_named_exactly_is_rare_in_a_small_town_too(build_world):
    town = build_world([(0.0, 0.0, {"amenity": "cafe", "name": "Kern"}), (60.0, 0.0, {})])
    query = compile_query(parse(town, "I am at Kern."), town)
    assert np.log(query.statements.gain[0]) > 8.0


def test_a_roundabout_is_never_rare(build_world):
    shapes = [(0.0, 0.0, {"highway": "mini_roundabout"}), *BENCHES]
    town = build_world(shapes)
    gains = [
        compile_query(parse(town, text), town).statements.gain[0]
        for text in ("There is a mini roundabout.", "There is a bench.")
    ]
    assert gains[0] < 20.0 * gains[1]
