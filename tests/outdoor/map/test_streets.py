import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from tests.cities import PLANE

from placegraph.core.estimate import Status
from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.search.locate import find_evidence
from placegraph.outdoor.search.request import parse
from placegraph.outdoor.search.status import AT_A_PLACE, Diagnostics, find_uncertainty
from placegraph.view import write_page

MAIN, BROADWAY, OAK, TENTH, ELEVENTH = (
    "Main Street", "West Broadway", "Oak Street", "West 10th Avenue", "West 11th Avenue",
)  # fmt: skip


def house(number, street, east, north):
    return (east, north, {"building": "yes", "addr:housenumber": number, "addr:street": street})


@pytest.fixture
def city(build_world):
    """Three streets to the north cross three to the east, 200 m apart; a few houses have numbers."""
    ends = [(MAIN, 0, -50, 0, 450), (OAK, 200, -50, 200, 450), ("The Crescent", 600, 0, 600, 90)]
    ends += [
        (name, -50, north, 450, north)
        for name, north in ((BROADWAY, 0), (TENTH, 200), (ELEVENTH, 400))
    ]
    nodes = [(float(e), float(n), {}) for _, a, b, c, d in ends for e, n in ((a, b), (c, d))]
    ways = [
        ((2 * i, 2 * i + 1), {"highway": "residential", "name": name})
        for i, (name, *_) in enumerate(ends)
    ]
    houses = [
        house("100", TENTH, 0.0, 210.0), house("200", TENTH, 200.0, 210.0),
        house("100", BROADWAY, 0.0, 10.0), house("300", BROADWAY, 400.0, 10.0),
    ]  # fmt: skip
    return build_world([*nodes, *houses], ways)


@pytest.fixture
def place(city):
    """Find the sites of a text: words and first place, against the crossing of Main and Broadway."""
    streets = city.name_index.streets
    (origin,) = streets.resolve("Main Street & West Broadway")

    def find(text):
        return [
            (text[s.start : s.end], *np.round(s.positions.mean(axis=0) - origin, -1))
            for s in streets.find_sites(text)
        ]

    return find


@pytest.mark.parametrize(
    ("text", "words", "east", "north"),
    [
        ("NE corner of Main St & W 10th Ave", "NE corner of Main St & W 10th Ave", 0, 200),
        ("I'm at the corner of Oak and Broadway.", "the corner of Oak and Broadway", 200, 0),
        ("10th & Oak", "10th & Oak", 200, 200),
        ("OAK ST @ WEST BROADWAY", "OAK ST @ WEST BROADWAY", 200, 0),
        ("a bench at oak street and west 10th", "oak street and west 10th", 200, 200),
        ("On Oak between Broadway and 10th.", "Oak between Broadway and 10th", 200, 100),
        ("between Broadway and 10th on Oak", "between Broadway and 10th on Oak", 200, 100),
        ("the north end of Main Street", "the north end of Main Street", 0, 450),
        ("a bench at the end of West 10th Avenue", "the end of West 10th Avenue", 200, 200),
        ("Main Street between 10th and 11th Avenues", "Main Street between 10th and 11th Avenues", 0, 300),
    ],
)  # fmt: skip
def test_crossings_and_blocks(place, text, words, east, north):
    assert place(text) == [(words, east, north)]


@pytest.mark.parametrize(
    ("text", "east", "north"),
    [
        ("200 W 10th Ave", 200, 210),  # as mapped
        ("150 West 10th", 100, 200),  # between its neighbours
        ("200 Broadway", 200, 0),
        ("180 West 11th Avenue", 160, 400),  # by the numbers of parallel streets
        ("West 10th Avenue 200", 200, 210),  # as most of the world writes
    ],
)
def test_house_numbers(place, text, east, north):
    ((words, *found),) = place(text)
    assert words == text
    assert np.hypot(found[0] - east, found[1] - north) < 50.0


def test_a_number_on_streets_of_one_name_in_two_towns(build_world):
    houses = [house("12", OAK, e, 20.0) for e in (0.0, 5000.0)]
    ends = [(e, 0.0, {}) for e in (0.0, 100.0, 5000.0, 5100.0)]
    way = {"highway": "residential", "name": OAK}
    city = build_world([*houses, *ends], [((2, 3), way), ((4, 5), way)])
    east = city.name_index.streets.resolve("12 Oak Street")[:, 0]
    assert np.ptp(east) == pytest.approx(5000.0, abs=10.0)


@pytest.mark.parametrize(
    "text",
    [
        "Main Street and Oak Street",  # they never meet
        "A bench is between Main Street and Oak Street.",
        "near two fountains and the main entrance",
        "9000 Oak Street",
        "On West 10th Avenue 200 metres east of here.",
        "At the end of the line, and at the end of oak floors.",
        "",
    ],
)
def test_other_words_are_no_sites(place, text):
    assert place(text) == []


@pytest.mark.parametrize(
    "text",
    [
        "Southwest corner of Oak & 10th.",
        "I'm at the corner of Oak and 10th.",
        "The fountain at the corner of Oak and 10th",
        "Ich bin an der Ecke Oak und 10th.",
        "Estoy en la esquina de Oak y 10th.",
        "Je suis à l'angle de Oak et 10th.",
        "Я на углу Oak и 10th.",
        "Sono all'angolo tra Oak e 10th.",
    ],
)
def test_a_text_is_located_at_a_crossing(city, text):
    found = city.locate(text)
    (goal,) = city.name_index.find_places("Oak & 10th")
    assert (
        np.hypot(*(city.plane.to_plane([found.best.longitude, found.best.latitude]) - goal)) < 30.0
    )
    assert found.best.evidence[0].verdict == "for"


def test_the_reason_counts_places_that_are_not_listed(city):
    one, five = (city.locate("Main between 10th and 11th", top=top) for top in (1, 5))
    assert len(one.modes) == 1 < len(five.modes)
    assert one.reason == five.reason


@pytest.mark.parametrize(
    ("width", "near", "text", "reason"),
    [
        (60.0, 1.0, "I'm in Elm Park.", ""),
        (60.0, 1.0, "I'm in Elm Park. Quill and Page is north of me.", "“Quill and Page” does not fit"),
        (60.0, 1.0, "I'm in Elm Park. The Xyzal bookshop is here.", "“Xyzal” does not fit"),
        (60.0, 1.0, "I'm in Elm Park. There is no park.", ""),
        (60.0, 0.98, "I'm in Elm Park. There is no park.", "Only 1 of 2 statements fit"),
        (
            60.0, 1.0, "I'm in Elm Park. There is no park. There is a silo and a quay.",
            "Only 1 of 4 statements fit the best place, so it cannot be sure.",
        ),
        (900.0, 1.0, "I'm in Elm Park.", "“Elm Park” is more than .* m wide; say where in it."),
        (900.0, 1.0, "Elm Park is north of me. I'm in Elm Park.", "“Elm Park” is more than"),
    ],
)  # fmt: skip
def test_findings_that_forbid_ok(build_world, width, near, text, reason):
    park, shop = (
        {"leisure": "park", "name": "Elm Park"},
        {"shop": "books", "name": "Quill and Page"},
    )
    corners = [(e, n, {}) for e, n in ((0.0, 0.0), (width, 0.0), (width, 60.0), (0.0, 60.0))]
    city = build_world([*corners, (900.0, 900.0, shop)], [((0, 1, 2, 3, 0), park)])
    best = city.locate("I'm in Elm Park.").best
    query = compile_query(parse(city, text), city)
    at = city.plane.to_plane((best.longitude, best.latitude))
    best = replace(best, explain=partial(find_evidence, at, city, query))
    found = Diagnostics(best=1.0, near_best=near, claim=AT_A_PLACE)
    assert re.match(reason or "$", find_uncertainty(best, query, city, found))


def test_nothing_is_on_a_street_out_of_sight(build_world):
    """The bank on Oak Street may be missing; another 220 m away from the street is not the one."""
    line = [(0.0, 0.0, {}), (600.0, 0.0, {})]
    banks = [(300.0, n, {"amenity": "bank", "name": "Rexbank"}) for n in (10.0, 220.0)]
    city = build_world(
        [*line, *banks], [((0, 1), {"highway": "residential", "name": "Oak Street"})]
    )
    query = compile_query(parse(city, "I'm at the Rexbank on Oak Street."), city)
    at = sorted(city.objects.center[city.objects.kind == 0].tolist(), key=lambda at: at[1])
    near, far = (find_evidence(np.array(each), city, query)[1].weight for each in at)
    assert near > far + 5.0


@pytest.mark.parametrize(("width", "radius"), [(60.0, 250.0), (900.0, 900.0)])
def test_an_area_is_sure_within_its_own_radius(build_world, tmp_path, width, radius):
    corners = [(e, n, {}) for e, n in ((0.0, 0.0), (width, 0.0), (width, 60.0), (0.0, 60.0))]
    area = {"leisure": "park", "name": "Elm Park"}
    far = (2000.0, 2000.0, {"shop": "books", "name": "Quill and Page"})
    city = build_world([*corners, far], [((0, 1, 2, 3, 0), area)])
    found = city.locate("I'm in Elm Park.")
    assert found.status is Status.OK
    assert found.to_dict()["radius"] == found.radius <= radius
    page = write_page(city, found, tmp_path / "page.html").read_text()
    said = f"within {found.radius:.0f} m"
    assert said in found.reason
    assert "any of them" not in found.reason or width < 100.0
    assert said in page
    doubt = city.locate("I'm in Elm Park, by the gondola ticket booth.")
    assert (doubt.status is Status.OK) == (width < 100.0)


def test_what_a_map_lacks_does_not_drown_a_name(build_world):
    """A fountain far away is no reason to leave the park that is named."""
    park = {"leisure": "park", "name": "Elm Park"}
    corners = [(e, n, {}) for e, n in ((0.0, 0.0), (60.0, 0.0), (60.0, 60.0), (0.0, 60.0))]
    far = [(900.0, 900.0, {"amenity": "drinking_water"}), (905.0, 905.0, {"amenity": "bench"})]
    city = build_world([*corners, *far], [((0, 1, 2, 3, 0), park)])
    found = city.locate("I'm at the drinking fountain in Elm Park. There is a bench.")
    east, north = city.plane.to_plane(
        (found.best.longitude, found.best.latitude)
    ) - city.plane.to_plane(PLANE.to_lonlat((30.0, 30.0)))
    assert np.hypot(east, north) < 60.0
