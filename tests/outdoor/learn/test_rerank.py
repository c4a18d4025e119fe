"""The network shifts probability among the best viewpoints, and leaves the rest as it was."""

from dataclasses import replace

import numpy as np
import pytest

from placegraph.outdoor import rerank as module
from placegraph.outdoor.query import compile_query
from placegraph.outdoor.rerank import MOST, rerank
from placegraph.outdoor.search import Prior, candidates


class Judge:
    """An encoded city whose network says what it is told to say."""

    def __init__(self, city, logits, fusion=0.5):
        self.city, self.logits, self.asked = city, logits, []
        self.network = type("Network", (), {"fusion": fusion})()

    def text(self, query):
        return query

    def match(self, text, places, rows):
        self.asked.append((text, places, rows))
        return type("Match", (), {"logit": np.asarray(self.logits(len(rows)), np.float32)})()


@pytest.fixture(scope="module")
def asked(harbour, said):
    query = compile_query(
        said(("natural=tree", "near", "me"), ("amenity=bench", "east", "me")), harbour
    )
    found = candidates(query, harbour, Prior())
    assert len(found.rows) > MOST
    return query, found


def posterior(found):
    return found.scores + found.log_prior


def test_weight_nothing_changes_nothing(asked, harbour):
    query, found = asked
    judge = Judge(harbour, np.arange, fusion=0.0)
    assert rerank(found, query, judge) is found
    assert not judge.asked


def test_equal_logits_change_nothing(asked, harbour):
    query, found = asked
    after = rerank(found, query, Judge(harbour, lambda n: np.full(n, 7.0)))
    assert after.log_prior == pytest.approx(found.log_prior, abs=1e-9)


def test_the_judged_weigh_as_much_as_before(asked, harbour, rng):
    query, found = asked
    after = rerank(found, query, Judge(harbour, lambda n: 5.0 * rng.standard_normal(n)))
    best = np.argsort(-posterior(found), kind="stable")
    judged, rest = best[:MOST], best[MOST:]
    assert np.array_equal(after.log_prior[rest], found.log_prior[rest])
    assert not np.allclose(after.log_prior[judged], found.log_prior[judged], atol=0.1)
    total = np.logaddexp.reduce(posterior(found)[judged])
    assert np.logaddexp.reduce(posterior(after)[judged]) == pytest.approx(total)
    assert after.rest == found.rest
    assert np.array_equal(after.scores, found.scores)


def test_logits_shift_as_much_as_they_weigh(asked, harbour):
    query, found = asked
    after = rerank(found, query, Judge(harbour, lambda n: -2.0 * np.arange(n), fusion=0.3))
    judged = np.argsort(-posterior(found), kind="stable")[:MOST]
    gain = (after.log_prior - found.log_prior)[judged]
    assert np.diff(gain) == pytest.approx(-0.6, abs=1e-5)


def test_what_the_network_finds_best_comes_first(asked, harbour):
    query, found = asked
    judge = Judge(harbour, lambda n: np.where(np.arange(n) == 9, 60.0, 0.0))
    after = rerank(found, query, judge)
    tenth = np.argsort(-posterior(found), kind="stable")[9]
    assert np.argmax(posterior(after)) == tenth
    ((_, places, rows),) = judge.asked
    assert len(places) == len(rows) == MOST  # judged in one call


def test_a_lone_candidate_stays(asked, harbour):
    query, found = asked
    few = found._replace(
        rows=found.rows[:1],
        scores=found.scores[:1],
        log_prior=found.log_prior[:1],
        far=found.far[:1],
    )
    assert rerank(few, query, Judge(harbour, np.ones)) is few


def test_the_judged_places_are_the_viewpoints_themselves(asked, harbour, encoded):
    query, found = asked
    after = rerank(found, query, encoded)
    best = np.argsort(-posterior(found), kind="stable")[: module.MOST]
    views = found.rows[best].astype(np.int64)
    places = module.PlaceGraphs.of_views(harbour, views)
    logit = encoded.match(encoded.text(query), places, np.arange(len(best))).logit
    assert logit.std() > 0.01
    gain = (after.log_prior - found.log_prior)[best]
    expected = encoded.network.fusion * logit
    assert gain - gain.mean() == pytest.approx(expected - expected.mean(), abs=1e-4)


def test_another_weight_shifts_more(asked, encoded):
    query, found = asked
    little, much = (
        rerank(found, query, replace(encoded, network=replace(encoded.network, fusion=f)))
        for f in (0.05, 1.0)
    )
    near, far = (np.abs(x.log_prior - found.log_prior).max() for x in (little, much))
    assert 0.0 < near < far
