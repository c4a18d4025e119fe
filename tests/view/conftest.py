"""A small town with unfriendly names, and estimates in it made by hand."""

import numpy as np
import pytest

from placegraph.core.estimate import CityEstimate, Evidence, ObjectRef, Place, Status
from placegraph.language.text import IgnoredText
from placegraph.outdoor.city import build_city
from placegraph.outdoor.language.description import Description, Mention, Relation, Sense, Statement
from placegraph_lab.worlds.town.town import Town

TOWN = """
[town]
name = Testing
center = 7.42 43.73

[drawing]
 ####   |  \"\"\"\"\"\"   ####
 #K##   |  \"\"\"F\"\"   #  #
 ####   |  \"\"\"\"\"\"   ####
        |
-----1--+------------------
        |       b
  CCC   |  ***
  CCC   |        S
≈≈≈≈≈≈≈≈|≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈≈
        |

[legend]
K: shop=bakery name=<script>alert("K")</script>
F: amenity=fountain
b: amenity=bench name="><img/onerror/alert(1)>
S: railway=tram_stop name=Größe & Müßiggang
C area: amenity=place_of_worship building=church name=St. Łukasz
1 road: highway=primary name=Lange Straße
"""
TEXT = "A <b>bakery</b> is west of me & a fountain north-east. It rains </script>."


@pytest.fixture(scope="session")
def town():
    return Town.parse(TOWN)


@pytest.fixture(scope="session")
def city(town, tmp_path_factory):
    folder = tmp_path_factory.mktemp("view")
    return build_city(town.write_osm(folder / "town.osm"), folder / "town.city")


def evidence_of(city, town, glyph, verdict, weight):
    """Evidence that names the object drawn by a glyph."""
    at = city.plane.to_plane(town.positions(glyph)[0])
    row = int(np.argmin(np.hypot(*(city.objects.center - at).T)))
    longitude, latitude = city.plane.to_lonlat(city.objects.center[row]).tolist()
    o = city.objects
    ref = ObjectRef(o.osm(row), o.label(row), o.name(row), longitude, latitude)
    return Evidence(f"the {glyph} <i>said</i>", verdict, weight, (ref,), "because & so")


def _estimate(city, town, status, probabilities):
    """Estimate with a mode for each probability, on a line from west to east."""
    evidence = (
        evidence_of(city, town, "K", "for", 3.2),
        evidence_of(city, town, "C", "against", -1.1),
        Evidence("it rains", "silent", 0.0, (), "no place"),
    )
    covariance, modes = np.array([[60.0, 20.0], [20.0, 90.0]]), []
    for k, probability in enumerate(probabilities):
        at = town.lonlat(5, 9 + 6 * k)
        cell = city.cells.at(*at) or ""
        modes.append(Place(*at, probability, cell, covariance, explain=lambda: evidence))
    support = [
        (*town.lonlat(5 + dr, 9 + 6 * k + dc), p / 9)
        for k, p in enumerate(probabilities)
        for dr in (-1, 0, 1)
        for dc in (-1, 0, 1)
    ]
    bakery = Mention(2, "A <b>bakery</b>", (Sense("shop=bakery", 0.9),))
    west = Statement(Relation.DIRECTION, 2, 0, bearing=3 * np.pi / 2, text="A bakery is west of me")
    ignored = (IgnoredText("It rains </script>", "no place"),)
    mentions = (Mention(0, "me"), Mention(1, "you"), bakery)
    understood = Description(TEXT, mentions, (west,), ignored)
    support = np.reshape(support, (-1, 3))
    return CityEstimate(status, tuple(modes), "One & only <reason>.", understood, support)


@pytest.fixture(scope="session")
def estimate_of(city, town):
    """Make an estimate of a status, with a mode for each probability."""
    return lambda status, *probabilities: _estimate(city, town, status, probabilities)


@pytest.fixture(params=["OK", "AMBIGUOUS", "LOST", "nothing"])
def estimate(request, estimate_of):
    if request.param == "nothing":
        return estimate_of(Status.LOST)
    probabilities = {"OK": (0.9, 0.05), "AMBIGUOUS": (0.4, 0.35, 0.2), "LOST": (0.1,)}
    return estimate_of(Status(request.param), *probabilities[request.param])


@pytest.fixture(scope="session")
def sure(estimate_of):
    return estimate_of(Status.OK, 0.9, 0.05)
