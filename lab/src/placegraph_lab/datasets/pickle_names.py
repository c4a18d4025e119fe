"""What a published pickle may name: its data set's own classes, and what numpy arrays are made with.

A name means what stands here; nothing is imported, and nothing of Python's or numpy's own is handed
out to be called.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

_ARRAYS = [f"numpy.{core}" for core in ("core", "_core")]  # numpy 1, numpy 2
_NUMPY: Mapping[tuple[str, str], str] = {
    **{(f"{core}.multiarray", "_reconstruct"): "reconstruct" for core in _ARRAYS},
    **{(f"{core}.multiarray", "scalar"): "scalar" for core in _ARRAYS},
    **{(f"{core}.numeric", "_frombuffer"): "frombuffer" for core in _ARRAYS},
    ("numpy", "dtype"): "dtype",
    ("numpy", "ndarray"): "ndarray",
    ("_codecs", "encode"): "encode",  # protocol 2 writes bytes as text
    ("__builtin__", "bytes"): "bytes",  # and no bytes as this
}
"""Names that arrays and numbers are made with, and what they mean here."""

_DTYPES = frozenset(["f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "b1"])
_MOST_DIMENSIONS = 4


@dataclass(frozen=True)
class Release:
    """A published data set, as its pickles name it."""

    name: str
    module: str
    classes: tuple[str, ...]
    """Their instances become `Record`s."""

    @cached_property
    def names(self) -> Mapping[tuple[str, str], str]:
        """Every name that a file may say, and what it means here."""
        return {**_NUMPY, **{(self.module, name): name for name in self.classes}}


@dataclass(slots=True)
class Record:
    """An instance of one of the published classes: its name and its fields."""

    kind: str
    fields: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Name:
    """A name that the file said, as it is understood here."""

    meaning: str


@dataclass(slots=True)
class DType:
    """Type of an array's numbers; its byte order comes afterwards."""

    code: str
    order: str = "<"

    @property
    def dtype(self) -> np.dtype[Any]:
        """As numpy calls it."""
        return np.dtype(("<" if self.order in "=|" else self.order) + self.code)


@dataclass(slots=True)
class Array:
    """An array on its way: pickles make it empty and fill it afterwards."""

    value: NDArray[Any] | None = None


class RefusedError(Exception):
    """What is wrong, as the end of a sentence."""


class Machine(Protocol):
    """What the calls need to know of the machine that reads the pickle."""

    encoded: int
    """Bytes that were written as text, so far."""

    @property
    def size(self) -> int:
        """Bytes of the pickle."""


def array_of(raw: object, dtype: object, shape: object, order: object) -> NDArray[Any]:
    """View of the numbers, which must be there, all of them and no more."""
    if not isinstance(dtype, DType) or not isinstance(raw, bytes | memoryview):
        raise RefusedError("an array does not hold plain numbers")
    if (
        type(shape) is not tuple
        or len(shape) > _MOST_DIMENSIONS
        or not all(type(n) is int and 0 <= n < 1 << 40 for n in shape)
        or order not in ("C", "F")
    ):
        raise RefusedError("an array's shape is not understood")
    kind = dtype.dtype
    count = 1
    for n in shape:
        count *= n
    if count * kind.itemsize != len(raw):
        raise RefusedError(f"an array of shape {shape} has {len(raw)} bytes")
    try:
        array = np.frombuffer(raw, kind) if count else np.zeros(0, kind)
        array = array.reshape(shape, order=order)
    except ValueError as error:  # no numbers in more dimensions than there are addresses
        raise RefusedError("an array's shape is not understood") from error
    array.flags.writeable = False
    return array


def order_of(state: object) -> str:
    """Byte order in a dtype's state; structured and nested ones are refused."""
    if (
        type(state) is not tuple
        or not 2 <= len(state) <= 9
        or state[1] not in ("<", ">", "|", "=")
        or any(part is not None for part in state[2:5])
    ):
        raise RefusedError("a dtype is not one of plain numbers")
    return str(state[1])


def _reconstruct(_: Machine, arguments: tuple[Any, ...]) -> Array:
    if len(arguments) != 3 or arguments[0] != Name("ndarray"):
        raise RefusedError("an array is not made as numpy makes one")
    return Array()


def _frombuffer(_: Machine, arguments: tuple[Any, ...]) -> Array:
    if len(arguments) != 4:
        raise RefusedError("an array is not made as numpy makes one")
    return Array(array_of(*arguments))


def _dtype(_: Machine, arguments: tuple[Any, ...]) -> DType:
    if not arguments or type(arguments[0]) is not str or arguments[0] not in _DTYPES:
        raise RefusedError("a dtype is not one of plain numbers")
    return DType(arguments[0])


def _scalar(_: Machine, arguments: tuple[Any, ...]) -> Any:  # noqa: ANN401  # bool, int or float
    if len(arguments) != 2:
        raise RefusedError("a number is not made as numpy makes one")
    return array_of(arguments[1], arguments[0], (), "C").item()


def _encode(machine: Machine, arguments: tuple[Any, ...]) -> bytes:
    if (
        len(arguments) != 2
        or type(arguments[0]) is not str
        or arguments[1] not in ("latin1", "latin-1")
    ):
        raise RefusedError("it asks for a codec that bytes do not need")
    machine.encoded += len(arguments[0])
    if machine.encoded > machine.size:  # one text many times: it would fill the memory
        raise RefusedError("it holds more bytes than it is long")
    try:
        return arguments[0].encode("latin-1")
    except UnicodeEncodeError as error:
        raise RefusedError("bytes are written as text that is none") from error


def _no_bytes(_: Machine, arguments: tuple[Any, ...]) -> bytes:
    if arguments != ():
        raise RefusedError("bytes are made of something")
    return b""


CALLS: Mapping[str, Callable[[Machine, tuple[Any, ...]], Any]] = {
    "reconstruct": _reconstruct,
    "frombuffer": _frombuffer,
    "dtype": _dtype,
    "scalar": _scalar,
    "encode": _encode,
    "bytes": _no_bytes,
}
