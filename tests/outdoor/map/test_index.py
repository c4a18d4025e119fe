"""Viewpoints and what is in sight of each, against brute force."""

import numpy as np
import pytest

from placegraph.outdoor.map.index import FADE, REACH, SECOND_LABEL, SIGHT, STRIDE, ViewIndex, fade
from placegraph.outdoor.map.index_kernels import EMPTY_BOX, join_boxes, pack_box, unpack_box
from placegraph.outdoor.map.raster_kernels import nearest_on_parts


def nearest(o, row, position):
    east, north, d2 = nearest_on_parts(
        o.part_starts, o.point_starts, o.points, o.kind[row], row, *map(float, position)
    )
    return east, north, np.sqrt(d2)


def sample(city, rng, n=25):
    return rng.choice(len(city.views.positions), min(n, len(city.views.positions)), replace=False)


def entries(views, view):
    return slice(views.starts[view], views.starts[view + 1])


def test_what_is_in_sight(real_city, rng):
    o, views = real_city.objects, real_city.views
    for view in sample(real_city, rng):
        position = views.positions[view].astype(np.float64)
        expected = {}
        for row in range(len(o)):
            east, north, d = nearest(o, row, position)
            if d <= REACH - 1e-3:
                expected[row] = (east, north)
        found = dict(
            zip(
                views.objects[entries(views, view)],
                views.offsets[entries(views, view)],
                strict=True,
            )
        )
        assert set(expected) <= set(found)
        assert all(nearest(o, row, position)[2] < REACH + 1e-3 for row in found)
        for row, offset in expected.items():
            assert np.hypot(*offset) == pytest.approx(np.hypot(*found[row]), abs=0.01)


def test_sums_of_sight(real_city, rng):
    o, views = real_city.objects, real_city.views
    for view in sample(real_city, rng):
        here = entries(views, view)
        d = np.hypot(*views.offsets[here].T)
        sight = 1 / (1 + np.exp((d - SIGHT) / FADE))
        np.testing.assert_allclose(views.sight[here], sight, rtol=1e-4)
        assert views.total[view] == pytest.approx(sight.sum(), rel=1e-4)
        outside = sight * ~((o.kind[views.objects[here]] == 2) & (d == 0))
        pairs = np.outer(outside, outside)
        assert views.pairs[view] == pytest.approx(pairs.sum() - np.trace(pairs), rel=1e-3, abs=1e-3)


def test_everything_is_seen_from_somewhere(real_city):
    assert len(np.unique(real_city.views.objects)) == len(real_city.objects)


def test_a_hut_in_the_hills_is_seen(build_world):
    hut = [(3000, 3000, {}), (3009, 3000, {}), (3009, 3009, {}), (3000, 3009, {})]
    town = [(12 * i, 10 * j, {"amenity": "bench"}) for i in range(6) for j in range(6)]
    path = [(-2000, -2000, {}), (-2300, -2000, {})]
    start = len(hut) + len(town)
    city = build_world(
        [*hut, *town, *path],
        [
            ([0, 1, 2, 3, 0], {"building": "yes", "name": "Refugi"}),
            ([start, start + 1], {"highway": "path", "name": "Camí"}),
        ],
    )
    for name in ("Refugi", "Camí"):
        estimate = city.locate(f"I am at {name}.")
        assert estimate.status.name != "LOST", name
        assert [o.name for o in estimate.evidence[0].objects] == [name]


def test_viewpoints_lie_on_a_grid_row_by_row(real_city):
    positions = real_city.views.positions.astype(np.float64)
    steps = (positions - positions.min(axis=0)) / STRIDE
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-2)
    order = np.lexsort((positions[:, 0], positions[:, 1]))
    np.testing.assert_array_equal(order, np.arange(len(positions)))
    assert len(np.unique(positions, axis=0)) == len(positions)


def test_postings_by_token(real_city, rng):
    o, views = real_city.objects, real_city.views
    n_labels = len(o.labels)
    tokens = rng.choice(len(views.posting_starts) - 1, 25, replace=False)
    mass = {int(token): np.zeros(len(views.positions)) for token in tokens}
    boxes = {}
    for view in range(len(views.positions)):
        for e in range(views.starts[view], views.starts[view + 1]):
            i = views.objects[e]
            for k, token in enumerate(range(views.token_starts[i], views.token_starts[i + 1])):
                value = int(views.token_values[token])
                if value not in mass:
                    continue
                weight = SECOND_LABEL[min(k, 2)] if value < n_labels else 1.0
                mass[value][view] += views.sight[e] * weight
                boxes.setdefault((value, view), []).append(views.offsets[e])
    for token, expected in mass.items():
        here = slice(views.posting_starts[token], views.posting_starts[token + 1])
        found = views.posting_views[here]
        np.testing.assert_array_equal(found, np.flatnonzero(expected))
        np.testing.assert_allclose(views.posting_mass[here], expected[found], rtol=1e-3)
        for view, box in zip(found, views.posting_boxes[here], strict=True):
            offsets = np.array(boxes[token, view])
            west, south, east, north = unpack_box(box)
            np.testing.assert_array_equal((west, south), np.floor(offsets.min(axis=0)))
            np.testing.assert_array_equal((east, north), np.ceil(offsets.max(axis=0)))


def test_frequency_is_a_share(real_city):
    o, views = real_city.objects, real_city.views
    n_tokens = len(o.labels) + len(o.names)
    shares = np.array(
        [views.frequency(np.array([t], np.int32), np.ones(1, np.float32)) for t in range(n_tokens)]
    )
    assert (shares > 0).all()
    assert (shares <= 1).all()
    total = views.sight.sum(dtype=np.float64)
    token = int(np.argmax(shares))
    expected = sum(
        views.sight[e] * views.token_weights[t]
        for e in range(len(views.objects))
        for t in range(
            views.token_starts[views.objects[e]], views.token_starts[views.objects[e] + 1]
        )
        if views.token_values[t] == token
    )
    assert shares[token] == pytest.approx(expected / total, rel=1e-3)


def test_near(real_city, rng):
    views = real_city.views
    low, high = views.positions.min(axis=0), views.positions.max(axis=0)
    for reach in (0.0, 15.0, 40.0, 400.0):
        for p in rng.uniform(low - 50, high + 50, (20, 2)):
            found = views.near(p, reach)
            delta = np.abs(views.positions - p).max(axis=1)
            assert set(found) == set(np.flatnonzero(delta <= reach))
            assert (np.diff(delta[found]) >= -1e-6).all(), "nearest first"


def test_nearest_is_what_near_finds_first(real_city, rng):
    views = real_city.views
    low, high = views.positions.min(axis=0), views.positions.max(axis=0)
    places = np.concatenate([rng.uniform(low - 50, high + 50, (300, 2)), views.positions[::40]])
    one_by_one = [next(iter(views.near(p, STRIDE)), -1) for p in places]
    assert views.nearest(places).tolist() == one_by_one
    assert -1 in one_by_one


def test_fade_falls_from_one_to_nothing():
    d = np.arange(0, 200, 5, dtype=np.float32)
    sight = fade(d)
    assert (np.diff(sight) <= 0).all()
    assert sight[0] > 0.99
    assert sight[-1] < 1e-6
    assert fade(np.array([SIGHT], np.float32))[0] == pytest.approx(0.5)


@pytest.mark.parametrize(
    "box",
    [(0, 0, 0, 0), (-127, -127, 127, 127), (-38, 5, -12, 38), (38, -38, 38, -1), (-1, 1, 1, 2)],
)
def test_boxes_in_a_word(box):
    assert tuple(unpack_box(pack_box(*box))) == box
    assert tuple(unpack_box(join_boxes(np.int32(EMPTY_BOX), pack_box(*box)))) == box
    assert tuple(unpack_box(join_boxes(pack_box(*box), pack_box(0, 0, 0, 0)))) == (
        min(box[0], 0), min(box[1], 0), max(box[2], 0), max(box[3], 0),
    )  # fmt: skip


def test_same_map_same_index(harbour):
    one, two = ViewIndex.build(harbour.objects), ViewIndex.build(harbour.objects)
    for name, column in vars(one).items():
        if isinstance(column, np.ndarray):
            np.testing.assert_array_equal(column, getattr(two, name), err_msg=name)
