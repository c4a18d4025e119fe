import numpy as np
import pytest

from placegraph_lab.tables.named.outdoor_matchers import (
    advantage,
    advantages,
    methods,
    recalls,
    report,
)
from placegraph_lab.tables.outdoor.matchers import (
    FUSED,
    PRINTED,
    PRINTED_ALONE,
    PRINTED_EDITS,
    RELATIONAL,
)
from placegraph_lab.tables.outdoor.metrics import Answer, Protocol, of_answers

PLAIN = Protocol(anywhere=True)


def row(city, method, distances, protocol=PLAIN):
    """Row whose best places are this far off; within 10 m, the cell is the right one."""
    answers = [Answer(np.array([d]), (d <= 10.0,), 0.001) for d in distances]
    return of_answers(city, protocol, method, answers)


@pytest.fixture
def rows():
    found = []
    for city, far in (("a", 100.0), ("b", 40.0)):
        found += [
            row(city, FUSED, [5.0] * 8 + [far] * 2),
            row(city, RELATIONAL, [5.0] * 7 + [30.0] * 3),
            row(city, PRINTED_ALONE, [5.0] * 2 + [60.0] * 8),
            row(city, PRINTED, [5.0] * 3 + [60.0] * 7),
        ]
    found.append(row("b", PRINTED_EDITS, [5.0, 300.0]))
    return found


def test_differences_are_paired_and_a_mean_of_cities(rows):
    rng = np.random.default_rng(0)
    lead = advantage(rows, FUSED, RELATIONAL, "exact", rng)
    assert lead.mean == pytest.approx(0.1)
    assert lead.low <= 0.1 <= lead.high
    assert advantage(rows, FUSED, RELATIONAL, "50 m", rng).mean == pytest.approx(-0.1)
    # of edit distance only the first two queries of one city are known
    assert advantage(rows, FUSED, PRINTED_EDITS, "exact", rng).mean == pytest.approx(0.5)


def test_tables_hold_every_matcher_and_the_paper(rows):
    table = advantages(rows, np.random.default_rng(0))
    assert {r["measure"] for r in table} == {"exact", "50 m"}
    assert {(r["first"], r["second"]) for r in table} == {
        (PRINTED, PRINTED_ALONE), (PRINTED, PRINTED_EDITS),
        (RELATIONAL, PRINTED), (FUSED, RELATIONAL),
    }  # fmt: skip
    text = report(rows, table)
    everywhere, _, slow = text.partition("#### Recall@1/3/5, the exact cell, 2 queries")
    for method in (FUSED, RELATIONAL, PRINTED_ALONE, "*paper: transformer, OSM*"):
        assert f"| {method} " in everywhere
    assert f"| {PRINTED_EDITS} " not in everywhere
    assert f"| {PRINTED_EDITS} " in slow
    assert ".80/.80/.80" in everywhere
    assert ".22/.39/.48" in everywhere
    assert "+0.100" in text
    assert "| a: " in text


def test_recalls_are_means_over_seeds_with_wider_intervals(rows):
    """Two seeds, of which one finds all and one nothing, are half right, and nobody knows the third."""
    rng = np.random.default_rng(0)
    again = [row(city, PRINTED, [60.0] * 10) for city in "ab"]
    sure = [row(city, RELATIONAL, [5.0] * 10) for city in "ab"]
    found = {r["method"]: r for r in recalls([*rows, *again], rng) if r["title"]}
    assert found[PRINTED]["seeds"] == 2
    assert found[PRINTED]["recall"][1].mean == pytest.approx(0.15)
    assert found[PRINTED]["recall"][1].low == 0.0
    assert found[RELATIONAL]["recall"][1].low > 0.4
    (only,) = recalls(sure, rng)
    assert only["recall"][5] == (1.0, 1.0, 1.0)
    text = report([*rows, *again], [], recalls([*rows, *again], rng))
    (line,) = (line for line in text.splitlines() if ".15 (.00 to" in line)
    cells = [cell.strip() for cell in line.strip("| ").split("|")]
    assert cells[:3] == [PRINTED, "6 statements, no noise", "2"]
    lead = advantage([*rows, *again], RELATIONAL, PRINTED, "exact", rng)
    assert lead.mean == pytest.approx(0.7 - 0.15)


def test_a_network_of_the_table_is_the_last_row(rows):
    assert methods([*rows, row("a", "mine", [5.0])])[-1] == "mine"
