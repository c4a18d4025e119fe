import numpy as np

from placegraph.core.estimate import Status
from placegraph.demo.town import ON_THE_WAY

CLEAR = (
    "I'm on Lange Straße. A bakery is north of me, a tram stop is south of me, "
    "and the church is to the southeast."
)
AMBIGUOUS = "I am standing on a square. There is a fountain north of me and a café to my east."


def apart(town, mode, lonlat):
    here, there = town.plane.to_plane([(mode.longitude, mode.latitude), lonlat])
    return float(np.hypot(*(here - there)))


def test_the_clear_sentence_finds_its_place(harbour, hafenstadt):
    estimate = harbour.locate(CLEAR)
    assert estimate.status is Status.OK
    assert apart(hafenstadt, estimate.best, hafenstadt.position("x")) < 30.0


def test_the_ambiguous_sentence_finds_both_squares(harbour, hafenstadt):
    estimate = harbour.locate(AMBIGUOUS)
    assert estimate.status is Status.AMBIGUOUS
    squares = [hafenstadt.position(","), hafenstadt.position(";")]
    nearest = {min(squares, key=lambda s: apart(hafenstadt, m, s)) for m in estimate.modes[:2]}
    assert nearest == set(squares)
    assert all(min(apart(hafenstadt, m, s) for s in squares) < 40.0 for m in estimate.modes[:2])
    assert estimate.next_question(harbour) is not None


def test_the_way_tells_the_two_squares_apart(harbour, hafenstadt):
    tracker = harbour.track()
    first, moved, last = (tracker.tell(text) for text in ON_THE_WAY)
    assert first.status is moved.status is Status.AMBIGUOUS
    assert last.status is Status.OK
    at = (last.best.longitude, last.best.latitude)
    places = [at, hafenstadt.position("V"), hafenstadt.position(",")]
    here, library, square = hafenstadt.plane.to_plane(places)
    east, north = library - here
    assert 0.0 < east < 60.0
    assert abs(north) < east
    assert 60.0 < square[1] - here[1] < 140.0
    alone = harbour.locate(ON_THE_WAY[-1])
    assert alone.best.probability < last.best.probability
