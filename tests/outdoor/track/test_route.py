"""A told way on a drawn grid: five streets to the east, five avenues to the north, 100 m apart."""

import math

import numpy as np
import pytest

from placegraph import Status
from placegraph.errors import OptionError
from placegraph.outdoor.track.route_answer import read_instructions
from placegraph.outdoor.track.route_text import Move, read_route

ENDS = [(-50.0, y, 450.0, y) for y in range(0, 500, 100)]
ENDS += [(x, -50.0, x, 450.0) for x in range(0, 300, 100)] + [(300.0, 0.0, 300.0, 200.0)]
NAMES = [f"{n} Street" for n in ("Ash", "Birch", "Cedar", "Dogwood", "Elm")]
NAMES += [f"{n} Avenue" for n in ("Jay", "Kite", "Lark", "Mew")]
SHOPS = [
    (115.0, 85.0, {"shop": "bakery", "name": "Rex"}),
    (250.0, 115.0, {"amenity": "bank", "name": "Chase"}),
    (215.0, 150.0, {"amenity": "pharmacy", "name": "Boots"}),
    (115.0, 30.0, {"shop": "florist", "name": "Flora"}),
    (85.0, 70.0, {"shop": "florist", "name": "Flora"}),
]
UNLIT = (100, 0)  # the junction without lights
EAST, NORTH = math.pi / 2, 0.0


@pytest.fixture
def grid(build_world):
    nodes = [(float(e), float(n), {}) for a, b, c, d in ENDS for e, n in ((a, b), (c, d))]
    ways = [
        ((2 * i, 2 * i + 1), {"highway": "residential", "name": name})
        for i, name in enumerate(NAMES)
    ]
    lights = [
        (float(x), float(y), {"highway": "traffic_signals"})
        for x in range(0, 400, 100) for y in range(0, 500, 100)
        if (x, y) != UNLIT and not (x == 300 and y > 200)
    ]  # fmt: skip
    return build_world([*nodes, *SHOPS, *lights], ways)


@pytest.fixture
def follow(grid, at):
    """End of a text [m east, north of Ash Street and Jay Avenue], begun at a place with a heading."""

    def find(text, start=(-30.0, 0.0), heading=EAST, **options):
        lonlat = grid.plane.to_lonlat(at(grid, start))
        estimate = grid.locate(text, listener=lonlat, heading=heading, **options)
        place = grid.plane.to_plane((estimate.best.longitude, estimate.best.latitude))
        return place - at(grid, (0.0, 0.0)), estimate

    return find


WAYS = """
Go to the second intersection and turn left. Stop halfway down the block. = 100 50
Go to the second light and turn left. Stop halfway down the block. = 200 50
Turn left at the third intersection. Go through a light and stop just before the next light. = 200 190
Turn left at the third intersection. Pass Boots, then turn right at the light. Stop immediately. = 210 200
Turn left at the first light. Turn right at the next light. Go through two lights. Stop at Chase. = 250 100
Go to the light and turn left, go two blocks and turn right. Walk 60 m and stop. = 60 200
Turn left at the fourth intersection. At the end of the street turn left. Stop immediately. = 290 200
Turn left at the second intersection. Stop at Flora on the left. = 100 70
Turn left at the second intersection. Stop when you see Flora on your right. = 100 30
Walk 200 m, then turn left at the intersection. Stop halfway down the block. = 200 50
Take the second street on the left. Stop halfway down the block. = 100 50
Take the second turning on the left. Stop halfway down the block. = 100 50
Take the third left. Stop halfway down the block. = 200 50
Carry on to the second crossroads and turn left. Stop halfway down the block. = 100 50
At the second set of traffic lights turn left. Stop halfway down the block. = 200 50
Turn left onto Lark Avenue. Stop just after Boots. = 200 165
Go past Kite Avenue and take the next left. Stop at Boots. = 200 150
Turn left into Kite Avenue, then take the first right. Stop at Chase. = 250 100
Cross Kite Avenue and turn left at the next junction. Stop just after Boots. = 200 165
Continue straight for three blocks and turn left. Stop halfway down the block. = 200 50
"""
"""Texts, and where their ways end [m east, north]; the first light is at the first junction."""


@pytest.mark.parametrize("line", WAYS.strip().splitlines())
def test_a_way_ends_where_the_text_says(follow, line):
    text, _, end = line.partition(" = ")
    place, estimate = follow(text)
    assert len(estimate.way) > 1
    assert np.hypot(*(place - np.array(end.split(), float))) < 20.0


def test_streets_that_are_simplified_meet_again(grid, at):
    graph = grid.street_graph
    assert len(graph.lights) == 18  # 15 crossings with three avenues, 3 with the short one
    assert graph.lights.sum() == 17
    assert (graph.tail[::2] == graph.head[1::2]).all()
    edge = int(np.argmin(np.hypot(*(graph.nodes[graph.head] - at(grid, (300.0, 200.0))).T)))
    north = [e for e in range(len(graph.tail)) if graph.head[e] == graph.head[edge]]
    assert sorted(int(graph.straight[e] >= 0) for e in north) == [0, 1, 1]  # the avenue ends there


def test_steps_of_a_text(grid):
    text = (
        "Go past the 1st light with Rex on the left corner and Chase. Turn right at the 3rd light. "
        "If you see Boots you went too far."
    )
    steps = read_route(text, grid)
    assert [s.move for s in steps] == [Move.PASS, Move.MARK, Move.MARK, Move.REACH, Move.TURN]
    assert (steps[3].amount, steps[3].is_ordinal, steps[4].amount) == (3.0, True, 90.0)
    assert not read_instructions("I turned left at the light. A bakery is on my left.", grid)
    assert not read_instructions("A bakery is on the left.", grid)


def test_the_way_and_its_evidence(follow, grid, at):
    text = "Go to the second light and turn left. Pass Boots on the right. Turn left at the light and stop."
    _, estimate = follow(text)
    way = grid.plane.to_plane(estimate.way) - at(grid, (0.0, 0.0))
    assert np.hypot(*(way[0] - (-30.0, 0.0))) < 6.0
    assert np.hypot(*(way - (200.0, 0.0)).T).min() < 1.0
    assert np.hypot(*np.diff(way, axis=0).T).max() < 6.0
    evidence = {e.statement: e for e in estimate.evidence}
    assert [o.name for o in evidence["Boots"].objects] == ["Boots"]
    assert {e.verdict for e in estimate.evidence} <= {"for", "silent"}
    assert evidence["Boots"].verdict == "for"
    assert estimate.to_dict()["way"] == estimate.way.tolist()
    assert [f["properties"]["kind"] for f in estimate.geojson()["features"]].count("way") == 1


def test_an_unknown_start_is_weighed_by_landmarks(grid, at):
    estimate = grid.locate("Pass Rex on the right. Turn left at the next light. Stop at Boots.")
    place = grid.plane.to_plane((estimate.best.longitude, estimate.best.latitude))
    assert np.hypot(*(place - at(grid, (200.0, 150.0)))) < 25.0
    assert estimate.status is not Status.LOST


def test_a_tracker_follows_instructions(grid, at):
    start = grid.plane.to_lonlat(at(grid, (-30.0, 0.0)))
    tracker = grid.track(near=start, radius=10.0, heading=EAST)
    text = "Go to the second light and turn left. Stop halfway down the block."
    estimate = tracker.tell(text)
    place = grid.plane.to_plane((estimate.best.longitude, estimate.best.latitude))
    assert np.hypot(*(place - at(grid, (200.0, 50.0)))) < 20.0
    assert abs(math.sin(tracker.heading - NORTH)) < 0.1
    assert tracker.history[-1].text == text
    more = tracker.move(0.0, 40.0)
    place = grid.plane.to_plane((more.best.longitude, more.best.latitude))
    assert np.hypot(*(place - at(grid, (200.0, 90.0)))) < 25.0


def test_a_heading_in_degrees_is_refused(grid):
    for ask in (
        lambda: grid.locate("A bank is left of me.", heading=356),
        lambda: grid.track(heading=356),
    ):
        with pytest.raises(OptionError, match=r"radians.*numpy.deg2rad\(356\)"):
            ask()
