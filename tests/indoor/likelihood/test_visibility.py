"""What is visible from where: panoramas against rays, free places against furniture, ranks by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.indoor.conftest import view_frames
from tests.indoor.likelihood.conftest import draw_view

from placegraph.core.geometry import compose, split_pose, wrap_angle
from placegraph.indoor.build import scene_of_model
from placegraph.indoor.likelihood.score import TEMPERATURE, model_of
from placegraph.indoor.likelihood.visibility import build_table, floor_under
from placegraph.indoor.map import free_space as free
from placegraph.indoor.map.free_space import MAX_ELEVATION, decode_ranges
from placegraph.indoor.map.map_kernels import (
    AZIMUTHS,
    ELEVATIONS,
    HEADINGS,
    STEP,
    opponent_colour,
    sample_colour,
)
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.merge import merge_scenes
from placegraph.indoor.options import STANDING, Likelihood, PoseSearchOptions
from placegraph.indoor.pose.search import SEEDS, table_seeds
from placegraph.indoor.pose.window import level_poses, make_label_encoder
from placegraph.indoor.scene_map import SceneMap

pytestmark = pytest.mark.usefixtures("one_thread")
OPTIONS = PoseSearchOptions(heights=STANDING, spacing=0.25)
"""One layer; `FilterOptions()` has several."""
NOISE = model_of(Likelihood()).noise
ELEVATION = ((np.arange(ELEVATIONS) + 0.5) / ELEVATIONS * 2 - 1) * MAX_ELEVATION
HALL = {
    "floor": ((0, 0, -0.1), (8, 6, 0)),
    "wall west": ((-0.2, 0, 0), (0, 6, 3)),
    "wall east": ((8, 0, 0), (8.2, 6, 3)),
    "wall south": ((0, -0.2, 0), (8, 0, 3)),
    "wall north": ((0, 6, 0), (8, 6.2, 3)),
    "cupboard": ((3, 2, 0), (5, 4, 2.2)),
    "table": ((6, 1, 0), (7, 2, 0.8)),
}


@pytest.fixture(scope="module")
def hall(boxes):
    """A hall of 8 x 6 m without a ceiling; a cupboard to walk round, a table to look over."""
    colours = np.random.default_rng(5).integers(0, 256, (8 * len(HALL), 3)).astype(np.uint8)
    return scene_of_model(boxes(HALL, colours=colours), detail="full")


@pytest.fixture(scope="module")
def table(room):
    return room.visibility(PoseSearchOptions())


def panorama(scene, position):
    """Objects, ranges and colours (E, A, ...) around a position, by the caster."""
    e, a = np.meshgrid(ELEVATION, np.arange(AZIMUTHS) * STEP, indexing="ij")
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)
    hits = scene.caster.cast(position, rays.reshape(-1, 3))
    objects = np.where(hits.triangle >= 0, scene.mesh.object_of[hits.triangle], len(scene))
    colours = np.full((len(hits.triangle), 3), np.nan)
    for r in np.flatnonzero(hits.triangle >= 0):
        footprint = np.float32(hits.distance[r] * STEP)
        seen = sample_colour(scene.surface, hits.triangle[r], hits.u[r], hits.v[r], footprint)
        colours[r] = opponent_colour(*seen)
    shape = (ELEVATIONS, AZIMUTHS)
    return objects.reshape(shape), hits.distance.reshape(shape), colours.reshape(*shape, 3)


@pytest.mark.parametrize("place", ["room", "hall"])
def test_panoramas_are_what_rays_hit(place, request, rng):
    scene = request.getfixturevalue(place)
    table = scene.visibility(OPTIONS)
    low, high = (opponent_colour(*np.float32(c)) for c in ((0, 0, 0), (1, 1, 1)))
    missed = 0
    for k in rng.choice(len(table), 3, replace=False):
        objects, ranges, colours = panorama(scene, table.positions[k])
        same = table.panoramas.objects[k] == objects
        assert same.mean() > 0.98  # rays along edges go either way
        got = decode_ranges(table.panoramas.ranges[k])[same]
        np.testing.assert_array_equal(np.isinf(got), np.isinf(ranges[same]))
        there = np.isfinite(got)
        ratio = got[there] / np.clip(ranges[same][there], 0.1, 30.0)
        assert np.quantile(np.abs(np.log(ratio)), 0.98) < 0.024  # one step of the logarithm
        missed += (~there).sum()
        # colours are bytes from black to white, and of the chromaticities' range
        stored = np.moveaxis(table.panoramas.colours[k], 1, 2)[same][there].astype(float)
        shown = colours[same][there]
        for c, scale in ((0, 255 / (high[0] - low[0])), (1, 127), (2, 63)):
            shift = 0 if c == 0 else 127
            error = np.abs(stored[:, c] - (shown[:, c] * scale + shift))
            assert np.quantile(error, 0.98) <= 1.5
    assert missed or place == "room"  # the hall has no ceiling


def test_stored_ranges_are_steps_of_a_logarithm():
    ranges = decode_ranges(np.arange(256, dtype=np.uint8))
    assert ranges[0] == pytest.approx(0.1)
    assert ranges[254] == pytest.approx(30.0)
    assert np.isinf(ranges[255])
    np.testing.assert_allclose(ranges[1:255] / ranges[:254], 300 ** (1 / 254), rtol=1e-4)


def test_the_background_is_what_is_seen_on_average(table, room):
    around = table.background
    assert around.objects.shape == (len(room),)
    assert around.objects.sum() == pytest.approx(1)
    assert (around.objects > 0).all()  # what no place sees could still be seen
    counts = np.bincount(table.panoramas.objects.ravel(), minlength=len(room) + 1)[:-1]
    np.testing.assert_allclose(around.objects, counts / counts.sum(), atol=1e-4)
    np.testing.assert_allclose(around.ranges.sum(axis=1), 1.0)
    assert around.ranges.shape == (ELEVATIONS, 256)
    assert (around.ranges[:, 255] == 0).all()
    # the floor is near where the table looks steeply down, walls are far along the horizon
    mean = around.ranges @ around.distances
    assert mean[0] < mean[ELEVATIONS // 2]


def inside(points, low, high, margin=0.0):
    low, high = np.array(low[:2]) - margin, np.array(high[:2]) + margin
    return ((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)


def test_all_that_is_open_is_free(hall):
    table = hall.visibility(OPTIONS)
    cell = table.spacing
    x, y = np.meshgrid(np.arange(-0.2, 8.2, cell), np.arange(-0.2, 6.2, cell), indexing="ij")
    grid = np.column_stack([x.ravel(), y.ravel()]) + cell / 2
    open_ = inside(grid, (0.3, 0.3), (7.7, 5.7)) & ~inside(grid, *HALL["cupboard"], margin=0.3)
    at = table.positions
    nearest = np.linalg.norm(grid[open_][:, None] - at[None, :, :2], axis=2).min(axis=1)
    assert nearest.max() < cell * 0.75
    assert inside(at, *HALL["table"]).any()
    np.testing.assert_allclose(at[:, 2], 1.65)


SOLID = "free.free admits places within closed furniture that is wide enough"


@pytest.mark.parametrize("place", ["room", "flat", "hall"])
def test_nobody_stands_outside_or_within_walls(place, request):
    scene = request.getfixturevalue(place)
    at = scene.visibility(OPTIONS).positions
    down = scene.caster.cast(at, np.tile([0.0, 0.0, -1.0], (len(at), 1)))
    outside = ~np.isfinite(down.distance)
    assert outside.mean() < 0.03
    if outside.any():
        ways = at[~outside][None] - at[outside][:, None]
        starts = np.repeat(at[outside], len(ways[0]), axis=0)
        seen = scene.caster.cast(starts, ways.reshape(-1, 3)).distance > 1.0
        assert seen.reshape(ways.shape[:2]).mean(axis=1).min() > 0.1


@pytest.mark.xfail(reason=SOLID, strict=True)
@pytest.mark.parametrize(("thing", "height"), [("cupboard", 1.65), ("table", 0.4)])
def test_nobody_stands_in_furniture(hall, thing, height):
    table = build_table(hall, PoseSearchOptions(heights=(height,)))
    assert not inside(table.positions, *HALL[thing]).any()


@pytest.mark.parametrize("place", ["room", "flat"])
def test_free_places_keep_clear_of_surfaces(place, request, rng):
    scene = request.getfixturevalue(place)
    table = scene.visibility(OPTIONS)
    azimuth = np.linspace(0, 2 * np.pi, 96, endpoint=False)
    around = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(96)])
    rows = rng.choice(len(table), min(len(table), 150), replace=False)
    near = [scene.caster.cast(table.positions[k], around).distance.min() for k in rows]
    assert min(near) > 0.1
    # no one can stand in the tall pieces of furniture
    boxes = scene.mesh.object_bounds(len(scene))
    tall = [i for i, label in enumerate(scene.graph.labels) if label in {"bookcase", "wardrobe"}]
    assert tall
    for i in tall:
        assert not inside(table.positions, *boxes[i], margin=-0.05).any()


def test_rows_are_found_by_cell(table):
    layers, nx, ny = table.index.shape
    assert layers == 5
    rows = np.sort(table.index[table.index >= 0])
    np.testing.assert_array_equal(rows, np.arange(len(table)))
    for layer, i, j in np.argwhere(table.index >= 0):
        row = table.index[layer, i, j]
        centre = table.origin + (np.array([i, j]) + 0.5) * table.spacing
        np.testing.assert_allclose(table.positions[row, :2], centre)
        assert table.layer[row] == layer
    assert layers * nx * ny > len(table)


def test_one_layer_serves_heights_near_each_other(hall):
    for heights in ((1.5, 1.6, 1.7, 1.8), (1.65,), (0.4, 1.7), (1.0, 1.5, 2.4)):
        table = build_table(hall, PoseSearchOptions(heights=heights, spacing=0.5))
        z = np.unique(table.positions[:, 2].round(6))
        assert len(z) == table.index.shape[0]
        for height in heights:
            assert np.abs(z - height).min() <= free.LAYER_GAP / 2 + 1e-6
        assert min(heights) - 1e-9 <= z.min() <= z.max() <= max(heights) + 1e-9
        assert (np.diff(z) <= free.LAYER_GAP + 1e-6).all()
        for layer, height in enumerate(z):
            assert (table.positions[table.layer == layer, 2].round(6) == height).all()
    # one above the cupboard looks over it
    high = build_table(hall, PoseSearchOptions(heights=(2.6,)))
    assert inside(high.positions, *HALL["cupboard"]).any()


def test_large_maps_get_a_wider_grid(hall, monkeypatch):
    monkeypatch.setattr(free, "MAX_PLACES", 100)
    table = build_table(hall, OPTIONS)
    assert table.spacing > 0.6
    assert 20 < len(table) <= 100
    monkeypatch.setattr(free, "MAX_PLACES", 100_000)
    assert build_table(hall, OPTIONS).spacing == OPTIONS.spacing


SMALL = "free._ground: in a small room, a square metre is more than a hundredth of all"


@pytest.mark.parametrize(
    "place",
    [
        "flat",
        pytest.param("room", marks=[pytest.mark.all, pytest.mark.xfail(reason=SMALL, strict=True)]),
    ],
)
def test_one_vast_triangle_does_not_spread_the_grid(place, request):
    scene = request.getfixturevalue(place)
    mesh, count = scene.mesh, len(scene.mesh.vertices)
    plain = [[-4000, -4000, -0.3], [4000, -4000, -0.3], [0, 5000, -0.3]]
    vast = SceneMap.create(
        Mesh.plain(
            np.concatenate([mesh.vertices, plain]),
            np.concatenate([mesh.triangles, [[count, count + 1, count + 2]]]),
            np.append(mesh.object_of, len(scene)),
        ),
        [*scene.graph.ids, "plain"], [*scene.graph.labels, "ground"], floor=float(scene.floors[0]),
    )  # fmt: skip
    found = build_table(vast, OPTIONS)
    assert found.spacing == OPTIONS.spacing
    low, high = scene.bounds
    within = inside(found.positions, low, high)
    assert within.sum() > 0.8 * len(scene.visibility(OPTIONS))
    assert inside(found.positions, low, high, margin=2.0).all()


@pytest.fixture(scope="module")
def merged(hall, boxes):
    """The hall, and a smaller room 3 m higher up."""
    upper = {"floor": ((0, 0, 2.9), (4, 4, 3)), "wall": ((0, 0, 3), (0.1, 4, 5.5))}
    return merge_scenes({"hall": hall, "upstairs": scene_of_model(boxes(upper))})


def test_floors_of_merged_scenes(merged):
    first, second = merged.scene_bounds
    points = np.array([first.mean(axis=0)[:2], second.mean(axis=0)[:2], [-100.0, 0.0]])
    np.testing.assert_allclose(floor_under(merged, points), [merged.floors[i] for i in (0, 1, 0)])
    table = build_table(merged, replace(OPTIONS, spacing=0.5))
    in_second = inside(table.positions, *second)
    assert in_second.sum() > 30
    assert inside(table.positions, *first).sum() > 100
    floors = np.where(in_second, merged.floors[1], merged.floors[0])
    np.testing.assert_allclose(table.positions[:, 2], floors + 1.65)
    near = (inside(table.positions, *b, free.SEARCH_MARGIN + 0.5) for b in merged.scene_bounds)
    assert np.logical_or(*near).all()


def slow_scan(table, view, k, a, turn=0.0):
    """What one view, turned, says of position k and heading a: each sample looks into its bin."""
    used = np.flatnonzero(view.patch >= 0)
    used = [r for r in used if abs(_elevation(view.directions[r])) < MAX_ELEVATION]
    shares = np.bincount(view.patch[used], minlength=len(view.weight))
    total, seen, shown = 0.0, [], []
    ranges = decode_ranges(np.arange(256, dtype=np.uint8))
    for r in used:
        ray = view.directions[r].astype(float)
        e = int((_elevation(ray) / MAX_ELEVATION + 1) / 2 * ELEVATIONS)
        b = (
            round((math.atan2(ray[1], ray[0]) + turn) / STEP) + a * AZIMUTHS // HEADINGS
        ) % AZIMUTHS
        expected = float(ranges[table.panoramas.ranges[k, e, b]])
        if view.terms[0]:
            ratio = view.semantic[view.patch[r], table.panoramas.objects[k, e, b]]
            total += math.log(ratio) * view.weight[view.patch[r]] / shares[view.patch[r]]
        if view.terms[1] and view.depth[r] > 0 and math.isfinite(expected):
            measured = view.depth[r] * np.linalg.norm(ray)
            sd = NOISE.depth_floor + table.spacing / 2 + NOISE.depth_slope * measured
            good = 1 / (1 + ((expected - measured) / sd) ** 2)
            cost = NOISE.near_cost if expected > measured else NOISE.far_cost
            fit = good * NOISE.depth_gain - (1 - good) * cost - view.background_depth[r]
            total += fit * NOISE.depth_weight / len(used)
        if view.terms[2] and math.isfinite(expected):
            seen.append(view.colour[r] * (85, 127, 63) + (0, 127, 127))
            shown.append(table.panoramas.colours[k, e, :, b].astype(float))
    if len(seen) >= 16:
        q, r = np.array(seen), np.array(shown)
        for c in range(3):
            if q[:, c].var() > 1 and r[:, c].var() > 1:
                rho = min(max(np.corrcoef(q[:, c], r[:, c])[0, 1], 0), 0.99)
                share = len(seen) / len(used)
                total -= NOISE.colour_weight * share * math.log(1 - rho * rho) / 6
    return total


def _elevation(ray):
    return math.asin(ray[2] / np.linalg.norm(ray))


@pytest.mark.parametrize("place", ["room", "hall"])
@pytest.mark.parametrize(
    "terms", [(True, False, False), (False, True, False), (False, False, True), (True, True, False)]
)
def test_scans_are_looked_up_sample_by_sample(place, terms, request, rng):
    scene = request.getfixturevalue(place)
    table = scene.visibility(OPTIONS)
    view = draw_view(rng, len(scene), stride=10, terms=terms)
    got = table.scans([view], np.zeros(1), NOISE)[0]
    assert got.shape == (len(table), HEADINGS)
    for _ in range(60):
        k, a = int(rng.integers(len(table))), int(rng.integers(HEADINGS))
        assert got[k, a] == pytest.approx(slow_scan(table, view, k, a), rel=2e-3, abs=2e-3)
    assert np.ptp(got) > 0.5


def test_what_a_frame_lacks_says_nothing(table, room, rng):
    terms = [(False, False, True), (True, False, False), (False, True, False), (True, True, False)]
    seen = [draw_view(rng, len(room), stride=10, terms=senses) for senses in terms]
    together = table.scans(seen, np.zeros(4), NOISE)
    for one, view in zip(together, seen, strict=True):
        alone = table.scans([view], np.zeros(1), NOISE)[0]
        np.testing.assert_allclose(one, alone, rtol=1e-4, atol=1e-3)


def test_ranks_add_up_what_frames_say(table, room, rng):
    seen = [draw_view(rng, len(room), stride=10, terms=(True, True, False)) for _ in range(3)]
    steps = np.array([[0, 0, 0, 0], [0.6, -0.3, 0.02, 1.0], [-0.9, 0.2, 0, -2.5]])
    ranks = table.ranks(seen, steps, NOISE)
    scans = table.scans(seen, steps[:, 3], NOISE)
    off_table = 0
    for _ in range(200):
        k, a = int(rng.integers(len(table))), int(rng.integers(HEADINGS))
        # where cameras seldom are comes later among equals
        expected = 0.0 if table.is_common[k] else -4.0 * TEMPERATURE * math.sqrt(3)
        for scan, step in zip(scans, steps, strict=True):
            pose = compose(np.append(table.positions[k], 2 * np.pi * a / HEADINGS), step)
            i, j = np.floor((pose[:2] - table.origin) / table.spacing).astype(int)
            _, nx, ny = table.index.shape
            row = table.index[table.layer[k], i, j] if 0 <= i < nx and 0 <= j < ny else -1
            # what is unknown is bad, not impossible
            expected += scan[row, a] if row >= 0 else np.percentile(scan.ravel()[::7], 5)
            off_table += row < 0
        assert ranks[k, a] == pytest.approx(expected, abs=1e-3)
    assert 0 < off_table < 400
    assert 0.2 < table.is_common.mean() < 0.6


@pytest.mark.parametrize(
    ("gravity", "turn"), [((0, 0.3, 1), 0.0), ((0.05, 1, 0.1), 0.4)], ids=["steep", "turned"]
)
def test_steep_and_turned_views(gravity, turn, table, room, rng):
    view = draw_view(rng, len(room), stride=10, terms=(True, True, False), gravity=gravity)
    got = table.scans([view], np.array([turn]), NOISE)[0]
    for k, a in ((0, 0), (50, 17), (100, 35)):
        assert got[k, a] == pytest.approx(slow_scan(table, view, k, a, turn), rel=2e-3, abs=2e-3)
    down = draw_view(rng, len(room), stride=10, terms=(True, True, True), gravity=(0, 0, 1))
    assert np.isfinite(table.scans([down], np.zeros(1), NOISE)).all()


@pytest.mark.parametrize("terms", [(False, True, False), (True, True, False)])
def test_few_samples_speak_for_all(terms, table, room, rng):
    view = draw_view(rng, len(room), stride=10, terms=terms)
    whole = table.scans([view], np.zeros(1), NOISE)[0]
    some = table.scans([view] * 15, np.zeros(15), NOISE)
    assert any((one != whole).any() for one in some)
    mean = some.mean(axis=0)
    assert np.corrcoef(mean.ravel(), whole.ravel())[0, 1] > 0.7
    assert mean.std() == pytest.approx(whole.std(), rel=0.4)


CUES = [
    {"semantic": True}, {"depth": True}, {"colour": True}, {"semantic": True, "depth": True},
    {"depth": True, "colour": True},
]  # fmt: skip


def sighted(scene, capture, truth, cues):
    """Views of a capture, its odometry and its true poses (T, 4)."""
    options = OPTIONS.only(**cues)
    encoder = make_label_encoder(scene, capture[0]) if cues.get("semantic") else None
    seen = view_frames(scene, capture, options, encoder)
    poses = level_poses(capture.odometry, capture.gravity)
    return seen, poses, split_pose(truth(capture))[0]


def off(poses, truth):
    """Distances (N,) on the floor [m] and turns (N,) [rad]."""
    distance = np.linalg.norm(poses[:, :2] - truth[:2], axis=1)
    return distance, np.abs(wrap_angle(poses[:, 3] - truth[3]))


@pytest.mark.parametrize("cues", CUES)
def test_the_table_ranks_the_true_cell_high(cues, room, walk, truth):
    table = room.visibility(OPTIONS)
    seen, _, true = sighted(room, walk, truth, cues)
    shares = []
    for t in range(0, len(seen), 3):
        scan = table.scans([seen[t]], np.zeros(1), NOISE)[0]
        near = np.linalg.norm(table.positions[:, :2] - true[t, :2], axis=1) < 0.3
        heading = round(true[t, 3] / (2 * np.pi) * HEADINGS) % HEADINGS
        assert near.any()
        shares.append((scan > scan[near, heading].max()).mean())
    assert np.median(shares) < 0.01


@pytest.mark.parametrize("cues", CUES)
def test_seeds_hold_the_true_pose(cues, flat, flat_walk, truth):
    seen, poses, true = sighted(flat, flat_walk, truth, cues)
    last = len(seen) - 1
    table = flat.visibility(PoseSearchOptions())
    seeds, ranks = table_seeds(table, seen, poses, NOISE, last)
    assert len(seeds) <= SEEDS
    assert (np.diff(ranks) <= 0).all()
    distance, turn = off(seeds, true[last])
    good = (distance < 0.5) & (turn < 0.35)
    assert good.any()
    if len(cues) > 1:
        assert good.argmax() < 3


def test_seeds_are_poses_of_the_frame_asked_for(room, walk, truth):
    seen, poses, true = sighted(room, walk, truth, {"semantic": True, "depth": True})
    table = room.visibility(PoseSearchOptions())
    for reference in (0, 4, 9):
        seeds, _ = table_seeds(table, seen, poses, NOISE, reference, 5)
        assert len(seeds) <= 5
        distance, turn = off(seeds[:2], true[reference])
        assert ((distance < 0.45) & (turn < 0.3)).any()
