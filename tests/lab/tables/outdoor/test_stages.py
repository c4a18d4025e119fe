"""The pipeline takes its stages in turn, and what it ranks is what it was given."""

import numpy as np
import pytest

from placegraph.outdoor.city import build_city
from placegraph.outdoor.network.encoded import EncodedCity
from placegraph.outdoor.network.network import GraphTransformer
from placegraph.outdoor.network.weights import Shape
from placegraph_lab.tables.outdoor.ablation import CANDIDATES, GIVEN, Task, evaluate, mean_of
from placegraph_lab.tables.outdoor.pairs import Pairs
from placegraph_lab.tables.outdoor.queries import Query, load, make_queries
from placegraph_lab.tables.outdoor.stages import STAGES, found_within, medians, run, slope


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
    assert all(len(given) == GIVEN for given in task.given)
    table = evaluate(task, network)
    assert {f"{n} candidates" for n in CANDIDATES} < set(table)
    for name, recall in table.items():
        assert recall == sorted(recall)
        assert all(0.0 <= r <= 1.0 for r in recall), name
    assert table["dense"][2] <= table["dense, of 10"][0]
    assert table["5 candidates"][2] == table["dense"][2]  # the same five, ranked anew
    assert mean_of([table, table]) == table


def test_every_pair_is_judged_by_either_network(city, network, asked):
    pairs = Pairs.of(city, asked, 5, np.random.default_rng(0))
    assert pairs.by_network(network)() == 4 * 5
    pytest.importorskip("torch", reason="the learn extra is not installed")
    assert pairs.by_torch(network, "cpu")() == 4 * 5
