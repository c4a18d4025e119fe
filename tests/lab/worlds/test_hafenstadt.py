from placegraph.core.estimate import Status
from placegraph.demo.town import ON_THE_WAY


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
