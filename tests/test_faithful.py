"""The page "How faithful?" leaves nothing of the papers out, and all that it names exists."""

import ast
import re
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

import placegraph as pg
from placegraph.indoor.options import Likelihood, MotionNoise
from placegraph.indoor.refine import RefineOptions
from placegraph.outdoor.network.network import Shape
from placegraph.outdoor.search.request import Matching

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "faithful.md"
PAPERS = {
    "GOTLoc": [
        *(f"Eq. {n}" for n in range(1, 20)),
        *(f"Sec. {s}" for s in ("III-A", "IV-A", "IV-B", "IV-D")),
        *(f"Table {n}" for n in ("I", "II", "III", "IV", "V", "VI")),
    ],
    "SG2Loc": [
        "Eq. 1", "Eq. 2",
        *(f"Sec. {s}" for s in ("3", "3.1", "3.2", "3.3", "3.4", "3.5", "3.6", "4", "5")),
        *(f"App. {a}" for a in "ABCDEF"),
        *(f"Table {n}" for n in range(1, 15)),
    ],
}  # fmt: skip
NONE = "–"
PLACE = re.compile(r"`((?:src|packages|lab|tests)/[\w/-]+(?:\.py)?)(?::([\w.]+))?`")
KNOWN = {
    "FilterOptions": pg.FilterOptions,
    "Likelihood": Likelihood,
    "Matching": Matching,
    "MotionNoise": MotionNoise,
    "RefineOptions": RefineOptions,
    "SearchOptions": pg.SearchOptions,
    "Shape": Shape,
}


def rows(heading):
    """Cells of the table rows under a heading of the page."""
    text = PAGE.read_text("utf-8").split(f"\n## {heading}\n")[1].split("\n## ")[0]
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    cells = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in lines]
    return [row for row in cells if row[0] not in ("Item", "Equation")]


ROWS = [(paper, *row) for paper in PAPERS for row in rows(paper)]
ITEMS = [f"{row[0]} {row[1]}: {row[2]}" for row in ROWS]


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
    return (ROOT / path).exists() and (not name or name in names(path))


@pytest.mark.parametrize("paper", PAPERS)
def test_every_equation_section_and_table_is_listed(paper):
    listed = [row[0] for row in rows(paper)]
    assert set(listed) == set(PAPERS[paper])
    twice = {name for name, n in Counter(listed).items() if n > 1}
    assert all(name.startswith("Sec.") for name in twice)  # a section may say several things


@pytest.mark.parametrize("row", ROWS, ids=ITEMS)
def test_what_a_row_names_exists(row):
    _, item, printed, published, ours, where, _, test, _ = row
    assert printed
    assert published
    assert ours
    for cell in (where, test):
        places = PLACE.findall(cell)
        assert len(places) == 1 or cell == NONE, f"name one place, not {cell}"
        assert all(map(exists, places)), f"{cell} is not there"
    assert test == NONE or "tests" in Path(PLACE.findall(test)[0][0]).parts
    if item.startswith(("Eq.", "Sec.")):
        assert NONE not in (where, test), "say where it stands, and which test holds it"


@pytest.mark.parametrize("row", ROWS, ids=ITEMS)
def test_options_can_be_given(row):
    for option in re.findall(r"`([^`]+)`", row[6]):
        head = re.match(r"\w+", option)[0]
        if head == "TrainOptions":
            training = pytest.importorskip("placegraph_learn.city.train")
            eval(option, vars(training) | KNOWN)  # noqa: S307  # our own page
        elif head in KNOWN:
            eval(option, KNOWN)  # noqa: S307  # our own page; raises where an option is none
        else:
            assert option.startswith("--") or hasattr(pg, head), f"{option} is no option"


@pytest.mark.parametrize("row", ROWS, ids=ITEMS)
def test_tables_can_be_printed(row):
    run = pytest.importorskip("placegraph_lab.tables.runner")
    _, item, *_, table = row
    tables = re.findall(r"`([^`]+)`", table)
    assert set(tables) <= set(run.names())
    assert tables or not item.startswith("Table") or item == "Table I"


def test_nothing_implements_two_equations():
    places = [PLACE.findall(row[5])[0] for row in ROWS if row[5] != NONE]
    functions = Counter(place for place in places if place[1])
    assert not [place for place, n in functions.items() if n > 1]


def test_twins_exist_and_a_test_holds_them_together():
    listed = {(row[0], row[1]) for row in ROWS}
    for equation, first, twin, test in rows("Twins"):
        assert tuple(equation.split(" ", 1)) in listed
        for cell in (first, twin, test):
            assert all(map(exists, PLACE.findall(cell))), f"{equation}: {cell} is not there"
            assert PLACE.search(cell)
        assert "tests" in Path(PLACE.findall(test)[0][0]).parts
        assert PLACE.findall(first) != PLACE.findall(twin)
