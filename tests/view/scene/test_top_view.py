"""What is uppermost, where walls are cut, and what lies inside."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.view.draw.canvas import Frame
from placegraph.view.scene.top_view import look_down, section, solid

SIDES = ((0, 1, 5, 4), (1, 3, 7, 5), (3, 2, 6, 7), (2, 0, 4, 6))
ENDS = ((1, 0, 2, 3), (4, 5, 7, 6))


def box(low, high):
    """Vertices (8, 3) and triangles (12, 3) of a closed box that faces outwards."""
    low, high = np.array(low, float), np.array(high, float)
    bits = np.array([(i & 1, i >> 1 & 1, i >> 2) for i in range(8)])
    quads = np.array([*SIDES, *ENDS])
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return (low + bits * (high - low)).astype(np.float32), triangles.astype(np.int32)


def joined(*meshes):
    counts = np.cumsum([0, *(len(v) for v, _ in meshes)])
    vertices = np.concatenate([v for v, _ in meshes])
    return vertices, np.concatenate([t + n for (_, t), n in zip(meshes, counts, strict=False)])


def turned(mesh, angle):
    vertices, triangles = mesh
    c, s = np.cos(angle), np.sin(angle)
    return (vertices @ np.array([(c, s, 0), (-s, c, 0), (0, 0, 1)])).astype(np.float32), triangles


def signed_area(segments):
    """Area to the left of closed outlines."""
    (ax, ay), (bx, by) = segments[:, 0].T, segments[:, 1].T
    return float((ax * by - bx * ay).sum() / 2)


def test_the_highest_is_on_top():
    vertices, triangles = joined(box((0, 0, 0), (4, 4, 1)), box((2, 2, 0), (3, 3, 2)))
    frame = Frame((2.0, 2.0), 10.0, 60, 60)
    view = look_down(vertices, triangles, np.zeros(len(triangles), np.float32), frame)
    of_small = view.triangle >= 12
    assert (view.triangle >= 0).sum() == pytest.approx(1600, abs=82)
    assert of_small.sum() == pytest.approx(100, abs=22)
    rows, columns = np.nonzero(of_small)
    # x 2 to 3 lies right of the middle, y 2 to 3 above it
    assert (columns.min(), columns.max()) == (pytest.approx(30, abs=1), pytest.approx(39, abs=1))
    assert (rows.min(), rows.max()) == (pytest.approx(20, abs=1), pytest.approx(29, abs=1))
    assert view.height[25, 35] == pytest.approx(2.0)
    assert view.height[45, 15] == pytest.approx(1.0)
    assert view.height[0, 0] == -np.inf


def test_a_lift_decides_what_is_on_top_and_leaves_out():
    vertices, triangles = joined(box((0, 0, 0), (4, 4, 3)), box((1, 1, 0), (3, 3, 1)))
    frame = Frame((2.0, 2.0), 10.0, 40, 40)
    lift = np.zeros(24, np.float32)
    lift[12:] = 5.0
    view = look_down(vertices, triangles, lift, frame)
    assert view.triangle[20, 20] >= 12
    assert view.height[20, 20] == pytest.approx(1.0), "the lift is no part of the height"
    lift[:12] = -np.inf
    assert look_down(vertices, triangles, lift, frame).triangle[2, 2] == -1


def test_walls_of_a_scan_are_lines():
    vertices = np.array([(0, 0, 0), (3, 1, 0), (3, 1, 2), (0, 0, 2)], np.float32)
    triangles = np.array([(0, 1, 2), (0, 2, 3)], np.int32)
    frame = Frame((1.5, 0.5), 20.0, 80, 40)
    seen = look_down(vertices, triangles, np.zeros(2, np.float32), frame).triangle >= 0
    rows, columns = np.nonzero(seen)
    along = np.polyfit(columns, rows, 1)
    assert along[0] == pytest.approx(-1 / 3, abs=0.02)
    assert 60 <= seen.sum() <= 130


def test_nothing_of_nothing():
    frame = Frame((0.0, 0.0), 10.0, 20, 10)
    vertices, triangles = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
    assert (look_down(vertices, triangles, np.zeros(0, np.float32), frame).triangle == -1).all()
    segments = section(vertices, triangles, 1.0)
    assert segments.shape == (0, 2, 2)
    assert not solid(segments, frame).any()


@given(
    st.floats(-3, 3), st.floats(-3, 3), st.floats(0.3, 2), st.floats(0.3, 2), st.floats(-3.2, 3.2)
)
def test_a_cut_box_is_its_footprint(x, y, wide, deep, angle):
    vertices, triangles = turned(box((x, y, 0), (x + wide, y + deep, 2)), angle)
    segments = section(vertices, triangles, 1.0)
    assert signed_area(segments) == pytest.approx(wide * deep, rel=1e-4)
    frame = Frame(tuple(segments.mean(axis=(0, 1)).tolist()), 40.0, 160, 160)
    inside = solid(segments, frame)
    assert inside.sum() / 1600 == pytest.approx(wide * deep, abs=0.06 * (wide + deep))


def test_what_lies_above_or_below_is_not_cut():
    beam = box((0, 0, 2), (4, 1, 3))
    step = box((0, 2, 0), (4, 3, 0.5))
    vertices, triangles = joined(beam, step, box((1, 0.2, 0), (2, 0.8, 3)))
    assert signed_area(section(vertices, triangles, 1.0)) == pytest.approx(0.6, rel=1e-5)


def test_walls_in_walls_leave_no_hole():
    segments = section(*joined(box((0, 0, 0), (4, 1, 3)), box((1, 0.5, 0), (2, 3, 3))), 1.0)
    frame = Frame((2.0, 1.5), 20.0, 100, 80)
    assert solid(segments, frame).sum() / 400 == pytest.approx(4 + 2, rel=0.05)


def test_rooms_whose_walls_face_inwards_are_not_filled():
    vertices, triangles = box((0, 0, 0), (4, 3, 3))
    segments = section(vertices, triangles[:, ::-1], 1.0)
    assert signed_area(segments) == pytest.approx(-12.0, rel=1e-5)
    assert not solid(segments, Frame((2.0, 1.5), 20.0, 100, 80)).any()


def test_a_gap_in_an_outline_smears_nothing():
    segments = section(*box((0, 0, 0), (2, 2, 3)), 1.0)
    right = segments[..., 0].min(axis=1) > 1.9
    frame = Frame((3.0, 1.0), 20.0, 200, 60)
    inside = solid(segments[~right], frame)
    assert not inside[:, frame.width // 2 :].any()
