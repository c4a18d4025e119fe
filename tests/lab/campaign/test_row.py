"""Rows of the campaign: counted, summed, written down and read again."""

import pytest

from placegraph_lab.campaign.row import OUTCOMES, Row, total

FOUND = {"accepted": 3, "typed": 4, "hang": 1}


def test_a_row_counts_every_trial():
    row = Row.counted("fuzz", "GLB", FOUND, seed=7, seconds=2.5)
    assert (row.tried, row.accepted, row.typed, row.hang, row.faults) == (8, 3, 4, 1, 1)
    assert sum(getattr(row, name) for name in OUTCOMES) == row.tried


def test_an_unknown_outcome_is_refused():
    with pytest.raises(KeyError, match="lucky"):
        Row.counted("fuzz", "GLB", {"lucky": 1}, seed=7, seconds=2.5)


def test_rows_come_back_and_are_summed():
    row = Row.counted("fuzz", "GLB", FOUND, seed=7, seconds=2.5)
    assert Row.from_dict(row.to_dict()) == row
    both = total([row, row])
    assert (both.tried, both.faults, both.seconds) == (16, 2, 5.0)
    assert total([]).tried == 0
