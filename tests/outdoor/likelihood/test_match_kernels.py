import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.outdoor.likelihood.match_kernels import MAX_OBJECTS
from placegraph.outdoor.map.directions_kernels import direction_table
from placegraph_lab.worlds.town.town import Town

FOUNTAIN, BENCH, BAKERY = "amenity=fountain", "amenity=bench", "shop=bakery"
CHURCH, TREE, STOP = "amenity=place_of_worship", "natural=tree", "highway=bus_stop"
ROAD, PARK = "highway=primary", "leisure=park"


def tags(label, **more):
    key, _, value = label.partition("=")
    return {key: value} | more


@pytest.fixture
def around(build_world, at):
    """City of things around (0, 0), with a town of benches, trees and stops far to the east.

    Returns the city and a function from east and north around (0, 0) to positions in it.
    """

    def make(nodes=(), ways=(), relations=()):
        town = [
            (600.0 + 40.0 * i, 40.0 * j, tags((BENCH, TREE, STOP, "shop=kiosk")[(i + j) % 4]))
            for i in range(12)
            for j in range(12)
        ]
        city = build_world([*nodes, *town], ways, relations)
        return city, lambda *p: at(city, p)

    return make


@pytest.fixture
def weight(score):
    """Log-likelihood ratio of one statement at a place, or of all of them together."""

    def of(city, description, position):
        return float(score(city, description, position)[0][0])

    return of


@pytest.mark.parametrize("target", ["me", BAKERY])
def test_directions_are_soft(target, around, make_description, weight):
    city, p = around([(0, 15, tags(FOUNTAIN)), (0, -15, tags(BAKERY)), (9, 0, tags(BENCH))])

    def weigh_statement(degrees):
        return weight(
            city, make_description((FOUNTAIN, float(np.radians(degrees)), target)), p(0, 0)
        )

    exact, a_little, much, opposite = map(weigh_statement, (0, 50, 90, 180))
    assert exact - a_little > 0.5
    assert a_little - opposite > 1.0
    assert much - opposite < 0.5
    assert weigh_statement(20) > exact - 0.3
    for degrees in (10, 45, 70, 120):
        assert weigh_statement(degrees) == pytest.approx(weigh_statement(-degrees), abs=0.1)
    inverse = weight(city, make_description((target, "south", FOUNTAIN)), p(0, 0))
    assert inverse == pytest.approx(exact, abs=0.02), "A north of B is B south of A"


def test_loosely_meant_directions_are_softer(around, make_description, weight):
    city, p = around([(0, 15, tags(FOUNTAIN)), (5, -5, tags(BENCH))])

    def weigh_statement(degrees, sigma):
        bearing = float(np.radians(degrees))
        statement = (FOUNTAIN, bearing, "me", {"bearing_sigma": sigma})
        return weight(city, make_description(statement), p(0, 0))

    assert weigh_statement(60, 0.8) > weigh_statement(60, 0.5) > weigh_statement(60, 0.25)
    assert weigh_statement(0, 0.25) > weigh_statement(90, 0.25) + 2


@given(st.floats(0.1, 1.2), st.floats(0, 0.5))
def test_direction_tables_fall_from_ahead_to_behind(sigma, slip):
    table = direction_table(sigma, slip)
    assert (np.diff(table) >= -1e-6).all()
    assert 0 <= table[0] <= slip * 0.25 + 0.5
    assert table[-1] <= 1
    assert np.isfinite(table).all()


def test_no_direction_where_two_things_are_one_place(around, make_description, weight):
    city, p = around([(0, 0, tags(FOUNTAIN)), (5, -5, tags(BENCH))])
    heard = [
        weight(city, make_description((FOUNTAIN, w, "me")), p(0, 0))
        for w in ("north", "south", "east")
    ]
    assert np.ptp(heard) < 0.05
    assert np.isfinite(heard).all()


def test_one_road_for_two_sentences_beats_two(around, make_description, weight):
    """A road runs between bakery and church, another one past them."""
    one, p = around(
        [(0, -60, {}), (0, 60, {}), (-12, 6, tags(BAKERY)), (12, -6, tags(CHURCH)),
         (-60, 24, {}), (60, 24, {})],
        [([0, 1], tags(ROAD)), ([4, 5], tags(ROAD))],
    )  # fmt: skip
    position = p(4, 4)
    text = make_description((BAKERY, "west", ROAD), (CHURCH, "east", ROAD))
    apart = make_description((BAKERY, "west", ROAD), (CHURCH, "east", f"{ROAD}#2"))
    assert weight(one, text, position) > weight(one, apart, position) + 0.02
    torn = make_description(
        (BAKERY, "west", ROAD), (CHURCH, "south", ROAD)
    )  # which only the other road serves
    torn_apart = make_description((BAKERY, "west", ROAD), (CHURCH, "south", f"{ROAD}#2"))
    assert weight(one, torn, position) < weight(one, torn_apart, position) - 0.02


def test_coherence_prefers_where_one_thing_serves_all(make_description, score, build_world, at):
    """At one place a bench is north and in the park; at the other these are two benches."""
    park = [(-10, -10, {}), (10, -10, {}), (10, 10, {}), (-10, 10, {})]

    def place(east, *benches):
        return [(e + east, n, t) for e, n, t in (*park, *((x, y, tags(BENCH)) for x, y in benches))]

    whole = [*place(0, (0, 8), (0, -18)), (0, -5, tags(FOUNTAIN))]
    torn = [*place(400, (0, -8), (0, 18)), (400, -5, tags(FOUNTAIN))]
    start = len(whole)
    city = build_world(
        [*whole, *torn],
        [([0, 1, 2, 3, 0], tags(PARK)), ([start + i for i in (0, 1, 2, 3, 0)], tags(PARK))],
    )
    text = make_description((BENCH, "north", "me"), (BENCH, "inside", PARK))
    positions = [at(city, (0, 0)), at(city, (400, 0))]
    together, _, served = score(city, text, positions, together=0.9)
    apart, _, _ = score(city, text, positions, together=0.0)
    assert together[0] - together[1] > apart[0] - apart[1] + 0.05
    assert served[0, 0, 0] == served[0, 1, 0], "one bench serves both"


def test_one_bench_cannot_be_north_of_itself(around, make_description, weight):
    city, p = around([(0, 12, tags(BENCH)), (12, 0, tags(FOUNTAIN)), (3, 3, tags(BAKERY))])
    two, q = around([(0, 12, tags(BENCH)), (0, -12, tags(BENCH)), (3, 3, tags(BAKERY))])
    text = make_description((BENCH, "north", f"{BENCH}#2"))
    assert weight(two, text, q(0, 0)) > weight(city, text, p(0, 0)) + 1


def test_served_are_the_right_things(around, make_description, score):
    things = [(0, 15, FOUNTAIN), (0, -15, FOUNTAIN), (15, 0, BENCH), (-15, 0, BENCH)]
    city, p = around([(east, north, tags(label)) for east, north, label in things])
    _, _, served = score(
        city,
        make_description((FOUNTAIN, "south", "me"), (BENCH, "west", "me")),
        p(0, 0),
        together=0.9,
    )
    [[fountain, _], [bench, _]] = served[0]
    np.testing.assert_allclose(city.objects.center[fountain] - p(0, 0), (0, -15), atol=1)
    np.testing.assert_allclose(city.objects.center[bench] - p(0, 0), (-15, 0), atol=1)


def test_near(around, make_description, weight):
    city, p = around([(0, 0, tags(BAKERY)), (5, 3, tags(BENCH))])
    heard = [
        weight(city, make_description(("me", "near", BAKERY)), p(-x, 0)) for x in (3, 20, 30, 60)
    ]
    assert heard == sorted(heard, reverse=True)
    assert heard[0] > heard[-1] + 2
    close, p = around([(0, 8, tags(BAKERY)), (4, 10, tags(FOUNTAIN))])
    apart, q = around([(0, 22, tags(BAKERY)), (0, -22, tags(FOUNTAIN))])
    text = make_description((BAKERY, "near", FOUNTAIN))
    assert weight(close, text, p(0, 0)) > weight(apart, text, q(0, 0)) + 0.5


def park_world():
    square = [(-30, -30, {}), (30, -30, {}), (30, 30, {}), (-30, 30, {})]
    hole = [(-5, -5, {}), (5, -5, {}), (5, 5, {}), (-5, 5, {})]
    nodes = [*square, *hole, (20, 20, tags(FOUNTAIN)), (45, 0, tags(FOUNTAIN)), (0, 0, tags(BENCH))]
    ways = [([0, 1, 2, 3, 0], {}), ([4, 5, 6, 7, 4], {})]
    return nodes, ways, [([(0, "outer"), (1, "inner")], tags(PARK))]


def test_inside(around, make_description, weight):
    city, p = around(*park_world())
    text = make_description(("me", "inside", PARK))
    inside, edge, beside, away = (weight(city, text, p(x, 15)) for x in (0, 29, 45, 90))
    assert inside == pytest.approx(edge, abs=0.5)
    assert inside > beside + 0.5
    assert beside > away
    assert weight(city, text, p(0, 0)) <= inside + 1e-3, "in a hole of the park"
    assert weight(city, make_description((FOUNTAIN, "inside", PARK)), p(15, 10)) > 2
    assert weight(city, make_description((STOP, "inside", PARK)), p(15, 10)) < 0
    negated = make_description(("me", "inside", PARK, {"negated": True}))
    assert weight(city, negated, p(15, 15)) < weight(city, negated, p(120, 0)) - 0.5


def test_along(around, make_description, weight):
    road = [(-80, 0, {}), (80, 0, {})]
    city, p = around([*road, (0, 4, tags(BAKERY)), (40, 25, tags(BAKERY))], [([0, 1], tags(ROAD))])
    text = make_description(("me", "along", ROAD))
    on, beside, away = (weight(city, text, p(-20, y)) for y in (1, 20, 60))
    assert on > beside > away
    assert weight(city, make_description((BAKERY, "along", ROAD)), p(0, 10)) > 1


def test_across(around, make_description, weight):
    road = [(-80, 0, {}), (80, 0, {})]
    city, p = around([*road, (0, 12, tags(BAKERY))], [([0, 1], tags(ROAD))])
    text = make_description((BAKERY, "across", "me", {"target2": ROAD}))
    across, at_it, away = (weight(city, text, p(0, y)) for y in (-8, 12, -120))
    assert across > at_it
    assert across > away + 1


def test_between(around, make_description, weight):
    city, p = around([(-18, 0, tags(BAKERY)), (18, 0, tags(FOUNTAIN)), (0, 4, tags(BENCH))])
    me = make_description(("me", "between", BAKERY, {"target2": FOUNTAIN}))
    between, aside, beyond = (weight(city, me, p(*q)) for q in ((0, 0), (0, 20), (25, 0)))
    assert between > aside > beyond
    assert between > beyond + 1
    bench = make_description((BENCH, "between", BAKERY, {"target2": FOUNTAIN}))
    assert weight(city, bench, p(0, 0)) > 1
    other = make_description((BAKERY, "between", BENCH, {"target2": FOUNTAIN}))
    assert weight(city, bench, p(0, 0)) > weight(city, other, p(0, 0)) + 1


def test_distances(around, make_description, weight):
    city, p = around([(0, 0, tags(BAKERY)), (2, 2, tags(BENCH))])

    def weigh_statement(said_m, true_m):
        statement = ("me", "near", BAKERY, {"distance": float(said_m)})
        return weight(city, make_description(statement), p(0, -true_m))

    assert weigh_statement(10, 10) > weigh_statement(30, 10) > weigh_statement(60, 10)
    assert weigh_statement(30, 30) > weigh_statement(30, 5)
    assert weigh_statement(30, 30) > weigh_statement(30, 80)
    assert weigh_statement(60, 60) > weigh_statement(60, 5), "from out of sight too"
    assert weigh_statement(100, 100) > weigh_statement(100, 10)
    direction = [
        weight(city, make_description((BAKERY, "north", "me", {"distance": d})), p(0, -25))
        for d in (25.0, 70.0)
    ]
    assert direction[0] > direction[1] + 0.5


NEGATIONS = [
    (BAKERY, "visible", "me"), (BAKERY, "near", "me"), ("me", "near", BAKERY),
    ("me", "same", BAKERY), (BAKERY, "north", "me"), ("me", "south", BAKERY),
    (BAKERY, "near", BENCH), (BAKERY, "north", BENCH),
]  # fmt: skip


@pytest.mark.parametrize("statement", NEGATIONS, ids=str)
def test_negation_turns_a_statement_round(statement, around, make_description, weight):
    city, p = around([(0, 5, tags(BAKERY)), (0, -6, tags(BENCH)), (90, 0, tags(FOUNTAIN))])
    no = make_description((*statement, {"negated": True}))
    there, elsewhere = weight(city, no, p(0, 0)), weight(city, no, p(85, 0))
    assert there < elsewhere - 0.5, "what is denied is there"
    assert elsewhere == pytest.approx(0, abs=0.15)
    yes = make_description(statement)
    assert weight(city, yes, p(0, 0)) > weight(city, yes, p(85, 0)) + 1


def test_a_denied_direction_spares_the_others(around, make_description, weight):
    city, p = around([(0, 10, tags(BAKERY)), (9, -6, tags(BENCH))])
    north = weight(city, make_description((BAKERY, "north", "me", {"negated": True})), p(0, 0))
    south = weight(city, make_description((BAKERY, "south", "me", {"negated": True})), p(0, 0))
    assert south > north + 0.5


@pytest.mark.parametrize("there", [1, 2, 4])
def test_numbers(there, around, make_description, weight):
    trees = [(6 * i - 9, 12 + (i % 2), tags(TREE)) for i in range(there)]
    city, p = around([*trees, (8, -8, tags(FOUNTAIN)), (-8, -8, tags(BENCH))])
    heard = {
        n: weight(city, make_description((TREE, "north", "me", {"count": n})), p(0, 0))
        for n in (1, 2, 4, 12)
    }
    assert max(heard, key=heard.get) == there
    assert heard[there] > heard[12] + 0.5
    if there == 4:
        four, one = (
            weight(city, make_description((TREE, "north", FOUNTAIN, {"count": n})), p(0, 0))
            for n in (4, 1)
        )
        assert four > one


def test_rare_things_say_more(around, make_description, weight):
    city, p = around([(0, 10, tags(BAKERY)), (0, 12, tags(BENCH))])
    rare = weight(city, make_description((BAKERY, "north", "me")), p(0, 0))
    common = weight(city, make_description((BENCH, "north", "me")), p(0, 0))
    assert rare > common + 1


def test_names_say_more_than_kinds(around, make_description, weight):
    nodes = [(0, 10, tags(BAKERY, name="Kern")), (0, 300, tags(BAKERY, name="Brot"))]
    city, p = around(nodes)
    name, kind, wrong = (
        weight(city, make_description((what, "north", "me")), p(0, 0))
        for what in ("Kern", BAKERY, "Brot")
    )
    assert name > kind
    assert name > wrong + 2


def test_hedged_statements_say_less(around, make_description, weight):
    city, p = around([(0, 10, tags(BAKERY)), (9, -6, tags(BENCH))])

    def weights(what):
        texts = (make_description((what, "north", "me", {"certainty": c})) for c in (1.0, 0.5, 0.1))
        return [weight(city, text, p(0, 0)) for text in texts]

    right, wrong = weights(BAKERY), weights(STOP)
    assert right == sorted(right, reverse=True)
    assert wrong == sorted(wrong)
    assert right[-1] > 0 > wrong[-1]


def test_statements_add_up(around, make_description, weight):
    city, p = around([(0, 10, tags(BAKERY)), (10, 0, tags(FOUNTAIN)), (-5, -5, tags(BENCH))])
    one, two = (BAKERY, "north", "me"), (FOUNTAIN, "east", "me")
    both = weight(city, make_description(one, two), p(0, 0))
    alone = weight(city, make_description(one), p(0, 0)) + weight(
        city, make_description(two), p(0, 0)
    )
    assert both == pytest.approx(alone, abs=0.05)
    assert weight(city, make_description(two, one), p(0, 0)) == pytest.approx(both, abs=1e-3)


def test_moving_the_world_changes_nothing(make_city, make_description, score):
    here = Town.load("hafenstadt")
    text = make_description(
        (BENCH, "near", "me"), ("amenity=cafe", "east", BENCH), ("me", "inside", "place=square")
    )
    totals = []
    for center in (here.center, (-58.4, -53.0), (179.9999, 53.5511)):
        town = replace(here, center=center)
        city = make_city(town)
        spots = itertools.product(range(0, 40, 6), range(0, 88, 8))
        at = [city.plane.to_plane(town.lonlat(*spot)) for spot in spots]
        totals.append(score(city, text, at)[0])
    # coordinates are stored in steps of half a metre, and so differ a little
    for moved in totals[1:]:
        assert np.median(np.abs(moved - totals[0])) < 0.05
        assert abs(moved.max() - totals[0].max()) < 0.3


def test_more_things_than_are_weighed(around, make_description, weight):
    """Of a crowd only so many things are looked at; that must not run over."""
    crowd = [(0.5 * (i % 20) - 5, 0.5 * (i // 20) + 2, tags(TREE)) for i in range(3 * MAX_OBJECTS)]
    city, p = around([*crowd, (0, -5, tags(BENCH))])
    text = make_description(
        (TREE, "north", "me"), (TREE, "north", BENCH), (BENCH, "near", f"{TREE}#2")
    )
    assert np.isfinite(weight(city, text, p(0, 0)))
    assert weight(city, make_description((TREE, "north", "me")), p(0, 0)) > -1


def test_things_nobody_sees(around, make_description, score):
    city, p = around([(0, 10, tags(BAKERY))])
    far_off = score(
        city, make_description((BAKERY, "north", BENCH), (BENCH, "near", "me")), p(-5000, -5000)
    )
    assert np.isfinite(far_off[0]).all()
    assert (far_off[1] <= 0).all()
    assert (far_off[2] == -1).all()
