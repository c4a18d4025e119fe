"""The pipeline takes its stages in turn, and what it ranks is what it was given."""

from dataclasses import replace

import numpy as np
import pytest

from placegraph.outdoor.city import build_city
from placegraph.outdoor.network.encoded import EncodedCity
from placegraph.outdoor.network.network import GraphTransformer
from placegraph.outdoor.network.weights import Shape
from placegraph_lab.tables.named.outdoor_ablation import (
    GIVEN,
    OURS,
    Task,
    evaluate,
    literal_alone,
    printed,
    recall,
)
from placegraph_lab.tables.named.outdoor_pairs import Pairs
from placegraph_lab.tables.outdoor.matchers import STAGES, found_within, medians, run, slope
from placegraph_lab.tables.outdoor.queries import Query, load, make_queries


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


def test_without_candidates_all_cells_are_ranked(encoded, city, asked):
    everything = run(encoded, asked[0].text, None).rows
    assert sorted(everything.tolist()) == list(range(len(city.cells)))
    few = run(encoded, asked[0].text, 7).rows
    place = {row: i for i, row in enumerate(everything.tolist())}
    order = [place[row] for row in few.tolist()]
    assert order == sorted(order)  # the same scores, so the same order


def test_recall_is_of_what_is_near(city):
    at = np.array([[0.0, 0.0], [0.0, 60.0], [30.0, 0.0]])
    lonlat = city.plane.to_lonlat(np.zeros((3, 2)))
    asked = [Query("", *map(float, where), ()) for where in lonlat]
    assert found_within(city, asked, list(at), 50.0) == pytest.approx(2 / 3)


def test_slopes_are_those_of_lines():
    assert slope([447, 1616, 3409], [1e-3 * n + 2.0 for n in (447, 1616, 3409)]) == pytest.approx(
        1e-3
    )


def test_a_network_is_evaluated_on_given_cells_and_its_own(city, network, town, asked):
    task = Task.of(city, load(town), asked)
    for truth, others, query in zip(task.truth, task.others, task.queries, strict=True):
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
    text = printed({OURS: [[table]], "other": [[table], [table]]}, 0)
    assert "| other |     2 |" in text
    assert "+0.000 to +0.000" in text


def test_what_is_said_literally_needs_no_training(network, city, town, asked):
    """Weights of the joint model do not matter, but for what the statements count."""
    task = Task.of(city, load(town), asked)
    other = {
        n: 2.0 * a if n.startswith(("judge", "cross")) else a for n, a in network.arrays.items()
    }
    first, second = (literal_alone(n) for n in (network, replace(network, arrays=other)))
    found, again = (evaluate(task, n) for n in (first, second))
    assert all((found[name] == again[name]).all() for name in found if "cosine" not in name)


def test_every_pair_is_judged_by_either_network(city, network, asked):
    pairs = Pairs.of(city, asked, 5, np.random.default_rng(0))
    assert pairs.by_network(network)() == 4 * 5
    pytest.importorskip("torch", reason="the learn extra is not installed")
    assert pairs.by_torch(network, "cpu")() == 4 * 5
