"""Table `weight`: how heavy is the house? Files and lines of every part, functions, prose, starts and sizes.

Counts the core, each package, the lab, tests and docs, beside their budgets and beside commit fa2f326,
when everything was one package.
"""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, median
from time import perf_counter
from typing import Annotated

from placegraph_lab.tables.runner import LAB, Column, Run, number, option, render, table

PACKAGES = {"io": 7_500, "serve": 4_000, "ros": 4_500, "scale": 6_000, "learn": 3_000}
"""Budgets of the plugins in lines."""
BUDGETS = {"core": 57_000, "packages together": 82_000, "lab": 26_000, "tests": 52_000}
BEFORE = {"packages together": 105_769, "lab": 41_142, "tests": 74_967, "docs": 10_995}
"""Lines at fa2f326, where the wheel was one package of 678 files."""
LONG, MANY = 80, 8
"""Most lines and parameters of a function; options of commands and kernels do not count."""
SENTENCE = "A bench is north of me. A cafe is east of me. I am on a street."
WEIGHTS = (
    Column("part", "name"), Column("files", "files", 0), Column("lines", "lines", 0),
    Column("budget", "budget", 0), Column("at fa2f326", "before", 0), Column("code", "code", 0),
    Column("of it imports", "imports", 0), Column("docstrings", "docstrings", 0),
    Column("comments", "comments", 0), Column("blank", "blank", 0),
)  # fmt: skip


@dataclass(frozen=True)
class Weight:
    """Files and lines of one part of the house; imports count as code."""

    name: str
    files: int
    lines: int
    code: int | None
    imports: int | None
    docstrings: int | None
    comments: int | None
    blank: int
    budget: int | None = None
    before: int | None = None


@dataclass(frozen=True)
class Figure:
    """One figure: at commit 9cf6d59 (one package of 553 files), now, and what was aimed at."""

    name: str
    before: float | None
    now: float
    aim: float | None
    unit: str = ""

    def cells(self) -> list[str]:
        digits = 1 if self.unit == "s" else 0
        return [
            self.name,
            *(number(x, digits, self.unit) for x in (self.before, self.now, self.aim)),
        ]


def count_lines(name: str, files: Iterable[Path]) -> Weight:
    """Count the lines of Python files by kind."""
    counts = [_count(path.read_text("utf-8")) for path in files]
    lines, imports, docstrings, comments, blank = (sum(c) for c in zip(*counts, strict=True))
    code = lines - docstrings - comments - blank
    budget, before = BUDGETS.get(name, PACKAGES.get(name)), BEFORE.get(name)
    return Weight(
        name, len(counts), lines, code, imports, docstrings, comments, blank, budget, before
    )


def _count(text: str) -> tuple[int, int, int, int, int]:
    lines = text.splitlines()
    imports: set[int] = set()
    docstrings: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        rows = range(getattr(node, "lineno", 1) - 1, getattr(node, "end_lineno", 0))
        if isinstance(node, ast.Import | ast.ImportFrom):
            imports.update(rows)
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            docstrings.update(rows if isinstance(node.value.value, str) else ())
    others = [line.strip() for i, line in enumerate(lines) if i not in docstrings]
    comments = sum(line.startswith("#") for line in others)
    return len(lines), len(imports), len(docstrings), comments, others.count("")


def weights(root: Path) -> list[Weight]:
    """Weigh every part of a repository."""
    folders = {"core": root / "src"}
    folders |= {name: root / f"packages/placegraph-{name}/src" for name in PACKAGES}
    files = {name: sorted(folder.rglob("*.py")) for name, folder in folders.items()}
    tests = [*(root / "tests").rglob("*.py"), *root.glob("packages/*/tests/**/*.py")]
    pages = [path.read_text("utf-8").splitlines() for path in (root / "docs").rglob("*.md")]
    blank, lines = (sum(not line.strip() for page in pages for line in page), sum(map(len, pages)))
    apart = [count_lines(name, found) for name, found in files.items() if found]
    return [
        *apart,
        _together("packages together", apart),
        count_lines("lab", sorted((root / "lab/src").rglob("*.py"))),
        count_lines("tests", tests),
        Weight("docs", len(pages), lines, None, None, None, None, blank, before=BEFORE["docs"]),
    ]


def _together(name: str, parts: Sequence[Weight]) -> Weight:
    sums = {
        field: sum(getattr(part, field) for part in parts)
        for field in ("files", "lines", "code", "imports", "docstrings", "comments", "blank")
    }
    return Weight(name, **sums, budget=BUDGETS[name], before=BEFORE[name])


def functions(path: Path) -> Iterator[tuple[str, int, int]]:
    """Yield name, lines without the docstring, and parameters of each function of a file."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            told = ast.get_docstring(node) is not None
            first = node.body[min(int(told), len(node.body) - 1)].lineno
            head = 1 if "cli" in (*path.parts, path.stem) else node.body[0].lineno - node.lineno
            each = (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
            parameters = sum(argument.arg not in {"self", "cls"} for argument in each)
            yield node.name, head + (node.end_lineno or 0) - first + 1, parameters


def shape(root: Path) -> list[Figure]:
    """Return the figures of files and functions of the core and the packages."""
    files = sorted([*(root / "src").rglob("*.py"), *root.glob("packages/*/src/**/*.py")])
    plain = [(p, f) for p in files if not p.stem.endswith("_kernels") for f in functions(p)]
    lengths = [lines for _, (_, lines, _) in plain]
    apart = [f for p, f in plain if "cli" not in (*p.parts, p.stem)]
    longest = max(p.read_text("utf-8").count("\n") for p in files)
    folders = {p.parent for p in files}
    entries = max(sum(p.parent == folder for p in files) for folder in folders)
    readme = (root / "README.md").read_text("utf-8").count("\n")
    return [
        Figure("longest file", 402, longest, 700, "lines"),
        Figure("mean function", None, round(mean(lengths), 1), 18, "lines"),
        Figure("longest function", 109, max(lengths), LONG, "lines"),
        Figure(f"functions over {LONG} lines", None, sum(n > LONG for n in lengths), 0),
        Figure(f"functions over {MANY} parameters", 70, sum(f[2] > MANY for f in apart), 0),
        Figure("most files in one folder", 60, entries, None),
        Figure("lines of the README", 491, readme, 150),
    ]


def time_commands(extract: Path, house: Path, walk: Path, times: int = 3) -> list[Figure]:
    """Time commands until their answer, with nothing compiled and with everything compiled.

    `extract`: an .osm.pbf; `house`: a .glb; `walk`: a capture of the house.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        city, scene, warm = folder / "a.city", folder / "a.scene", folder / "warm"
        build = ["scene", "build", str(house), "-o", str(scene)]
        locate = ["city", "locate", str(city), SENTENCE]
        localize = ["scene", "localize", str(scene), str(walk), "--frames", ":5"]
        _run(["city", "build", str(extract), "-o", str(city)], warm)
        _run(build, warm)
        rows = []
        commands = (("city locate", locate, 41.0, 15.0, 2.6, 1.0),
                    ("scene localize", localize, 52.0, 20.0, 4.3, 2.0),
                    ("scene build", build, 24.0, 12.0, None, None))  # fmt: skip
        for title, command, before, aim, before_warm, aim_warm in commands:
            cold = []
            for i in range(times):
                cold.append(_run(command, folder / f"cold{i}"))
                shutil.rmtree(folder / f"cold{i}", ignore_errors=True)
            rows.append(Figure(f"{title}, nothing compiled", before, median(cold), aim, "s"))
            _run(command, warm)
            seconds = median(_run(command, warm) for _ in range(2 * times + 1))
            rows.append(Figure(f"{title}, all compiled", before_warm, seconds, aim_warm, "s"))
        helped = median(_run(["--help"], warm) for _ in range(2 * times + 1))
        return [*rows, Figure("--help", None, helped, 0.2, "s")]


def install(root: Path) -> list[Figure]:
    """Install the core in an empty environment; megabytes and seconds."""
    with tempfile.TemporaryDirectory() as name:
        start = perf_counter()
        _call([sys.executable, "-m", "venv", name])
        _call([f"{name}/bin/python", "-m", "pip", "install", "--quiet", str(root)])
        size = sum(p.lstat().st_size for p in Path(name).rglob("*") if p.is_file()) / 1e6
        return [
            Figure("core and demo, installed", 2600.0, size, None, "MB"),
            Figure("core, installing", None, perf_counter() - start, None, "s"),
        ]


def _run(command: Sequence[str], compiled: Path) -> float:
    start = perf_counter()
    environment = os.environ | {"NUMBA_CACHE_DIR": str(compiled)}
    _call([sys.executable, "-m", "placegraph", *command], environment)
    return perf_counter() - start


def _call(command: Sequence[str], environment: dict[str, str] | None = None) -> str:
    done = subprocess.run(command, check=True, capture_output=True, env=environment)  # noqa: S603  # ours
    return done.stdout.decode().strip()


@table()
def weight(
    run: Run,
    *,
    starts: Annotated[bool, option("Time commands, with nothing compiled and all.")] = True,
    installs: Annotated[
        bool, option("Install the core in an empty environment.", "--install/--no-install")
    ] = True,
) -> None:
    """Size of the repository: files and lines of every part, functions, prose, starts."""
    root = LAB.parent
    parts = weights(root)
    print(f"{render(WEIGHTS, parts)}\n")
    prose = run.shared / "tools/prose.py"
    words = ""
    if prose.exists():
        words = _call(
            [sys.executable, str(prose), *(str(root / d) for d in ("src", "packages", "lab"))]
        )
        print(f"Prose: {words}\n")
    figures = shape(root)
    if starts:
        house = run.data / "house"
        extract = run.osm / "vancouver_2015.osm.pbf"
        figures += time_commands(extract, house / "map/house.glb", house / "seq00", 3)
    if installs:
        figures += install(root)
    header = (Column(title, title) for title in ("", "at 9cf6d59", "now", "aim"))
    print(render(tuple(header), (figure.cells() for figure in figures)))
    rows = {"parts": parts, "figures": figures}
    run.save({**rows, "prose": words}, complete=starts and installs)
