import json
from types import SimpleNamespace

import pytest

from placegraph_lab.tables.indoor import bench as indoor_bench
from placegraph_lab.tables.indoor.metrics import measure as measured
from placegraph_lab.tables.named import indoor_filter as script


@pytest.fixture
def bench(monkeypatch, shared):  # noqa: ARG001  # the benchmark's data
    """The script, its maps replaced by names and its answers by the truth."""
    asked = []

    def ask(job, scene, window, *, seed, device):  # noqa: ARG001
        assert scene == job.map
        asked.append((job.name, window.name, seed))
        estimate = SimpleNamespace(
            status=SimpleNamespace(name="LOST"), modes=(), best=None, stats={}
        )
        return measured(
            estimate, window.truth, seconds=0.1, frames=len(window.capture),
            window=window.name, place=window.place, changed=window.changed,
        )  # fmt: skip

    monkeypatch.setattr(script, "ask", ask)
    monkeypatch.setattr(indoor_bench, "measure_coverage", lambda _, window: window)
    monkeypatch.setattr(script.Bench, "scene", lambda _, name: name)
    return asked


@pytest.fixture
def run(measure, tmp_path):
    def go(*options):
        places = ("--cache", tmp_path / "cache", "--out", tmp_path / "out.json")
        result = measure("indoor_filter", *places, *options)
        assert result.exit_code == 0, result.output
        return result.output

    return go


def test_it_goes_on_where_it_was_cut(bench, run, tmp_path):
    options = ("--only", "instances: semantic", "--windows", "10,25")
    text = run(*options)
    assert "#### House, instance labels, 30 % of the patches wrong, 10 frames" in text
    assert len(bench) == 40 + 8 + 2  # and one of each length to warm up
    assert {seed for _, _, seed in bench} == {0, 1}
    bench.clear()
    journal = tmp_path / "cache/indoor_filter.jsonl"
    kept = journal.read_text().splitlines(keepends=True)[:-3]
    journal.write_text("".join(kept))
    assert run(*options) == text
    assert len(bench) == 3 + 1
    run(*options, "--fresh")
    assert len(bench) == 4 + 50


@pytest.mark.usefixtures("bench")
def test_it_writes_what_it_prints(run, tmp_path):
    run("--only", "b in a: depth,none: depth", "--windows", "5")
    written = json.loads((tmp_path / "out.json").read_text())
    rows = [(r["row"], r["length"]) for r in written["rows"]]
    assert rows == [("none: depth", 5), ("b in a: depth", 10)]
    none = written["rows"][0]
    assert none["score"]["windows"] == 48
    assert none["score"]["status"] == {"LOST": 1.0}
    assert {"unchanged", "changed", "seq00", "seq07"} <= set(none["parts"])
    assert written["machine"]["cores"]
