"""The weight of the house: what is counted, and that it is counted right."""

from placegraph_lab.tables.named.weight import count_lines, functions, shape, weights
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


def test_every_part_is_weighed(tmp_path):
    for folder in ("src", "packages/placegraph-io/src", "packages/placegraph-io/tests", "lab/src"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "room.py").write_text(CODE)
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs/page.md").write_text("# A page\n\nText.\n")
    parts = {part.name: part for part in weights(tmp_path)}
    assert list(parts) == ["core", "io", "packages together", "lab", "tests", "docs"]
    assert [part.lines for part in parts.values()] == [12, 12, 24, 12, 12, 3]


def test_the_house_keeps_its_rules():
    now = {figure.name: figure.now for figure in shape(LAB.parent)}
    assert now["functions over 80 lines"] == 0
    assert now["functions over 8 parameters"] <= 8  # doors, whose keywords are the interface
    assert now["lines of the README"] <= 150
