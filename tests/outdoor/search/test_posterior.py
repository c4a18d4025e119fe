from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.network.graphs import PlaceGraphs
from placegraph.outdoor.network.network import EncodedCity
from placegraph.outdoor.search.locate import search_views
from placegraph.outdoor.search.posterior import (
    MODE_SEPARATION,
    NUM_RERANKED,
    PRIOR_ELSEWHERE,
    SPACING,
    Candidates,
    Posterior,
    apply_bayes,
    compute_posterior,
    find_candidates,
    find_modes,
    rerank,
    score_around,
    score_candidates,
)
from placegraph.outdoor.search.request import Hints, Matching, Request, make_request

places = st.lists(
    st.tuples(st.integers(-30, 30), st.integers(-30, 30), st.floats(-12, 12)),
    min_size=1,
    max_size=40,
    unique_by=lambda p: p[:2],
)


def found_of(drawn, unscored=-50.0, step=20.0):
    """Posterior of viewpoints (column, row, score) on a grid."""
    drawn = np.array(drawn, float)
    prior = np.full(len(drawn), -np.log(len(drawn)))
    return apply_bayes(step * drawn[:, :2], drawn[:, 2], prior, unscored)


@given(places, st.floats(-50, 5))
def test_probabilities_follow_from_bayes_rule(drawn, unscored):
    found = found_of(drawn, unscored)
    weights = np.array([(1 - PRIOR_ELSEWHERE) * np.exp(s) / len(drawn) for _, _, s in drawn])
    total = weights.sum() + PRIOR_ELSEWHERE + (1 - PRIOR_ELSEWHERE) * np.exp(unscored)
    np.testing.assert_allclose(found.probabilities, weights / total, rtol=1e-9)
    assert found.elsewhere == pytest.approx(PRIOR_ELSEWHERE / total)


@given(places, st.integers(1, 8))
def test_modes(drawn, top):
    found = found_of(drawn)
    peaks = find_modes(found, top, SPACING)
    assert len(peaks) <= top
    probabilities = [m.probability for m in peaks]
    assert probabilities == sorted(probabilities, reverse=True)
    assert all(0 < p <= 1 for p in probabilities)
    assert sum(probabilities) <= found.probabilities.sum() + 1e-9
    for i, mode in enumerate(peaks):
        assert np.isfinite(mode.position).all()
        low, high = found.positions.min(axis=0), found.positions.max(axis=0)
        assert (low - 1e-6 <= mode.position).all()
        assert (mode.position <= high + 1e-6).all()
        np.testing.assert_allclose(mode.covariance, mode.covariance.T, atol=1e-9)
        assert np.linalg.eigvalsh(mode.covariance).min() >= SPACING**2 / 12
        for other in peaks[:i]:
            assert np.hypot(*(mode.position - other.position)) > 5.0, "one place is one mode"


@given(places)
def test_the_first_mode_holds_the_heaviest_surroundings(drawn):
    found = found_of(drawn)
    heaviest = max(
        found.probabilities[np.hypot(*(found.positions - p).T) <= MODE_SEPARATION].sum()
        for p in found.positions
    )
    assert find_modes(found, 1, SPACING)[0].probability >= 0.6 * heaviest


def test_a_mode_is_where_its_probability_is():
    found = Posterior(np.array([[0.0, 0], [20, 0], [1000, 0]]), np.array([0.3, 0.3, 0.2]), 0.2)
    first, second = find_modes(found, 5, SPACING)
    np.testing.assert_allclose(first.position, (10, 0))
    assert first.probability == pytest.approx(0.6)
    assert first.covariance[0, 0] == pytest.approx(100 + SPACING**2 / 12 + 1)
    np.testing.assert_allclose(second.position, (1000, 0))
    assert second.probability == pytest.approx(0.2)


def test_no_place_at_all():
    nothing = Posterior(np.zeros((0, 2)), np.zeros(0), 1.0)
    assert find_modes(nothing, 5, SPACING) == []
    none = Posterior(np.zeros((3, 2)), np.zeros(3), 1.0)
    assert find_modes(none, 5, SPACING) == []


@given(places, st.floats(-1e3, 1e3))
def test_extreme_scores_do_not_overflow(drawn, shift):
    found = found_of([(x, y, s + shift) for x, y, s in drawn])
    assert np.isfinite(found.probabilities).all()
    assert 0 <= found.elsewhere <= 1
    for mode in find_modes(found, 5, SPACING):
        assert np.isfinite(mode.covariance).all()


class FakeEncoding:
    """Encoded city whose network adds given numbers to the scores."""

    def __init__(self, city, added, scale=1.0, weight=1.0):
        self.city, self.added, self.calls = city, added, []
        prior = np.array([1.0, scale, weight], np.float32)
        self.network = SimpleNamespace(arrays={"prior": prior})

    def text(self, query):
        return query

    def match(self, text, places, rows):
        self.calls.append((text, places, rows))
        return SimpleNamespace(residual=np.asarray(self.added(len(rows)), np.float32))


@pytest.fixture(scope="module")
def scored(harbour, make_description):
    text = make_description(("natural=tree", "near", "me"), ("amenity=bench", "east", "me"))
    query = compile_query(text, harbour)
    request = Request(harbour, query)
    found = score_candidates(request, find_candidates(request))
    assert len(found.rows) > NUM_RERANKED
    return query, found


@pytest.fixture
def reranked(scored):
    def run(encoded, found=scored[1]):
        return rerank(Request(encoded.city, scored[0], matching=Matching(encoded=encoded)), found)

    return run


def total_score(found):
    return found.scores + found.log_prior


@pytest.fixture
def best(scored):
    return np.argsort(-total_score(scored[1]), kind="stable")


@pytest.mark.parametrize(
    ("residual", "scale", "weight"),
    [
        (np.zeros, 0.5, 1.0),
        (lambda n: np.full(n, 7.0), 1.0, 1.0),
        (lambda n: -1.2 * np.arange(n), 1.0, 0.5),
        (lambda n: np.where(np.arange(n) == 9, 60.0, 0.0), 1.0, 1.0),
    ],
)
def test_residuals_are_added_to_scaled_scores(
    scored, reranked, best, harbour, residual, scale, weight
):
    found, top = scored[1], best[:NUM_RERANKED]
    encoded = FakeEncoding(harbour, residual, scale, weight)
    after = reranked(encoded)
    gain = (after.log_prior - found.log_prior)[top]
    expected = weight * residual(len(top)) - (1.0 - scale) * found.scores[top]
    assert gain - gain.mean() == pytest.approx(expected - expected.mean(), abs=1e-4)
    ((_, places, rows),) = encoded.calls
    assert len(places) == len(rows) == NUM_RERANKED


def test_reranked_views_weigh_as_much_as_before(scored, reranked, best, harbour, rng):
    found, top, rest = scored[1], best[:NUM_RERANKED], best[NUM_RERANKED:]
    after = reranked(FakeEncoding(harbour, lambda n: 5.0 * rng.standard_normal(n)))
    assert np.array_equal(after.log_prior[rest], found.log_prior[rest])
    assert not np.allclose(after.log_prior[top], found.log_prior[top], atol=0.1)
    total = np.logaddexp.reduce(total_score(found)[top])
    assert np.logaddexp.reduce(total_score(after)[top]) == pytest.approx(total)
    assert after.log_rest == found.log_rest
    assert np.array_equal(after.scores, found.scores)


def test_a_lone_candidate_stays(scored, reranked, harbour):
    few = type(scored[1])(*(column[:1] for column in scored[1][:4]))
    assert reranked(FakeEncoding(harbour, np.ones), few) is few


def test_the_network_reranks_the_viewpoints_themselves(
    scored, reranked, best, harbour, encoded, make_network
):
    (query, found), top = scored, best[:NUM_RERANKED]
    places = PlaceGraphs.of_views(harbour, found.rows[top].astype(np.int64))
    expected = encoded.match(encoded.text(query), places, np.arange(len(top))).residual
    assert expected.std() > 1e-3
    gain = (reranked(encoded).log_prior - found.log_prior)[top]
    assert gain - gain.mean() == pytest.approx(expected - expected.mean(), abs=1e-4)
    near, far = (
        np.abs(reranked(EncodedCity(harbour, make_network(fusion=f))).log_prior - found.log_prior)
        for f in (0.05, 1.0)
    )
    assert 0.0 < near.max() < far.max()


BENCH, TREE, FOUNTAIN, BAKERY = "amenity=bench", "natural=tree", "amenity=fountain", "shop=bakery"
CHURCH, SQUARE = "amenity=place_of_worship", "place=square"

QUERIES = {
    "one bench": [(BENCH, "near", "me")],
    "square and fountain": [("me", "inside", SQUARE), (FOUNTAIN, "north", "me")],
    "museum and way": [("tourism=museum", "south", "me"), ("me", "along", "Speicherweg")],
    "tree and bench": [(TREE, "north", BENCH), (TREE, "east", f"{BENCH}#2")],
    "no trees": [(BENCH, "near", "me"), (TREE, "visible", "me", {"negated": True})],
    "church and stop": [("railway=tram_stop", "near", "me"), (CHURCH, "southeast", "me")],
    "between": [("me", "between", FOUNTAIN, {"target2": "amenity=cafe"})],
    "one of two is false": [("amenity=kindergarten", "near", "me"), (BAKERY, "north", "me")],
    "two trees": [(TREE, "near", "me", {"count": 2}), ("me", "along", "Uferpromenade")],
    "names": [("Bücherwurm", "west", "me"), ("Gartenweg", "visible", "me")],
}


@pytest.fixture(scope="module", params=QUERIES)
def everywhere(request, harbour, make_description):
    """A description, and positions around all viewpoints with their scores."""
    description = make_description(*QUERIES[request.param])
    request = Request(harbour, compile_query(description, harbour))
    every = Candidates.of_views(request, np.arange(len(harbour.views)))
    positions, scores = score_around(request, every.rows, every.distant)
    return description, positions.reshape(-1, 2), scores.ravel()


def smoothed(positions, scores, at, radius=25.0):
    near = np.hypot(*(positions - at).T) <= radius
    return np.logaddexp.reduce(scores[near]) if near.any() else -np.inf


def test_search_finds_the_modes_of_an_exhaustive_search(everywhere, harbour):
    description, positions, scores = everywhere
    found = search_views(Request(harbour, compile_query(description, harbour)))
    assert found.probabilities.sum() + found.elsewhere <= 1 + 1e-6
    modes = find_modes(found, 3, SPACING)
    highest = max(smoothed(positions, scores, positions[i]) for i in np.argsort(-scores)[:50])
    assert smoothed(positions, scores, modes[0].position) > highest - 0.7
    weights = (1 - PRIOR_ELSEWHERE) * np.exp(scores.astype(np.float64)) / len(positions)
    left = weights / (weights.sum() + PRIOR_ELSEWHERE)  # places count for the first mode near by
    for mode in modes:
        near = np.hypot(*(positions - mode.position).T) <= 50.0
        assert mode.probability == pytest.approx(left[near].sum(), abs=0.15)
        left[near] = 0.0


TOLD = (
    "A bakery is north of me. A bench is east of me.",
    "There is a tree to my south. There is a bench to my west. There is no fountain near me.",
    "A restaurant is north of the footway. The footway is south of the bench. A tree is near the bench.",
    "I am between a restaurant and a bus stop. A hotel is west of me.",
    "I am on Boulevard des Moulins. A bank is north of me.",
    "A church is east of me and a parking is to the south.",
)


@pytest.mark.parametrize("text", TOLD)
def test_the_best_of_few_is_the_best_of_all(text, monaco):
    """Its probability is off by what is estimated of the rest, and by what lies 4 nat behind."""
    asked = make_request(monaco, text, Hints(), Matching())
    every = Candidates.of_views(asked, np.arange(len(monaco.views)))
    exhaustive = compute_posterior(asked, score_candidates(asked, every, 30.0))
    few, all_ = (find_modes(p, 5, SPACING)[0] for p in (search_views(asked), exhaustive))
    assert np.hypot(*(few.position - all_.position)) < 1.0
    assert few.probability == pytest.approx(all_.probability, abs=0.05)


def search(city, text):
    return search_views(Request(city, compile_query(text, city)))


def test_an_object_out_of_sight_is_found(harbour, make_description, hafenstadt):
    """The only museum is 70 m south: no viewpoint there has it in sight."""
    text = make_description(
        ("me", "along", "Hafenstraße"), ("tourism=museum", "south", "me", {"far": True})
    )
    best = find_modes(search(harbour, text), 1, SPACING)[0]
    museum = harbour.plane.to_plane(hafenstadt.position("I"))
    assert best.position[1] > museum[1] + 50


def test_nothing_is_in_sight_of_anything(harbour, make_description):
    found = search(harbour, make_description(("Brotkorb", "north", "Rathaus", {"negated": True})))
    assert found.probabilities.sum() + found.elsewhere <= 1 + 1e-6


def test_candidates_do_not_depend_on_the_order_of_statements(harbour, make_description):
    statements = [s for name in ("square and fountain", "names") for s in QUERIES[name]]
    one, two = (
        find_modes(search(harbour, make_description(*s)), 3, SPACING)
        for s in (statements, statements[::-1])
    )
    for a, b in zip(one, two, strict=True):
        np.testing.assert_allclose(a.position, b.position, atol=1.0)
        assert a.probability == pytest.approx(b.probability, abs=0.02)


def test_few_viewpoints_are_scored(monaco, make_description):
    found = search(monaco, make_description(("amenity=fountain", "north", "me")))
    assert 0 < len(found.positions) < 0.2 * len(monaco.views)
