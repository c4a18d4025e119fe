"""Scores, re-ranking, the posterior and its modes."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.locate import search
from placegraph.outdoor.network.network import EncodedCity
from placegraph.outdoor.search import posterior as module
from placegraph.outdoor.search.candidates import Candidates, find_candidates
from placegraph.outdoor.search.posterior import (
    APART,
    ELSEWHERE,
    WITHIN,
    Posterior,
    apply_bayes,
    compute_posterior,
    find_modes,
    look_around,
    rerank,
    score,
)
from placegraph.outdoor.search.posterior import HARD as MOST
from placegraph.outdoor.search.posterior import score as scored
from placegraph.outdoor.search.request import Hints, Matching, Request, make_request

SPACING = 6.67

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
def test_probabilities_add_up(drawn, unscored):
    found = found_of(drawn, unscored)
    assert (found.probabilities >= 0).all()
    total = found.probabilities.sum() + found.elsewhere
    assert total <= 1 + 1e-9
    if unscored < -40:
        assert total == pytest.approx(1.0)


@given(places)
def test_it_is_bayes_rule(drawn):
    found = found_of(drawn, -np.inf)
    weights = np.array([(1 - ELSEWHERE) * np.exp(s) / len(drawn) for _, _, s in drawn])
    total = weights.sum() + ELSEWHERE
    np.testing.assert_allclose(found.probabilities, weights / total, rtol=1e-9)
    assert found.elsewhere == pytest.approx(ELSEWHERE / total)


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
        found.probabilities[np.hypot(*(found.positions - p).T) <= APART].sum()
        for p in found.positions
    )
    assert find_modes(found, 1, SPACING)[0].probability >= 0.6 * heaviest


def test_a_mode_is_where_its_probability_is():
    found = Posterior(
        np.array([[0.0, 0.0], [20.0, 0.0], [1000.0, 0.0]]), np.array([0.3, 0.3, 0.2]), 0.2
    )
    first, second = find_modes(found, 5, SPACING)
    np.testing.assert_allclose(first.position, (10, 0))
    assert first.probability == pytest.approx(0.6)
    assert first.covariance[0, 0] == pytest.approx(100 + SPACING**2 / 12 + 1)
    np.testing.assert_allclose(second.position, (1000, 0))
    assert second.probability == pytest.approx(0.2)


def test_probability_is_of_lying_within():
    ring = np.array([[np.cos(a), np.sin(a)] for a in np.linspace(0, 2 * np.pi, 60)])
    found = Posterior(
        np.concatenate([0.5 * WITHIN * ring, 2.5 * WITHIN * ring]), np.full(120, 1 / 120), 0.0
    )
    best = find_modes(found, 20, SPACING)[0]
    distance = np.hypot(*(found.positions - best.position).T)
    assert best.probability == pytest.approx(
        found.probabilities[distance <= WITHIN].sum(), abs=0.02
    )


def test_no_place_at_all():
    nothing = Posterior(np.zeros((0, 2)), np.zeros(0), 1.0)
    assert find_modes(nothing, 5, SPACING) == []
    none = Posterior(np.zeros((3, 2)), np.zeros(3), 1.0)
    assert find_modes(none, 5, SPACING) == []


def test_what_was_not_scored_counts():
    sure = [(-50, 0, 12.0), (50, 50, 0.0)]
    best = find_modes(found_of(sure), 1, SPACING)[0].probability
    assert best > 0.9
    doubtful = find_modes(found_of(sure, unscored=12.0), 1, SPACING)[0].probability
    assert doubtful < 0.5


@given(places, st.floats(-1e3, 1e3))
def test_extreme_scores_do_not_overflow(drawn, shift):
    found = found_of([(x, y, s + shift) for x, y, s in drawn])
    assert np.isfinite(found.probabilities).all()
    assert 0 <= found.elsewhere <= 1
    for mode in find_modes(found, 5, SPACING):
        assert np.isfinite(mode.covariance).all()


class Judge:
    """An encoded city whose network says what it is told to say."""

    def __init__(self, city, added, scale, weight):
        self.city, self.added, self.asked = city, added, []
        prior = np.array([1.0, scale, weight], np.float32)
        self.network = SimpleNamespace(arrays={"prior": prior})

    def text(self, query):
        return query

    def match(self, text, places, rows):
        self.asked.append((text, places, rows))
        return SimpleNamespace(residual=np.asarray(self.added(len(rows)), np.float32))


@pytest.fixture(scope="module")
def asked(harbour, said):
    query = compile_query(
        said(("natural=tree", "near", "me"), ("amenity=bench", "east", "me")), harbour
    )
    asked = Request(harbour, query)
    found = score(asked, find_candidates(asked))
    assert len(found.rows) > MOST
    return query, found


def reranked(found, query, encoded):
    return rerank(Request(encoded.city, query, matching=Matching(encoded=encoded)), found)


def total_score(found):
    return found.scores + found.log_prior


@pytest.fixture
def judge(harbour):
    return lambda added, scale=1.0, weight=1.0: Judge(harbour, added, scale, weight)


def test_nothing_added_changes_nothing(asked, judge):
    query, found = asked
    after = reranked(found, query, judge(np.zeros))
    assert after.log_prior == pytest.approx(found.log_prior, abs=1e-6)


def test_relational_matching_is_scaled(asked, judge):
    """A network that trusts it half as much says so."""
    query, found = asked
    after = reranked(found, query, judge(np.zeros, 0.5))
    judged = np.argsort(-total_score(found), kind="stable")[:MOST]
    gain = (after.log_prior - found.log_prior)[judged]
    expected = -0.5 * found.scores[judged]
    assert gain - gain.mean() == pytest.approx(expected - expected.mean(), abs=1e-4)


def test_what_is_added_to_all_changes_nothing(asked, judge):
    query, found = asked
    after = reranked(found, query, judge(lambda n: np.full(n, 7.0)))
    assert after.log_prior == pytest.approx(found.log_prior, abs=1e-6)


def test_the_judged_weigh_as_much_as_before(asked, judge, rng):
    query, found = asked
    after = reranked(found, query, judge(lambda n: 5.0 * rng.standard_normal(n)))
    best = np.argsort(-total_score(found), kind="stable")
    judged, rest = best[:MOST], best[MOST:]
    assert np.array_equal(after.log_prior[rest], found.log_prior[rest])
    assert not np.allclose(after.log_prior[judged], found.log_prior[judged], atol=0.1)
    total = np.logaddexp.reduce(total_score(found)[judged])
    assert np.logaddexp.reduce(total_score(after)[judged]) == pytest.approx(total)
    assert after.rest == found.rest
    assert np.array_equal(after.scores, found.scores)


def test_what_is_added_is_added(asked, judge):
    query, found = asked
    after = reranked(found, query, judge(lambda n: -1.2 * np.arange(n), weight=0.5))
    judged = np.argsort(-total_score(found), kind="stable")[:MOST]
    gain = (after.log_prior - found.log_prior)[judged]
    assert np.diff(gain) == pytest.approx(-0.6, abs=1e-5)


def test_what_the_network_finds_best_comes_first(asked, judge):
    query, found = asked
    told = judge(lambda n: np.where(np.arange(n) == 9, 60.0, 0.0))
    after = reranked(found, query, told)
    tenth = np.argsort(-total_score(found), kind="stable")[9]
    assert np.argmax(total_score(after)) == tenth
    ((_, places, rows),) = told.asked
    assert len(places) == len(rows) == MOST  # judged in one call


def test_a_lone_candidate_stays(asked, judge):
    query, found = asked
    few = found._replace(
        rows=found.rows[:1],
        scores=found.scores[:1],
        log_prior=found.log_prior[:1],
        far=found.far[:1],
    )
    assert reranked(few, query, judge(np.ones)) is few


def test_the_judged_places_are_the_viewpoints_themselves(asked, harbour, encoded):
    query, found = asked
    after = reranked(found, query, encoded)
    best = np.argsort(-total_score(found), kind="stable")[:MOST]
    views = found.rows[best].astype(np.int64)
    places = module.PlaceGraphs.of_views(harbour, views)
    expected = encoded.match(encoded.text(query), places, np.arange(len(best))).residual
    assert expected.std() > 1e-3
    gain = (after.log_prior - found.log_prior)[best]
    assert gain - gain.mean() == pytest.approx(expected - expected.mean(), abs=1e-4)


def test_who_adds_more_shifts_more(asked, harbour, make_network):
    query, found = asked
    little, much = (
        reranked(found, query, EncodedCity(harbour, make_network(fusion=weight)))
        for weight in (0.05, 1.0)
    )
    near, far = (np.abs(x.log_prior - found.log_prior).max() for x in (little, much))
    assert 0.0 < near < far


BENCH, TREE, FOUNTAIN, BAKERY = "amenity=bench", "natural=tree", "amenity=fountain", "shop=bakery"
CHURCH, SQUARE, ROAD = "amenity=place_of_worship", "place=square", "highway=residential"

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
def everywhere(request, harbour, said):
    """A description, and positions around all viewpoints with their scores."""
    description = said(*QUERIES[request.param])
    asked = Request(harbour, compile_query(description, harbour))
    every = Candidates.given(asked, np.arange(len(harbour.views)))
    positions, scores = look_around(asked, every.rows, every.far)
    return description, positions.reshape(-1, 2), scores.ravel()


def smoothed(positions, scores, at, radius=25.0):
    near = np.hypot(*(positions - at).T) <= radius
    return np.logaddexp.reduce(scores[near]) if near.any() else -np.inf


def test_search_finds_what_looking_everywhere_finds(everywhere, harbour):
    description, positions, scores = everywhere
    found = search(Request(harbour, compile_query(description, harbour)))
    assert found.probabilities.sum() + found.elsewhere <= 1 + 1e-6
    best = find_modes(found, 1, 6.67)[0]
    highest = max(smoothed(positions, scores, positions[i]) for i in np.argsort(-scores)[:50])
    assert smoothed(positions, scores, best.position) > highest - 0.7


def test_probabilities_are_those_of_looking_everywhere(everywhere, harbour):
    from placegraph.outdoor.search.posterior import ELSEWHERE

    description, positions, scores = everywhere
    weights = (1 - ELSEWHERE) * np.exp(scores.astype(np.float64)) / len(positions)
    weights /= weights.sum() + ELSEWHERE
    found = search(Request(harbour, compile_query(description, harbour)))
    left = weights.copy()  # places count for the first mode that is near
    for mode in find_modes(found, 3, 6.67):
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
    every = Candidates.given(asked, np.arange(len(monaco.views)))
    few, all_ = (
        find_modes(p, 5, 6.67)[0]
        for p in (search(asked), compute_posterior(asked, scored(asked, every, 30.0)))
    )
    assert np.hypot(*(few.position - all_.position)) < 1.0
    assert few.probability == pytest.approx(all_.probability, abs=0.05)


def test_a_thing_out_of_sight_is_found(harbour, said, hafenstadt):
    """The only museum is 70 m south: no viewpoint there has it in sight."""
    text = said(("me", "along", "Hafenstraße"), ("tourism=museum", "south", "me", {"far": True}))
    found = search(Request(harbour, compile_query(text, harbour)))
    best = find_modes(found, 1, 6.67)[0]
    museum = harbour.plane.to_plane(hafenstadt.position("I"))
    assert best.position[1] > museum[1] + 50


def test_nothing_is_in_sight_of_anything(harbour, said):
    query = compile_query(said(("Brotkorb", "north", "Rathaus", {"negated": True})), harbour)
    found = search(Request(harbour, query))
    assert found.probabilities.sum() + found.elsewhere <= 1 + 1e-6


def test_candidates_do_not_depend_on_the_order_of_statements(harbour, said):
    statements = [s for name in ("square and fountain", "names") for s in QUERIES[name]]
    one = search(Request(harbour, compile_query(said(*statements), harbour)))
    two = search(Request(harbour, compile_query(said(*statements[::-1]), harbour)))
    for a, b in zip(find_modes(one, 3, 6.67), find_modes(two, 3, 6.67), strict=True):
        np.testing.assert_allclose(a.position, b.position, atol=1.0)
        assert a.probability == pytest.approx(b.probability, abs=0.02)


def test_few_viewpoints_are_looked_at(monaco, said):
    query = compile_query(said(("amenity=fountain", "north", "me")), monaco)
    found = search(Request(monaco, query))
    assert 0 < len(found.positions) < 0.2 * len(monaco.views)
