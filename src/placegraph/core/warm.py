# mypy: disable-error-code="attr-defined"
"""What each command compiles, and compiling it in processes side by side before it is needed.

`kernels.txt` lists by command the kernels that Python calls, and the types that it calls them with;
kernels that these call are found by the compiler. A list that lacks something costs time alone: what
is missing is compiled where it is called.
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
from typing import TYPE_CHECKING, Any

from numba.core import types

from placegraph.core import cache
from placegraph.core.threads import count_processors, end_with_parent

if TYPE_CHECKING:
    from placegraph.core.jit import Kernel

_ROOT = "placegraph."
_PLUGIN = "placegraph_"
_STALE = AttributeError, ImportError, NameError
"""What names of the list raise that stand for nothing any more."""


def list_calls() -> dict[str, list[str]]:
    """Calls ``KERNEL(TYPE, ...)`` by command and kind, in the order to compile them in."""
    found: dict[str, list[str]] = {}
    for line in _lines():
        if line.startswith("["):
            calls = found[line.strip("[]")] = []
        elif " = " not in line:
            calls.append(line)
    return found


def calls_with(kernel: str, words: Collection[str]) -> list[str]:
    """Return the calls of the simplest kind of a command, of `words`, that needs a kernel.

    The demo runs commands of all kinds. Empty where the kernel is not listed.
    """
    kinds = [
        calls
        for command, calls in list_calls().items()
        if ("demo" in words or set(command.partition(",")[0].split()) <= set(words))
        and any(call.startswith(f"{kernel.removeprefix(_ROOT)}(") for call in calls)
    ]
    return min(kinds, key=len, default=[])


def missing_calls(calls: Iterable[str]) -> list[str]:
    """Those of the calls whose code is not kept yet."""
    lacking = []
    for call in dict.fromkeys(calls):
        with suppress(*_STALE):
            if not _found(call).is_cached(_types_of(call, _words())):
                lacking.append(call)
    return lacking


def compile_calls(calls: list[str], told: Callable[[str], None]) -> list[str]:
    """Compile calls in as many processes as there are processors; says each when it is done.

    Returns what could not be compiled, with the reason.
    """
    failed = []
    workers = max(1, min(count_processors(), len(calls)))
    with ProcessPoolExecutor(
        workers, get_context("spawn"), _begin, (cache.FOLDERS.chosen,)
    ) as pool:
        jobs = {pool.submit(_compile, call): call for call in calls}
        try:
            for job in as_completed(jobs):
                if job.exception() is not None:
                    failed.append(f"{jobs[job]}: {job.exception()}")
                told(jobs[job])
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return failed


def spell_call(kernel: Kernel, args: tuple[types.Type, ...], names: dict[str, str]) -> str:
    """A call as `kernels.txt` has it; `names` collects the named tuples, by their definition."""
    function = kernel.py_func
    where = f"{function.__module__}.{function.__qualname__}".removeprefix(_ROOT)
    return f"{where}({', '.join(_spelled(arg, names) for arg in args)})"


def _spelled(kind: types.Type, names: dict[str, str]) -> str:
    if isinstance(kind, types.Array):
        axes = [":"] * kind.ndim
        if kind.layout != "A":
            axes[-1 if kind.layout == "C" else 0] = "::1"
        text = f"{_spelled(kind.dtype, names)}[{', '.join(axes)}]"
        return text if kind.mutable else f"readonly({text})"
    if isinstance(kind, types.BaseNamedTuple):
        members = ", ".join(_spelled(member, names) for member in kind)
        made = kind.instance_class
        text = f"{made.__module__}.{made.__qualname__}({members})".removeprefix(_ROOT)
        alike = sum(name.startswith(made.__name__) for name in names.values())
        return names.setdefault(text, f"{made.__name__}{alike or ''}")
    if isinstance(kind, types.BaseTuple):
        return f"({', '.join(_spelled(member, names) for member in kind)},)"
    if isinstance(kind, types.Omitted):
        return f"omitted({kind.value!r})"
    return str(kind)


@functools.cache
def _lines() -> list[str]:
    text = files("placegraph").joinpath("kernels.txt").read_text("utf-8")
    return [line for line in text.splitlines() if line and not line.startswith("#")]


def _found(call: str) -> Any:  # noqa: ANN401  # a kernel, or the class of a named tuple
    module, name = call.partition("(")[0].rsplit(".", 1)
    return getattr(import_module(module if module.startswith(_PLUGIN) else _ROOT + module), name)


def _types_of(call: str, words: dict[str, Any]) -> tuple[types.Type, ...]:
    """Types between the brackets, such as ``float64[:, ::1], Surface``, in the words of the list."""
    inside = call[call.index("(") + 1 : -1]
    given: Any = eval(f"[{inside}]", {"__builtins__": {}}, words)  # noqa: S307  # our own list
    return tuple(_as_type(kind) for kind in given)


def _as_type(kind: Any) -> types.Type:  # noqa: ANN401  # tuples are written as tuples
    if isinstance(kind, tuple):
        return types.BaseTuple.from_types([_as_type(member) for member in kind])
    return kind


class _Words(dict[str, Any]):
    """Words of numba, and named tuples of the list, whose modules are imported when asked for."""

    def __missing__(self, name: str) -> Any:  # noqa: ANN401
        for line in _lines():
            if line.startswith(f"{name} = "):
                call = line.partition(" = ")[2]
                self[name] = types.BaseTuple.from_types(_types_of(call, self), _found(call))
                return self[name]
        raise KeyError(name)


@functools.cache
def _words() -> _Words:
    named = {name: kind for name, kind in vars(types).items() if isinstance(kind, types.Type)}
    return _Words(named, omitted=types.Omitted, readonly=lambda kind: kind.copy(readonly=True))


def _begin(folder: Path | None) -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends it at once, without a word
    warnings.simplefilter("ignore")  # the one who asked has been warned
    cache.FOLDERS.choose(folder)
    end_with_parent()


def _compile(call: str) -> None:
    _found(call).compile(_types_of(call, _words()))
