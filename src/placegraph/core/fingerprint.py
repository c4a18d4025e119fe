"""What a compiled kernel is made of, told so that two processes tell the same.

Numba compiles constants in: whatever a kernel names, in its own file or another, is part of its
code. So the parts of a kernel are its bytecode, its options, its defaults, and the parts of every
constant, function and kernel that it names, however deep. Comments, docstrings and lines are not.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from enum import Enum
from functools import singledispatch
from itertools import chain
from types import BuiltinFunctionType, CodeType, EllipsisType, FunctionType, ModuleType, NoneType
from typing import Any

import numpy as np
from numba.core.extending import _Intrinsic
from numba.core.registry import CPUDispatcher
from numba.core.types import BaseNamedTuple, Type

_PLAIN = (bool, int, float, complex, str, bytes, NoneType, EllipsisType, np.generic, Enum, Type)


def fingerprint(*values: object) -> str:
    """Short digest of kernels, functions and constants.

    Raises
    ------
    TypeError
        A kernel names something of which a change could not be told.

    """
    sha = hashlib.sha256()
    for part in _parts(values, set()):
        sha.update(part.encode() + b"\n")
    return sha.hexdigest()[:16]


@singledispatch
def _parts(value: Any, seen: set[str]) -> Iterator[str]:  # noqa: ANN401, ARG001  # any constant
    if not isinstance(value, _PLAIN):
        raise TypeError(f"A kernel uses {value!r}, of which compiled code cannot tell a change.")
    yield f"{type(value).__name__} {value!r}"


@_parts.register(BaseNamedTuple)
def _(value: Any, seen: set[str]) -> Iterator[str]:  # noqa: ANN401, ARG001
    # code that was kept names the class and its fields, a type's repr does not
    home = value.instance_class
    yield f"{home.__module__}.{home.__qualname__} {value.fields} {value!r}"


@_parts.register(tuple)
@_parts.register(list)
def _(value: Any, seen: set[str]) -> Iterator[str]:  # noqa: ANN401
    yield f"{type(value).__name__} of {len(value)}"
    for item in value:
        yield from _parts(item, seen)


@_parts.register(set)
@_parts.register(frozenset)
def _(value: Any, seen: set[str]) -> Iterator[str]:  # noqa: ANN401
    yield from sorted("\n".join(_parts(item, seen)) for item in value)


@_parts.register(dict)
def _(value: dict[Any, Any], seen: set[str]) -> Iterator[str]:
    yield from sorted("\n".join(_parts(pair, seen)) for pair in value.items())


@_parts.register(np.ndarray)
def _(value: np.ndarray, seen: set[str]) -> Iterator[str]:  # noqa: ARG001
    yield f"{value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"


@_parts.register(type)
@_parts.register(BuiltinFunctionType)
@_parts.register(np.ufunc)
@_parts.register(ModuleType)
def _(value: Any, seen: set[str]) -> Iterator[str]:  # noqa: ANN401, ARG001
    yield f"{getattr(value, '__module__', '')} {value.__name__} {getattr(value, '_fields', '')}"


@_parts.register(CPUDispatcher)
def _(value: Any, seen: set[str]) -> Iterator[str]:  # noqa: ANN401
    yield from _parts(value.targetoptions, seen)
    yield from _parts(value.py_func, seen)


@_parts.register(_Intrinsic)
def _(value: Any, seen: set[str]) -> Iterator[str]:  # noqa: ANN401
    yield from _parts(value._defn, seen)  # noqa: SLF001  # the function that it was made of


@_parts.register(FunctionType)
def _(function: FunctionType, seen: set[str]) -> Iterator[str]:
    name = f"{function.__module__}.{function.__qualname__}"
    yield name
    if name in seen:
        return
    seen.add(name)
    code = function.__code__
    yield from _code_parts(code, function.__doc__, seen)
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    yield from _parts((function.__defaults__, function.__kwdefaults__, cells), seen)
    names = list(dict.fromkeys(_names(code)))
    for key in names:
        if key in function.__globals__:
            yield key
            yield from _named_parts(function.__globals__[key], names, seen)


def _named_parts(value: object, names: list[str], seen: set[str]) -> Iterator[str]:
    yield from _parts(value, seen)
    if isinstance(value, ModuleType) and value.__name__.partition(".")[0].startswith("placegraph"):
        for name in names:  # perhaps of its members
            if hasattr(value, name):
                yield from _parts(getattr(value, name), seen)


@_parts.register(CodeType)
def _(code: CodeType, seen: set[str]) -> Iterator[str]:
    yield from _code_parts(code, None, seen)


def _code_parts(code: CodeType, doc: str | None, seen: set[str]) -> Iterator[str]:
    yield repr((code.co_code, code.co_names, code.co_varnames, code.co_flags))
    for const in code.co_consts:
        if const is None or const != doc:
            yield from _parts(const, seen)


def _names(code: CodeType) -> Iterable[str]:
    inner = (const for const in code.co_consts if isinstance(const, CodeType))
    return chain(code.co_names, *(_names(each) for each in inner))
