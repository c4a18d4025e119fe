"""The network shifts probability among the best viewpoints, and leaves the rest as it was."""

from types import SimpleNamespace

import numpy as np
import pytest

from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.network.network import EncodedCity
from placegraph.outdoor.search import posterior as module
from placegraph.outdoor.search.candidates import find_candidates
from placegraph.outdoor.search.posterior import HARD as MOST
from placegraph.outdoor.search.posterior import rerank, score
from placegraph.outdoor.search.request import Matching, Request


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


def posterior(found):
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
    judged = np.argsort(-posterior(found), kind="stable")[:MOST]
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
    best = np.argsort(-posterior(found), kind="stable")
    judged, rest = best[:MOST], best[MOST:]
    assert np.array_equal(after.log_prior[rest], found.log_prior[rest])
    assert not np.allclose(after.log_prior[judged], found.log_prior[judged], atol=0.1)
    total = np.logaddexp.reduce(posterior(found)[judged])
    assert np.logaddexp.reduce(posterior(after)[judged]) == pytest.approx(total)
    assert after.rest == found.rest
    assert np.array_equal(after.scores, found.scores)


def test_what_is_added_is_added(asked, judge):
    query, found = asked
    after = reranked(found, query, judge(lambda n: -1.2 * np.arange(n), weight=0.5))
    judged = np.argsort(-posterior(found), kind="stable")[:MOST]
    gain = (after.log_prior - found.log_prior)[judged]
    assert np.diff(gain) == pytest.approx(-0.6, abs=1e-5)


def test_what_the_network_finds_best_comes_first(asked, judge):
    query, found = asked
    told = judge(lambda n: np.where(np.arange(n) == 9, 60.0, 0.0))
    after = reranked(found, query, told)
    tenth = np.argsort(-posterior(found), kind="stable")[9]
    assert np.argmax(posterior(after)) == tenth
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
    best = np.argsort(-posterior(found), kind="stable")[:MOST]
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
