import pytest

from placegraph_lab.tables import runner as journal
from placegraph_lab.tables.runner import Journal, code_key


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
