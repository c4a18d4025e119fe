"""The search looks at few viewpoints, and finds what looking at all of them finds."""

import numpy as np
import pytest

from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.locate import search
from placegraph.outdoor.search.candidates import Candidates
from placegraph.outdoor.search.posterior import FINE, compute_posterior, modes
from placegraph.outdoor.search.posterior import score as scored
from placegraph.outdoor.search.request import Hints, Matching, Request, make_request

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
def everywhere(request, harbour, said, score):
    """A description, and positions around all viewpoints with their scores."""
    description = said(*QUERIES[request.param])
    positions = (harbour.views.positions[:, None].astype(np.float64) + FINE).reshape(-1, 2)
    return description, positions, score(harbour, description, positions)[0]


def smoothed(positions, scores, at, radius=25.0):
    near = np.hypot(*(positions - at).T) <= radius
    return np.logaddexp.reduce(scores[near]) if near.any() else -np.inf


def test_search_finds_what_looking_everywhere_finds(everywhere, harbour):
    description, positions, scores = everywhere
    found = search(Request(harbour, compile_query(description, harbour)))
    assert found.probabilities.sum() + found.elsewhere <= 1 + 1e-6
    best = modes(found, 1, 6.67)[0]
    highest = max(smoothed(positions, scores, positions[i]) for i in np.argsort(-scores)[:50])
    assert smoothed(positions, scores, best.position) > highest - 0.7


def test_probabilities_are_those_of_looking_everywhere(everywhere, harbour):
    from placegraph.outdoor.search.posterior import ELSEWHERE

    description, positions, scores = everywhere
    weights = (1 - ELSEWHERE) * np.exp(scores.astype(np.float64)) / len(positions)
    weights /= weights.sum() + ELSEWHERE
    found = search(Request(harbour, compile_query(description, harbour)))
    left = weights.copy()  # places count for the first mode that is near
    for mode in modes(found, 3, 6.67):
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
        modes(p, 5, 6.67)[0]
        for p in (search(asked), compute_posterior(asked, scored(asked, every, 30.0)))
    )
    assert np.hypot(*(few.position - all_.position)) < 1.0
    assert few.probability == pytest.approx(all_.probability, abs=0.05)


def test_a_thing_out_of_sight_is_found(harbour, said, hafenstadt):
    """The only museum is 70 m south: no viewpoint there has it in sight."""
    text = said(("me", "along", "Hafenstraße"), ("tourism=museum", "south", "me", {"far": True}))
    found = search(Request(harbour, compile_query(text, harbour)))
    best = modes(found, 1, 6.67)[0]
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
    for a, b in zip(modes(one, 3, 6.67), modes(two, 3, 6.67), strict=True):
        np.testing.assert_allclose(a.position, b.position, atol=1.0)
        assert a.probability == pytest.approx(b.probability, abs=0.02)


def test_few_viewpoints_are_looked_at(monaco, said):
    query = compile_query(said(("amenity=fountain", "north", "me")), monaco)
    found = search(Request(monaco, query))
    assert 0 < len(found.positions) < 0.2 * len(monaco.views)
