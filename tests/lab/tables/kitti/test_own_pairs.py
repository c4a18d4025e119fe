import json
import shutil

import pytest

from placegraph_lab.tables.kitti.own_pairs import evaluate_folder
from placegraph_lab.tables.outdoor.metrics import HIT

CLEAR = "I am on Speicherweg. The museum is south of me."
TRUE = (9.9918, 53.5496)


def rows(*more):
    lon, lat = TRUE
    return [
        {"id": "clear", "text": CLEAR, "longitude": lon, "latitude": lat},
        {"id": "wrong", "text": CLEAR, "longitude": lon + 0.003, "latitude": lat},
        {"id": "lost", "text": "A lighthouse is north of me.", "longitude": lon, "latitude": lat},
        {"id": "long", "text": "x " * 50_000, "longitude": lon, "latitude": lat},
        *more,
    ]


@pytest.fixture
def folder(tmp_path, harbour_file):
    shutil.copy(harbour_file, tmp_path)
    return write(tmp_path, rows())


def write(folder, told):
    text = "\n".join(json.dumps(row) for row in told)
    (folder / "descriptions.jsonl").write_text(text, encoding="utf-8")
    return folder


def test_recall_and_calibration(folder):
    found = evaluate_folder(folder)
    by_id = dict(zip([t.id for t in found.descriptions], found.answers, strict=True))
    assert by_id["clear"].distance[0] <= HIT
    assert by_id["clear"].own_cell is not None
    assert by_id["wrong"].distance[0] > 3 * HIT, "the truth never reaches the map"
    assert by_id["wrong"].probability == by_id["clear"].probability
    assert len(by_id["lost"].distance) == len(by_id["long"].distance) == 0
    s = found.score
    assert s.within[50.0] == {1: 0.25, 3: 0.25, 5: 0.25}
    assert s.status == {"LOST": 0.5, "OK": 0.5}
    assert s.calibration.count.sum() == 4
    assert found.outside == ()
    told = found.to_dict(answers=True)
    assert json.loads(json.dumps(told, allow_nan=False)) == told
    assert [a["id"] for a in told["answers"]] == ["clear", "wrong", "lost", "long"]
    assert "4 descriptions" in found.table()


def test_the_command(run, folder):
    result = run("city", "evaluate", folder)
    assert (result.code, result.err) == (0, "")
    assert "50 m @1/3/5" in result.out
    told = run("city", "evaluate", folder, "--json", "-o", folder / "answers.json").json
    assert told["within"]["50 m"]["1"] == 0.25
    assert "answers" not in told
    assert len(json.loads((folder / "answers.json").read_text())["answers"]) == 4
    write(folder, [{"id": 1}])
    failed = run("city", "evaluate", folder)
    assert failed.code == 3
    assert "line 1: text is missing" in failed.err
