"""Cells and their vertices, and parts of a mesh."""

from collections import Counter

import numpy as np

from placegraph.indoor.mapping.fuse import loop_tables, without_specks
from placegraph.indoor.mapping.fuse_kernels import low_corner


def crossed(case):
    ends = [(low_corner(e), low_corner(e) | 1 << (e >> 2)) for e in range(12)]
    return np.array([(case >> a ^ case >> b) & 1 for a, b in ends], bool)


def test_loops_take_up_all_crossed_edges_and_no_other():
    loop_of, loops = loop_tables()
    for case in range(1, 255):
        assert ((loop_of[case] >= 0) == crossed(case)).all()
        assert set(loop_of[case][loop_of[case] >= 0]) == set(range(loops[case]))
        sizes = np.bincount(loop_of[case][loop_of[case] >= 0])
        assert sizes.min() >= 3
    assert loops[255] == 0


def test_corners_behind_the_surface_are_cut_off_one_by_one():
    _, loops = loop_tables()
    assert loops[0b00000001] == 1
    assert loops[0b10000001] == 2  # opposite corners
    assert loops[0b01101001] == 4  # every second corner
    assert loops[0b00001111] == 1


def test_small_parts_are_dropped_and_counted():
    points = np.array(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [5, 0, 0], [5.1, 0, 0], [5, 0.1, 0.0]]
    )
    triangles = np.array([[0, 1, 2], [4, 5, 6], [1, 3, 2]])
    colours = np.arange(21, dtype=np.uint8).reshape(7, 3)
    left_out = Counter()
    kept, rows, shades = without_specks(points, triangles, colours, 0.1, left_out)
    assert rows.tolist() == [[0, 1, 2], [1, 3, 2]]
    assert kept.tolist() == points[:4].tolist()
    assert shades.tolist() == colours[:4].tolist()
    assert list(left_out.values()) == [1]
