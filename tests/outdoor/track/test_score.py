"""What a tracker thinks of viewpoints is what looking at them finds."""

import numpy as np
import pytest
from tests.outdoor.search.test_viewpoints import QUERIES

from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.search.posterior import FINE
from placegraph.outdoor.track.belief import MOST_SCORED, score


@pytest.mark.parametrize("name", QUERIES)
def test_closer_looks_are_looks(name, harbour, said, request):
    look = request.getfixturevalue("score")
    description = said(*QUERIES[name])
    found = score(compile_query(description, harbour), harbour, np.ones(len(harbour.views)))
    assert found.positions.shape == (len(found.closer), len(FINE), 2)
    off = []
    for view, positions, ratios in zip(found.closer, found.positions, found.ratios, strict=True):
        np.testing.assert_allclose(positions.mean(axis=0), harbour.views.positions[view], atol=0.01)
        off.append(np.abs(ratios - look(harbour, description, positions)[0]))
        assert found.views[view] == pytest.approx(np.log(np.exp(ratios).mean()), abs=1e-6)
    # what is far is seen from the viewpoint, not from each position around it
    assert np.median(off) < 0.1
    assert np.percentile(off, 90) < 0.8


@pytest.mark.parametrize("name", ["one bench", "tree and bench", "names", "no trees"])
def test_a_believed_place_is_looked_at_however_badly_it_fits(name, harbour, said, request, rng):
    look = request.getfixturevalue("score")
    description = said(*QUERIES[name])
    query = compile_query(description, harbour)
    n = len(harbour.views)
    for view in rng.choice(n, 12, replace=False):
        weights = np.full(n, 1e-12)
        weights[view] = 1.0
        found = score(query, harbour, weights)
        seen = look(harbour, description, harbour.views.positions[view] + FINE)[0]
        exact = float(np.log(np.exp(seen.astype(np.float64)).mean()))
        assert found.views[view] == pytest.approx(exact, abs=0.8)


def test_nothing_drops_to_zero(harbour, said):
    for name, statements in QUERIES.items():
        query = compile_query(said(*statements), harbour)
        found = score(query, harbour, np.ones(len(harbour.views)))
        assert np.isfinite(found.views).all(), name
        assert found.views.min() >= np.log(query.statements.noise).sum() - 3.0
        assert found.nothing == pytest.approx(
            np.log(query.statements.noise[~query.statements.negated]).sum(), abs=1e-5
        )


def test_no_belief_on_the_map_is_no_error(harbour, said):
    query = compile_query(said(*QUERIES["one bench"]), harbour)
    found = score(query, harbour, np.zeros(len(harbour.views)))
    assert len(found.closer) == 0
    assert (found.views == found.nothing).all()


def test_many_are_left_with_their_bounds(monaco, said):
    """More viewpoints see a building than are scored; the rest still tell good from bad."""
    description = said(("building=yes", "north", "highway=footway"))
    query = compile_query(description, monaco)
    weights = np.ones(len(monaco.views))
    found = score(query, monaco, weights)
    spread = np.unique(found.views.round(3))
    assert (found.views > found.nothing + 0.05).sum() > MOST_SCORED / 3
    assert len(spread) > 100
