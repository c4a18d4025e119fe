"""Benchmark pages against new runs: rows that agree, a false number, and what is not compared."""

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from placegraph_lab.cli.lab import app
from placegraph_lab.tables.verify import agrees, compare, grids_of, is_compared, tables_of

COMMENT = "<!-- placegraph-lab table outdoor_map_size (0123abc, 2026-11-28) -->"
ROOT = Path(__file__).parents[3]


@pytest.fixture
def verify(tmp_path):
    def run(*options):
        places = ("--data", str(tmp_path), "--cache", str(tmp_path / "cache"))
        return CliRunner().invoke(app, ["table", "--verify", *places, *map(str, options)])

    return run


@pytest.fixture
def page(town, measure, tmp_path):
    """A page with the table of the shipped town, as the runner prints it."""
    options = ("--cities", town, "--cache", tmp_path / "cache", "--out", tmp_path / "rows.json")
    done = measure("outdoor_map_size", *options)
    assert done.exit_code == 0, done.output
    comment = re.fullmatch(
        rf"<!-- placegraph-lab table outdoor_map_size --cities {town} \(\S*, 20\d\d-\d\d-\d\d\) -->",
        done.stdout.splitlines()[0],
    )
    assert comment
    path = tmp_path / "page.md"
    path.write_text(f"# Sizes\n\n{done.stdout}", encoding="utf-8")
    return path


def test_a_page_of_what_was_printed_agrees(page, verify):
    done = verify("--page", page, "--every")
    assert done.exit_code == 0, done.output
    (_, grid), *_ = grids_of(done.stdout)
    assert [row[2] for row in grid.rows] == ["town.osm, 110", "town.osm, 158"]
    assert {row[-1] for row in grid.rows} == {"no"}
    assert min(int(row[-2]) for row in grid.rows) >= 6
    nothing = verify("--page", page)  # has no sample
    assert (nothing.exit_code, len(next(grids_of(nothing.stdout))[1].rows)) == (0, 0)


def test_a_false_number_is_found(page, verify):
    text = page.read_text()
    size = re.search(r"158 \|[^|]*\|[^|]*\|[^|]*\|[^|]*\| *(0\.0\d+)", text)[1]
    wrong = f"{float(size) + 0.001:.3f}"
    comment = text.splitlines()[2]
    sampled = text.replace(
        comment, f"{COMMENT}\n<!-- sample: {comment.split('size ')[1].split(' (')[0]} -->"
    )
    page.write_text(sampled.replace(f"{size} ", f"{wrong} "))
    done = verify("--page", page)
    assert done.exit_code == 1, done.output
    (_, grid), *_ = grids_of(done.stdout)
    told = {row[2]: row[-1] for row in grid.rows}
    assert f"map [mb]: {wrong}, now {size}" in told["town.osm, 158"]
    page.write_text(sampled)
    assert verify("--page", page).exit_code == 0


def test_pages_that_cannot_be_compared(page, verify):
    text = page.read_text()
    page.write_text(text.replace("| town.osm", "| village.osm"))
    done = verify("--page", page, "--every")
    assert done.exit_code == 1
    assert "prints no row of it" in done.stdout
    page.write_text(text.replace("--cities ", "--cities no"))
    done = verify("--page", page, "--every")
    assert done.exit_code == 1
    assert re.search("outdoor_map_size --cities no.* fails: .*There is no extract", done.stdout)
    page.write_text(text.splitlines()[2])
    assert "no table follows" in str(verify("--page", page, "--every").exception)
    page.unlink()
    assert "cannot be read" in str(verify("--page", page).exception)


def test_the_fastest_rows_of_the_real_page(shared, tmp_path):
    """Table V of the page on places, with the shared data."""
    options = ["table", "--verify", "--only", "outdoor_map_size", "--page"]
    page = ROOT / "docs/benchmarks/outdoor.md"
    places = ["--data", str(shared), "--cache", str(tmp_path)]
    done = CliRunner().invoke(app, [*options, str(page), *places])
    assert done.exit_code == 0, done.output
    (_, grid), *_ = grids_of(done.stdout)
    assert len(grid.rows) == 5
    false = tmp_path / "page.md"
    false.write_text(
        page.read_text(encoding="utf-8").replace("447 | 4,225", "447 | 4,226"), encoding="utf-8"
    )
    assert CliRunner().invoke(app, [*options, str(false), *places]).exit_code == 1


@pytest.mark.parametrize(
    ("cell", "new", "interval", "same"),
    [
        (".45/.60/.67", ".45/.60/.67", "", True), (".45/.60/.67", ".45/.60/.66", "", False),
        ("**1,387**", "1,387", "", True), (".45", ".449", "", True), (".45", ".444", "", False),
        (".4", "–", "", False), ("+.102", "+.090", "+.083 to +.121", True),
        ("+.102", "+.130", "+.083 to +.121", False),
        (".45 (.40 to .50)", ".41 (.36 to .47)", "", True),
        (".45 (.40 to .50)", ".52 (.47 to .57)", "", False), ("-.337", "\u2212.337", "", True),
        (".75/1.00", ".75/1.00", ".51 to 1.00", True),
        (".75/1.00", ".74/1.00", ".51 to 1.00", False),
    ],
)  # fmt: skip
def test_agreement(cell, new, interval, same):
    assert agrees(cell.strip("*"), new.replace("\u2212", "-"), interval) is same


@pytest.mark.parametrize(
    ("title", "cell", "compared"),
    [
        ("cells", "1,387", True), ("50 m @1/3/5", ".91/.96/.96", True), ("off", "7.2 cm, 0.6°", True),
        ("s/query", "0.0358", False), ("p50 / p95", "9.2", False), ("a frame", "26 ms", False),
        ("95 % interval", "+.083 to +.121", False),
        ("exact cell @1, 95 % interval", ".10 (.08 to .12)", True),
        ("paper", "–", False), ("map", "1.2 s (1.7)", False),
        ("mb", "0.14", True), ("pairs/s", "26", False), ("windows", "house", False),
    ],
)  # fmt: skip
def test_times_are_not_compared(title, cell, compared):
    assert is_compared(title, cell) is compared


def test_rows_are_told_apart_by_as_many_columns_as_needed(tmp_path):
    page = tmp_path / "page.md"
    rows = "| a | 5 | .1 |\n| a | 10 | .2 |\n| b | 5 | .3 |\n"
    head = "| windows | frames | recall |\n|---|---:|---:|\n"
    page.write_text(f"{COMMENT}\n\n{head}{rows}")
    (table,) = tables_of(page)
    assert (table.name, table.commit, table.sample) == ("outdoor_map_size", "0123abc", None)
    ((_, printed),) = grids_of(f"text\n{head}| a | 10 | .2 |\n| b | 5 | .4 |\n| c | 5 | .9 |\n")
    found = compare(table, [printed])
    assert [(f.row, f.compared, len(f.differences)) for f in found] == [
        ("a, 10", 1, 0),
        ("b, 5", 1, 1),
    ]
