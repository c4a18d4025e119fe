from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.indoor.mapping.parts import lattice

from placegraph.errors import OptionError
from placegraph.indoor.mapping.segment import SegmentOptions, segment

GREY, WHITE, RED = (120, 120, 120), (250, 250, 250), (190, 20, 20)


def sheet(corner, u, v, step=0.05, colour=WHITE):
    n, m = (max(round(float(np.linalg.norm(side)) / step), 1) for side in (u, v))
    points, triangles = lattice(n, m)
    points = np.asarray(corner) + points @ np.array([u, v], float)
    return points, triangles, np.broadcast_to(np.uint8(colour), points.shape)


def box(low, high, colour=GREY, step=0.05):
    x, y, z = (np.eye(3)[k] * (np.array(high) - low)[k] for k in range(3))
    low = np.array(low, float)
    return [
        sheet(at, u, v, step, colour)
        for at, u, v in (
            (low + z, x, y), (low, x, z), (low + y, z, x), (low, z, y), (low + x, y, z),
        )
    ]  # fmt: skip


def world(parts):
    points, rows, colours, owner, base = [], [], [], [], 0
    for number, (p, t, c) in enumerate(parts):
        points.append(p)
        rows.append(t + base)
        colours.append(c)
        owner.append(np.full(len(t), number))
        base += len(p)
    return tuple(np.concatenate(column) for column in (points, rows, colours, owner))


def study():
    table = [
        *box((1.0, 1.0, 0.7), (2.2, 1.8, 0.74)),
        sheet((1.0, 1.0, 0.7), (0, 0.8, 0), (1.2, 0, 0), colour=GREY),
        *(p for x in (1.05, 2.1) for y in (1.05, 1.7) for p in box((x, y, 0), (x + 0.05, y + 0.05, 0.7))),
    ]  # fmt: skip
    parts = {
        "floor": [sheet((0, 0, 0), (4, 0, 0), (0, 3, 0))],
        "ceiling": [sheet((0, 0, 2.5), (0, 3, 0), (4, 0, 0))],
        "south": [sheet((0, 0, 0), (0, 0, 2.5), (4, 0, 0))],
        "west": [sheet((0, 0, 0), (0, 3, 0), (0, 0, 2.5))],
        "cupboard": box((3.0, 2.0, 0), (3.9, 2.6, 1.1)),
        "table": table,
        "thing": box((1.3, 1.3, 0.74), (1.6, 1.5, 0.95), RED),
    }
    names = [name for name, sheets in parts.items() for _ in sheets]
    vertices, triangles, colours, owner = world([s for sheets in parts.values() for s in sheets])
    return vertices, triangles, colours, np.array(names)[owner]


def areas(vertices, triangles):
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def best_overlaps(segments, truth, area):
    names, row = np.unique(truth, return_inverse=True)
    table = np.zeros((len(segments), len(names)))
    np.add.at(table, (segments.object_of, row), area)
    union = table.sum(1)[:, None] + table.sum(0)[None] - table
    return dict(zip(names.tolist(), (table / union).max(axis=0), strict=True))


def check(segments, count):
    assert segments.object_of.shape == (count,)
    assert segments.object_of.dtype == np.int32
    if count:
        assert np.unique(segments.object_of).tolist() == list(range(len(segments)))
    for column in (segments.labels, segments.names, segments.ids):
        assert len(column) == len(segments)
    assert len(set(segments.names)) == len(set(segments.ids)) == len(segments)
    assert segments.floor is None or np.isfinite(segments.floor)


def same_partition(a, b):
    pairs = len(np.unique(np.stack([a, b]), axis=1).T)
    return pairs == len(np.unique(a)) == len(np.unique(b))


def test_study():
    vertices, triangles, colours, truth = study()
    told = []
    found = segment(vertices, triangles, colours, progress=lambda *state: told.append(state))
    assert [stage for stage, _, _ in told] == ["faces", "planes", "patches", "objects"]
    assert all(0 <= done < whole for _, done, whole in told)
    check(found, len(triangles))
    assert found.labels[:4] == ("floor", "ceiling", "wall", "wall")
    assert found.names[:4] == ("floor", "ceiling", "wall 1", "wall 2")
    assert found.floor == pytest.approx(0.0, abs=1e-6)
    overlap = best_overlaps(found, truth, areas(vertices, triangles))
    assert min(overlap.values()) > 0.85, overlap
    assert len(found) == 7
    assert found.names[4:] == ("object 1", "object 2", "object 3")


def test_flat_without_its_ids(flat):
    mesh = flat.mesh
    count = len(mesh)
    third = np.full(count, 1 / 3, np.float32)
    shades = np.repeat(mesh.colour_at(np.arange(count), third, third), 3, axis=0)
    vertices = mesh.vertices[mesh.triangles].reshape(-1, 3)
    triangles = np.arange(3 * count).reshape(-1, 3)
    found = segment(vertices, triangles, shades)
    check(found, count)
    area = areas(vertices.astype(float), triangles)
    labels = np.array(flat.graph.labels)
    whole = np.bincount(mesh.object_of, area)
    building = np.isin(labels, ["wall", "floor", "ceiling"])
    overlap = best_overlaps(found, mesh.object_of, area)
    things = [overlap[i] for i in range(len(labels)) if not building[i] and whole[i] >= 0.05]
    assert np.mean(things) > 0.7
    assert np.mean(np.array(things) > 0.5) > 0.75
    said = np.isin(np.array(found.labels)[found.object_of], ["wall", "floor", "ceiling"])
    true = building[mesh.object_of]
    assert area[said & true].sum() > 0.95 * area[true].sum()
    assert area[said & true].sum() > 0.8 * area[said].sum()
    assert found.floor == pytest.approx(flat.floors[0], abs=0.02)


def test_noisy_scan():
    vertices, triangles, colours, truth = study()
    rng = np.random.default_rng(3)
    shared, back = np.unique(vertices.round(4), axis=0, return_inverse=True)
    noisy = (shared + rng.normal(0, 0.004, shared.shape))[back]
    found = segment(noisy, triangles, colours)
    check(found, len(triangles))
    overlap = best_overlaps(found, truth, areas(vertices, triangles))
    assert min(overlap.values()) > 0.8, overlap


def test_neither_sides_nor_order_of_triangles_matter(rng):
    vertices, triangles, colours, _ = study()
    one = segment(vertices, triangles, colours)
    out = segment(vertices, triangles[:, ::-1], colours)
    assert same_partition(one.object_of, out.object_of)
    assert one.labels == out.labels
    order = rng.permutation(len(triangles))
    two = segment(vertices, triangles[order], colours)
    np.testing.assert_array_equal(one.object_of[order], two.object_of)
    assert one.names == two.names


@settings(max_examples=2, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1), points=st.integers(3, 40), count=st.integers(0, 60),
    spread=st.sampled_from([1e-5, 0.3, 1.0]), bad=st.integers(0, 4),
)  # fmt: skip
def test_soup(seed, points, count, spread, bad):
    rng = np.random.default_rng(seed)
    vertices = rng.normal(0, spread, (points, 3)).round(rng.integers(0, 4))
    vertices[rng.integers(0, points, bad)] = [[np.nan, np.inf, -np.inf][bad % 3]]
    triangles = rng.integers(0, points, (count, 3))
    colours = rng.integers(0, 256, (points, 3), np.uint8)
    left_out = Counter()
    found = segment(vertices, triangles, colours, left_out=left_out)
    check(found, count)
    order = rng.permutation(count)
    again = segment(vertices, triangles[order], colours)
    np.testing.assert_array_equal(found.object_of[order], again.object_of)


def test_an_empty_mesh_and_one_giant_plane():
    found = segment(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3), np.uint8))
    check(found, 0)
    assert found.labels == ()
    assert found.floor is None
    vertices, triangles, colours, _ = world([sheet((0, 0, 2), (400, 0, 0), (0, 300, 0), 5.0)])
    found = segment(vertices, triangles, colours)
    assert found.labels == ("floor",)
    assert found.floor == pytest.approx(2.0)


@pytest.mark.parametrize("flatten", [False, True])
def test_one_triangle(flatten):
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 1]])
    if flatten:
        vertices[2] = vertices[1]
    left_out = Counter()
    found = segment(vertices, [[0, 1, 2]], left_out=left_out)
    check(found, 1)
    assert found.labels == ("unknown",)
    assert left_out["triangles without area"] == int(flatten)


def test_picture_and_carpet_by_colour_alone():
    red = sheet((1, 0, 1.2), (0, 0, 0.6), (0.8, 0, 0), colour=RED)
    vertices, triangles, colours, owner = world(
        [
            sheet((0, 0, 0), (4, 0, 0), (0, 3, 0)),
            sheet((0, 0, 0), (0, 0, 1.2), (4, 0, 0)),
            sheet((0, 0, 1.8), (0, 0, 0.7), (4, 0, 0)),
            sheet((0, 0, 1.2), (0, 0, 0.6), (1, 0, 0)),
            sheet((1.8, 0, 1.2), (0, 0, 0.6), (2.2, 0, 0)),
            red,
        ]
    )
    found = segment(vertices, triangles, colours)
    assert found.labels == ("floor", "wall", "unknown")
    picture = np.bincount(owner[found.object_of == 2], minlength=6)
    assert picture[5] > 0.9 * (owner == 5).sum()
    assert picture[:5].sum() < 0.1 * picture[5]


@pytest.mark.parametrize(("wide", "count"), [(1.0, 2), (2.2, 1)])
def test_a_carpet_is_apart_and_another_colour_of_floor_is_not(wide, count):
    vertices, triangles, _, _ = world([sheet((0, 0, 0), (8, 0, 0), (0, 6, 0))])
    x, y = np.abs(vertices[:, :2] - (4.0, 3.0)).T
    colours = np.where(((x < wide) & (y < 0.5 * wide + 0.1))[:, None], RED, GREY).astype(np.uint8)
    found = segment(vertices, triangles, colours)
    assert found.labels == ("floor",) * count


@pytest.mark.parametrize("name", ["gap", "crease", "patch"])
def test_options_are_checked(name):
    with pytest.raises(OptionError, match=name):
        SegmentOptions(**{name: 0.0})
    with pytest.raises(OptionError, match=name):
        SegmentOptions(**{name: float("nan")})
