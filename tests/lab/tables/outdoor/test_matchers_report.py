"""Tables say what the rows say."""

import numpy as np
import pytest

from placegraph_lab.tables.outdoor.matchers import DENSE, EDIT, FUSED, RELATIONAL
from placegraph_lab.tables.outdoor.matchers_report import (
    advantage,
    advantages,
    best_single,
    hits,
    report,
    title,
)
from placegraph_lab.tables.outdoor.metrics import Answer
from placegraph_lab.tables.outdoor.report import Protocol, of_answers

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
            row(city, DENSE, [5.0] * 2 + [60.0] * 8),
            row(city, EDIT, [5.0, 300.0]),
        ]
    return found


def test_hits_are_of_the_best_place(rows):
    assert hits(rows[0], "exact") == [True] * 8 + [False] * 2
    assert hits(rows[4], "50 m") == [True] * 10
    assert hits(rows[4], "25 m") == [True] * 8 + [False] * 2


def test_the_best_single_matcher_depends_on_the_measure(rows):
    assert best_single(rows, "exact") == RELATIONAL
    assert best_single([r for r in rows if r.method != RELATIONAL], "exact") == EDIT
    assert best_single(rows, "50 m") == RELATIONAL


def test_the_lead_is_paired_and_a_mean_of_cities(rows):
    rng = np.random.default_rng(0)
    lead = advantage(rows, RELATIONAL, "exact", rng)
    assert lead.mean == pytest.approx(0.1)
    assert lead.low <= 0.1 <= lead.high
    assert advantage(rows, RELATIONAL, "50 m", rng).mean == pytest.approx(-0.1)
    # of edit distance only the first two queries are known
    assert advantage(rows, EDIT, "exact", rng).mean == pytest.approx(0.5)


def test_tables_hold_every_matcher_and_the_paper(rows):
    table = advantages(rows, np.random.default_rng(0))
    assert {r["measure"] for r in table} == {"exact", "25 m", "50 m"}
    text = report(rows, table)
    for method in (FUSED, RELATIONAL, DENSE, EDIT, "*paper: transformer, OSM*"):
        assert f"| {method} " in text
    assert ".80/.80/.80" in text
    assert ".22/.39/.48" in text
    assert "+0.100" in text
    assert "| a: " in text


def test_nothing_is_compared_without_both_fused(rows):
    without = [r for r in rows if r.method != FUSED]
    assert advantages(without, np.random.default_rng(0)) == []
    assert "best single" not in report(without, [])


def test_titles_tell_protocols_apart():
    assert title(Protocol(anywhere=True)) == "6 statements, no noise"
    assert title(Protocol()) == "6 statements, no noise, near the middle of cells"
