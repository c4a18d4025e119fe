"""Verification of benchmark pages: tables are run anew and compared with their rows on the page.

A comment above a table of a page names the command that prints the table, and the commit and date of the
figures (`runner.provenance` writes it):

    <!-- placegraph-lab table outdoor_cities (3b092714, 2026-11-28) -->
    <!-- sample: --cities monaco -->

The second comment holds the options of a run that is short and prints some of the rows.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from placegraph.errors import InputError
from placegraph_lab.tables.runner import Column as Col

_COMMAND = re.compile(r"<!-- placegraph-lab table (\S+)(.*?) \(([^,()]*), ([^()]*)\) -->")
_SAMPLE = re.compile(r"<!-- sample:(.*?) -->")
_NUMBER = re.compile(r"[-+\u2212]?(?:\d[\d,]*(?:\.\d+)?|\.\d+)")
_INTERVAL = re.compile(r"([-+]?[\d.,]+) to ([-+]?[\d.,]+)")
_SECONDS = re.compile(
    r"\d ?(?:ms|µs|s|min|h)\b|"
    r"(?:^|[\s/\[(])(?:ms|µs|s|min|h|seconds|p50|p95|time|build|open|peak)(?:$|[\s/\]),])",
    re.IGNORECASE,
)
"""In a header or a cell: figures that measure the machine are not compared."""


@dataclass(frozen=True)
class Grid:
    """Markdown table: cells of its header and of its rows."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    @property
    def keys(self) -> int:
        """Number of leading columns that tell all rows apart."""
        for n in range(1, len(self.header)):
            if len({row[:n] for row in self.rows}) == len(self.rows):
                return n
        return len(self.header)


@dataclass(frozen=True)
class PageTable:
    """Table of a page, with the command that prints it."""

    page: Path
    name: str
    options: tuple[str, ...]
    sample: tuple[str, ...] | None  # further options of a short run; None where there is none
    commit: str
    date: str
    grid: Grid


@dataclass(frozen=True)
class Agreement:
    """Comparison of a row of a page with the same row of a run."""

    table: PageTable
    row: str
    compared: int  # cells
    differences: tuple[str, ...]


COLUMNS = (
    Col("page", "table.page.name"), Col("table", "table.name"), Col("row", "row"),
    Col("commit", "table.commit"), Col("cells compared", "compared", 0),
    Col("differs", lambda a: "; ".join(a.differences) or "no"),
)  # fmt: skip


def grids_of(text: str) -> Iterator[tuple[int, Grid]]:
    """Yield the tables of a Markdown text, with the number of the line that each begins on."""
    lines = text.splitlines()
    at = 0
    while at < len(lines):
        if not (
            lines[at].startswith("|") and re.match(r"\|[\s:|-]+$", "".join(lines[at + 1 : at + 2]))
        ):
            at += 1
            continue
        end = at + 2
        while end < len(lines) and lines[end].startswith("|"):
            end += 1
        cells = [_cells(line) for line in (lines[at], *lines[at + 2 : end])]
        yield at, Grid(cells[0], tuple(row for row in cells[1:] if len(row) == len(cells[0])))
        at = end


def _cells(line: str) -> tuple[str, ...]:
    """Cells of a line without markup, in small letters."""
    plain = re.sub(r"[*`]", "", line.strip().strip("|")).replace("\u2212", "-")
    return tuple(" ".join(cell.split()).casefold() for cell in plain.split("|"))


def tables_of(page: Path) -> list[PageTable]:
    """Tables of a page that have a comment with their command.

    Raises `InputError` where the page cannot be read, or no table follows a comment.
    """
    try:
        text = page.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{page} cannot be read: {error}") from error
    found = []
    grids = list(grids_of(text))
    lines = text.splitlines()
    for at, line in enumerate(lines):
        if not (command := _COMMAND.fullmatch(line.strip())):
            continue
        sample = _SAMPLE.fullmatch("".join(lines[at + 1 : at + 2]).strip())
        grid = next((grid for start, grid in grids if start > at), None)
        if grid is None:
            raise InputError(f"{page}, line {at + 1}: no table follows; remove the comment.")
        name, options, commit, date = command.groups()
        options_of_sample = None if sample is None else tuple(shlex.split(sample[1]))
        given = tuple(shlex.split(options))
        found.append(PageTable(page, name, given, options_of_sample, commit, date, grid))
    return found


def compare(table: PageTable, printed: Iterable[Grid]) -> list[Agreement]:
    """Compare the rows of a page's table with those of the same name in printed tables."""
    here, found = table.grid, []
    for there in printed:
        keys = max(here.keys, there.keys)
        if here.header[:keys] != there.header[:keys]:
            continue
        rows = {row[:keys]: row for row in there.rows}
        columns = [
            (i, _matching(here.header, i, there.header)) for i in range(keys, len(here.header))
        ]
        for row in here.rows:
            if (other := rows.get(row[:keys])) is None:
                continue
            shared = [
                (i, other[k])
                for i, k in columns
                if k is not None and is_compared(here.header[i], row[i])
            ]
            if shared:
                wrong = [
                    f"{here.header[i] or 'value'}: {row[i]}, now {new}"
                    for i, new in shared
                    if not agrees(row[i], new, "".join(row[i + 1 : i + 2]))
                ]
                found.append(Agreement(table, ", ".join(row[:keys]), len(shared), tuple(wrong)))
    return found


def _matching(header: Sequence[str], i: int, other: Sequence[str]) -> int | None:
    """Column of another header with the title of column `i`: the second one of the second, and so on."""
    at = [k for k, title in enumerate(other) if title == header[i]]
    before = header[:i].count(header[i])
    return at[before] if before < len(at) else None


def is_compared(title: str, cell: str) -> bool:
    """Whether a cell holds numbers that another run should repeat: neither times nor intervals."""
    if _INTERVAL.fullmatch(cell) or _SECONDS.search(title) or _SECONDS.search(cell):
        return False
    return bool(_NUMBER.search(cell))


def agrees(cell: str, new: str, beside: str = "") -> bool:
    """Whether a new cell has the numbers of a cell, up to rounding, or lies in the stated interval.

    The interval fills the cell `beside` it, or follows the number: ".45 (.40 to .50)".
    """
    bounds = _INTERVAL.fullmatch(beside) or _INTERVAL.search(cell)
    numbers = [_NUMBER.findall(_INTERVAL.sub("", text)) for text in (cell, new)]
    if bounds and len(numbers[0]) == 1:  # of several shares, the interval is that of the last one
        low, high = (_value(bound) for bound in bounds.groups())
        slack = _half_digit(bounds[1])
        return len(numbers[1]) == 1 and low - slack <= _value(numbers[1][0]) <= high + slack
    return len(numbers[0]) == len(numbers[1]) and all(
        abs(_value(a) - _value(b))
        <= max(_half_digit(a), _half_digit(b)) * (_digits(a) != _digits(b)) + 1e-9
        for a, b in zip(*numbers, strict=True)
    )


def _value(number: str) -> float:
    return float(number.replace(",", ""))


def _digits(number: str) -> int:
    return len(number.partition(".")[2])


def _half_digit(number: str) -> float:
    return 0.5 * 10.0 ** -_digits(number)


@cache
def rerun(name: str, options: tuple[str, ...], data: Path, maps: Path) -> tuple[Grid, ...]:
    """Run a table in a process of its own, and return the tables that it prints.

    Raises `InputError` where the run fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        places = ["--data", str(data), "--cache", str(maps), "--out", f"{folder}/rows.json"]
        command = [sys.executable, "-m", "placegraph_lab", "table", name, *options, *places]
        done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["it says nothing"])[-1]
        raise InputError(f"placegraph-lab table {shlex.join((name, *options))} fails: {last}")
    return tuple(grid for _, grid in grids_of(done.stdout))


def verify(
    pages: Iterable[Path], data: Path, maps: Path, *, only: str = "", every: bool = False
) -> Iterator[Agreement]:
    """Run the samples of the tables of pages, and compare their rows.

    `only`: name of a table; `every`: the whole tables instead of their samples. A run that fails, or
    shares no row with its table, counts as a difference.
    """
    for page in pages:
        for table in tables_of(page):
            if (only and table.name != only) or (table.sample is None and not every):
                continue
            options = table.options if every else (*table.options, *(table.sample or ()))
            try:
                found = compare(table, rerun(table.name, options, data, maps))
                reason = (
                    f"placegraph-lab table {shlex.join((table.name, *options))} prints no row of it"
                )
            except InputError as error:
                found, reason = [], str(error)
            yield from found or [Agreement(table, "all", 0, (reason,))]
