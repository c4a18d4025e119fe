"""The sea lies on the right hand of the coast."""

from types import SimpleNamespace

import numpy as np
import pytest

from placegraph.view.city.city_items import _inside, sea

BOUNDS = (0.0, 0.0, 1000.0, 1000.0)


def objects(*lines, labels=("natural=coastline",)):
    """Just what `sea` reads of a city's objects: coastlines, and a city that fills the bounds."""
    corners = np.array([(0.0, 0.0), (1000.0, 1000.0)])
    lines = [np.array(line, np.float32) for line in lines]
    return SimpleNamespace(
        labels=labels,
        kind=np.array([2 if (line[0] == line[-1]).all() else 1 for line in lines]),
        label_starts=np.arange(len(lines) + 1),
        label_values=np.zeros(len(lines), np.int64),
        parts=lambda row: [lines[row]],
        center=np.repeat(corners, 500, axis=0),
    )


def is_sea(city, *points):
    rings = sea(city, BOUNDS)
    return [bool(wet) for wet in _inside(rings, np.array(points, np.float64))]


def test_no_coast_no_sea():
    assert sea(objects([(0, 0), (1, 1)], labels=("natural=tree",)), BOUNDS) == []


@pytest.mark.parametrize("northward", [True, False])
def test_a_straight_coast(northward):
    line = [(500, -50), (500, 1050)] if northward else [(500, 1050), (500, -50)]
    assert is_sea(objects(line), (900, 500), (100, 500)) == [northward, not northward]


def test_pieces_are_joined_in_any_order():
    city = objects([(500, 300), (500, 700)], [(500, 700), (500, 1100)], [(500, -100), (500, 300)])
    assert is_sea(city, (900, 50), (900, 950), (100, 500)) == [True, True, False]


def test_an_island_in_the_sea():
    ring = [(400, 400), (600, 400), (600, 600), (400, 600), (400, 400)]  # land on the left
    assert is_sea(objects(ring), (500, 500), (100, 100), (900, 500)) == [False, True, True]


def test_a_bay_and_an_island_in_it():
    bay = [(-10, 300), (700, 300), (700, 700), (-10, 700)][::-1]
    island = [(200, 450), (300, 450), (300, 550), (200, 550), (200, 450)]
    points = (100, 500), (250, 500), (500, 100), (900, 500)
    wet = is_sea(objects(bay, island), *points)
    assert wet[1] != wet[0]
    assert wet[2] == wet[3] != wet[0]


def test_a_coast_that_the_extract_cut_off_goes_straight_on():
    assert is_sea(objects([(500, 200), (520, 800)]), (900, 100), (900, 900), (100, 100)) == [
        True, True, False,
    ]  # fmt: skip


def test_two_shores_of_a_strait():
    south = [(1050, 300), (-50, 300)]  # going west, land to the south on the left
    north = [(-50, 700), (1050, 700)]
    city = objects(south, north)
    assert is_sea(city, (500, 500), (500, 100), (500, 900)) == [True, False, False]


def test_a_coast_that_contradicts_itself_gives_no_sea():
    assert sea(objects([(500, -50), (500, 1050)], [(700, -50), (700, 1050)]), BOUNDS) == []
