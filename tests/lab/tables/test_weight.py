"""The weight of the house: what is counted, and that it is counted right."""

from placegraph_lab.tables.named.weight import Source, sources
from placegraph_lab.tables.run import LAB

CODE = """
class Room:
    def enter(self, door, *, slowly=False):
        def inner(): ...
        return door
"""


def test_functions_are_weighed(tmp_path):
    file = tmp_path / "room_kernels.py"
    file.write_text(CODE)
    found = Source.read(file)
    assert (found.lines, found.compiled) == (5, True)
    assert sorted(found.functions) == [("enter", 3, 2), ("inner", 1, 0)]


def test_the_house_keeps_its_rules():
    now = {row.name: row.now for row in sources(LAB.parent)}
    assert now["longest file"] <= 300
    assert now["functions over 60 lines"] == now["functions over 8 parameters"] == 0
    assert now["lines of the README"] <= 150
