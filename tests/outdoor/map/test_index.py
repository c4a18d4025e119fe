import os
import pickle
from dataclasses import replace
from mmap import mmap

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.errors import MapError
from placegraph.outdoor.likelihood.bound_kernels import _add_run, list_runs
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.geometry_kernels import nearest_on_parts
from placegraph.outdoor.map.index import (
    FADE,
    LEVELS,
    REACH,
    SECOND_LABEL,
    SIGHT,
    STRIDE,
    Core,
    ViewColumns,
    ViewIndex,
    _joined,
    build,
    fade,
)
from placegraph.outdoor.map.index_kernels import (
    FALLS,
    JUMP,
    PULLS,
    SLOTS,
    TOTALS,
    count_bits,
    read_step,
    slot_of,
    write_step,
)


def nearest(o, row, position):
    east, north, d2 = nearest_on_parts(
        o.part_starts, o.point_starts, o.points, o.kind[row], row, *map(float, position)
    )
    return east, north, np.sqrt(d2)


def sample(city, rng, n=25):
    return rng.choice(len(city.views), min(n, len(city.views)), replace=False)


def sight_of(seen):
    return fade(np.hypot(seen.offsets[:, 0], seen.offsets[:, 1]))


def test_what_is_in_sight(real_city, rng):
    o = real_city.objects
    rows = sample(real_city, rng)
    seen = real_city.in_sight(rows)
    np.testing.assert_array_equal(seen.points, rows)
    for k, position in enumerate(real_city.views.positions_of(rows).astype(np.float64)):
        here = slice(seen.starts[k], seen.starts[k + 1])
        found = dict(zip(seen.objects[here], seen.offsets[here], strict=True))
        assert (np.diff(seen.objects[here]) > 0).all()
        expected = {}
        for row in range(len(o)):
            east, north, d = nearest(o, row, position)
            if d <= REACH - 1e-3:
                expected[row] = (east, north)
        assert set(expected) <= set(found)
        assert all(nearest(o, row, position)[2] < REACH + 1e-3 for row in found)
        for row, offset in expected.items():
            assert np.hypot(*offset) == pytest.approx(np.hypot(*found[row]), abs=0.01)


def test_sums_of_sight_are_rounded_to_the_safe_side(real_city, rng):
    o, rows = real_city.objects, sample(real_city, rng)
    seen, c = real_city.in_sight(rows), real_city.views.columns
    for k, row in enumerate(rows):
        here = slice(seen.starts[k], seen.starts[k + 1])
        d = np.hypot(*seen.offsets[here].T)
        sight = 1 / (1 + np.exp((d - SIGHT) / FADE))
        assert 0.5 * sight.sum() <= TOTALS[c.density[row]] <= max(1.0, sight.sum() * 1.0001)
        outside = sight * ~((o.kind[seen.objects[here]] == 2) & (d == 0))
        root = np.sqrt(max(outside.sum() ** 2 - (outside**2).sum(), 0.0))
        pull = sight.sum() / np.sqrt(root**2 + 30.0)
        assert pull * 0.999 <= PULLS[c.density[row]] <= max(PULLS[0], pull * 1.1)


def test_everything_is_seen_from_somewhere(real_city):
    seen = real_city.in_sight(np.arange(len(real_city.views)))
    assert len(np.unique(seen.objects)) == len(real_city.objects)
    c, listed, k = real_city.views.columns, set(), 0
    for end in c.thing_starts[1:]:
        row = -1
        while k < end:
            step, k = read_step(c.things, k)
            row += step
            listed.add(row)
    assert listed == set(range(len(real_city.objects)))


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


def test_viewpoints_lie_on_a_grid_tile_by_tile(real_city):
    positions = real_city.views.positions.astype(np.float64)
    steps = (positions - real_city.views.grid[:2]) / STRIDE
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-2)
    column, row = np.round(steps).astype(int).T
    order = np.lexsort((column, row, column // 8, row // 8))
    np.testing.assert_array_equal(order, np.arange(len(positions)))
    assert len(np.unique(positions, axis=0)) == len(positions)


def postings(views, token):
    """Viewpoint, run and share of every posting of a token."""
    c = views.columns
    runs = list_runs(c, np.array([token]))
    for run, tile, first in zip(
        range(*c.token_starts[token : token + 2]), runs.tiles, runs.postings, strict=True
    ):
        shares = np.zeros(SLOTS, np.float32)
        end = int(first) + int(c.run_sizes[run])
        _add_run(shares, c.postings, int(first), end, 0, c.present[tile], LEVELS[c.run_total[run]])
        for slot in np.flatnonzero(shares).tolist():
            before = int(c.present[tile]) & ((1 << slot) - 1)
            yield c.first[tile] + before.bit_count(), run, shares[slot]


def test_postings_by_token(real_city, rng):
    o, views = real_city.objects, real_city.views
    starts, values, _ = real_city.tokens
    seen = real_city.in_sight(np.arange(len(views)))
    sight = sight_of(seen)
    view_of = np.repeat(np.arange(len(views)), np.diff(seen.starts))
    for token in rng.choice(len(views.share), 25, replace=False).tolist():
        weights = np.zeros(len(o))
        for row in np.flatnonzero(np.add.reduceat(values == token, starts[:-1])):
            mine = np.flatnonzero(values[starts[row] : starts[row + 1]] == token)
            weights[row] = sum(
                SECOND_LABEL[min(k, 2)] if token < len(o.labels) else 1.0 for k in mine
            )
        entries = np.flatnonzero(weights[seen.objects])
        mass = np.bincount(view_of[entries], (sight * weights[seen.objects])[entries], len(views))
        found = list(postings(views, token))
        assert sorted(view for view, _, _ in found) == np.flatnonzero(mass).tolist()
        c, total = views.columns, np.bincount(view_of, sight, len(views))
        for view, run, share in found:
            exact, largest = mass[view] / total[view], LEVELS[c.run_total[run]]
            assert exact <= share * 1.0001
            assert share <= max(exact * 1.17, largest * FALLS[-1] * 1.0001)
            assert LEVELS[c.run_pairs[run]] >= share * PULLS[c.density[view]] * 0.9999


def test_frequency_is_a_share(real_city):
    views, (starts, values, weights) = real_city.views, real_city.tokens
    assert (views.share > 0).all()
    assert (views.share <= 1).all()
    seen = real_city.in_sight(np.arange(len(views)))
    sight = np.bincount(seen.objects, sight_of(seen), len(real_city.objects))
    token = int(np.argmax(views.share))
    owner = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    expected = ((values == token) * weights * sight[owner]).sum() / sight.sum()
    found = real_city.frequency(np.array([token], np.int32), np.ones(1))
    assert found == pytest.approx(expected, rel=1e-3)


def test_near(real_city, rng):
    views = real_city.views
    low, high = views.positions.min(axis=0), views.positions.max(axis=0)
    for reach in (0.0, 15.0, 40.0, 400.0):
        for p in rng.uniform(low - 50, high + 50, (20, 2)):
            found = views.near(p, reach)
            delta = np.abs(views.positions - p).max(axis=1)
            assert set(found) == set(np.flatnonzero(delta <= reach))
            assert (np.diff(delta[found]) >= -1e-6).all(), "nearest first"
    assert not len(views.near(high + 1e6, 400.0))
    assert len(views.near(low, 1e7)) == len(views)


def test_nearest_is_what_near_finds_first(real_city, rng):
    views = real_city.views
    low, high = views.positions.min(axis=0), views.positions.max(axis=0)
    places = np.concatenate([rng.uniform(low - 50, high + 50, (300, 2)), views.positions[::40]])
    one_by_one = [next(iter(views.near(p, STRIDE)), -1) for p in places]
    assert views.nearest(places).tolist() == one_by_one
    assert -1 in one_by_one


@given(st.lists(st.integers(1, 1 << 31), min_size=1))
def test_steps_are_read_as_they_were_written(steps):
    things, n = np.zeros(5 * len(steps), np.uint8), 0
    for step in steps:
        n = write_step.py_func(things, n, step)
    found, k = [], 0
    while k < n:
        step, k = read_step(things[:n], k)
        found.append(step)
    assert found == steps


@pytest.mark.parametrize("tiles", [[0, 1, 70_000, 300_000], [65_535, 65_536, 131_072], [200_000]])
def test_runs_of_far_apart_tiles_are_read_as_they_were_joined(tiles):
    n = len(tiles)
    part = {
        "token": np.zeros(n, np.int32),
        "run_tiles": np.array(tiles),
        "run_sizes": np.ones(n, np.uint8),
    }
    part |= {name: np.ones(n, np.uint8) for name in ("run_pairs", "run_total")}
    part |= {"postings": np.arange(n, dtype=np.uint8), "tiles": np.arange(400_000)}
    joined = _joined([part], 1)
    c = ViewColumns(*[None] * len(ViewColumns._fields))
    starts = (np.array([0, int(joined[name][0])]) for name in ("run_counts", "run_bytes"))
    runs = list_runs.py_func(c._replace(
        **dict(zip(("token_starts", "posting_starts"), starts, strict=True)),
        run_tiles=joined["run_tiles"], run_sizes=joined["run_sizes"],
    ), [0])  # fmt: skip
    real = joined["run_sizes"] > 0
    assert runs.tiles[real].tolist() == tiles
    assert joined["postings"][runs.postings[real]].tolist() == list(range(n))
    assert (np.diff(runs.tiles.astype(int), prepend=-1) <= JUMP).all()


@given(st.sets(st.integers(0, 63), min_size=1))
def test_bits_are_counted(slots):
    bits = np.uint64(sum(1 << s for s in slots)).astype(np.int64)
    assert slot_of(bits) == min(slots)
    assert count_bits(np.int64(bits & (1 << 62) - 1)) == sum(s < 62 for s in slots)


def test_band_by_band_is_all_at_once(real_city):
    (once, _), (banded, _) = build(real_city.objects), build(real_city.objects, at_once=200)
    # postings stand band by band; runs say where
    for name in once.keys() - {"share"}:
        np.testing.assert_array_equal(once[name], banded[name], err_msg=name)
    np.testing.assert_allclose(once["share"], banded["share"], rtol=1e-5)


def test_about_a_core_viewpoints_are_those_of_the_whole_map(real_city):
    o, views = real_city.objects, real_city.views
    middle = np.median(views.positions, axis=0).astype(np.float64)
    core = Core(middle - 300, middle + 300, lambda at: (np.abs(at - middle) < 200).all(axis=1))
    index, seen = ViewIndex.build(o, core)
    assert 0 < len(index) < len(views)
    inside = np.flatnonzero(core.holds(views.positions.astype(np.float64)))
    here = np.flatnonzero(core.holds(index.positions.astype(np.float64)))
    np.testing.assert_array_equal(index.positions[here], views.positions[inside])
    np.testing.assert_array_equal(index.columns.density[here], views.columns.density[inside])
    assert seen.viewpoints == len(inside)
    looked = real_city.in_sight(inside)
    sight, (starts, values, weights) = sight_of(looked), real_city.tokens
    assert seen.visibility == pytest.approx(sight.sum(), rel=1e-4)
    mass = np.zeros((len(inside), len(seen.mass)))
    view = np.repeat(np.arange(len(inside)), np.diff(looked.starts))
    for row, o_row, s in zip(view.tolist(), looked.objects.tolist(), sight.tolist(), strict=True):
        mine = slice(starts[o_row], starts[o_row + 1])
        np.add.at(mass[row], values[mine], s * weights[mine])
    np.testing.assert_allclose(seen.mass, mass.sum(axis=0), rtol=1e-3, atol=1e-4)
    total = np.add.reduceat(sight, looked.starts[:-1])
    np.testing.assert_allclose(seen.peak, (mass / total[:, None]).max(axis=0), rtol=1e-3, atol=1e-4)
    shares = (mass[:, : len(o.labels)] / total[:, None]).sum(axis=1)
    assert seen.spread == pytest.approx(shares.max(), rel=1e-3)
    assert seen.pull == pytest.approx((PULLS[index.columns.density[here]] ** 2).max(), rel=0.2)


def test_a_core_in_which_nothing_is_seen_counts_nothing(harbour):
    far = np.full(2, 1e6)
    index, seen = ViewIndex.build(harbour.objects, Core(far, far, lambda at: at[:, 0] > 1e5))
    assert len(index) == len(harbour.views)
    assert (seen.viewpoints, seen.visibility, seen.mass.any()) == (0, 0.0, False)


def test_an_index_travels(harbour):
    again = pickle.loads(pickle.dumps(harbour.views))  # noqa: S301  # our own
    assert again.columns.grid == harbour.views.columns.grid
    for name, column in harbour.views.arrays().items():
        np.testing.assert_array_equal(again.arrays()[name], column)
        assert not again.arrays()["postings"].flags.writeable


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("tiles", lambda a: a[::-1].copy(), "viewpoints|tile"),
        ("tiles", lambda a: a - 1, "viewpoints|tile"),
        ("present", lambda a: a * 0, "viewpoints|tile"),
        ("share", lambda a: a * np.nan, "share"),
        ("share", lambda a: -a, "share"),
        *((name, lambda a: a[:-1], "entries") for name in (
            "present", "things", "density", "run_tiles", "run_sizes", "postings", "run_pairs", "share"
        )),
        *(("grid", lambda _, grid=grid: grid, "grid") for grid in (
            (np.nan, 0.0, 4), (0.0, 1e12, 4), (0.0, 0.0, 0)
        )),
    ],
)  # fmt: skip
def test_columns_that_make_no_sense_are_refused(harbour, name, change, says):
    columns = harbour.views.arrays() | {"grid": harbour.views.grid}
    columns[name] = change(columns[name])
    with pytest.raises(ValueError, match=says):
        ViewIndex.of(columns, columns.pop("grid"))


@pytest.mark.parametrize("seed", range(4))
def test_a_forged_index_is_searched_without_harm(harbour, make_description, seed):
    rng, columns = np.random.default_rng(seed), harbour.views.arrays()
    names = "things run_tiles run_sizes postings density run_pairs run_total"
    for name in names.split():
        raw = rng.integers(0, 256, columns[name].nbytes, np.uint8)
        columns[name] = raw.view(columns[name].dtype)
    forged = replace(harbour)
    forged.__dict__["_views"] = ViewIndex.of(columns, harbour.views.grid)
    forged.locate(
        make_description(
            ("amenity=bench", "near", "me"), ("natural=tree", "north", "amenity=bench")
        )
    )
    forged.locate(make_description(("amenity=bench", "near", "me")), near=(0.0, 0.0), radius=1e7)


@pytest.fixture
def stored(harbour, tmp_path, monkeypatch):
    monkeypatch.setattr("placegraph.core.mapfile.ALIGNMENT", 1)
    monkeypatch.setattr("placegraph.outdoor.map.city.LARGE", 1000)
    path = tmp_path / "harbour.city"
    harbour.save(path, index=True)
    return path


@pytest.mark.parametrize("how", ["is truncated", "written to"])
def test_a_file_that_is_changed_while_its_index_is_used_is_refused(how, harbour, stored):
    city = City.open(stored)
    assert isinstance(city.views.columns.postings.base.base, mmap)
    sent = pickle.loads(pickle.dumps(city))  # noqa: S301  # our own
    if how == "is truncated":
        os.truncate(stored, 100)
    else:
        with stored.open("r+b") as file:
            file.write(b"x")
        os.utime(stored, (0, 0))
    with pytest.raises(MapError, match="changed while it was open"):
        city.views  # noqa: B018
    np.testing.assert_array_equal(sent.views.columns.postings, harbour.views.columns.postings)


def test_a_file_may_be_replaced_or_removed_while_its_index_is_used(harbour, stored):
    city = City.open(stored)
    harbour.save(stored, index=False)
    np.testing.assert_array_equal(city.views.columns.postings, harbour.views.columns.postings)
    stored.unlink()
    np.testing.assert_array_equal(city.views.columns.postings, harbour.views.columns.postings)


def test_an_index_that_is_not_large_is_read_and_its_file_may_be_cut_short(harbour, tmp_path):
    path = tmp_path / "harbour.city"
    harbour.save(path, index=True)
    city = City.open(path)
    os.truncate(path, 100)
    np.testing.assert_array_equal(city.views.columns.postings, harbour.views.columns.postings)
