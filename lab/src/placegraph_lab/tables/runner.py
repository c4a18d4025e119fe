"""Runner of the tables: options, progress, answers kept between runs, Markdown and JSON."""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import os
import pkgutil
import platform
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from datetime import UTC, datetime
from functools import cached_property
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress, track

import placegraph
import placegraph_lab
from placegraph.cli.common import bare
from placegraph.core.files import write_output
from placegraph_lab.tables import named

SOURCES = tuple(Path(str(p.__file__)).parent for p in (placegraph, placegraph_lab))
_BOTH = ("placegraph/core", "placegraph/io", "placegraph/language")
INDOOR = (*_BOTH, "placegraph/indoor", "placegraph_lab/tables/indoor")
OUTDOOR = (*_BOTH, "placegraph/outdoor", "placegraph_lab/tables/outdoor")
WORLDS = ("placegraph_lab/worlds",)
"""Folders with the code that decides what answers, maps and drawn worlds are."""


def code_key(folders: Iterable[str]) -> str:
    """Return sixteen hexadecimal digits of all files below folders, by name and content.

    A folder begins with a package: `placegraph/indoor`. Raises `ValueError` where one is missing, so
    that code which has moved is not silently left out.
    """
    digest = hashlib.sha256()
    for folder in sorted(folders):
        package, _, below = folder.partition("/")
        root = next(path for path in SOURCES if path.name == package)
        if not (root / below).is_dir():
            raise ValueError(f"{folder} is not a folder of {root}.")
        for path in sorted((root / below).rglob("*")):
            if path.is_file() and path.suffix != ".pyc":
                digest.update(path.relative_to(root).as_posix().encode() + b"\0")
                digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


class Journal:
    """Rows of JSON by key, one line each, appended as they come.

    A line that was cut short by an interruption is passed over.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._rows: dict[str, Any] = {}
        if not path.exists():
            return
        text = path.read_text(encoding="utf-8")
        for line in text.splitlines():
            try:
                entry = json.loads(line)
                self._rows[entry["key"]] = entry["row"]
            except (ValueError, KeyError, TypeError):
                continue
        if text and not text.endswith("\n"):
            with path.open("a", encoding="utf-8") as file:
                file.write("\n")

    def __contains__(self, key: str) -> bool:
        return key in self._rows

    def __getitem__(self, key: str) -> Any:
        return self._rows[key]

    def __len__(self) -> int:
        return len(self._rows)

    def find_missing(self, keys: Iterable[str]) -> list[int]:
        return [i for i, key in enumerate(keys) if key not in self]

    def fill(
        self,
        keys: Sequence[str],
        ask: Callable[[int], Any],
        *,
        warm: Callable[[], object] = lambda: None,
        tick: Callable[[], object] = lambda: None,
    ) -> list[Any]:
        """Rows of all keys; those that are missing are asked for by their place in `keys`.

        Each is written down at once, and `tick` called. `warm` is called before the first, so that
        what is timed is compiled.
        """
        for n, i in enumerate(self.find_missing(keys)):
            if not n:
                warm()
            self.put(keys[i], ask(i))
            tick()
        return [self[key] for key in keys]

    def put(self, key: str, row: Any) -> None:
        if is_dataclass(row) and not isinstance(row, type):
            row = asdict(row)
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"key": key, "row": row}) + "\n")
        self._rows[key] = row


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table with the first column to the left and all others to the right."""
    cells = [list(header), *[list(row) for row in rows]]
    if len({len(row) for row in cells}) != 1:
        raise ValueError("The rows of a table have as many cells as its header.")
    width = [max(3, *(len(row[i]) for row in cells)) for i in range(len(header))]
    rule = ["-" * width[0], *["-" * (w - 1) + ":" for w in width[1:]]]
    lines = []
    for k, row in enumerate([cells[0], rule, *cells[1:]]):
        text = [
            cell.ljust(w) if i == 0 or k == 1 else cell.rjust(w)
            for i, (cell, w) in enumerate(zip(row, width, strict=True))
        ]
        lines.append("| " + " | ".join(text) + " |")
    return "\n".join(lines)


@dataclass(frozen=True)
class Column:
    """Column of a table: title, value of a row, and how the value is written.

    `value` is a path of keys, attributes and indices (`score.recall.0`), or a function of the row;
    `write` a function of the value or a number of decimals. Missing values are dashes.
    """

    title: str
    value: str | Callable[[Any], Any]
    write: int | Callable[[Any], str] | None = None
    unit: str = ""
    scale: float = 1.0

    def cell(self, row: Any) -> str:
        """Write the value of a row."""
        found = self.value(row) if callable(self.value) else lookup(row, self.value)
        if callable(self.write):
            return self.write(found)
        if self.write is None:
            return "–" if found is None else str(found)
        return number(found if found is None else self.scale * found, self.write, self.unit)


def lookup(row: Any, path: str) -> Any:
    """Follow a path of keys, attributes and indices; None where it ends at None."""
    for key in path.split("."):
        if isinstance(row, Mapping):
            row = row.get(key)
        else:
            row = row[int(key)] if key.isdecimal() else getattr(row, key)
        if row is None:
            return None
    return row


def render(columns: Sequence[Column], rows: Iterable[Any]) -> str:
    """Return rows as a Markdown table; a row of strings stands as it is."""
    cells = (r if isinstance(r, list) else [c.cell(r) for c in columns] for r in rows)
    return markdown([c.title for c in columns], cells)


def share(value: float | None) -> str:
    """Write a share with two digits: ``.45``, ``1.00``; a dash where there is none."""
    return number(value, 2).removeprefix("0")


def shares(values: Iterable[float | None]) -> str:
    """Write shares set off by slashes: ``.45/.60/.67``."""
    return "/".join(share(v) for v in values)


def number(value: float | None, digits: int = 0, unit: str = "") -> str:
    """Write a number with a unit: ``12 m``, ``∞ m``; a dash where there is none."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞"
    return f"{value:,.{digits}f}{' ' + unit if unit else ''}"


PACKAGES = (
    "placegraph", "numpy", "numba", "osmium", "rapidfuzz", "lark", "embreex",
    "opencv-python-headless", "poselib", "kornia", "torch", "small_gicp",
)  # fmt: skip


def plain(value: Any) -> Any:
    """Return a value as small JSON: dataclasses as objects, floats of six digits, null for no number."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if hasattr(value, "_asdict"):
        return plain(value._asdict())
    if isinstance(value, list | tuple | set):
        return [plain(v) for v in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value if value is None or isinstance(value, str | int) else str(value)


def show(title: str, columns: Sequence[Column], rows: Iterable[Any]) -> None:
    """Print rows as a Markdown table below a title."""
    print(f"{title and f'#### {title}{chr(10) * 2}'}{render(columns, rows)}\n", flush=True)


def machine() -> dict[str, object]:
    """Processor, cores, Python and package versions."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": sys.version.split()[0],
        "packages": {name: found for name in PACKAGES if (found := _version(name))},
    }


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""  # an extra that is not installed


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for entry in info.read_text(encoding="utf-8").splitlines():
            if entry.startswith("model name"):
                return entry.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


Item = TypeVar("Item")
LAB = Path(__file__).parents[3]  # folder of the lab in the repository


def option(text: str, *flags: str) -> Any:
    return typer.Option(*flags, help=text)


Seed = Annotated[int, option("Of all that is drawn; the same seed, the same rows.")]
Device = Annotated[str, option("auto, cpu or cuda.")]
Quick = Annotated[bool, option("A first impression: few rows, few queries.")]
Fresh = Annotated[bool, option("Ask everything anew, not only what is missing.")]
Every = Annotated[int, option("Frames from one window of the house to the next.")]
OfficeEvery = Annotated[int, option("The same for the office.")]


@dataclass(frozen=True)
class Run:
    """One run of a table: where its data lie, and where its rows go."""

    name: str
    shared: Path  # folder with `data` and `weights`
    cache: Path  # for maps and answers
    out: Path | None = None  # JSON file; `results/NAME.json` of the lab if not given
    options: dict[str, Any] = field(default_factory=dict)  # the table's own, as they were given

    @property
    def data(self) -> Path:
        return self.shared / "data"

    @property
    def osm(self) -> Path:
        return self.data / "osm"

    @cached_property
    def console(self) -> Console:
        return Console(file=bare(sys.stderr))

    def log(self, text: str) -> None:
        typer.echo(text, err=True)

    def progress(self) -> Progress:
        return Progress(console=self.console, transient=True)

    def track(
        self, items: Iterable[Item], title: str = "", total: float | None = None
    ) -> Iterable[Item]:
        return track(items, title, total=total, console=self.console, transient=True)

    def one_core(self) -> None:
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

    def journal(self, *, fresh: bool = False) -> Journal:
        """Answers of earlier runs; none if `fresh`."""
        self.cache.mkdir(parents=True, exist_ok=True)
        path = self.cache / f"{self.name}.jsonl"
        if fresh:
            path.unlink(missing_ok=True)
        return Journal(path)

    def save(self, record: dict[str, Any], *, complete: bool = True) -> None:
        """Write rows as small JSON (`plain`), with machine, commit and options.

        `complete`: False of a part of the table, which is written only where `--out` says so, as a
        quick run is.
        """
        complete = complete and not self.options.get("quick")
        out = self.out or (LAB / "results" / f"{self.name}.json" if complete else None)
        if out is None:
            return
        head = {"table": self.name, "machine": machine(), "commit": _commit()}
        text = json.dumps(plain(head | self.options | record), indent=1, allow_nan=False)
        out.parent.mkdir(parents=True, exist_ok=True)
        write_output(out, f"{text}\n".encode())  # in one step: a run may be cut short


@dataclass(frozen=True)
class Table:
    """A table that can be run by its name."""

    measure: Callable[..., None]
    paper: str = ""  # what it stands beside in the papers

    @property
    def name(self) -> str:
        return self.measure.__name__

    @property
    def asks(self) -> str:
        return (inspect.getdoc(self.measure) or "").partition("\n")[0]

    def app(self) -> typer.Typer:
        """Command of this table alone: its own options, and those of a `Run`."""
        own = list(inspect.signature(self.measure, eval_str=True).parameters.values())[1:]
        shared = list(inspect.signature(_shared, eval_str=True).parameters.values())

        def command(context: typer.Context, **given: Any) -> None:
            print(provenance(self.name, context), flush=True)
            where = {p.name: given.pop(p.name) for p in shared}
            run = Run(self.name, where["data"], where["cache"], where["out"], given)
            self.measure(run, **given)

        keyword = inspect.Parameter.KEYWORD_ONLY
        context = inspect.Parameter("context", keyword, annotation=typer.Context)
        parameters = [context, *(p.replace(kind=keyword) for p in (*own, *shared))]
        command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        command.__annotations__ = {p.name: p.annotation for p in parameters}
        command.__doc__ = self.measure.__doc__
        app = typer.Typer(pretty_exceptions_enable=False, rich_markup_mode=None)
        app.command(self.name)(command)
        return app


def provenance(name: str, context: typer.Context) -> str:
    """Comment above a printed table: its command, commit and date; `verify` reads it on a page."""
    words = [name]
    for parameter in context.command.params:
        value = context.params.get(parameter.name or "")
        if value in (None, parameter.default) or parameter.name in ("data", "cache", "out"):
            continue
        if parameter.param_type_name == "option":
            words.append((parameter.secondary_opts if value is False else parameter.opts)[0])
        if not isinstance(value, bool):
            words.append(str(value))
    today = datetime.now(tz=UTC).date()
    return f"<!-- placegraph-lab table {shlex.join(words)} ({_commit()}, {today}) -->"


def table(paper: str = "") -> Callable[[Callable[..., None]], Table]:
    """Make a function of a `Run` a table; `paper` says what it stands beside."""
    return lambda measure: Table(measure, paper)


def names() -> list[str]:
    modules = sorted(m.name for m in pkgutil.iter_modules(named.__path__))
    counts = {m: named.NUMBERED.get(m, 0) for m in modules}
    return [name for m, n in counts.items() for name in ([f"{m}-{i + 1}" for i in range(n)] or [m])]


def load(name: str) -> Table:
    """Table of a name; `KeyError` where there is none."""
    if name not in names():
        raise KeyError(name)
    module = import_module(f"{named.__name__}.{name.partition('-')[0]}")
    found: Table = module.TABLES[name] if "-" in name else getattr(module, name)
    return found


def parts(text: str, mark: str = ",") -> list[str]:
    return [part.strip() for part in text.split(mark) if part.strip()]


def check_names(given: Sequence[str], there: Iterable[str], what: str) -> list[str]:
    """Return the names given; all there are where none is, refused where one is not there."""
    every = list(there)
    unknown = sorted(set(given) - set(every))
    if unknown:
        raise typer.BadParameter(f"{unknown[0]!r} is not a {what}; choose from {'; '.join(every)}")
    return list(given) or every


def _shared(
    data: Annotated[Path, option("Folder with `data` and `weights`.")] = Path("../shared"),
    cache: Annotated[Path, option("Folder for maps and answers.")] = Path(".benchmark-cache"),
    out: Annotated[
        Path | None, option("JSON file; a part of a table is written only where this is given.")
    ] = None,
) -> None:
    """Options of every table."""


def _commit() -> str:
    command = ["git", "-C", str(LAB), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True)  # noqa: S603
    except (OSError, subprocess.CalledProcessError):
        return ""
    return done.stdout.strip()
