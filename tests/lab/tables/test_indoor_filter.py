"""The benchmark itself, with answers that cost nothing: what it asks, writes and asks again."""

import importlib.util
import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from placegraph_lab.tables.indoor import bench as indoor_bench
from placegraph_lab.tables.indoor.metrics import measure

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def bench(monkeypatch, shared):  # noqa: ARG001  # the benchmark's data
    """The script, its maps replaced by names and its answers by the truth."""
    spec = importlib.util.spec_from_file_location("bench", ROOT / "benchmarks/indoor_filter.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    asked = []

    def ask(job, scene, window, *, seed, device):  # noqa: ARG001
        assert scene == job.map
        asked.append((job.name, window.name, seed))
        estimate = SimpleNamespace(
            status=SimpleNamespace(name="LOST"), modes=(), best=None, stats={}
        )
        return measure(
            estimate, window.truth, seconds=0.1, frames=len(window.capture),
            window=window.name, place=window.place, changed=window.changed,
        )  # fmt: skip

    monkeypatch.setattr(script, "ask", ask)
    monkeypatch.setattr(indoor_bench, "covered", lambda _, window: window)
    monkeypatch.setattr(script.Bench, "scene", lambda _, name: name)
    script.asked = asked
    return script


def run(script, folder, *options):
    import typer

    app = typer.Typer()
    app.command()(script.main)
    arguments = ["--cache", str(folder / "cache"), "--out", str(folder / "out.json"), *options]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    return result.output


def test_it_goes_on_where_it_was_cut(bench, tmp_path):
    options = ("--only", "instances: semantic", "--windows", "10,25")
    text = run(bench, tmp_path, *options)
    assert "#### House, instance labels, 30 % of the patches wrong, 10 frames" in text
    assert len(bench.asked) == 40 + 8 + 2  # and one of each length to warm up
    assert {seed for _, _, seed in bench.asked} == {0, 1}
    bench.asked.clear()
    journal = tmp_path / "cache/indoor_filter.jsonl"
    kept = journal.read_text().splitlines(keepends=True)[:-3]
    journal.write_text("".join(kept))
    assert run(bench, tmp_path, *options) == text
    assert len(bench.asked) == 3 + 1
    run(bench, tmp_path, *options, "--fresh")
    assert len(bench.asked) == 4 + 50


def test_it_writes_what_it_prints(bench, tmp_path):
    run(bench, tmp_path, "--only", "b in a: depth,none: depth", "--windows", "5")
    written = json.loads((tmp_path / "out.json").read_text())
    assert [(r["table"], r["row"], r["length"]) for r in written["rows"]] == [
        ("none", "depth", 5),
        ("b in a", "depth", 10),
    ]
    none = written["rows"][0]
    assert none["score"]["windows"] == 48
    assert none["score"]["status"] == {"LOST": 1.0}
    assert {"unchanged", "changed", "seq00", "seq07"} <= set(none["parts"])
    assert written["machine"]["cores"]


def test_a_quick_run_is_short(bench, tmp_path):
    run(bench, tmp_path, "--quick")
    assert {name for name, _, _ in bench.asked} == set(bench.QUICK)
    assert len(bench.asked) < 250


def test_unknown_rows_are_refused(bench, tmp_path):
    import typer

    app = typer.Typer()
    app.command()(bench.main)
    result = CliRunner().invoke(app, ["--only", "gold", "--cache", str(tmp_path)])
    assert result.exit_code == 2
    assert "instances: semantic" in result.output
