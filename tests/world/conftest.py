"""A small world: two towns drawn in ASCII, and rooms that stand in their buildings."""

import atexit
import shutil
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from tests.indoor.library.conftest import (  # noqa: F401 - fixtures
    make_rooms,
    maps,
    rooms,
    signatures_once,
)

from placegraph.core.geo import Anchor
from placegraph.outdoor.city import build_city
from placegraph.world import open_world
from placegraph_lab.worlds.town.town import Town

TOWN = """
[town]
center = {center}
metres = 12

[drawing]
       |          |
 LL    |   BB     |   HH
 LL    |   BB     |   HH
       |          |
---1---+----------+--------
       |          |
 KK    2   CC     3   MM
 KK    |   CC     |   MM
       |          |

[legend]
1 road: highway=residential name=Lange Straße
2 road: highway=residential name=Kurze Gasse
3 road: highway=residential name=Hafenweg
L area: building=yes amenity=library name=Stadtbibliothek
B area: building=yes shop=bakery name=Bäckerei Kern
H area: building=yes tourism=hotel name=Hotel Hansa
K area: building=church amenity=place_of_worship name=St. Marien
C area: building=yes addr:housenumber=7 addr:street=Lange Straße
M area: building=yes amenity=cafe name=Café Mole
"""
PLACES = {"west": "9.99 53.55", "east": "13.40 52.52"}
STANDS = {  # scene: room, town, building
    "reading": ("study", "west", "Stadtbibliothek"),
    "suite": ("parlour", "west", "Hotel Hansa"),
    "twin": ("parlour", "west", "7 Lange Straße"),
    "stacks": ("bedroom", "east", "Stadtbibliothek"),
}


def anchored(scene, city, name, **known):
    """The scene with the middle of its floor in the middle of a named building."""
    rows = [i for i in range(len(city.objects)) if city.objects.name(i) == name]
    longitude, latitude = city.plane.to_lonlat(city.objects.center[rows[0]].astype(float))
    middle = scene.bounds.mean(axis=0) * (1, 1, 0)
    covariance = np.diag([0.25, 0.25, 0.25, 0.001])
    there = Anchor(longitude, latitude, 10.0, 0.0, covariance, building=name, level="0", **known)
    return scene.anchored(there.shift_origin(middle))


@cache
def make_folder():
    folder = Path(tempfile.mkdtemp(prefix="world"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    cities = {}
    for name, center in PLACES.items():
        osm = Town.parse(TOWN.format(center=center)).write_osm(folder / f"{name}.osm")
        cities[name] = build_city(osm, folder / f"{name}.city")
    for name, (room, town, building) in STANDS.items():
        scene = make_rooms()[room].scene
        anchored(scene, cities[town], building).save(folder / f"{name}.scene")
    return folder


@pytest.fixture(scope="session")
def folder():
    """Folder of the small world, with a file that is none of its maps."""
    return make_folder()


@pytest.fixture(scope="session")
def world(folder):
    """The world of that folder; only asked."""
    return open_world(folder)


@pytest.fixture(scope="session")
def films(rooms):  # noqa: F811
    """Four frames with depth in each room."""
    return {name: room.film(21, 6, depth=True, labels=None) for name, room in rooms.items()}
