"""Tiles: nothing is lost at the finest level, little is left at the coarsest."""

import numpy as np
import pytest

from placegraph.demo.world import TOWN, unpack
from placegraph.outdoor.city import build_city
from placegraph.view.city.page import FINEST, SIDE, UNIT, CityTiles, examples
from placegraph.view.draw.style import LAYER, PAINTS
from placegraph_lab.worlds.town.town import Town


@pytest.fixture(scope="module")
def tiles(city):
    return CityTiles(city)


def shapes(tile):
    """Paint, id and parts of every shape of a tile."""
    return [
        (layer["paint"], osm, parts)
        for layer in tile["layers"]
        for osm, parts in zip(layer["osm"], layer["shapes"], strict=True)
    ]


def test_the_finest_level_has_every_object_that_is_painted(city, tiles):
    found = set()
    for key in tiles.within(tiles.bounds, 0):
        found |= {osm for _, osm, _ in shapes(tiles.tile(*key)) if osm}
    painted = {city.objects.osm(i) for i in range(len(city.objects)) if tiles._paints[i]}
    assert found == painted


def test_points_come_back_to_half_a_metre(city, tiles):
    [row] = [i for i in range(len(city.objects)) if city.objects.label(i) == "amenity=fountain"]
    for level, x, y in tiles.within(tiles.bounds, 0):
        for _, osm, parts in shapes(tiles.tile(level, x, y)):
            if osm == city.objects.osm(row):
                at = np.array(parts[0]) * UNIT + np.array([x, y]) * SIDE
                assert np.abs(at - city.objects.center[row]).max() <= UNIT / 2 + 1e-3


def test_layers_lie_in_painters_order_and_are_known(tiles):
    paints = [layer["paint"] for layer in tiles.tile(0, 0, 0)["layers"]]
    assert [LAYER[p] for p in paints] == sorted(LAYER[p] for p in paints)
    assert set(paints) <= set(tiles.index()["paints"]) == set(PAINTS)


def test_coarser_levels_have_less_in_them(shared, tmp_path):
    source = shared / "data" / "osm" / "toronto_downtown_2020.osm.bz2"
    tiles = CityTiles(build_city(source, tmp_path / "toronto.city"))
    counts = [
        sum(len(part) for key in tiles.within(tiles.bounds, level)
            for _, _, parts in shapes(tiles.tile(*key)) for part in parts)
        for level in range(tiles.top + 1)
    ]  # fmt: skip
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] < 0.9 * counts[0]
    assert len(tiles.within(tiles.bounds, tiles.top)) <= 4
    small = [PAINTS[p].since > 1.5 * FINEST / 2**tiles.top
             for p, _, _ in shapes(tiles.tile(tiles.top, 0, 0))]  # fmt: skip
    assert not any(small)


def test_examples_are_found_where_they_are_true(tmp_path):
    world = unpack(tmp_path)
    city = build_city(world / f"{TOWN}.osm", tmp_path / "town.city")
    said = examples(city, CityTiles(city)._paints)
    assert len(said) == 3
    for text in said:
        estimate = city.locate(text)
        assert estimate.modes
        assert not estimate.understood.ignored


def test_examples_say_what_people_say(tmp_path):
    drawn = (
        "[town]\nname = Small\ncenter = 7.42 43.73\n\n[drawing]\n"
        "   A   \n" + 8 * "       \n" + "   G   \n\n[legend]\nA: shop=alcohol\nG: shop=gift\n"
    )
    source = Town.parse(drawn).write_osm(tmp_path / "small.osm")
    city = build_city(source, tmp_path / "small.city")
    said = "A liquor store is north of me and a gift shop is to the south."
    assert said in examples(city, CityTiles(city)._paints)
