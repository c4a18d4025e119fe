"""The search looks at few viewpoints, and finds what looking at all of them finds."""

import numpy as np
import pytest

from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.search.posterior import modes
from placegraph.outdoor.search.viewpoints import FINE, Prior, search

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


def exhaustive(city, description, score):
    """Positions around all viewpoints, and their scores."""
    positions = (city.views.positions[:, None].astype(np.float64) + FINE).reshape(-1, 2)
    return positions, score(city, description, positions)[0]


def smoothed(positions, scores, at, radius=25.0):
    near = np.hypot(*(positions - at).T) <= radius
    return np.logaddexp.reduce(scores[near]) if near.any() else -np.inf


@pytest.mark.parametrize("name", QUERIES)
def test_search_finds_what_looking_everywhere_finds(name, harbour, said, score):
    description = said(*QUERIES[name])
    positions, scores = exhaustive(harbour, description, score)
    found = search(compile_query(description, harbour), harbour, Prior())
    assert found.probabilities.sum() + found.elsewhere <= 1 + 1e-6
    best = modes(found, 1, 6.67)[0]
    highest = max(smoothed(positions, scores, positions[i]) for i in np.argsort(-scores)[:50])
    assert smoothed(positions, scores, best.position) > highest - 0.7


@pytest.mark.parametrize("name", QUERIES)
def test_probabilities_are_those_of_looking_everywhere(name, harbour, said, score):
    from placegraph.outdoor.search.posterior import ELSEWHERE

    description = said(*QUERIES[name])
    positions, scores = exhaustive(harbour, description, score)
    weights = (1 - ELSEWHERE) * np.exp(scores.astype(np.float64)) / len(positions)
    weights /= weights.sum() + ELSEWHERE
    found = search(compile_query(description, harbour), harbour, Prior())
    left = weights.copy()  # places count for the first mode that is near
    for mode in modes(found, 3, 6.67):
        near = np.hypot(*(positions - mode.position).T) <= 50.0
        assert mode.probability == pytest.approx(left[near].sum(), abs=0.15)
        left[near] = 0.0


def test_a_thing_out_of_sight_is_found(harbour, said, hafenstadt):
    """The only museum is 70 m south: no viewpoint there has it in sight."""
    text = said(("me", "along", "Hafenstraße"), ("tourism=museum", "south", "me", {"far": True}))
    found = search(compile_query(text, harbour), harbour, Prior())
    best = modes(found, 1, 6.67)[0]
    museum = harbour.plane.to_plane(hafenstadt.position("I"))
    assert best.position[1] > museum[1] + 50


def test_nothing_is_in_sight_of_anything(harbour, said):
    query = compile_query(said(("Brotkorb", "north", "Rathaus", {"negated": True})), harbour)
    found = search(query, harbour, Prior())
    assert found.probabilities.sum() + found.elsewhere <= 1 + 1e-6


# --- what is known beforehand ---


@pytest.fixture
def positions(harbour):
    return harbour.views.positions.astype(np.float64)


def test_nothing_known_is_uniform(positions):
    prior = Prior()
    assert not prior.informative
    assert np.ptp(prior.log(positions)) == 0
    assert np.exp(prior.log(positions)).sum() == pytest.approx(1.0)


@pytest.mark.parametrize("radius", [10.0, 100.0, 1000.0, 1e5])
def test_near_shifts_probability_within_the_map(radius, positions):
    near = positions[len(positions) // 2] + 3.0
    prior = Prior(near=near, radius=radius)
    assert prior.informative
    weights = np.exp(prior.log(positions))
    assert weights.sum() == pytest.approx(1.0, abs=0.1)
    order = np.argsort(np.hypot(*(positions - near).T))
    assert (np.diff(weights[order]) <= 1e-12).all()


def test_half_lies_within_the_radius(rng):
    wide = rng.uniform(-3000, 3000, (40_000, 2))
    weights = np.exp(Prior(near=np.zeros(2), radius=500.0).log(wide))
    within = weights[np.hypot(*wide.T) <= 500.0].sum() / weights.sum()
    assert within == pytest.approx(0.5, abs=0.03)


def test_near_beyond_the_map_is_mostly_off_it(positions):
    far = positions.max(axis=0) + 2000.0
    total = [np.exp(Prior(near=far, radius=r).log(positions)).sum() for r in (300.0, 1000.0, 1e5)]
    assert total == sorted(total)
    assert total[0] < 1e-6
    assert total[-1] > 0.9


def test_the_way_from_a_listener(positions):
    listener = positions.mean(axis=0)
    north = Prior(listener=listener, bearings=((0.0, 0.5, 1.0),)).log(positions)
    delta = positions - listener
    ahead = (delta[:, 1] > 100) & (np.abs(delta[:, 0]) < 50)
    behind = (delta[:, 1] < -100) & (np.abs(delta[:, 0]) < 50)
    assert north[ahead].min() > north[behind].max() + 1
    unsure = Prior(listener=listener, bearings=((0.0, 0.5, 0.2),)).log(positions)
    assert np.ptp(unsure) < np.ptp(north)
    assert np.isfinite(north).all()


def test_candidates_do_not_depend_on_the_order_of_statements(harbour, said):
    statements = [s for name in ("square and fountain", "names") for s in QUERIES[name]]
    one = search(compile_query(said(*statements), harbour), harbour, Prior())
    two = search(compile_query(said(*statements[::-1]), harbour), harbour, Prior())
    for a, b in zip(modes(one, 3, 6.67), modes(two, 3, 6.67), strict=True):
        np.testing.assert_allclose(a.position, b.position, atol=1.0)
        assert a.probability == pytest.approx(b.probability, abs=0.02)


def test_few_viewpoints_are_looked_at(monaco, said):
    query = compile_query(said(("amenity=fountain", "north", "me")), monaco)
    found = search(query, monaco, Prior())
    assert 0 < len(found.positions) < 0.2 * len(monaco.views.positions)
