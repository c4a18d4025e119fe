"""What the commands of both wings share."""

from __future__ import annotations

import json
from math import isfinite
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON for machines.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress, no summary.")]


def echo_json(told: object) -> None:
    """Print as JSON, which has no NaN and no infinity: they become null."""
    typer.echo(json.dumps(_finite(told), ensure_ascii=False, allow_nan=False))


def progress_bar(*, hidden: bool) -> Progress:
    """Spinner with a line of text, on stderr; gone when done, never there for a file or a pipe."""
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    console = Console(stderr=True)
    hidden = hidden or not console.is_terminal
    return _Bar(*columns, console=console, disable=hidden, transient=True)


class _Bar(Progress):
    def start(self) -> None:
        OPEN.append(self)
        super().start()

    def stop(self) -> None:
        super().stop()
        if self in OPEN:
            OPEN.remove(self)


OPEN: list[Progress] = []
"""Bars that are shown now; a second one would write over the first, so that lines are added to it."""


def show_facts(told: dict[str, object]) -> None:
    """Print names and values as a table."""
    table = Table(box=None, show_header=False, pad_edge=False)
    for key, value in told.items():
        table.add_row(key.replace("_", " "), _said(value))
    Console(soft_wrap=True, highlight=False, markup=False, emoji=False).print(table)


def _finite(told: object) -> Any:  # noqa: ANN401  # any JSON
    if isinstance(told, dict):
        return {key: _finite(value) for key, value in told.items()}
    if isinstance(told, list | tuple):
        return [_finite(value) for value in told]
    return None if isinstance(told, float) and not isfinite(told) else told


def _said(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{k} {_said(v)}" for k, v in value.items())
    if isinstance(value, list):
        return ", ".join(_said(v) for v in value)
    return f"{value:,}" if isinstance(value, int) else str(value)
