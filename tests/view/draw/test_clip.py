"""Cutting to a rectangle keeps what is inside, and nothing else."""

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from placegraph.view.draw.canvas import clip_line, clip_ring, dashes

BOUNDS = (0.0, 0.0, 100.0, 60.0)
coordinate = st.integers(-300, 300).map(float)
points = st.lists(st.tuples(coordinate, coordinate), min_size=2, max_size=8).map(np.array)


def length(line):
    return float(np.hypot(*np.diff(line, axis=0).T).sum())


def area(ring):
    x, y = ring.T
    return 0.5 * float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())


def within(line):
    west, south, east, north = BOUNDS
    x, y = line.T
    slack = 1e-6
    return (
        (x >= west - slack) & (x <= east + slack) & (y >= south - slack) & (y <= north + slack)
    ).all()


@given(points)
def test_pieces_of_a_line_lie_within(line):
    for piece in clip_line(line, BOUNDS):
        assert len(piece) >= 2
        assert within(piece)


@given(points)
def test_no_length_inside_is_lost(line):
    t = (np.arange(4000) + 0.5) / 4000
    inside = 0.0
    for a, b in pairwise(line):
        samples = a + t[:, None] * (b - a)
        west, south, east, north = BOUNDS
        hit = (samples >= (west, south)).all(axis=1) & (samples <= (east, north)).all(axis=1)
        inside += hit.mean() * np.hypot(*(b - a))
    assert abs(sum(map(length, clip_line(line, BOUNDS))) - inside) < 2e-3 * length(line) + 1e-6


def test_a_line_inside_comes_back_whole():
    line = np.array([(1.0, 1.0), (50.0, 20.0), (99.0, 59.0)])
    [piece] = clip_line(line, BOUNDS)
    assert np.array_equal(piece, line)


def test_a_line_that_leaves_and_returns_is_cut_in_two():
    line = np.array([(10.0, 10.0), (10.0, 100.0), (20.0, 100.0), (20.0, 10.0)])
    assert [piece.tolist() for piece in clip_line(line, BOUNDS)] == [
        [[10.0, 10.0], [10.0, 60.0]],
        [[20.0, 60.0], [20.0, 10.0]],
    ]


@given(st.lists(st.tuples(coordinate, coordinate), min_size=3, max_size=8, unique=True))
def test_a_clipped_ring_lies_within_and_is_closed(corners):
    ring = clip_ring(np.array([*corners, corners[0]]), BOUNDS)
    if len(ring):
        assert within(ring)
        assert (ring[0] == ring[-1]).all()


@given(coordinate, coordinate, st.integers(1, 200), st.integers(1, 200))
def test_a_clipped_box_has_the_area_of_the_overlap(x, y, width, height):
    ring = np.array([(x, y), (x + width, y), (x + width, y + height), (x, y + height), (x, y)])
    west, south, east, north = BOUNDS
    overlap = max(0.0, min(x + width, east) - max(x, west)) * max(
        0.0, min(y + height, north) - max(y, south)
    )
    clipped = clip_ring(ring, BOUNDS)
    assert abs((area(clipped) if len(clipped) > 3 else 0.0) - overlap) < 1e-6


@given(
    st.lists(st.tuples(st.integers(-50, 50), st.integers(-50, 50)), min_size=2, max_size=6),
    st.integers(1, 20),
    st.integers(1, 20),
)
def test_dashes_cover_their_share_of_a_line(points, drawn, blank):
    line = np.array(points, float)
    length = np.hypot(*np.diff(line, axis=0).T).sum()
    pieces = dashes(line, float(drawn), float(blank))
    total = sum(np.hypot(*np.diff(piece, axis=0).T).sum() for piece in pieces)
    assert abs(total - length * drawn / (drawn + blank)) <= drawn + blank
