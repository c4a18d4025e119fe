import numpy as np
import pytest

import placegraph as pg
from placegraph.outdoor.search.ask import NO, NONE, YES, Question, Subject
from placegraph_lab.tables.named.outdoor_dialogue import Speaker, dialogue, distance
from placegraph_lab.tables.outdoor.queries import Query, load
from placegraph_lab.worlds.town.town import Town

TOWN = """
[town]
name = Zwei
center = 8.0 50.0
metres = 10

[drawing]
ppppppppp
ppFppppBp
ppppppppp
*********
----1----

[legend]
1 road: highway=residential name=Hauptweg
p area: leisure=park name=Volkspark
F: amenity=fountain
B: amenity=bench
*: natural=tree
"""


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    folder = tmp_path_factory.mktemp("zwei")
    town = Town.parse(TOWN)
    osm = town.write_osm(folder / "zwei.osm")
    return town, load(osm), pg.build_city(osm, folder / "zwei.city")


def yes_or_no(label, wind=""):
    return Question("Is there one?", (YES, NO), (Subject("it", label, wind),), 1.0)


def test_the_speaker_sees_things_in_their_direction_and_areas_around(world):
    town, bins, _ = world
    viewpoint = bins.city.plane.to_plane(town.position("F"))
    speaker = Speaker(bins, viewpoint + np.array([8.0, 0.0]))
    assert speaker.answer(yes_or_no("amenity=fountain", "west")).option == YES
    assert speaker.answer(yes_or_no("amenity=fountain", "east")).option == NO
    assert speaker.answer(yes_or_no("amenity=pub")).option == NO
    assert speaker.answer(yes_or_no("leisure=park")).option == YES
    for options, answer in ((("Volkspark", "Elsewhere"), "Volkspark"), (("A", "B"), NONE)):
        question = Question("Which?", (*options, NONE), tuple(map(Subject, options)), 1.0)
        assert speaker.answer(question).option == answer


@pytest.mark.parametrize("asking", ["best", "random"])
def test_a_dialogue_ends_and_never_asks_twice(world, asking):
    town, bins, city = world
    longitude, latitude = town.position("F")
    query = Query("There is a tree.", longitude, latitude, ())
    speaker = Speaker(bins, bins.city.plane.to_plane((longitude, latitude)))
    course = dialogue(city, query, speaker, asking, np.random.default_rng(0), most=6)
    assert 1 <= len(course) <= 7
    said = [s.text for s in course[-1].understood.statements]
    assert len(said) == len(set(said))
    assert np.isfinite(distance(course[-1], query, city))
