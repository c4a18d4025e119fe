"""The pipeline takes its stages in turn, and what it ranks is what it was given."""

import numpy as np
import pytest

from placegraph.outdoor.city import build_city
from placegraph.outdoor.network.network import EncodedCity, GraphTransformer, Shape
from placegraph_lab.tables.named.outdoor_ablation import (
    GIVEN,
    OURS,
    Task,
    evaluate,
    recall,
    report,
)
from placegraph_lab.tables.outdoor.matchers import STAGES, medians, run
from placegraph_lab.tables.outdoor.queries import load, make_queries


@pytest.fixture(scope="module")
def city(town, tmp_path_factory):
    return build_city(town, tmp_path_factory.mktemp("map") / "town.city")


@pytest.fixture(scope="module")
def network():
    """Weights drawn at random: these tests are about what goes where."""
    shape, rng = Shape(width=16, dimension=16, heads=2, evidence=8), np.random.default_rng(0)
    arrays = {
        name: rng.normal(scale=0.2, size=size).astype(np.float32)
        for name, size in shape.arrays().items()
    }
    return GraphTransformer(shape, arrays, "random")


@pytest.fixture(scope="module")
def encoded(city, network):
    return EncodedCity(city, network)


@pytest.fixture(scope="module")
def asked(town):
    return make_queries(town, n=4)


def test_stages_are_timed_and_rank_candidates(encoded, city, asked):
    runs = [run(encoded, q.text, 7) for q in asked]
    for found in runs:
        assert tuple(found.seconds) == STAGES
        assert all(seconds >= 0.0 for seconds in found.seconds.values())
        assert found.total == pytest.approx(sum(found.seconds.values()))
        assert len(set(found.rows.tolist())) == 7
        assert found.rows.max() < len(city.cells)
    table = medians(runs)
    assert table["total"] == pytest.approx(np.median([r.total for r in runs]))


def test_a_network_is_evaluated_on_given_cells_and_its_own(city, network, town, asked):
    task = Task.of(city, load(town), asked)
    for truth, others, query in zip(task.truth, task.distractors, task.queries, strict=True):
        assert city.cells.id_of(truth) == city.cells.at(query.longitude, query.latitude)
        assert truth not in others
        assert len(set(others.tolist())) == len(others) >= max(GIVEN) - 1
    table = evaluate(task, network)
    assert {f"{n} given" for n in GIVEN} < set(table)
    for name, hits in table.items():
        assert hits.shape == (len(task.queries), 3), name
        assert (np.diff(hits.astype(int), axis=1) >= 0).all(), name
    assert table["5 given"][:, 2].all()  # of five cells the true one is among the best five
    assert (table["5 given"][:, 0] >= table["50 given"][:, 0]).all()  # more to be confused with
    for own in ("10 candidates", "10 candidates, cosine", "dense"):
        assert (table[own][:, 2] <= table["among 10"][:, 0]).all()
    twice = recall([table, table])
    assert twice["dense"] == pytest.approx(table["dense"].mean(axis=0))
    text = report({OURS: [[table]], "other": [[table], [table]]}, 0)
    assert "| other |     2 |" in text
    assert "+0.000 to +0.000" in text
