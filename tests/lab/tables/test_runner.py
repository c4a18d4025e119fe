import json

import osmium
import pytest
import typer
from typer.testing import CliRunner

from placegraph_lab.cli.lab import app
from placegraph_lab.tables import runner as journal
from placegraph_lab.tables.named import scene_sentences as told
from placegraph_lab.tables.runner import Journal, Run, check_names, code_key, load, names
from placegraph_lab.worlds.town.town import Town


def test_every_table_is_listed(measure):
    listed = CliRunner().invoke(app, ["table", "--list"])
    assert listed.exit_code == 0, listed.output
    shown = dict(line.split(maxsplit=1) for line in listed.output.splitlines())
    assert list(shown) == names()
    assert {"human_text", "indoor_filter", "outdoor_recall", "scene_maps"} <= shown.keys()
    for name, asks in shown.items():
        assert asks.startswith(load(name).asks)
        assert len(load(name).asks) > 20
        assert name == "weight" or "--quick" in measure(name, "--help").output


def test_a_table_has_options_of_its_own_and_of_all():
    shown = CliRunner().invoke(app, ["table", "outdoor_recall", "--help"]).output
    for option in ("--cities", "--seed", "--quick", "--data", "--cache", "--out"):
        assert option in shown
    assert CliRunner().invoke(app, ["table", "gold"]).exit_code == 2


def test_vectors(measure, tmp_path):
    out = tmp_path / "rows.json"
    result = measure("outdoor_vectors", "--quick", "--out", out)
    assert result.exit_code == 0, result.output
    assert "| ours, exact, 8 bits" in result.stdout
    written = json.loads(out.read_text())
    assert (written["table"], written["seed"]) == ("outdoor_vectors", 0)
    assert written["machine"]["cores"]
    assert "commit" in written
    exact = next(r for r in written["rows"] if r["name"] == "ours, exact, float32")
    assert exact["recall"]["10"] == 1.0


def test_a_drawn_town(measure, tmp_path):
    """As if it were the extract of Monaco."""
    osm = Town.load("hafenstadt").write_osm(tmp_path / "town.osm")
    extract = tmp_path / "shared/data/osm/monaco_2025.osm.pbf"
    extract.parent.mkdir(parents=True)
    with osmium.SimpleWriter(str(extract)) as writer:
        for item in osmium.FileProcessor(str(osm)):
            writer.add(item)
    places = ("--data", tmp_path / "shared", "--cache", tmp_path / "cache")
    result = measure("outdoor_map_size", "--quick", *places, "--out", tmp_path / "rows.json")
    assert result.exit_code == 0, result.output
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert [row["cells"] for row in rows] == [110, 158]
    assert all(f"{row['bytes'] * 1e-6:.3f}" in result.stdout for row in rows)


@pytest.mark.all
def test_drawn_homes(measure, tmp_path, monkeypatch):
    described = told.read_texts()[:20]  # of few homes
    monkeypatch.setattr(told, "read_texts", lambda: described)
    monkeypatch.setattr(told, "OTHERS", 2)
    options = ("--quick", "--data", tmp_path, "--out", tmp_path / "rows.json")
    result = measure("scene_sentences", *options)
    assert result.exit_code == 0, result.output
    assert "house.glb is not there" in result.stderr
    assert json.loads((tmp_path / "rows.json").read_text())["scenes"]


def test_a_part_of_a_table_is_written_only_where_it_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr("placegraph_lab.tables.runner.LAB", tmp_path)
    Run("some", tmp_path, tmp_path).save({"rows": []}, complete=False)
    Run("some", tmp_path, tmp_path, options={"quick": True}).save({"rows": []})
    assert not list(tmp_path.iterdir())
    Run("some", tmp_path, tmp_path).save({"rows": []})
    assert (tmp_path / "results/some.json").exists()


def test_what_is_said_of_rows():
    assert check_names([], ("a", "b"), "row") == ["a", "b"]
    with pytest.raises(typer.BadParameter, match="choose from a; b"):
        check_names(["c"], ("a", "b"), "row")


def test_a_line_cut_short_is_passed_over(tmp_path):
    path = tmp_path / "a.jsonl"
    Journal(path).put("x", 1)
    with path.open("a") as file:
        file.write('{"key": "y", "ro')
    cut = Journal(path)
    assert "y" not in cut
    cut.put("y", 2)
    assert Journal(path)["y"] == 2
    assert Journal(path)["x"] == 1


def test_what_is_missing_is_asked_and_written_down_at_once(tmp_path):
    kept = Journal(tmp_path / "a.jsonl")
    kept.put("b", 20)
    told = []

    def ask(i):
        told.append(i)
        if i == 3:
            raise KeyboardInterrupt
        return 10 * (i + 1)

    keys = ["a", "b", "c", "d"]
    assert kept.find_missing(keys) == [0, 2, 3]
    with pytest.raises(KeyboardInterrupt):
        kept.fill(keys, ask, warm=lambda: told.append("warm"), tick=lambda: told.append("tick"))
    assert told == ["warm", 0, "tick", 2, "tick", 3]
    again = Journal(tmp_path / "a.jsonl")
    assert again.find_missing(keys) == [3]
    assert again.fill(keys, lambda i: 10 * (i + 1)) == [10, 20, 30, 40]
    assert again.fill(keys, pytest.fail, warm=pytest.fail) == [10, 20, 30, 40]


def test_a_change_of_the_code_is_seen(tmp_path, monkeypatch):
    tmp_path /= "placegraph"
    monkeypatch.setattr(journal, "SOURCES", (tmp_path,))
    (tmp_path / "indoor").mkdir(parents=True)
    (tmp_path / "indoor/a.py").write_text("x = 1")
    (tmp_path / "other.py").write_text("y = 1")
    folders = ("placegraph/indoor",)
    before = code_key(folders)
    (tmp_path / "other.py").write_text("y = 2")
    assert code_key(folders) == before
    (tmp_path / "indoor/a.py").write_text("x = 2")
    changed = code_key(folders)
    (tmp_path / "indoor/a.py").rename(tmp_path / "indoor/b.py")
    assert len({before, changed, code_key(folders)}) == 3
    with pytest.raises(ValueError, match="is not a folder"):
        code_key(("placegraph/outdoor",))
