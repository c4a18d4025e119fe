"""What the commands of both wings share."""

from __future__ import annotations

import json
import sys
from contextlib import ExitStack, contextmanager
from math import isfinite
from typing import TYPE_CHECKING, Annotated, Any

import click

from placegraph.cli.command import Option
from placegraph.cli.terminal import bare, harmless
from placegraph.errors import OptionError

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterator

    from rich.console import Console
    from rich.progress import Progress
    from rich.table import Table
    from rich.text import Text

AsJson = Annotated[bool, Option("--json", help="Print JSON for machines.")]
Quiet = Annotated[bool, Option("--quiet", help="No progress, no summary.")]


def numbers_of(text: str, option: str, counts: Container[int], mend: str) -> list[float]:
    """Finite numbers of a text, commas between; `OptionError` with the mend where they are not so many."""
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if len(found) not in counts or not all(map(isfinite, found)):
        raise OptionError(f"{option} is {text!r}; {mend}")
    return found


def echo_json(told: object) -> None:
    """Print as JSON, which has no NaN and no infinity: they become null."""
    click.echo(json.dumps(_finite(told), ensure_ascii=False, allow_nan=False))


@contextmanager
def progress_of(*, hidden: bool) -> Iterator[Callable[..., None]]:
    """Spinner, bar and time, on stderr, gone when done; yields what steps tell: name, done, total.

    Where one is shown already, another is a line of it. A file or a pipe sees none of it.
    """
    if hidden or not sys.stderr.isatty():
        yield lambda *_: None
        return
    with ExitStack() as stack:
        bar = _SHOWN[-1] if _SHOWN else stack.enter_context(_bar())
        task = bar.add_task("starting", total=None)
        stack.callback(bar.remove_task, task)

        def tell(step: str, done: int = 0, total: int | None = None) -> None:
            bar.update(task, description=harmless(step), completed=done, total=total)

        yield tell


@contextmanager
def _bar() -> Iterator[Progress]:
    from rich import progress
    from rich.console import Console

    columns = (
        progress.SpinnerColumn(),
        progress.TextColumn("{task.description}"),
        progress.BarColumn(bar_width=28),
        progress.TimeElapsedColumn(),
    )
    shown = Console(file=bare(sys.stderr))
    with progress.Progress(*columns, console=shown, transient=True) as bar:
        _SHOWN.append(bar)
        try:
            yield bar
        finally:
            _SHOWN.remove(bar)


_SHOWN: list[Progress] = []
"""A second one beside it would write over it."""


def console() -> Console:
    """Where answers are printed, as they are but for what would steer the terminal."""
    from rich.console import Console

    class Harmless(Console):
        def render_str(self, text: str, **options: Any) -> Text:  # noqa: ANN401  # rich's
            return super().render_str(harmless(text), **options)

    return Harmless(
        file=bare(sys.stdout), soft_wrap=True, highlight=False, markup=False, emoji=False
    )


def table(*headings: str, show_header: bool = True) -> Table:
    """Table without lines."""
    from rich.table import Table

    return Table(*headings, box=None, pad_edge=False, show_header=show_header)


def show_facts(told: dict[str, object]) -> None:
    """Print names and values as a table."""
    facts = table(show_header=False)
    for key, value in told.items():
        facts.add_row(key.replace("_", " "), _said(value))
    console().print(facts)


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
