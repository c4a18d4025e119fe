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
