import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.outdoor.search.test_posterior import QUERIES

from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.search.posterior import FINE_OFFSETS, PRIOR_ELSEWHERE
from placegraph.outdoor.track.belief import (
    MAX_SCORED,
    Belief,
    TrackGrid,
    _convolve_by_fourier,
    add_mass,
    inject_uniform,
    make_displacement_kernel,
    make_walk_kernel,
    propagate,
    score_belief,
)

SHORT = st.floats(-150.0, 150.0)


@pytest.fixture(scope="module")
def grid(harbour):
    return TrackGrid.of_views(harbour.views)


def lump(grid, at=(0.0, 0.0)):
    """All probability at one place, in the grid's middle."""
    mass = np.zeros((grid.rows, grid.columns), np.float32)
    middle = grid.positions(np.array([grid.rows // 2 * grid.columns + grid.columns // 2]))
    add_mass(mass, grid, middle + at, np.ones(1))
    return Belief(mass, 0.0)


def mean(belief, grid):
    positions = grid.positions(np.arange(belief.mass.size))
    mass = belief.mass.ravel().astype(np.float64)
    return mass @ positions / mass.sum()


def test_viewpoints_lie_in_the_middle_of_their_cells(grid, harbour):
    np.testing.assert_allclose(grid.positions(grid.cells), harbour.views.positions, atol=0.01)
    assert len(np.unique(grid.cells)) == len(grid.cells)


def test_the_start_knows_nothing(grid):
    start = Belief.start(grid)
    assert start.elsewhere == pytest.approx(PRIOR_ELSEWHERE, abs=1e-6)
    assert np.unique(start.mass.ravel()[grid.cells]).size == 1
    off = Belief.start(grid, np.zeros(len(grid.cells)))
    assert off.elsewhere == 1.0


@given(SHORT, SHORT, st.floats(0.0, 40.0))
def test_a_measured_motion_moves_the_mean(grid, east, north, sigma):
    before = lump(grid)
    kernel = make_displacement_kernel(east, north, sigma)
    after = propagate(before, kernel)
    assert kernel.weights.sum() == pytest.approx(1.0, abs=1e-5)
    assert after.mass.sum() + after.elsewhere == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_allclose(mean(after, grid) - mean(before, grid), (east, north), atol=0.05)
    np.testing.assert_allclose(kernel.mean, (east, north), atol=1e-6)


@given(st.floats(0.0, 120.0), st.floats(0.0, 30.0), st.floats(0.0, 6.3), st.floats(0.0, 0.6))
def test_a_loose_way_forth_and_back_keeps_the_mean(grid, distance, loose, bearing, sigma):
    before = lump(grid)
    forth = make_walk_kernel(distance, loose, bearing, sigma)
    back = make_walk_kernel(distance, loose, bearing + np.pi, sigma)
    np.testing.assert_allclose(
        mean(propagate(propagate(before, forth), back), grid), mean(before, grid), atol=0.3
    )
    ahead = np.array([np.sin(bearing), np.cos(bearing)])
    assert forth.mean @ ahead <= distance + 0.8 * loose + 1e-6


def test_in_any_direction(grid):
    after = propagate(lump(grid), make_walk_kernel(100.0, 5.0, None, 0.0))
    positions = grid.positions(np.arange(after.mass.size)) - mean(lump(grid), grid)
    off = np.hypot(*positions.T)
    ring = after.mass.ravel()[(off > 70.0) & (off < 130.0)].sum()
    assert ring > 0.97
    np.testing.assert_allclose(mean(after, grid), mean(lump(grid), grid), atol=0.1)


def test_a_looser_way_spreads_more():
    spread = [np.trace(make_walk_kernel(100.0, loose, 1.0, sigma).covariance)
              for loose, sigma in ((2.0, 0.05), (25.0, 0.05), (25.0, 0.5))]  # fmt: skip
    assert spread == sorted(spread)
    assert spread[0] < 100.0 < spread[2]


def test_large_kernels_give_the_same_through_fourier(grid):
    belief = Belief.start(grid)
    scale = np.float32(1e3)
    for kernel in (
        make_walk_kernel(120.0, 30.0, 0.7, 0.4), make_walk_kernel(90.0, 9.0, None, 0),
        make_displacement_kernel(-333.0, 52.0, 10.0),
    ):  # fmt: skip
        plain = propagate(Belief(scale * belief.mass, 0.0), kernel).mass / scale
        fourier = _convolve_by_fourier(belief.mass, kernel)
        np.testing.assert_allclose(fourier.sum(), plain.sum(), rtol=1e-3)
        # cells lighter than the background are shifted whole: compare where there is something
        lumped = lump(grid)
        np.testing.assert_allclose(
            _convolve_by_fourier(lumped.mass, kernel), propagate(lumped, kernel).mass, atol=1e-5
        )


def test_over_the_border_and_far_away(grid):
    gone = propagate(lump(grid), make_displacement_kernel(20_000.0, 0.0, 10.0))
    assert gone.elsewhere == pytest.approx(1.0, abs=1e-6)
    kernel = make_displacement_kernel(0.5 * 20.0 * grid.columns, 0.0, 0.0)
    half = propagate(Belief.start(grid), kernel)
    assert 0.1 < half.elsewhere < 0.9


def test_who_was_lost_may_be_anywhere_again(grid):
    gone = Belief(np.zeros((grid.rows, grid.columns), np.float32), 1.0)
    back = inject_uniform(gone, grid)
    assert back.elsewhere < 0.85
    assert back.mass.sum() + back.elsewhere == pytest.approx(1.0, abs=1e-5)
    start = Belief.start(grid)
    np.testing.assert_allclose(inject_uniform(start, grid).mass.sum(), start.mass.sum(), atol=0.02)


@pytest.mark.parametrize("name", QUERIES)
def test_closer_looks_are_looks(name, harbour, make_description, request):
    look = request.getfixturevalue("score")
    description = make_description(*QUERIES[name])
    found = score_belief(compile_query(description, harbour), harbour, np.ones(len(harbour.views)))
    assert found.positions.shape == (len(found.refined), len(FINE_OFFSETS), 2)
    off = []
    for view, positions, ratios in zip(found.refined, found.positions, found.ratios, strict=True):
        np.testing.assert_allclose(positions.mean(axis=0), harbour.views.positions[view], atol=0.01)
        off.append(np.abs(ratios - look(harbour, description, positions)[0]))
        assert found.views[view] == pytest.approx(np.log(np.exp(ratios).mean()), abs=1e-6)
    # what is far is seen from the viewpoint, not from each position around it
    assert np.median(off) < 0.1
    assert np.percentile(off, 90) < 0.8


@pytest.mark.parametrize("name", ["one bench", "tree and bench", "names", "no trees"])
def test_a_believed_place_is_looked_at_however_badly_it_fits(
    name, harbour, make_description, request, rng
):
    look = request.getfixturevalue("score")
    description = make_description(*QUERIES[name])
    query = compile_query(description, harbour)
    n = len(harbour.views)
    for view in rng.choice(n, 12, replace=False):
        weights = np.full(n, 1e-12)
        weights[view] = 1.0
        found = score_belief(query, harbour, weights)
        seen = look(harbour, description, harbour.views.positions[view] + FINE_OFFSETS)[0]
        exact = float(np.log(np.exp(seen.astype(np.float64)).mean()))
        assert found.views[view] == pytest.approx(exact, abs=0.8)


def test_nothing_drops_to_zero(harbour, make_description):
    for name, statements in QUERIES.items():
        query = compile_query(make_description(*statements), harbour)
        found = score_belief(query, harbour, np.ones(len(harbour.views)))
        assert np.isfinite(found.views).all(), name
        assert found.views.min() >= np.log(query.statements.noise).sum() - 3.0
        assert found.nothing == pytest.approx(
            np.log(query.statements.noise[~query.statements.negated]).sum(), abs=1e-5
        )


def test_no_belief_on_the_map_is_no_error(harbour, make_description):
    query = compile_query(make_description(*QUERIES["one bench"]), harbour)
    found = score_belief(query, harbour, np.zeros(len(harbour.views)))
    assert len(found.refined) == 0
    assert (found.views == found.nothing).all()


def test_many_are_left_with_their_bounds(monaco, make_description):
    """More viewpoints see a building than are scored; the rest still tell good from bad."""
    description = make_description(("building=yes", "north", "highway=footway"))
    query = compile_query(description, monaco)
    weights = np.ones(len(monaco.views))
    found = score_belief(query, monaco, weights)
    spread = np.unique(found.views.round(3))
    assert (found.views > found.nothing + 0.05).sum() > MAX_SCORED / 3
    assert len(spread) > 100
