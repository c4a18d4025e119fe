# mypy: disable-error-code="attr-defined"
"""Compilation of all kernels of a command, in parallel processes, before they are needed.

`kernels.txt` lists the kernels that Python calls, the types of their arguments, and by letters the
commands that need them. Kernels missing from the list only cost time: they are compiled at their first
call.
"""

from __future__ import annotations

import functools
import signal
import warnings
from collections.abc import Callable, Collection, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import suppress
from importlib import import_module
from importlib.resources import files
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from numba.core import types

from placegraph.core import cache
from placegraph.core.threads import count_processors, end_with_parent

_ROOT = "placegraph."
_PLUGIN = "placegraph_"
_STALE_ENTRY = AttributeError, ImportError, NameError
"""Errors of entries of the list whose kernel no longer exists."""


def list_calls() -> dict[str, list[str]]:
    """Return calls ``KERNEL(TYPE, ...)`` by command and kind, in the order to compile them in."""
    found: dict[str, list[str]] = {}
    commands: dict[str, str] = {}
    for line in _lines():
        if ": " in line[:3]:
            letter, _, command = line.partition(": ")
            commands[letter], found[command] = command, []
        elif " = " not in line:
            letters, _, call = line.partition(" ")
            for letter in letters:
                found[commands[letter]].append(call)
    return found


def calls_with(kernel: str, words: Collection[str]) -> list[str]:
    """Return the calls of the simplest kind of the command in `words` that needs a kernel, if listed."""
    kinds = [
        calls
        for command, calls in list_calls().items()
        if set(command.partition(",")[0].split()) <= set(words)
        and any(call.startswith(f"{kernel.removeprefix(_ROOT)}(") for call in calls)
    ]
    return min(kinds, key=len, default=[])


def missing_calls(calls: Iterable[str]) -> list[str]:
    """Return those of the calls whose code is not cached yet."""
    lacking = []
    for call in dict.fromkeys(calls):
        with suppress(*_STALE_ENTRY):
            if not _resolve(call).is_cached(_parse_types(call, _type_names())):
                lacking.append(call)
    return lacking


def compile_calls(calls: list[str], report: Callable[[str], None]) -> list[str]:
    """Compile calls on all processors and report each when it is done.

    Returns the calls that could not be compiled, each with the reason.
    """
    failed = []
    workers = max(1, min(count_processors(), len(calls)))
    with ProcessPoolExecutor(
        workers, get_context("spawn"), _initialize_worker, (cache.FOLDERS.chosen,)
    ) as pool:
        jobs = {pool.submit(_compile, call): call for call in calls}
        try:
            for job in as_completed(jobs):
                if job.exception() is not None:
                    failed.append(f"{jobs[job]}: {job.exception()}")
                report(jobs[job])
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return failed


@functools.cache
def _lines() -> list[str]:
    text = files("placegraph").joinpath("kernels.txt").read_text("utf-8")
    return [line for line in text.splitlines() if line and not line.startswith("#")]


def _resolve(call: str) -> Any:  # noqa: ANN401  # a kernel or a named tuple
    module, name = call.partition("(")[0].rsplit(".", 1)
    return getattr(import_module(module if module.startswith(_PLUGIN) else _ROOT + module), name)


def _parse_types(call: str, words: dict[str, Any]) -> tuple[types.Type, ...]:
    """Return the types between the brackets, such as ``float64[:, ::1], Surface``."""
    inside = call[call.index("(") + 1 : -1]
    given: Any = eval(f"[{inside}]", {"__builtins__": {}}, words)  # noqa: S307  # our own list
    return tuple(_as_type(kind) for kind in given)


def _as_type(kind: Any) -> types.Type:  # noqa: ANN401  # tuples are written as tuples
    if isinstance(kind, tuple):
        return types.BaseTuple.from_types([_as_type(member) for member in kind])
    return kind


class _TypeNames(dict[str, Any]):
    """Numba's types and the list's named tuples, imported at first use, by name."""

    def __missing__(self, name: str) -> Any:  # noqa: ANN401
        for line in _lines():
            if line.startswith(f"{name} = "):
                call = line.partition(" = ")[2]
                self[name] = types.BaseTuple.from_types(_parse_types(call, self), _resolve(call))
                return self[name]
        raise KeyError(name)


@functools.cache
def _type_names() -> _TypeNames:
    named = {name: kind for name, kind in vars(types).items() if isinstance(kind, types.Type)}
    return _TypeNames(named, omitted=types.Omitted, readonly=lambda kind: kind.copy(readonly=True))


def _initialize_worker(folder: Path | None) -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends it at once and silently
    warnings.simplefilter("ignore")  # the parent has warned already
    cache.FOLDERS.choose(folder)
    end_with_parent()


def _compile(call: str) -> None:
    _resolve(call).compile(_parse_types(call, _type_names()))
