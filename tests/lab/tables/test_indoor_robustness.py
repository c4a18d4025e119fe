import json
import math

import pytest

from placegraph_lab.tables.indoor.robustness import Case, Outcome, all_cases, quick
from placegraph_lab.tables.named import indoor_robustness as script
from placegraph_lab.tables.named.indoor_robustness import Row
from placegraph_lab.tables.runner import plain


@pytest.fixture
def asked(monkeypatch, shared):  # noqa: ARG001  # the table's data
    """The script, its maps replaced by names and its answers by one that is nearly right."""
    seen = []

    def ask(scene, asked, clip, case, *, seed, device):  # noqa: ARG001
        seen.append((case.name, scene, asked.number))
        off = math.inf if case.map else 0.07
        return Outcome(
            clip.name, asked.number, off, 1.0, "OK", "One place fits.", 5.0, {"depth": 0.9}
        )

    monkeypatch.setattr(script, "ask", ask)
    monkeypatch.setattr(script.Places, "scene", lambda _, name: name)
    return seen


def test_it_goes_on_where_it_was_cut(asked, measure, tmp_path):
    options = ("--only", "house: tilt*; office: in house depth alone, 10 frames", "--windows", "4")
    options += ("--cache", tmp_path, "--out", tmp_path / "out.json")
    first = measure("indoor_robustness", *options)
    assert first.exit_code == 0, first.output
    assert "| house: tilt 2°" in first.stdout
    assert ".00/1.00/1.00/1.00" in first.stdout
    names = {name for name, _, _ in asked}
    assert names == {f"house: tilt {k}°" for k in (1, 2, 4)} | {
        "office: in house depth alone, 10 frames"
    }
    assert {scene for name, scene, _ in asked if "office" in name} == {"house"}
    assert {number % 2 for _, _, number in asked} == {0, 1}
    asked.clear()
    assert measure("indoor_robustness", *options).stdout == first.stdout
    assert not asked
    rows = {r["name"]: r for r in json.loads((tmp_path / "out.json").read_text())["rows"]}
    absent = rows["office: in house depth alone, 10 frames"]
    assert (absent["ok"], absent["false_ok"]) == (1.0, 1.0)
    assert rows["house: tilt 1°"]["false_ok"] == 0.0


def test_names_are_distinct_and_a_quick_run_has_every_family():
    cases = all_cases()
    names = [case.name for case in cases]
    assert len(set(names)) == len(names)
    few = quick(cases)
    assert {(c.set, c.family) for c in few if c.part in {"spoiled", "bad"}} == {
        (c.set, c.family) for c in cases if c.part in {"spoiled", "bad"}
    }
    assert len(few) < len(cases) / 2


def test_no_answer_to_bad_input_may_be_sure():
    right = Outcome("w", 0, 0.01, 0.1, "OK", "", 5.0)
    assert Row(Case("house", "as recorded"), (right,)).false_ok == 0.0
    assert Row(Case("house", "frozen image", part="bad"), (right,)).false_ok == 1.0
    refused = Outcome("w", 1, math.inf, math.inf, "OptionError", "stamps", math.nan)
    row = Row(Case("house", "time backwards", part="bad"), (refused, refused))
    assert row.false_ok == 0.0
    assert plain(row.record())["milliseconds"] is None
