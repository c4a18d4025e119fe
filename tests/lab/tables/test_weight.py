"""The weight of the house: what is counted, and that it is counted right."""

from placegraph_lab.tables.named.weight import Source, sources
from placegraph_lab.tables.runner import LAB

CODE = """
class Room:
    def enter(self, door, *, slowly=False):
        'Docstrings are no weight.'
        def inner(): ...
        return door
"""


def test_functions_are_weighed(tmp_path):
    file = tmp_path / "room_kernels.py"
    file.write_text(CODE)
    found = Source.read(file)
    assert (found.lines, found.compiled) == (6, True)
    assert sorted(found.functions) == [("enter", 3, 2), ("inner", 1, 0)]


def test_the_house_keeps_its_rules():
    now = {row.name: row.now for row in sources(LAB.parent)}
    assert now["files over 300 lines"] <= 2  # the store, which is one subject, and geometry
    assert now["functions over 60 lines"] == 0
    assert now["functions over 8 parameters"] <= 6  # doors, whose keywords are the interface
    assert now["lines of the README"] <= 150
