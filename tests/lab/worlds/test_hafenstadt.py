import numpy as np
import pytest

from placegraph.core.estimate import Status
from placegraph.demo.town import ON_THE_WAY
from placegraph.outdoor.city import build_city
from placegraph_lab.worlds.town.town import Town

CLEAR = (
    "I'm on Lange Straße. A bakery is north of me, a tram stop is south of me, "
    "and the church is to the southeast."
)
AMBIGUOUS = "I am standing on a square. There is a fountain north of me and a café to my east."


@pytest.fixture(scope="module")
def town():
    return Town.load("hafenstadt")


@pytest.fixture(scope="module")
def city(town, tmp_path_factory):
    folder = tmp_path_factory.mktemp("hafenstadt")
    return build_city(town.write_osm(folder / "town.osm"), folder / "town.city")


def apart(town, mode, lonlat):
    there = town.plane.to_plane([(mode.longitude, mode.latitude), lonlat])
    return float(np.hypot(*(there[0] - there[1])))


def test_the_clear_sentence_finds_its_place(city, town):
    estimate = city.locate(CLEAR)
    assert estimate.status is Status.OK
    assert apart(town, estimate.best, town.position("x")) < 30.0


def test_the_ambiguous_sentence_finds_both_squares(city, town):
    estimate = city.locate(AMBIGUOUS)
    assert estimate.status is Status.AMBIGUOUS
    squares = [town.position(","), town.position(";")]
    nearest = {min(squares, key=lambda s: apart(town, m, s)) for m in estimate.modes[:2]}
    assert nearest == set(squares)
    assert all(min(apart(town, m, s) for s in squares) < 40.0 for m in estimate.modes[:2])
    assert estimate.next_question(city) is not None


def test_the_way_tells_the_two_squares_apart(city, town):
    tracker = city.track()
    first, moved, last = (tracker.tell(text) for text in ON_THE_WAY)
    assert first.status is moved.status is Status.AMBIGUOUS
    assert last.status is Status.OK
    here, library, square = town.plane.to_plane(
        [(last.best.longitude, last.best.latitude), town.position("V"), town.position(",")]
    )
    east, north = library - here
    assert 0.0 < east < 60.0
    assert abs(north) < east
    assert 60.0 < square[1] - here[1] < 140.0
    alone = city.locate(ON_THE_WAY[-1])
    assert alone.best.probability < last.best.probability
