"""PLY files as columns: header, then elements as text or binary of either byte order."""

from __future__ import annotations

import struct
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import regular
from placegraph.errors import InputError

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER = 1 << 20
_MOST = 1 << 31  # elements
_LONGEST_NUMBER = 64
_BLANKS = bytes.maketrans(b"\t\n\v\f\r", b"     ")
_BLANK = ord(" ")


@dataclass(frozen=True, slots=True)
class Property:
    """One property of an element."""

    name: str
    dtype: str
    """Without byte order."""
    count: str = ""
    """Type of a list's length; empty: a single number."""


@dataclass(frozen=True, slots=True)
class Element:
    """One element of the header, such as vertex or face."""

    name: str
    count: int
    properties: list[Property] = field(default_factory=list)


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """What was read of an element, by property."""

    single: dict[str, NDArray[Any]]
    """(N,) numbers in the file's own type."""
    lists: dict[str, tuple[NDArray[np.int64], NDArray[Any]]]
    """Lengths (N,) and all entries, one list after the other."""


def read_columns(path: Path) -> dict[str, Columns]:
    """Read a PLY file; elements by name.

    Raises `InputError` where it is missing, not PLY, or shorter than its header announces.
    """
    try:
        data = regular(path).read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist.") from error
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise InputError(f"{path} cannot be read: {why}.") from error
    order, elements, at = _header(path, data)
    found: dict[str, Columns] = {}
    tokens = _tokens(path, data[at:]) if not order else np.zeros(0)
    at = at if order else 0
    for element in elements:
        try:
            if order:
                found[element.name], at = _binary(element, data, at, order)
            else:
                found[element.name], at = _text(element, tokens, at)
        except (IndexError, struct.error, ValueError, OverflowError) as error:
            raise InputError(
                f"{path} ends within, or holds nonsense among, its {element.count} {element.name} "
                "entries: it is truncated or damaged; copy it again."
            ) from error
    return found


def _header(path: Path, data: bytes) -> tuple[str, list[Element], int]:
    """Byte order ("" for text), elements, and where they begin."""
    if not data:
        raise InputError(f"{path} is empty; export it again.")
    end = data.find(b"end_header", 0, _MAX_HEADER)
    if not data.startswith(b"ply") or end < 0:
        raise InputError(
            f"{path} is not a PLY file: it lacks `ply` or `end_header`; export it again."
        )
    begin = data.find(b"\n", end, end + 32) + 1
    if not begin:  # nothing follows, or lines end with carriage returns alone
        begin = end + len(b"end_header\r")
    try:
        order, elements = _parse(data[:end].decode("latin-1").splitlines())
    except (KeyError, ValueError, IndexError) as error:
        raise InputError(
            f"{path}: its header is not understood ({error!r}); export it again."
        ) from error
    return order, elements, begin


def _parse(lines: list[str]) -> tuple[str, list[Element]]:
    """Byte order and elements; KeyError, ValueError or IndexError where lines make no sense."""
    order: list[str] = []
    elements: list[Element] = []
    for line in lines:
        match line.split():
            case ["format", form, *_]:
                order.append(_ORDERS[form])
            case ["element", name, count]:
                elements.append(Element(name, int(count)))
            case ["property", "list", length, kind, name]:
                elements[-1].properties.append(Property(name, _TYPES[kind], _TYPES[length]))
            case ["property", kind, name]:
                elements[-1].properties.append(Property(name, _TYPES[kind]))
            case ["element" | "property" | "format", *_]:
                raise ValueError(line)
    if not all(0 <= e.count < _MOST for e in elements):
        raise ValueError("an impossible count")
    return order[0], elements


def _tokens(path: Path, body: bytes) -> NDArray[np.float64]:
    """Numbers of the text after the header; `InputError` where there are others."""
    text = np.frombuffer(body.translate(_BLANKS), np.uint8)
    words = int(np.count_nonzero(text[1:][text[:-1] == _BLANK] != _BLANK)) if text.size else 0
    words += bool(text.size and text[0] != _BLANK)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            numbers: NDArray[np.float64] = np.fromstring(text.tobytes(), np.float64, sep=" ")
        except (DeprecationWarning, ValueError):
            return _tokens_one_by_one(path, body)
    return numbers if words and len(numbers) == words else _tokens_one_by_one(path, body)


def _tokens_one_by_one(path: Path, body: bytes) -> NDArray[np.float64]:
    tokens = body.split() or [b"0"]
    if max(map(len, tokens)) > _LONGEST_NUMBER:  # NumPy would make room for as much in every row
        raise InputError(f"{path} holds what is no number (of many digits); export it again.")
    try:
        return np.array(tokens).astype(np.float64)
    except ValueError as error:
        raise InputError(f"{path} holds what is no number ({error}); export it again.") from error


def _text(element: Element, tokens: NDArray[np.float64], at: int) -> tuple[Columns, int]:
    """Columns from tokens: rows of one width in one go, others one by one."""
    n, properties = element.count, element.properties
    if not n:
        return _empty(element), at
    ends, lengths = [], []
    place = at
    for p in properties:  # as the first row is, all rows are tried
        length = int(tokens[place]) if p.count else 0
        place += 1 + length
        ends.append(place - at)
        lengths.append(length)
    width = ends[-1] if ends else 0
    rows = tokens[at : at + n * width]
    if rows.size == n * width:
        table = rows.reshape(n, width)
        starts = [end - length - 1 for end, length in zip(ends, lengths, strict=True)]
        counts = [(s, k) for s, k, p in zip(starts, lengths, properties, strict=True) if p.count]
        if all((table[:, s] == k).all() for s, k in counts):
            single, lists = {}, {}
            for p, start, end, length in zip(properties, starts, ends, lengths, strict=True):
                if p.count:
                    entries = table[:, start + 1 : end].ravel()
                    lists[p.name] = (np.full(n, length, np.int64), entries)
                else:
                    single[p.name] = _cast(table[:, start], p.dtype)
            return Columns(single, lists), at + n * width
    return _one_by_one(element, tokens, at)


def _one_by_one(element: Element, tokens: NDArray[np.float64], at: int) -> tuple[Columns, int]:
    numbers = tokens.tolist()
    values: list[list[float]] = [[] for _ in element.properties]
    counts: list[list[int]] = [[] for _ in element.properties]
    for _ in range(element.count):
        for i, p in enumerate(element.properties):
            length = int(numbers[at]) if p.count else 1
            at += 1 if p.count else 0
            if length < 0 or at + length > len(numbers):
                raise IndexError(at)
            values[i] += numbers[at : at + length]
            counts[i].append(length)
            at += length
    return _gathered(element, values, counts), at


def _binary(element: Element, data: bytes, at: int, order: str) -> tuple[Columns, int]:
    """Columns from bytes: rows of one size in one go, others one by one."""
    n, properties = element.count, element.properties
    if not n or not properties:
        return _empty(element), at
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    place, lengths = at, []
    for i, p in enumerate(properties):  # as the first row is, all rows are tried
        length = 1
        if p.count:
            length = _length(data, place, order + p.count)
            fields.append((f"n{i}", order + p.count, ()))
            place += np.dtype(p.count).itemsize
        fields.append((f"v{i}", order + p.dtype, (length,) if p.count else ()))
        place += np.dtype(p.dtype).itemsize * length
        lengths.append(length)
    row = np.dtype(fields)
    if at + n * row.itemsize <= len(data):
        table = np.frombuffer(data, row, n, at)
        single, lists = {}, {}
        for i, (p, length) in enumerate(zip(properties, lengths, strict=True)):
            if p.count and not (table[f"n{i}"] == length).all():
                break
            if p.count:
                lists[p.name] = (np.full(n, length, np.int64), table[f"v{i}"].ravel())
            else:
                single[p.name] = table[f"v{i}"].astype(p.dtype)
        else:
            return Columns(single, lists), at + n * row.itemsize
    return _bytes_one_by_one(element, data, at, order)


def _bytes_one_by_one(element: Element, data: bytes, at: int, order: str) -> tuple[Columns, int]:
    values: list[list[float]] = [[] for _ in element.properties]
    counts: list[list[int]] = [[] for _ in element.properties]
    codes = [(np.dtype(p.dtype).char, np.dtype(p.dtype).itemsize) for p in element.properties]
    for _ in range(element.count):
        for i, p in enumerate(element.properties):
            length = 1
            if p.count:
                length = _length(data, at, order + p.count)
                at += np.dtype(p.count).itemsize
            code, size = codes[i]
            if at + length * size > len(data):
                raise IndexError(at)
            values[i] += struct.unpack_from(f"{order}{length}{code}", data, at)
            counts[i].append(length)
            at += length * size
    return _gathered(element, values, counts), at


def _length(data: bytes, at: int, dtype: str) -> int:
    """Length of a list; IndexError where it is negative or lies beyond the file."""
    kind = np.dtype(dtype)
    if at + kind.itemsize > len(data):
        raise IndexError(at)
    length = int(np.frombuffer(data, kind, 1, at)[0])
    if not 0 <= length <= len(data):
        raise IndexError(at)
    return length


def _gathered(element: Element, values: list[list[float]], counts: list[list[int]]) -> Columns:
    single, lists = {}, {}
    for p, entries, lengths in zip(element.properties, values, counts, strict=True):
        column = _cast(np.array(entries, np.float64), p.dtype)
        if p.count:
            lists[p.name] = (np.array(lengths, np.int64), column)
        else:
            single[p.name] = column
    return Columns(single, lists)


def _cast(column: NDArray[np.float64], dtype: str) -> NDArray[Any]:
    """Numbers of a text file in the type its header says; ValueError where they do not fit."""
    kind = np.dtype(dtype)
    if kind.kind == "f":
        with np.errstate(over="ignore"):
            return column.astype(kind)
    limits = np.iinfo(kind)
    if column.size and not (column.min() >= limits.min and column.max() <= limits.max):
        raise ValueError(dtype)
    return column.astype(kind)


def _empty(element: Element) -> Columns:
    none = np.zeros(0, np.int64)
    return Columns(
        {p.name: np.zeros(0, p.dtype) for p in element.properties if not p.count},
        {p.name: (none, np.zeros(0, p.dtype)) for p in element.properties if p.count},
    )
