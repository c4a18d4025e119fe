import json

import pytest

from placegraph.errors import InputError
from placegraph_lab.tables.outdoor.metrics import distances
from placegraph_lab.tables.outdoor.places import Baselines, landmarks, read_records


def test_points_are_listed_latitude_first(tmp_path):
    path = tmp_path / "records.jsonl"
    row = {
        "content": "by the bank",
        "rvs_goal_point": [50.0, 10.0],
        "rvs_start_point": [50.1, 10.1],
        "landmarks": {"near_pivot": [[50.2, 10.2], "bank"], "end_point": [[50.2, 10.2], "bank"]},
    }
    path.write_text(json.dumps(row), encoding="utf-8")
    (found,) = read_records(path)
    assert (found.goal, found.start) == ((10.0, 50.0), (10.1, 50.1))
    assert landmarks([found]) == [("bank", 10.2, 50.2)]
    path.write_text('{"content": "x"}\n', encoding="utf-8")
    with pytest.raises(InputError, match="line 1"):
        read_records(path)
    with pytest.raises(InputError, match=r"missing\.jsonl"):
        read_records(tmp_path / "missing.jsonl")


def test_baselines_are_as_good_as_quoted(shared):
    """The issue quotes .29/.47 within 100/250 m for the rarest landmark nearest to the start."""
    told = read_records(shared / "data/text/rvs_pittsburgh.jsonl")
    assert len(told) == 1023
    simple = Baselines(landmarks(told))
    off = []
    for r in told:
        place = simple.rarest_near(r)
        off.append(float("inf") if place is None else distances(place, *r.goal)[0])
    assert sum(d <= 100.0 for d in off) / len(off) == pytest.approx(0.29, abs=0.04)
    assert sum(d <= 250.0 for d in off) / len(off) == pytest.approx(0.47, abs=0.04)
