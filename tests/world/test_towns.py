"""On which street a building stands, and what it weighs where somebody says another one."""

import numpy as np
import pytest

from placegraph.world.estimate import WorldQuery
from placegraph.world.evidence import collect_evidence, match_outdoors
from placegraph.world.sentence import parse_sentence
from placegraph.world.towns import compare_address, find_roads


def corners(city, name):
    """Corners (4, 2) of a room in the middle of a named building."""
    o = city.objects
    row = next(i for i in range(len(o)) if o.name(i) == name)
    return o.center[row] + np.array([[-3, -2], [3, -2], [3, 2], [-3, 2]], float)


@pytest.mark.parametrize(
    ("building", "street", "least", "most"),
    [
        ("Stadtbibliothek", "Lange Straße", 0.7, 0.9),  # the nearest
        ("Stadtbibliothek", "Kurze Gasse", 0.0, 0.05),
        ("7 Lange Straße", "Lange Straße", 0.9, 1.0),  # its address
        ("7 Lange Straße", "Kurze Gasse", 0.0, 0.1),
        ("Café Mole", "Hafenweg", 0.03, 0.2),  # one street farther
    ],
)
def test_a_building_is_on_its_street(world, building, street, least, most):
    city = world.cities["west"]
    on = compare_address(city, find_roads(city, street), corners(city, building))
    assert least <= on.probability <= most


def test_a_street_far_off_is_not_its_street(world):
    city = world.cities["west"]
    away = corners(city, "Stadtbibliothek") - (0.0, 500.0)
    assert compare_address(city, find_roads(city, "Lange Straße"), away) is None
    assert not len(find_roads(city, "Hotel Hansa"))


@pytest.mark.parametrize("street", ["Kurze Gasse", "Hafenweg"])
def test_another_street_weighs_as_much_as_the_wrong_building(world, street):
    def weigh_text(text):
        query = WorldQuery(text)
        found = collect_evidence(world, query, match_outdoors(world, query))
        return found.scenes["reading"].building_match.score.weights

    _, right = weigh_text("I am in the library on Lange Straße")
    _, wrong = weigh_text(f"I am in the library on {street}")
    (elsewhere,) = weigh_text("I am in the hotel")
    assert right > 0.5
    assert wrong < 0.5 * elsewhere < 0


@pytest.mark.parametrize("said", ["on Hafenweg", "at Hafenweg 99", "in the Hafenweg"])
def test_one_is_along_what_the_map_knows_as_a_street(world, said):
    told = parse_sentence(f"I am {said}", {"west": world.towns["west"]}, ("desk",)).outside["west"]
    assert [s.relation.name for s in told.statements] == ["ALONG"]
