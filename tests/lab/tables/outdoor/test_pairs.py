import time

import numpy as np
import pytest

from placegraph.outdoor.network.label_graphs import LabelGraphs
from placegraph.outdoor.network.network import GraphTransformer
from placegraph_lab.tables.named.outdoor_pairs import Pairs, rate
from placegraph_lab.tables.outdoor.queries import make_queries


@pytest.fixture(scope="module")
def pairs(harbour, town):
    return Pairs.of(harbour, make_queries(town, n=3), 7, np.random.default_rng(0))


def test_rates_are_pairs_over_time(monkeypatch):
    now, runs = [0.0], iter([10.0, 1.0, 2.0, 4.0, 4.0])  # the first one warms up
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    def work():
        now[0] += next(runs)
        return 8

    assert rate(work, seconds=6.5) == 4.0


def test_every_pair_is_judged(pairs):
    assert pairs.by_relations()() == 3 * 7
    assert pairs.by_edits(plain=False, texts=2, cells=5, timeout=0.01)() == 2 * 5
    assert pairs.by_edits(plain=True, texts=1, cells=2, timeout=0.01)() == 2


@pytest.mark.parametrize("printed", [False, True])
@pytest.mark.parametrize("encoded", [False, True])
def test_networks_match_every_pair(pairs, printed, encoded):
    network = GraphTransformer.default(printed=printed)
    assert pairs.by_network(network, encoded=encoded)() == 3 * 7


def test_pairs_in_pytorch_are_those_of_the_printed_network(pairs, monkeypatch):
    pytest.importorskip("torch", reason="PyTorch is not installed (extra learn)")
    from placegraph_learn.city import batches

    network, logits, forward = GraphTransformer.default(printed=True), [], batches.forward

    def record(*arguments):
        scores = forward(*arguments)
        logits.append(scores.logit.numpy())
        return scores

    monkeypatch.setattr(batches, "forward", record)
    assert pairs.by_torch(network, "cpu")() == 3 * 7
    texts, cells = LabelGraphs.of_texts(pairs.descriptions), LabelGraphs.of_cells(pairs.city)
    for text, (rows, found) in enumerate(zip(pairs.rows, logits, strict=True)):
        assert found == pytest.approx(network.match(texts, text, cells, rows).logit, abs=1e-3)
