from math import radians

import numpy as np
import pytest

from placegraph.outdoor.map.objects import LINE, CityObjects
from placegraph.outdoor.map.street_graph import USUAL, Blocks, StreetGraph


def grid(north, east, turned, n=8):
    """Streets `north` apart that cross avenues `east` apart [m], turned clockwise [rad]."""
    lines = [[(0, i * north), (n * east, i * north)] for i in range(n)]
    lines += [[(i * east, 0), (i * east, n * north)] for i in range(n)]
    points = np.array(lines, np.float64).reshape(-1, 2)
    turn = np.array([[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]])
    rows = np.arange(2 * n + 1, dtype=np.int32)
    return CityObjects(
        osm_type=np.ones(2 * n, np.uint8), osm_id=np.arange(2 * n),
        kind=np.full(2 * n, LINE, np.uint8), label_starts=rows,
        label_values=np.zeros(2 * n, np.int32), name_starts=rows, name_values=rows[:-1],
        part_starts=rows, point_starts=2 * np.arange(2 * n + 1, dtype=np.int32),
        points=(points @ turn).astype(np.float32),
        labels=("highway=residential",), names=tuple(f"Street {i}" for i in range(2 * n)),
    )  # fmt: skip


@pytest.mark.parametrize("turned", [0.0, radians(29.0), radians(-29.0)])
def test_blocks_have_the_spacing_of_the_streets(turned):
    blocks = Blocks.measure(StreetGraph.of_objects(grid(80.0, 250.0, turned)))
    assert blocks.axis == pytest.approx(turned, abs=0.03)
    for bearing, length in ((0.0, 80.0), (90.0, 250.0), (180.0, 80.0), (280.0, 250.0)):
        assert blocks.length(radians(bearing) + turned) == pytest.approx(length, abs=15.0)
    assert 80.0 < blocks.length(None) < 250.0


def test_without_streets_a_block_is_what_it_usually_is(harbour):
    alone = grid(80.0, 250.0, 0.0, n=1)
    assert Blocks.measure(StreetGraph.of_objects(alone)).length(0.0) == USUAL
    assert harbour.block_length(None) > 0.0
