"""Recall for the curves of a training."""

import numpy as np
import pytest

pytest.importorskip("torch", reason="PyTorch is not installed (extra learn)")

from placegraph_learn.train.city.recalls import Judged, judge, recall, recalls

pytestmark = pytest.mark.usefixtures("one_thread")


def judged(relational, logit, cosine, fused, near, together=None):
    near = np.array(near, bool)
    if together is None:
        together = np.broadcast_to(
            np.eye(near.shape[1], dtype=bool), (len(near), *[near.shape[1]] * 2)
        )
    scores = (np.array(x, np.float64) for x in (relational, logit, cosine, fused))
    return Judged(*scores, near, together)


def test_places_close_together_share_their_probability():
    """Two weak places side by side outweigh a strong one alone, as modes of a posterior do."""
    scores = np.log([[0.4, 0.3, 0.3]])
    near = [[False, True, True]]
    side_by_side = np.eye(3, dtype=bool)[None] | np.array([[[0, 0, 0], [0, 0, 1], [0, 1, 0]]], bool)
    apart = judged(*[scores] * 4, near)
    assert recall(scores, apart) == 0.0
    assert recall(scores, apart._replace(together=side_by_side)) == 1.0


def test_each_matcher_is_counted_and_cities_count_alike():
    first, second = [0.0, 9.0], [9.0, 0.0]
    near = [[True, False]]
    one = judged([second], [first], [first], [second], near)
    other = judged([second], [second], [first], [second], near)
    many = judged(*(np.repeat(x, 5, axis=0) for x in other))
    assert recalls([one, many]) == {"relational": 1.0, "network": 0.5, "dense": 0.0, "fused": 1.0}


def test_what_was_not_asked_is_not_found():
    no = -np.inf
    asked = judged([[1.0, no]], [[1.0, no]], [[0.1, no]], [[1.0, no]], [[True, False]])
    assert set(recalls([asked]).values()) == {1.0}


def test_what_is_judged_are_the_best_of_relational_matching(harbour, pool, network):
    import torch

    from placegraph.outdoor.search.rerank import HARD
    from placegraph_learn.train.city.torch_batches import Lessons
    from placegraph_learn.train.city.torch_network import Network

    module = Network(network.shape)
    module.load_state_dict({n: torch.from_numpy(a) for n, a in network.arrays.items()})
    found = judge(module, Lessons(harbour, pool), "cpu")
    asked = np.isfinite(found.relational)
    assert asked.sum(axis=1).max() <= HARD
    for scores in (found.logit, found.cosine, found.fused):
        assert np.array_equal(np.isfinite(scores), asked)
    assert (pool.views[asked] >= 0).all()
    least = np.where(asked, found.relational, np.inf).min(axis=1)
    left_out = np.isfinite(pool.scores) & ~asked
    assert (np.where(left_out, pool.scores, -np.inf).max(axis=1) <= least + 1e-6).all()
    off = np.hypot(
        *(harbour.views.positions[pool.views] - pool.positions[:, None]).transpose(2, 0, 1)
    )
    assert np.array_equal(found.near, (off <= 50.0) & asked)


def test_training_begins_with_relational_matching(harbour, pool, network):
    """An untrained network adds nothing: what it may lose by being fused is nothing either."""
    from placegraph_learn.train.city.torch_batches import Lessons
    from placegraph_learn.train.city.torch_network import Network

    found = judge(Network(network.shape), Lessons(harbour, pool), "cpu")
    asked = np.isfinite(found.relational)
    added = found.fused[asked] - found.relational[asked]
    of = np.nonzero(asked)[0]
    first = added[np.searchsorted(of, of)]
    assert added == pytest.approx(first, abs=1e-4)  # the same for all places of a text
    told = recalls([found])
    assert told["fused"] == told["relational"]
