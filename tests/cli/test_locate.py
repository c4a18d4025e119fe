"""`placegraph locate`: a world from the shell."""

import pytest

from placegraph_lab.worlds.town.town import Town

TOWN = """
[drawing]
 LL    |   BB
 LL    |   BB
---1---+------

[legend]
1 road: highway=residential name=Lange Straße
L area: building=yes amenity=library name=Stadtbibliothek
B area: building=yes shop=bakery name=Bäckerei Kern
"""


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    from placegraph.outdoor.city import build_city

    folder = tmp_path_factory.mktemp("world")
    osm = Town.parse(TOWN).write_osm(folder / "town.osm")
    build_city(osm, folder / "town.city")
    return folder


def test_words_find_a_building(run, world):
    told = run("locate", world, "I am in the Stadtbibliothek", "--json")
    assert told.code == 0
    assert told.json["modes"][0]["probability"] > 0.5  # a map of four objects makes nothing sure
    plain = run("locate", world, "I am in the Stadtbibliothek")
    assert "I am in the Stadtbibliothek" in plain.out
    assert plain.err == ""


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        ([], 7, "The query is empty"),
        (["the library", "--frames", ":3"], 7, "--capture"),
        (["the library", "--near", "here"], 7, "--near"),
        (["the library", "--capture", "nowhere"], 3, "nowhere"),
        ([" "], 6, "empty"),
    ],
)
def test_bad_questions_are_typed_errors(run, world, arguments, code, says):
    result = run("locate", world, *arguments)
    assert result.code == code
    assert says in result.err
    assert "Traceback" not in result.err
