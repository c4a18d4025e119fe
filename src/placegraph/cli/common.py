"""Terminal of the commands: progress, tables, JSON, interrupts."""

from __future__ import annotations

import json
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Container, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from math import isfinite
from typing import TYPE_CHECKING, Annotated, Any, TextIO

import click

from placegraph.cli.command import Option
from placegraph.errors import OptionError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress
    from rich.table import Table
    from rich.text import Text

    from placegraph.core.estimate import Estimate, Evidence

AsJson = Annotated[bool, Option("--json", help="Print JSON.")]
Quiet = Annotated[bool, Option("--quiet", help="Print neither progress nor summary.")]


def numbers_of(text: str, option: str, counts: Container[int], advice: str) -> list[float]:
    """Finite numbers of a text, commas between; `OptionError` with the mend where they are not so many."""
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if len(found) not in counts or not all(map(isfinite, found)):
        raise OptionError(f"{option} is {text!r}; {advice}")
    return found


def print_remainder(out: Console, estimate: Estimate[Any], count: int) -> None:
    """Print the probability of the places that are not among the `count` modes, from 1 % on."""
    if estimate.remainder is None or not count:
        return
    hidden = estimate.modes[count:]
    left = estimate.remainder + sum(mode.probability for mode in hidden)
    if left >= 0.01:
        out.print(f"{f'{len(hidden)} more, and elsewhere' if hidden else 'Elsewhere'}: {left:.1%}")


def echo_json(value: object) -> None:
    """Print a value as JSON; NaN and infinity become null."""
    click.echo(json.dumps(_finite(value), ensure_ascii=False, allow_nan=False))


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
    """Return a console that prints answers, with control characters escaped."""
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


def evidence_cells(evidence: Evidence) -> tuple[str, str, str]:
    """Return the cells of evidence in a table: sign of the verdict, statement, log-likelihood ratio.

    The ratio is left out where it contradicts the verdict: a rare object is there, which speaks for the
    place, but not where the statement says.
    """
    sign = {"for": "+", "against": "-"}.get(evidence.verdict, " ")
    agrees = evidence.verdict != "against" or evidence.weight <= 0.0
    return sign, evidence.statement, f"{evidence.weight:+.1f}" if agrees else ""


def show_facts(facts_by_name: dict[str, object]) -> None:
    """Print names and values as a table."""
    facts = table(show_header=False)
    for key, value in facts_by_name.items():
        facts.add_row(key.replace("_", " "), _format(value))
    console().print(facts)


def _finite(value: object) -> Any:  # noqa: ANN401  # any JSON
    if isinstance(value, dict):
        return {key: _finite(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not isfinite(value) else value


def _format(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{k} {_format(v)}" for k, v in value.items())
    if isinstance(value, list):
        return ", ".join(_format(v) for v in value)
    return f"{value:,}" if isinstance(value, int) else str(value)


_STEERING = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)
"""Control characters but tab and end of line, what separates lines, marks of direction, and halves of a
character: bytes of a file's name that are no UTF-8."""


def harmless(text: str) -> str:
    """Text with characters that steer a terminal as escapes of JSON."""
    return _STEERING.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


class _Guarded:
    """A stream to which only harmless text is written; all else of it is the stream's own."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        """Write text; a carriage return before an end of line is part of that."""
        if not isinstance(text, str):
            raise TypeError(f"{type(text).__name__} is not text")
        self.stream.write(harmless(text.replace("\r\n", "\n")))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write one after the other."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  # the stream's
        return getattr(self.stream, name)


@contextmanager
def guard_streams() -> Iterator[None]:
    """Within it, what is written to stdout and stderr is harmless."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (_Guarded(stream) for stream in before)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


def bare(stream: TextIO) -> TextIO:
    """The stream itself, for who steers the terminal on purpose and takes only `harmless` text."""
    return stream.stream if isinstance(stream, _Guarded) else stream


INTERRUPTED = 130
"""Exit code of what a second Ctrl-C ends: 128 and the number of SIGINT, as shells count."""
GRACE = 5.0
"""Time [s] that is left after the second to leave no lock and no half of a file."""
_AGAIN = 0.05
"""After this [s] an interruption is raised again that fell where Python ignores exceptions."""


@contextmanager
def interruptible() -> Iterator[None]:
    """See to it that a SIGINT within is never lost.

    Python ignores a `KeyboardInterrupt` that it raises in a destructor or in what C calls back, of
    which loading libraries and compiling have many: it is then raised again. And nothing is raised
    in a kernel or a library that takes long; there a second SIGINT ends the process after a while.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    read, write = os.pipe()
    os.set_blocking(write, False)
    before = signal.signal(signal.SIGALRM, signal.default_int_handler), sys.unraisablehook
    sys.unraisablehook = _raise_again
    woken = signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    over = threading.Event()
    threading.Thread(target=_watch, args=(read, over), daemon=True).start()
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.set_wakeup_fd(woken)
        signal.signal(signal.SIGALRM, before[0])
        sys.unraisablehook = before[1]
        over.set()
        os.close(write)  # ends the thread


def _raise_again(ignored: Any) -> None:  # noqa: ANN401  # sys.UnraisableHookArgs
    if issubclass(ignored.exc_type, KeyboardInterrupt):
        signal.setitimer(signal.ITIMER_REAL, _AGAIN)
    else:
        sys.__unraisablehook__(ignored)


def _watch(read: int, over: threading.Event) -> None:
    """End the process by the second SIGINT, whatever its main thread does."""
    seen = 0
    while numbers := os.read(read, 64):
        seen += numbers.count(signal.SIGINT)
        if seen > 1 and not over.wait(GRACE):
            os._exit(INTERRUPTED)
    os.close(read)
