"""Compilation of kernels before a command can go on, with one line of progress."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import suppress
from time import perf_counter

import click

from placegraph.cli.common import Quiet, progress_of
from placegraph.core import cache
from placegraph.errors import OptionError


class CompileListener:
    """Listens for a kernel that is not found, and has all that the command will need compiled at once.

    `words` are those of the command line, without the program's name.
    """

    def __init__(self, words: Sequence[str]) -> None:
        self._words = words
        self._busy = False

    def __call__(self, name: str, done: bool) -> None:
        """Take part: `cache.listen_to_compilation`."""
        if done or self._busy or cache.FOLDERS.write is None:  # what others compile would be lost
            return
        from concurrent.futures import BrokenExecutor

        from placegraph.core.warm import calls_with, missing_calls

        self._busy = True  # what is imported here may itself be compiled
        try:
            lacking = missing_calls(calls_with(name, self._words))
            if "demo" in self._words and lacking and not sys.stderr.isatty():
                click.echo(f"{_line(0, len(lacking))} ...", err=True)  # a terminal shows a bar
            with suppress(OSError, BrokenExecutor):  # no process can be started: one by one, here
                compile_all(lacking, hidden="--quiet" in self._words)
        finally:
            self._busy = False


def compile_all(calls: list[str], *, hidden: bool) -> list[str]:
    """Compile on all processors, and say how far it is; returns what failed, as of `warm.compile_calls`."""
    from placegraph.core.warm import compile_calls

    if not calls:
        return []
    done = 0
    with progress_of(hidden=hidden) as tell:
        tell(_line(done, len(calls)), done, len(calls))

        def count_compiled(_call: str) -> None:
            nonlocal done
            done += 1
            tell(_line(done, len(calls)), done, len(calls))

        return compile_calls(calls, count_compiled)


def warm_up(quiet: Quiet = False) -> None:
    """Compile all numeric code now, on all processors, so that the first use of a command is fast.

    The code is stored beside the package, in your cache folder, or in `placegraph --compiled FOLDER`.
    It is valid for this processor, this Python and this version of numba.
    """
    from placegraph.core.warm import list_calls, missing_calls

    if cache.FOLDERS.write is None:
        raise OptionError(
            "--compiled: the folder is not writable; choose a writable one, else compiled code is "
            "not cached."
        )
    start = perf_counter()
    _read_once()
    calls = list(dict.fromkeys(call for its in list_calls().values() for call in its))
    lacking = missing_calls(calls)
    failed = compile_all(lacking, hidden=quiet)
    for reason in failed:
        click.echo(f"placegraph: cannot compile {reason}", err=True)
    if not quiet:
        seconds = perf_counter() - start
        click.echo(
            f"{len(lacking) - len(failed)} of {len(calls)} functions compiled in "
            f"{seconds:.0f} s and cached in {cache.FOLDERS.write}."
        )
    if failed:
        sys.exit(1)


def _read_once() -> None:
    """Make what sentences are read by, which is kept beside compiled code: grammars, tables of words."""
    from placegraph.indoor.language import read
    from placegraph.outdoor.language import describe

    describe("A bakery is north of me. Eine Bank ist links von mir.")
    read("A lamp is on the table.")


def _line(done: int, total: int) -> str:
    return f"Compiling for this machine, once: {done} of {total} functions"
