import numpy as np
import pytest

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
def asked(town):
    return make_queries(town, n=4)


def test_stages_are_timed_and_rank_candidates(encoded, harbour, asked):
    runs = [run(encoded, q.text, 7) for q in asked]
    for found in runs:
        assert tuple(found.seconds) == STAGES
        assert all(seconds >= 0.0 for seconds in found.seconds.values())
        assert found.total == pytest.approx(sum(found.seconds.values()))
        assert len(set(found.rows.tolist())) == 7
        assert found.rows.max() < len(harbour.cells)
    table = medians(runs)
    assert table["total"] == pytest.approx(np.median([r.total for r in runs]))


def test_a_network_is_evaluated_on_given_cells_and_its_own(harbour, network, town, asked):
    task = Task.of(harbour, load(town), asked)
    for truth, others, query in zip(task.truth, task.distractors, task.queries, strict=True):
        assert harbour.cells.id_of(truth) == harbour.cells.at(query.longitude, query.latitude)
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
