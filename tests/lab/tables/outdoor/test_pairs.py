import time

import numpy as np
import pytest

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
