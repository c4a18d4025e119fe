"""How heavy is the house? Files, lines, functions, starts and sizes, beside what they were at 9cf6d59.

    placegraph-lab table weight
    placegraph-lab table weight --no-starts --no-install

Before it was rebuilt everything was one package of 553 files. Prints Markdown, writes JSON.
"""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Annotated

from placegraph_lab.tables.runner import LAB, Run, markdown, number, option, table

FINDING = ("outdoor", "indoor", "language", "vectors")
"""Folders of the library where places and poses are found,"""
MAKING = ("indoor/mapping", "outdoor/map")
"""but for those where maps are made."""
LONG, MANY = 60, 8
"""Lines and parameters that a function has at most; options of commands and kernels do not count."""
SENTENCE = "A bench is north of me. A cafe is east of me. I am on a street."


@dataclass(frozen=True)
class Row:
    """One figure: before (one package, at the commit named in `BEFORE`), now, and what was aimed at."""

    name: str
    before: float | None
    now: float
    aim: float | None
    unit: str = ""

    @property
    def digits(self) -> int:
        """Digits behind the point that mean something."""
        return 1 if self.unit == "s" else 0


@dataclass(frozen=True)
class Source:
    """What one Python file weighs."""

    path: Path
    lines: int
    functions: tuple[tuple[str, int, int], ...]
    """Name, lines without the docstring, and parameters of each function."""

    @classmethod
    def read(cls, path: Path) -> Source:
        """Weigh a file."""
        text = path.read_text("utf-8")
        functions = tuple(
            (node.name, _weight(node, "cli" in path.parts), _parameters(node.args))
            for node in ast.walk(ast.parse(text))
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        )
        return cls(path, text.count("\n"), functions)

    @property
    def compiled(self) -> bool:
        """Whether it holds kernels."""
        return self.path.stem.endswith("_kernels")


def sources(root: Path) -> list[Row]:
    """Files, lines and functions of the library."""
    package = root / "src/placegraph"
    files = [Source.read(path) for path in sorted(package.rglob("*.py"))]
    finding = [s for s in files if _finds(s.path.relative_to(package).as_posix())]
    plain = [(s, f) for s in files if not s.compiled for f in s.functions]
    apart = [f for s, f in plain if "cli" not in s.path.relative_to(package).parts]
    entries = [len(_entries(p)) for p in (package, *package.rglob("*")) if _is_package(p)]
    return [
        Row("files of the wheel", 553, len(files), None),
        Row("lines of the wheel", 90_851, sum(s.lines for s in files), 60_000),
        Row("lines that find places and poses", None, sum(s.lines for s in finding), 30_000),
        Row("files over 300 lines", 63, sum(s.lines > 300 for s in files), 0),
        Row("longest file", 402, max(s.lines for s in files), 300, "lines"),
        Row("longest function", 109, max(lines for _, (_, lines, _) in plain), LONG, "lines"),
        Row("functions over 60 lines", 48, sum(f[1] > LONG for _, f in plain), 0),
        Row("functions over 8 parameters", 70, sum(f[2] > MANY for f in apart), 0),
        Row("most entries in one folder", 60, max(entries), 12),
        Row("lines of the README", 491, _lines(root / "README.md"), 150),
    ]


def timed(extract: Path, house: Path, walk: Path, times: int = 3) -> list[Row]:
    """Seconds from a command to its answer, by an empty and by a full cache of compiled code.

    `extract`: an .osm.pbf; `house`: a .glb; `walk`: a capture of the house.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        city, scene = folder / "a.city", folder / "a.scene"
        build = ["scene", "build", str(house), "-o", str(scene)]
        locate = ["city", "locate", str(city), SENTENCE]
        localize = ["scene", "localize", str(scene), str(walk), "--frames", ":5"]
        _run(["city", "build", str(extract), "-o", str(city)], folder / "warm")
        _run(build, folder / "warm")
        rows = []
        commands = (("city locate", locate, 41.0, 15.0, 2.6, 1.0),
                    ("scene localize", localize, 52.0, 20.0, 4.3, 2.0),
                    ("scene build", build, 24.0, 12.0, None, None))  # fmt: skip
        for title, command, cold, aim, warm, warm_aim in commands:
            rows.append(
                Row(f"{title}, nothing compiled", cold, _cold(command, folder, times), aim, "s")
            )
            _run(command, folder / "warm")
            seconds = median(_run(command, folder / "warm") for _ in range(2 * times + 1))
            rows.append(Row(f"{title}, all compiled", warm, seconds, warm_aim, "s"))
        helped = median(_run(["--help"], folder / "warm") for _ in range(2 * times + 1))
        return [*rows, Row("--help", None, helped, 0.2, "s")]


def installed(root: Path) -> list[Row]:
    """Megabytes and seconds of installing the core in an empty environment."""
    with tempfile.TemporaryDirectory() as name:
        start = perf_counter()
        _call([sys.executable, "-m", "venv", name])
        _call([f"{name}/bin/python", "-m", "pip", "install", "--quiet", str(root)])
        size = sum(p.lstat().st_size for p in Path(name).rglob("*") if p.is_file()) / 1e6
        return [
            Row("core and demo, installed", 2600.0, size, None, "MB"),
            Row("core, installing", None, perf_counter() - start, None, "s"),
        ]


def _cold(command: Sequence[str], folder: Path, times: int) -> float:
    def once() -> float:
        shutil.rmtree(folder / "cold", ignore_errors=True)
        return _run(command, folder / "cold")

    return median(once() for _ in range(times))


def _run(command: Sequence[str], cache: Path) -> float:
    start = perf_counter()
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache)}
    _call([sys.executable, "-m", "placegraph", *command], environment)
    return perf_counter() - start


def _call(command: Sequence[str], environment: dict[str, str] | None = None) -> None:
    subprocess.run(command, check=True, capture_output=True, env=environment)  # noqa: S603  # ours


def _finds(path: str) -> bool:
    return path.startswith(FINDING) and not path.startswith(MAKING)


def _is_package(path: Path) -> bool:
    return path.is_dir() and (path / "__init__.py").exists()


def _entries(folder: Path) -> list[Path]:
    return [p for p in folder.iterdir() if p.name not in {"__pycache__", "__init__.py"}]


def _lines(path: Path) -> int:
    return path.read_text("utf-8").count("\n")


def _weight(node: ast.FunctionDef | ast.AsyncFunctionDef, command: bool) -> int:
    """Lines of a function without its docstring, of a command without its options."""
    told = ast.get_docstring(node) is not None
    first = node.body[min(int(told), len(node.body) - 1)].lineno
    head = 1 if command else node.body[0].lineno - node.lineno
    return head + (node.end_lineno or 0) - first + 1


def _parameters(given: ast.arguments) -> int:
    each = (*given.posonlyargs, *given.args, *given.kwonlyargs)
    return sum(argument.arg not in {"self", "cls"} for argument in each)


@table()
def weight(
    run: Run,
    times: Annotated[int, option("Runs of each command with nothing compiled.")] = 3,
    *,
    starts: Annotated[bool, option("Time commands, with nothing compiled and all.")] = True,
    install: Annotated[bool, option("Install the core in an empty environment.")] = True,
) -> None:
    """How heavy is the house? Files, lines, starts and sizes, beside what they were."""
    root = LAB.parent
    rows = sources(root)
    if starts:
        house = run.data / "house"
        walk = house / "seq00"
        rows += timed(run.osm / "vancouver_2015.osm.pbf", house / "map/house.glb", walk, times)
    if install:
        rows += installed(root)
    cells = [
        [r.name, *(number(x, r.digits, r.unit) for x in (r.before, r.now, r.aim))] for r in rows
    ]
    print(markdown(["", "before", "now", "aim"], cells))
    run.save({"rows": [asdict(r) for r in rows]}, whole=starts and install)
