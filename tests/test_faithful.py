"""The page "How faithful?" leaves nothing of the papers out, and all that it names exists and is run.

`python3 -m tests.test_faithful` writes the lines of the functions that the page names.
"""

import ast
import json
import os
import re
import subprocess
import sys
import threading
from collections import Counter
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from tests.indoor.conftest import render, room_world  # noqa: F401  # fixtures

import placegraph as pg
from placegraph.indoor.options import Likelihood, MotionNoise
from placegraph.indoor.refine import RefineOptions
from placegraph.outdoor.network.weights import Shape
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


LINED = re.compile(PLACE.pattern + r"(?: \((\d+)\))?")
"""A place, and the line of what it names."""


@cache
def names(path):
    """First and last lines of the functions and classes of a module, methods as `Class.method`."""
    found = {}

    def walk(body, prefix):
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                found[prefix + node.name] = node.lineno, node.end_lineno
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
    paper, item, printed, published, ours, where, _, test, _ = row
    assert printed
    assert published
    assert ours
    for cell in (where, test):
        places = PLACE.findall(cell)
        assert len(places) == 1 or cell == NONE, f"name one place, not {cell}"
        assert all(map(exists, places)), f"{cell} is not there"
    for path, name, line in LINED.findall(where):
        if name and (line or paper == "GOTLoc"):
            first, last = names(path)[name]
            assert first <= int(line or 0) <= last, "run python3 -m tests.test_faithful"
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


def where(paper, *items):
    """Files and names of the functions and classes of some rows."""
    return {PLACE.findall(row[5])[0] for row in ROWS if row[0] == paper and row[1] in items}


def not_called(wanted, called):
    """Places of `wanted` that are not among the called (file, name); a class is by any method."""
    return {
        (path, name)
        for path, name in wanted
        if not any(
            file == path and (function == name or function.startswith(f"{name}."))
            for file, function in called
        )
    }


RECORD = """
import atexit, json, runpy, sys
called = set()
def note(frame, event, _):
    if event == "call" and frame.f_code.co_filename.startswith(sys.argv[0]):
        called.add((frame.f_code.co_filename, frame.f_code.co_qualname))
root, out, *command = sys.argv[1:]
sys.argv[0] = root
def write():
    sys.setprofile(None)
    with open(out, "w") as file:
        json.dump([(path[len(root) + 1:], name) for path, name in called], file)
atexit.register(write)
sys.argv = [root, *command]
sys.setprofile(note)
runpy.run_module("placegraph", run_name="__main__")
"""

SQUARE = """
[town]
metres = 10
[drawing]
B.......
........
F.b....S
........
[legend]
B: shop=bakery
F: amenity=fountain
b: amenity=bench
S: railway=tram_stop
"""
TEXT = "The bakery is on the north of the fountain. The bench is on the east of the fountain."


def test_the_papers_preset_calls_what_the_page_names(make_city, tmp_path):
    """Compiled functions run as Python here, so that a profile sees them."""
    make_city(SQUARE).save(tmp_path / "square.city")
    command = ("city", "locate", tmp_path / "square.city", TEXT, "--preset", "paper")
    done = subprocess.run(  # noqa: S603  # our own command
        [sys.executable, "-c", RECORD, ROOT, tmp_path / "called.json", *command],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode in (0, 1), done.stderr
    called = {tuple(place) for place in json.loads((tmp_path / "called.json").read_text("utf-8"))}
    wanted = where("GOTLoc", *(f"Eq. {n}" for n in range(1, 17)))
    assert len(wanted) == 16
    assert not not_called(wanted, called)
    assert not_called(where("SG2Loc", "Eq. 1"), called)  # it sees what is not called


def test_its_training_calls_what_the_page_names(harbour, vocabulary, tmp_path):
    pytest.importorskip("torch", reason="PyTorch is not installed (extra learn)")
    from placegraph_learn.city.train import TrainOptions, train

    shape = Shape(width=8, dimension=8, heads=2, layers=1, crossings=1, printed=True)
    options = TrainOptions(
        epochs=1, examples=4, steps=1, batch=4, check=4, losses=("eq17", "eq18"), shape=shape
    )
    called, before = set(), sys.getprofile()

    def note(frame, event, _):
        if event == "call":
            called.add((frame.f_code.co_filename, frame.f_code.co_qualname))

    sys.setprofile(note)
    try:
        train(
            {"town": harbour}, tmp_path / "a.weights", folder=tmp_path / "work", options=options,
            vocabulary=vocabulary, device="cpu",
        )  # fmt: skip
    finally:
        sys.setprofile(before)
    here = {(os.path.relpath(path, ROOT), name) for path, name in called}
    assert not not_called(where("GOTLoc", "Eq. 17", "Eq. 18", "Eq. 19"), here)


def with_kernels(called):
    """The called, and the functions of their files that they name: compiled code has no profile."""
    found = set(called)
    for path in {path for path, _ in called if path.endswith("_kernels.py")}:
        tree = ast.parse((ROOT / path).read_text("utf-8"))
        uses = {
            f.name: {n.id for n in ast.walk(f) if isinstance(n, ast.Name)}
            for f in tree.body if isinstance(f, ast.FunctionDef)
        }  # fmt: skip
        reached = [name for file, name in called if file == path and name in uses]
        while reached:
            for name in uses[reached.pop()] & set(uses):
                if (path, name) not in found:
                    found.add((path, name))
                    reached.append(name)
    return found


def test_the_papers_filter_and_refinement_call_what_the_page_names(render, room_world):  # noqa: F811
    """The presets as they are, with fewer particles; the matcher is SIFT, without RoMa's weights."""
    clip = render(room_world, "named", 2, through="123", frames=2, labels="labels")
    few = replace(pg.FilterOptions.paper(), spacing=0.6, per_cell=1, min_particles=60)
    called = set()

    def note(frame, event, _):
        if event == "call" and frame.f_code.co_filename.startswith(str(ROOT)):
            path = os.path.relpath(frame.f_code.co_filename, ROOT)
            called.add((path, frame.f_code.co_qualname))

    library = pg.SceneLibrary("labels")
    before = sys.getprofile()
    threading.setprofile(note)
    sys.setprofile(note)
    try:
        pg.open_map(room_world.folder / "flat.scene").localize(
            clip, options=few, refine=RefineOptions.paper(), matcher="sift", seed=0
        )
        library.add("room", room_world.scene)
        library.search(clip, options=pg.SearchOptions(method="cosines"))
    finally:
        sys.setprofile(before)
        threading.setprofile(before)
    items = ("Eq. 1", "Eq. 2", *(f"Sec. 3.{n}" for n in range(1, 7)), "Sec. 4")
    wanted = where("SG2Loc", *items)
    assert len(wanted) == 19
    assert not not_called(wanted, with_kernels(called))
    assert not_called(where("GOTLoc", "Eq. 9"), with_kernels(called))


def write_lines():
    """Write the line of each function that a row names, unless the page has one within it."""

    def line(match):
        path, name, given = match.groups()
        first, last = names(path).get(name, (0, 0)) if name else (0, 0)
        kept = given if given and first <= int(given) <= last else first
        return match[0] if not first else f"`{path}:{name}` ({kept})"

    text, made = PAGE.read_text("utf-8"), []
    for row in text.split("\n"):
        cells = row.split(" | ")
        if row.startswith("| ") and len(cells) == 8:
            cells[4] = LINED.sub(line, cells[4])
        made.append(" | ".join(cells))
    PAGE.write_text("\n".join(made), "utf-8")


if __name__ == "__main__":
    write_lines()
