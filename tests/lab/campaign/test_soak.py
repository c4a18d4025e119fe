import numpy as np
import pytest

from placegraph_lab.campaign.row import Effort
from placegraph_lab.campaign.soak import LOADS, LoadReport, rows, run_in_process
from placegraph_lab.campaign.trial import prepare

MEGABYTE = 1e6


def steady(count=2000, **changed):
    kinds = {"took": 0.01, "memory": 500 * MEGABYTE, "files": 12}
    return LoadReport.of(
        *(changed.get(kind, np.full(count, value)) for kind, value in kinds.items())
    )


def test_what_stays_as_it_is_is_no_fault():
    assert steady().faults == []
    assert "memory 500.0 -> 500.0 MB (+0.0%), open files 12 -> 12" in str(steady())
    assert steady(memory=np.linspace(500, 509, 2000) * MEGABYTE).faults == []


def test_what_grows_slows_down_or_stays_open_is_one():
    assert steady(memory=np.linspace(500, 600, 2000) * MEGABYTE).faults == ["memory"]
    assert steady(took=np.linspace(0.01, 0.05, 2000)).faults == ["slower"]
    assert steady(files=np.arange(2000)).faults == ["files"]


@pytest.mark.all
def test_a_load_is_looked_at_and_ends_with_its_count(tmp_path, monkeypatch):
    monkeypatch.setitem(LOADS, "sentences", 5)
    report = run_in_process("sentences", prepare(tmp_path / "inputs"), 600.0, 7)
    assert report.count == 5
    assert report.memory[0] > 10 * MEGABYTE
    assert report.files[0] >= 3
    assert report.seconds > 0.0


@pytest.mark.all
def test_nothing_wears_out(tmp_path):
    found = list(rows(Effort(240.0, 20261123, tmp_path, tmp_path / "none", print)))
    assert sorted(row.what for row in found) == sorted(LOADS)
    assert [row for row in found if row.faults] == []
