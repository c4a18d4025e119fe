"""The page of equations names what exists, leaves no equation out, and names none in two places."""

import ast
import re
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "equations.md"
PAPERS = {
    "GOTLoc": [f"Eq. {n}" for n in range(1, 20)],
    "SG2Loc": [
        "Eq. 1", "Eq. 2",
        *(f"Sec. {s}" for s in ("3", "3.1", "3.2", "3.3", "3.4", "3.5", "3.6", "4", "5")),
        *(f"App. {a}" for a in "ABCDEF"),
    ],
}  # fmt: skip
KINDS = {"paper", "departure", "both"}
PLACE = re.compile(r"`((?:src|lab|tests)/[\w/]+\.py)(?::([\w.]+))?`")


def rows(heading):
    """Cells of the table rows under a heading of the page."""
    text = PAGE.read_text("utf-8").split(f"\n## {heading}\n")[1].split("\n## ")[0]
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    cells = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in lines]
    return [row for row in cells if row[0] not in ("Equation", "Section")]


@cache
def names(path):
    """Functions and classes of a module, methods as `Class.method`."""
    found = set()

    def walk(body, prefix):
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                found.add(prefix + node.name)
                if isinstance(node, ast.ClassDef):
                    walk(node.body, f"{prefix}{node.name}.")

    walk(ast.parse((ROOT / path).read_text("utf-8")).body, "")
    return found


def exists(place):
    path, name = place
    return (ROOT / path).is_file() and (not name or name in names(path))


@pytest.mark.parametrize("paper", PAPERS)
def test_every_equation_and_section_is_listed(paper):
    listed = [row[0] for row in rows(paper)]
    assert set(listed) == set(PAPERS[paper])
    twice = {name for name, n in Counter(listed).items() if n > 1}
    assert all(name.startswith("Sec.") for name in twice)  # a section may say several things


@pytest.mark.parametrize("paper", PAPERS)
def test_each_row_names_one_place_that_exists(paper):
    for name, says, where, kind, *departure in rows(paper):
        places = PLACE.findall(where)
        assert len(places) == 1, f"{paper} {name}: name one place, not {where}"
        assert exists(places[0]), f"{paper} {name}: {where} is not there"
        assert says
        assert kind in KINDS
        assert departure or kind == "paper", f"{paper} {name}: say how it departs"


def test_nothing_implements_two_equations():
    places = [PLACE.findall(row[2])[0] for paper in PAPERS for row in rows(paper)]
    functions = Counter(place for place in places if place[1])
    assert not [place for place, n in functions.items() if n > 1]


def test_twins_exist_and_a_test_holds_them_together():
    listed = {(paper, row[0]): row[2] for paper in PAPERS for row in rows(paper)}
    for equation, first, twin, test in rows("Twins"):
        paper, name = equation.split(" ", 1)
        assert (paper, name) in listed
        for cell in (first, twin, test):
            assert all(map(exists, PLACE.findall(cell))), f"{equation}: {cell} is not there"
            assert PLACE.search(cell)
        assert PLACE.findall(test)[0][0].startswith("tests/")
        assert PLACE.findall(first) != PLACE.findall(twin)
