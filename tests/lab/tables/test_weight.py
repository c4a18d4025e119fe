from typer.testing import CliRunner

from placegraph_lab.cli.lab import app
from placegraph_lab.tables.named import weight as script
from placegraph_lab.tables.named.weight import count_lines, functions, shape
from placegraph_lab.tables.runner import LAB

CODE = '''"""A room."""
import os

# Doors.
class Room:
    width: float
    """Metres."""

    def enter(self, door, *, slowly=False):
        "Docstrings are no weight."
        def inner(): ...
        return door
'''


def test_lines_and_functions_are_counted(tmp_path):
    file = tmp_path / "room.py"
    file.write_text(CODE)
    found = count_lines("lab", [file])
    assert (found.files, found.lines, found.budget, found.before) == (1, 12, 26_000, 41_142)
    kinds = (found.code, found.imports, found.docstrings, found.comments, found.blank)
    assert kinds == (6, 1, 3, 1, 2)
    assert sorted(functions(file)) == [("enter", 3, 2), ("inner", 1, 0)]


def test_the_comment_repeats_the_command(tmp_path, monkeypatch):
    (tmp_path / "src").mkdir()
    (tmp_path / "src/room.py").write_text(CODE)
    (tmp_path / "README.md").write_text("A house.\n")
    monkeypatch.setattr(script, "LAB", tmp_path / "lab")
    options = ["--no-starts", "--no-install", "--out", str(tmp_path / "rows.json")]
    done = CliRunner().invoke(app, ["table", "weight", *options])
    assert done.stdout.startswith("<!-- placegraph-lab table weight --no-starts --no-install (")


def test_the_house_keeps_its_rules():
    now = {figure.name: figure.now for figure in shape(LAB.parent)}
    assert now["functions over 80 lines"] == 0
    assert now["functions over 8 parameters"] <= 8  # doors, whose keywords are the interface
    assert now["lines of the README"] <= 150
