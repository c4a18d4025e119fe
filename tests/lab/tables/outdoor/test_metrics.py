import json

import numpy as np
import pytest

from placegraph.core.estimate import CityEstimate, Place, Status
from placegraph_lab.tables.outdoor.metrics import (
    OURS,
    Answer,
    Protocol,
    Row,
    measure,
    of_answers,
    report,
    score,
)
from placegraph_lab.tables.runner import markdown


def answer(*off, exact=(), seconds=0.001, status="OK", probability=0.9):
    exact = exact or tuple(d <= 10.0 for d in off)
    return Answer(np.array(off, float), exact, seconds, status, probability)


def test_an_estimate_is_measured():
    here = Place(10.0, 50.0, 0.7, "a", np.eye(2))
    there = Place(10.001, 50.0, 0.2, "b", np.eye(2))
    estimate = CityEstimate(Status.AMBIGUOUS, (there, here), "two places fit")
    measured = measure(estimate, 10.0, 50.0, seconds=0.5, exact=(True, False), cell="a")
    assert measured.distance == pytest.approx([71.70, 0.0], abs=0.05)
    assert measured.exact == (True, False)
    assert measured.own_cell == (False, True)
    assert score([measured]).own_cell == {1: 0.0, 3: 1.0, 5: 1.0}
    assert (measured.status, measured.probability) == ("AMBIGUOUS", 0.2)
    lost = measure(CityEstimate(Status.LOST, (), "nothing fits"), 10.0, 50.0, seconds=0.5, cell="a")
    assert (len(lost.distance), lost.exact, lost.probability) == (0, (), 0.0)


def test_recall_counts_ranks_and_radii():
    lost = answer(status="LOST", probability=0.0, seconds=0.009)
    found = [answer(5.0, 400.0), answer(30.0, 20.0), answer(90.0, 80.0, 70.0, 60.0, 40.0)]
    s = score([*found, lost])
    assert s.exact == {1: 0.25, 3: 0.25, 5: 0.25}
    assert s.within[25.0] == {1: 0.25, 3: 0.5, 5: 0.5}
    assert s.within[50.0] == {1: 0.5, 3: 0.5, 5: 0.75}
    assert s.median == 60.0
    assert s.status == {"LOST": 0.25, "OK": 0.75}
    assert s.right == {"LOST": 0.0, "OK": pytest.approx(2 / 3)}
    assert (s.p50, s.p95) == pytest.approx((0.001, 0.0078))


def test_a_report_shows_methods():
    protocol = Protocol()
    bound = {"exact": [1, 1, 1], "25 m": [1, 1, 1], "50 m": [1, 1, 1]}
    rows = [
        of_answers("a", protocol, "triple bag", [answer(5.0, probability=None), answer(99.0)]),
        of_answers("a", protocol, OURS, [answer(5.0), answer(9.0)]),
        Row("a", protocol, "ceiling", bound, None),
    ]
    text = report(rows, ["a"])
    assert "| 6 statements, no noise | .50/.50/.50 | 1.00/1.00/1.00 | 1.00/1.00/1.00 |" in text
    assert json.dumps([r.to_dict() for r in rows], allow_nan=False)


def test_tables_are_markdown():
    lines = markdown(["", "b"], [["long name", ".5"], ["x", "∞"]]).splitlines()
    assert lines[1] == "| --------- | --: |"
    assert len({len(x) for x in lines}) == 1
    with pytest.raises(ValueError, match="as many cells"):
        markdown(["a"], [["b", "c"]])
