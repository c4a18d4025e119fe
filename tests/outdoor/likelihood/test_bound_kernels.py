import numpy as np
import pytest

from placegraph.outdoor.likelihood import bound_kernels as promise_kernels
from placegraph.outdoor.likelihood.bound_kernels import TILE_SLACK, find_views_by_bound
from placegraph.outdoor.likelihood.match_kernels import BOUND_SLACK, REJECTED, score_views
from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.search.request import parse

TEXTS = (
    "A bakery is north of me.",
    "There is a tree to my south. There is a bench to my west. There is no fountain near me.",
    "The building is on the north of the footway. The footway is on the south of the bench.",
    "I am between a restaurant and a bus stop. A hotel is west of me.",
)
MANY = 1 << 14
"""So many are drawn that all tiles are looked at."""


@pytest.fixture(params=TEXTS)
def query(request, monaco):
    return compile_query(parse(monaco, request.param), monaco)


def promising(query, city, weights, most, drawn=0, least=0.0):
    return find_views_by_bound(
        query.statements, query.mentions, city.views.columns, weights, most, drawn, least
    )


def score(query, city, rows, prior, together, cutoff):
    views, s = city.views, query.statements
    return score_views(
        s, city.columns, views.columns, query.token_weights(len(views.share)), rows,
        np.full(len(rows), 1e290), prior, np.zeros((len(rows), len(s.op)), np.float32),
        together, cutoff,
    )[0]  # fmt: skip


@pytest.mark.parametrize("most", [5, 60, 400])
@pytest.mark.parametrize("weighed", [False, True])
def test_the_heaviest_are_found(query, monaco, rng, most, weighed):
    weights = rng.random(len(monaco.views)) ** 4 if weighed else np.zeros(0)
    rows, bounds, stands = promising(query, monaco, weights, most)
    every, of_every, _ = promising(query, monaco, weights, len(monaco.views))
    assert not stands.any()
    most = min(most, len(every))
    assert len(np.unique(every)) == len(every)
    assert len(np.unique(rows)) == len(rows) == most
    assert bounds.sum() >= 0.97 * of_every[:most].sum()
    assert set(every[of_every > bounds[-1] * TILE_SLACK * 1.000001]) <= set(rows)


@pytest.mark.parametrize("weighed", [False, True])
def test_some_stand_for_all_others(query, monaco, rng, weighed):
    weights = rng.random(len(monaco.views)) ** 4 if weighed else np.zeros(0)
    every, of_every, _ = promising(query, monaco, weights, len(monaco.views))
    rows, bounds, stands = promising(query, monaco, weights, 60, MANY)
    others = of_every[60:] ** 0.75
    told = stands[60:] * bounds[60:] ** 0.75
    assert not stands[:60].any()
    assert len(told) == MANY * bool(others.sum())
    assert set(rows) <= set(every)
    for n in (MANY, MANY // 2, MANY // 4):  # those drawn first do as well as all
        assert told[:n].sum() * MANY / n == pytest.approx(others.sum(), rel=1e-6)
    # what they say of something else is about right
    assert stands[60:] @ bounds[60:] == pytest.approx(of_every[60:].sum(), rel=0.1)


@pytest.mark.parametrize("weighed", [False, True])
@pytest.mark.parametrize("drawn", [256, MANY])
def test_of_small_bounds_some_stand_for_all(query, monaco, rng, weighed, drawn):
    """What does not count elsewhere is not looked at for itself."""
    weights = rng.random(len(monaco.views)) ** 4 if weighed else np.zeros(0)
    _, of_every, _ = promising(query, monaco, weights, len(monaco.views))
    least = float(of_every[min(20, len(of_every) // 2)]) * 1.000001
    _, bounds, stands = promising(query, monaco, weights, 60, drawn, least)
    found = bounds[stands == 0.0]
    assert found.min(initial=np.inf) >= least
    assert found.sum() >= of_every[of_every > TILE_SLACK * least].sum() * 0.999999
    rest = of_every.sum() - found.sum()
    assert stands @ bounds == pytest.approx(rest, rel=0.1 if drawn == MANY else 0.4)


def test_bounds_are_bounds(query, monaco):
    """No viewpoint scores above its bound."""
    rows, bounds, _ = promising(query, monaco, np.zeros(0), 2000)
    scores = score(query, monaco, rows, np.zeros(len(rows)), 0.0, 1e9)
    noise = np.log(query.statements.noise[~query.statements.negated]).sum()
    assert (scores <= np.log(bounds) + noise + BOUND_SLACK).all()


def test_what_is_given_up_does_not_depend_on_the_order(query, monaco, rng):
    rows, _, _ = promising(query, monaco, np.zeros(0), 300)
    prior, order = np.log(rng.random(len(rows))), rng.permutation(len(rows))
    ordered = score(query, monaco, rows, prior, 0.3, 3.0)
    shuffled = score(query, monaco, rows[order], prior[order], 0.3, 3.0)
    np.testing.assert_array_equal(shuffled, ordered[order])
    assert 0 < (ordered > REJECTED).sum() < len(rows)


def test_no_more_are_chosen_than_there_is_room_for():
    """A tile that was passed over holds a viewpoint that is, by rounding, as good as those chosen."""
    bounds, highest = np.array([3.0, 2.0, np.nextafter(2.0, 3.0)]), np.array([3.0, 2.0])
    rows = np.arange(3, dtype=np.int32)
    chosen, _, stands = promise_kernels._select_best(rows, bounds, np.ones(3), highest, 0.0, 2, 1)
    assert len(chosen) == 3
    assert (stands == 0.0).sum() == 2
