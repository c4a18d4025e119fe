"""Views: what was seen where, whatever cameras saw it; ratios against knowing nothing."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.core.geometry import Camera, level_from_camera
from placegraph.indoor.encode import Patches
from placegraph.indoor.likelihood.observe import Background, observe_frame, views
from placegraph.indoor.likelihood.score import model_of
from placegraph.indoor.map.map_kernels import opponent_colour
from placegraph.indoor.options import FilterOptions, Likelihood, PoseSearchOptions
from placegraph.io.capture.frame import Frame

CAMERA = Camera(160, 90, 115.0, 112.0, 78.0, 47.0)
BENT = Camera(160, 90, 90.0, 92.0, 81.0, 44.0, (-0.2, 0.05, 0.001, -0.002))
GRAVITY = np.array([0.1, 0.95, 0.3])
OPTIONS = PoseSearchOptions()
ALL = np.array([True, True, True])


def background(objects=3, shares=None, ranges=None):
    """Nothing known: `shares` of objects, and the same `ranges` in every band."""
    bins = np.geomspace(0.2, 20, 64)
    ranges = np.ones(64) if ranges is None else ranges
    return Background(
        objects=np.full(objects, 1 / objects) if shares is None else np.array(shares, float),
        ranges=np.tile(ranges / ranges.sum(), (20, 1)),
        distances=bins,
        highest=np.deg2rad(50),
    )


def frame(camera=CAMERA, rgb=None, **options):
    rgb = np.full((camera.height, camera.width, 3), 128, np.uint8) if rgb is None else rgb
    return Frame.from_arrays(rgb, camera, **{"gravity": GRAVITY} | options)


class Says:
    """An encoder that says what it is told."""

    def __init__(self, patches):
        self.patches = patches

    def encode(self, _):
        return self.patches


def view_of(seen, stride=10.0, encoder=None, options=OPTIONS, around=None):
    model = model_of(options.likelihood)
    (view,) = views([observe_frame(seen, encoder, options)], stride, model, around or background())
    return view


def points(view, camera=CAMERA):
    """Image points (R, 2) in the colour image through which a view's rays go."""
    return camera.project(view.directions @ level_from_camera(GRAVITY))


def pixel(uv, camera):
    """Row and column of image points, and whether they lie in the image."""
    column, row = np.floor(np.nan_to_num(uv, nan=-1.0)).astype(int).T
    there = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return np.where(there, row, 0), np.where(there, column, 0), there


def patches(grid, camera=CAMERA, rows=None, table=None):
    count = grid[0] * grid[1]
    rows = np.arange(count) % 3 if rows is None else rows
    table = 2 * np.eye(3) - 1 if table is None else table
    return Patches(camera, grid, np.array(rows, np.int32), np.array(table, np.float32))


@given(
    st.integers(16, 400), st.integers(16, 400), st.floats(2, 60), st.booleans(),
    st.floats(0.5, 2), st.floats(-0.1, 0.1),
)  # fmt: skip
@settings(max_examples=20)
def test_samples_fill_the_image_whatever_the_stride(width, height, stride, bent, focal, off):
    longer = max(width, height)
    camera = Camera(
        width, height, longer * focal, longer * focal, width * (0.5 + off), height * 0.5,
        (-0.05, 0.01, 0.0, 0.0) if bent else (),
    )  # fmt: skip
    view = view_of(frame(camera), stride)
    uv = points(view, camera)[view.patch >= 0]
    columns, rows = max(4, round(width / stride)), max(4, round(height / stride))
    size = np.array([width / columns, height / rows])
    cell = np.floor(uv / size)
    np.testing.assert_allclose(uv, (cell + 0.5) * size, atol=0.02)
    assert sorted(map(tuple, cell)) == [(x, y) for x in range(columns) for y in range(rows)]
    assert len(view.directions) % 16 == 0
    assert view.footprint == pytest.approx(width / columns / camera.fx)


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (1920, 1080), (1080, 1920), (641, 480)])
def test_large_images_have_larger_pixels_not_more_samples(width, height):
    longer = max(width, height)
    camera = Camera(width, height, longer * 0.7, longer * 0.7, width / 2, height / 2)
    small = camera.resize(round(width * 640 / longer), round(height * 640 / longer))
    many, few = (view_of(frame(c), 20.0) for c in (camera, small))
    assert (many.patch >= 0).sum() == (few.patch >= 0).sum()
    inside = many.patch >= 0
    np.testing.assert_allclose(many.directions[inside], few.directions[inside], atol=2e-3)
    assert many.footprint == pytest.approx(few.footprint, rel=0.01)


@pytest.mark.parametrize("stride", [20, 8, 4, 12, 1])
@pytest.mark.parametrize(("width", "height"), [(540, 960), (1296, 968)])
def test_strides_of_the_paper_are_pixels_of_images_of_any_size(width, height, stride):
    """Those of 3RScan and of ScanNet: rows and columns are as many as the stride goes in."""
    camera = Camera(width, height, 700.0, 700.0, width / 2, height / 2)
    seen, model = observe_frame(frame(camera), None, OPTIONS), model_of(OPTIONS.likelihood)
    (view,) = views([seen], stride, model, background(), scaled=False)
    samples = (view.patch >= 0).sum()
    assert samples == round(width / stride) * round(height / stride)
    assert view.footprint * camera.fx == pytest.approx(stride, rel=0.02)
    for options in (FilterOptions.paper(), FilterOptions.published(), FilterOptions.coarse()):
        assert not any(one.scaled for one in options.passes)


def test_where_a_lens_cannot_be_undone_there_is_no_sample():
    folded = Camera(160, 90, 60.0, 60.0, 80.0, 45.0, (-0.3, 0.0, 0.0, 0.0))
    view = view_of(frame(folded, depth=np.full((90, 160), 2.0)), 10.0)
    inside = view.patch >= 0
    # x (1 - 0.3 x^2) grows up to 0.703: a circle of 42 px
    assert inside.sum() / (16 * 9) == pytest.approx(np.pi * 42.2**2 / (160 * 90), abs=0.06)
    assert np.isfinite(view.directions).all()
    assert (view.depth[~inside] == 0).all()
    uv = points(view, folded)[inside]
    assert (np.abs(uv / 10 - np.floor(uv / 10) - 0.5) < 0.11).all()  # they are where cells are


def test_samples_stand_in_tiles():
    view = view_of(frame(), 10.0)  # 16 x 9 samples: the last tiles are filled up
    assert len(view.directions) == 16 * 12
    uv = points(view).reshape(-1, 16, 2)
    inside = (view.patch >= 0).reshape(-1, 16)
    assert inside.sum() == 16 * 9
    assert (np.ptp(uv, axis=1) <= 31).all()
    np.testing.assert_allclose(uv[0, :5], [[5, 5], [15, 5], [25, 5], [35, 5], [5, 15]], atol=1e-3)
    # what fills a tile up lies at the border, so that its rays stay alike
    assert (uv[:, :, 1] < 90).all()


OTHERS = [
    Camera(160, 90, 115.0, 112.0, 78.0, 47.0),  # the same
    Camera(80, 45, 57.5, 56.0, 39.0, 23.5),  # half
    Camera(97, 61, 60.0, 64.0, 50.0, 28.0),  # of its own size and focal lengths
    Camera(120, 90, 140.0, 140.0, 75.0, 40.0),  # narrower: it misses the borders
    Camera(64, 64, 30.0, 31.0, 32.5, 30.0, (-0.1, 0.02, 0.001, 0.001)),  # wider, bent
]


@pytest.mark.parametrize("camera", [CAMERA, BENT])
@pytest.mark.parametrize("other", OTHERS)
@pytest.mark.parametrize("stride", [13.7, 7.3])
def test_depth_is_taken_where_the_ray_goes(camera, other, stride):
    numbers = (np.arange(other.width * other.height) + 1.0).reshape(other.height, other.width)
    seen = frame(camera, depth=numbers, depth_camera=other)
    view = view_of(seen, stride)
    # from the view's rays alone: through the depth camera
    uv = other.project(view.directions.astype(float) @ level_from_camera(GRAVITY))
    row, column, there = pixel(uv, other)
    there &= view.patch >= 0
    expected = np.where(there, numbers[row, column], 0.0)
    on_edge = np.abs(uv - np.rint(uv)).min(axis=1) < 1e-3  # rounded otherwise in four bytes
    np.testing.assert_array_equal(view.depth[~on_edge], expected[~on_edge])
    assert (there & ~on_edge).sum() > 20
    if other in OTHERS[:2] and camera is CAMERA:  # it sees just as much
        assert there[view.patch >= 0].all()


@pytest.mark.parametrize("camera", [CAMERA, BENT])
@pytest.mark.parametrize("other", OTHERS)
@pytest.mark.parametrize("grid", [(9, 16), (14, 14), (1, 1), (5, 3)])
def test_patches_are_taken_where_the_ray_goes(camera, other, grid):
    view = view_of(frame(camera), 8.0, Says(patches(grid, other)))
    uv = other.project(view.directions.astype(float) @ level_from_camera(GRAVITY))
    _, _, there = pixel(uv, other)
    inside = view.patch >= 0
    with np.errstate(invalid="ignore"):
        row = np.floor(uv[:, 1] / other.height * grid[0])
        column = np.floor(uv[:, 0] / other.width * grid[1])
    count = grid[0] * grid[1]
    expected = np.where(there, np.nan_to_num(row) * grid[1] + np.nan_to_num(column), count)
    scaled = uv / (other.width, other.height) * grid[::-1]
    on_edge = np.abs(scaled - np.rint(scaled)).min(axis=1) < 1e-4
    same = inside & ~on_edge
    np.testing.assert_array_equal(view.patch[same], expected[same])
    assert same.sum() > 100
    # who lies in no patch is told nothing
    assert len(view.weight) == len(view.semantic) == count + 1
    assert view.weight[-1] == 0
    assert (view.semantic[-1] == 1).all()


def test_holes_say_nothing():
    depth = np.full((45, 80), 2.0, np.float32)
    depth[:20] = np.nan
    depth[20:30] = 0.0
    depth[30:40] = -1.0
    depth[40:42] = np.inf
    view = view_of(frame(depth=depth), 4.0)
    v = points(view)[:, 1]
    read = view.depth > 0
    assert (view.depth[read] == 2.0).all()
    assert (read == ((v > 84) & (view.patch >= 0))).all()
    assert np.isfinite(view.depth).all()
    assert (view.background_depth[~read] == 0).all()
    assert view.terms.tolist() == [False, True, True]


@pytest.mark.parametrize("depth", [np.zeros((45, 80)), np.full((45, 80), np.nan)])
def test_depth_without_a_reading_is_none(depth):
    seen = frame(depth=depth)
    observation = observe_frame(seen, None, OPTIONS)
    assert observation.depth is None
    assert view_of(seen).terms.tolist() == [False, False, True]


def test_nothing_is_read_that_is_not_asked_for():
    class Torn:
        def rgb(self):
            raise AssertionError("read the colours")

        def depth(self):
            raise AssertionError("read the depth")

        def labels(self):
            raise AssertionError("read the labels")

    seen = frame()
    torn = replace(seen, images=Torn())
    for cue, says in (("depth", "the depth"), ("colour", "the colours")):
        with pytest.raises(AssertionError, match=says):
            observe_frame(torn, None, OPTIONS.only(**{cue: True}))
    encoder = Says(patches((2, 2)))
    observation = observe_frame(torn, encoder, OPTIONS.only(semantic=True))
    assert observation.patches is encoder.patches
    assert observation.depth is observation.rgb is None
    assert observe_frame(frame(), encoder, OPTIONS.only(colour=True)).patches is None


def test_what_a_patch_says_by_hand():
    """A share of patches is wrong (`Likelihood.wrong`), the rest is shared by similarity."""
    table = np.array([[1, -1, -1], [1, 1, -1], [0.9, 0.85, 0.1]])
    seen = patches((2, 2), rows=[0, 2, 1, -1], table=table)
    view = view_of(frame(), encoder=Says(seen))
    share = np.exp(table / 0.05)
    share /= share.sum(axis=1, keepdims=True)
    expected = np.column_stack([0.7 * 3 * share + 0.3, np.ones(3)])
    np.testing.assert_allclose(view.semantic[:3], expected[[0, 2, 1]], rtol=1e-4)
    assert view.weight.tolist() == [1, 1, 1, 0, 0]


@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.floats(0.01, 0.99), st.floats(0.02, 1))
@settings(max_examples=40)
def test_ratios_average_to_one_over_the_map(seed, objects, wrong, sharpness):
    rng = np.random.default_rng(seed)
    options = PoseSearchOptions(likelihood=Likelihood(wrong=wrong, sharpness=sharpness))
    shares = rng.dirichlet(np.ones(objects))
    table = rng.uniform(-1, 1, (6, objects))
    seen = patches((2, 3), rows=np.arange(6), table=table)
    view = view_of(frame(), 30.0, Says(seen), options, background(objects, shares))
    np.testing.assert_allclose(view.semantic[:6, :objects] @ shares, 1.0, rtol=1e-4)
    assert (view.semantic > 0).all()
    assert (view.semantic[:, objects] == 1).all()


def test_eq_2_scores_agreement_by_its_cosine():
    options = PoseSearchOptions(likelihood=Likelihood(kind="gaussian"))
    table = [[0.8, -0.5, 0.1], [0.4, 0.4, -1.0]]
    seen = patches((1, 3), rows=[0, 1, -1], table=table)
    view = view_of(frame(), encoder=Says(seen), options=options)
    np.testing.assert_allclose(view.semantic[0], [1.8, 0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(view.semantic[1], [1.4, 1.4, 0, 0], atol=1e-6)  # both are best
    assert view.weight.tolist() == [1, 1, 0, 0]


def test_what_fills_many_patches_counts_in_part():
    few = Likelihood(object_patches=9.0)
    options = PoseSearchOptions(likelihood=few)
    first = patches((6, 6), rows=[0] * 30 + [1] * 5 + [-1])
    second = patches((6, 6), rows=[0] * 6 + [1] * 4 + [2] * 3 + [-1] * 23)
    observations = [observe_frame(frame(), Says(p), options) for p in (first, second)]
    one, two = views(observations, 20.0, model_of(few), background())
    wall = math.sqrt(9 / 36)
    np.testing.assert_allclose(one.weight, [wall] * 30 + [1.0] * 5 + [0, 0], rtol=1e-6)
    np.testing.assert_allclose(two.weight[:13], [wall] * 6 + [1.0] * 7, rtol=1e-6)
    assert (two.weight[13:] == 0).all()
    # a frame that has no patches among others that have
    mixed = views(
        [observations[0], observe_frame(frame(), None, options)], 20.0, model_of(few), background()
    )
    assert [v.terms[0] for v in mixed] == [True, False]
    assert not mixed[1].weight.any()
    paper = Likelihood(kind="gaussian", object_patches=9.0)
    (view, _) = views(observations, 20.0, model_of(paper), background())
    assert view.weight.tolist() == [1] * 35 + [0] * 2


def depth_ratio(expected, measured, model):
    """Likelihood ratio of one reading, written out."""
    sd = model.depth_floor + 0.1 + model.depth_slope * measured
    good = 1 / (1 + ((expected - measured) / sd) ** 2)
    cost = np.where(expected > measured, model.near_cost, model.far_cost)
    return np.exp(good * model.depth_gain - (1 - good) * cost)


@given(st.floats(0.3, 12), st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_usual_readings_say_nothing(metres, seed):
    ranges = np.random.default_rng(seed).random(64) + 0.05
    around = background(ranges=ranges)
    depth = np.full((45, 80), metres, np.float32)
    view = view_of(frame(depth=depth), 20.0, around=around)
    read = np.flatnonzero(view.depth > 0)
    assert read.size == (view.patch >= 0).sum()
    reach = np.linalg.norm(view.directions[read], axis=1)
    elevation = np.arcsin(view.directions[read, 2] / reach)
    assert (np.abs(elevation) < around.highest).all()
    for r, long in zip(read, reach, strict=True):
        ratios = depth_ratio(around.distances, metres * long, OPTIONS.likelihood)
        mean = (ratios * around.ranges[0]).sum() / math.exp(view.background_depth[r])
        assert mean == pytest.approx(1, rel=1e-3)


def test_readings_are_compared_with_those_of_their_elevation():
    around = background()
    ranges = around.ranges.copy()
    floor = np.abs(around.distances - 2.0).argmin()
    ranges[:10] = 0.0  # below the horizon everything is 2 m away
    ranges[:10, floor] = 1.0
    around = Background(around.objects, ranges, around.distances, around.highest)
    depth = np.full((45, 80), 2.0, np.float32)
    # level camera
    seen = frame(depth=depth, gravity=(0, 1, 0))
    view = view_of(seen, 10.0, around=around)
    ahead = (view.depth > 0) & (np.linalg.norm(view.directions, axis=1) < 1.05)
    below, above = ahead & (view.directions[:, 2] < -0.1), ahead & (view.directions[:, 2] > 0.1)
    assert view.background_depth[below].min() > view.background_depth[above].max() + 1
    gaussian = PoseSearchOptions(likelihood=Likelihood(kind="gaussian"))
    assert not view_of(seen, 10.0, options=gaussian, around=around).background_depth.any()


def test_steep_views_stay_within_the_bands():
    for gravity in ((0, 0, 1), (0, 0, -1)):
        depth = np.full((45, 80), 1.5, np.float32)
        view = view_of(frame(depth=depth, gravity=gravity), 20.0)
        assert np.isfinite(view.background_depth).all()
        assert (view.background_depth[view.depth > 0] != 0).all()


def test_colours_are_means_of_cells():
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (90, 160, 3)).astype(np.uint8)
    view = view_of(frame(rgb=rgb), 10.0)
    uv = points(view)
    for r in np.flatnonzero(view.patch >= 0):
        x, y = (uv[r] // 10).astype(int)
        mean = rgb[10 * y : 10 * y + 10, 10 * x : 10 * x + 10].mean(axis=(0, 1)) / 255
        expected = opponent_colour(*mean.astype(np.float32))
        np.testing.assert_allclose(view.colour[r], expected, atol=0.02)
    assert np.ptp(view.colour[:, 1]) > 0.05


def test_scores_add_up():
    scores = np.array([[1.0, 2.0, 4.0, 8.0], [-3.0, 0.5, 0.25, 1.0]], np.float32)
    got = model_of(Likelihood()).combine_terms(scores, ALL)
    assert got.tolist() == [15.0, -1.25]
    for terms, sums in (
        ([True, False, True], [5.0, -2.75]),  # tones count beside depth alone
        ([False, True, False], [2.0, 0.5]),
    ):
        assert model_of(Likelihood()).combine_terms(scores, np.array(terms)).tolist() == sums


def test_eq_2():
    """-(2 (1 + l1 + l2) - (s + l1 d + l2 c))^2 / (2 sigma^2)."""
    options = Likelihood(kind="gaussian", sigma=0.3, depth_lambda=0.5, colour_lambda=0.25)
    model = model_of(options)
    scores = np.array([[2, 2, 2, 0], [1.5, 1.0, 0.4, 0]], np.float32)
    got = model.combine_terms(scores, ALL)
    assert got[0] == 0.0
    assert got[1] == pytest.approx(-((3.5 - (1.5 + 0.5 + 0.1)) ** 2) / (2 * 0.09))
    # a term that is not there asks for nothing
    only = model.combine_terms(scores, np.array([True, False, False]))
    assert only[1] == pytest.approx(-(0.5**2) / 0.18)
    even = model_of(Likelihood(kind="gaussian")).combine_terms(scores, ALL)
    assert even[1] == pytest.approx(-((6 - 2.9) ** 2) / 0.08, rel=1e-6)  # the paper's 6
