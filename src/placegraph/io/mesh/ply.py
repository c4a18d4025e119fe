"""Reader and writer of PLY meshes whose vertices or faces carry object ids."""

from __future__ import annotations

import struct
import warnings
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import regular, write_file
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.json_files import LabelEntry
from placegraph.io.mesh.gltf import Z_UP
from placegraph.io.mesh.model import Model, Picture, Thing

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


OBJECT_PROPERTIES = (
    "objectid", "object_id", "object", "instanceid", "instance_id", "instance", "segment_id",
    "segmentid", "label", "label_id",
)  # fmt: skip
"""Names of properties that hold object ids, first come first; upper and lower case are alike."""
UNKNOWN = "unknown"  # Id and label of the object made of faces that belong to none


def read_ply(
    path: str | PathLike[str],
    *,
    up: Literal["y", "z"] = "z",
    object_property: str | None = None,
    table: Mapping[str, LabelEntry] | None = None,
) -> Model:
    """Read a PLY mesh, text or binary.

    A face belongs to the object its own property names, else to the one most of its vertices name
    (all different: the first). Faces without an object (a negative id, the largest of an unsigned
    type, an id that a given table with others does not hold) become one object "unknown".

    Parameters
    ----------
    up
        Axis that points up in it.
    object_property
        Property of faces or vertices that holds object ids; one of `OBJECT_PROPERTIES` if not given.
    table
        What the ids are called: `placegraph.io.capture.json_files.label_table`.

    Raises
    ------
    InputError
        The file is missing, truncated, not PLY, holds no vertex positions, or lacks the property.

    """
    path = Path(path)
    elements = read_columns(path)
    vertex = elements.get("vertex")
    if vertex is None or not {"x", "y", "z"} <= vertex.single.keys():
        raise InputError(f"{path} has no vertices with x, y, z; export it as a mesh.")
    face = elements.get("face", Columns({}, {}))
    vertices = np.stack([vertex.single[axis].astype(np.float64) for axis in "xyz"], axis=1)
    triangles, face_of = _triangles(path, face, len(vertices))
    ids = _object_ids(path, vertex, face, triangles, face_of, object_property)
    colours = _colours(path, vertex.single)
    if colours is None:
        by_face = _colours(path, face.single)
        if by_face is not None:  # colours belong to corners: faces no longer share them
            vertices = vertices[triangles.ravel()]
            colours = np.repeat(by_face[face_of], 3, axis=0)
            triangles = np.arange(len(vertices)).reshape(-1, 3)
    things, thing_of, left_out = things_of_ids(ids, len(triangles), table or {})
    return Model(
        path=path,
        things=things,
        vertices=vertices @ Z_UP.T if up == "y" else vertices,
        triangles=triangles,
        thing_of=thing_of,
        colours=np.full(vertices.shape, 255, np.uint8) if colours is None else colours,
        uv=np.zeros((len(vertices), 2)),
        picture_of=np.zeros(len(triangles), np.int64),
        pictures=(Picture(None),),
        left_out=left_out,
    )


def _triangles(
    path: Path, face: Columns, count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Triangles (T, 3) of the faces, polygons as fans, and the face of each."""
    names = ("vertex_indices", "vertex_index")
    found = next((face.lists[name] for name in names if name in face.lists), None)
    if found is None:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    lengths, entries = found[0], found[1].astype(np.int64)
    if entries.size and not 0 <= int(entries.min()) <= int(entries.max()) < count:
        raise InputError(
            f"{path}: a face names a vertex outside 0 to {count - 1}; export it again."
        )
    starts = np.cumsum(lengths) - lengths
    fans = np.maximum(lengths - 2, 0)
    face_of = np.repeat(np.arange(len(lengths)), fans)
    step = np.arange(len(face_of)) - np.repeat(np.cumsum(fans) - fans, fans)
    first = starts[face_of]
    corners = [entries[first], entries[first + step + 1], entries[first + step + 2]]
    return np.stack(corners, axis=1), face_of


def _object_ids(
    path: Path,
    vertex: Columns,
    face: Columns,
    triangles: NDArray[np.int64],
    face_of: NDArray[np.int64],
    wanted: str | None,
) -> NDArray[np.int64] | None:
    """Object id of each triangle, -1 where it has none; None where the file has no ids."""
    names = OBJECT_PROPERTIES if wanted is None else (wanted.lower(),)
    for columns, by_face in ((face.single, True), (vertex.single, False)):
        known = {name.lower(): column for name, column in columns.items()}
        for name in names:
            if name in known:
                ids = whole(known[name])
                return ids[face_of] if by_face else majority(ids[triangles])
    if wanted is not None:
        there = ", ".join(sorted(vertex.single.keys() | face.single.keys()))
        raise InputError(f"{path} has no property {wanted!r}; it has {there}.")
    return None


def whole(column: NDArray[Any]) -> NDArray[np.int64]:
    """Ids as int64, -1 where there is none."""
    if column.dtype.kind == "f":
        good = np.isfinite(column) & (np.abs(column) < 2**53)
        return np.where(good, np.where(good, column, 0), -1).astype(np.int64)
    top = np.iinfo(column.dtype).max
    ids = column.astype(np.int64)  # what uint64 holds beyond becomes negative: no id
    none = ids < 0
    if column.dtype.kind == "u":  # where -1 did not fit
        none |= column == top
    return np.where(none, -1, ids)


def majority(ids: NDArray[np.int64]) -> NDArray[np.int64]:
    """(T,) what two of three corners (T, 3) say, or else the first."""
    a, b, c = ids.T
    voted: NDArray[np.int64] = np.where(b == c, b, a)
    return voted


def _colours(path: Path, columns: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8] | None:
    """(N, 3) uint8 of red, green, blue: integers as they are, fractions times 255."""
    for prefix in ("", "diffuse_"):
        names = [f"{prefix}{c}" for c in ("red", "green", "blue")]
        if set(names) <= columns.keys():
            stacked: NDArray[Any] = np.stack([columns[name] for name in names], axis=1)
            if stacked.dtype.kind == "f":
                if not np.isfinite(stacked).all():
                    raise InputError(f"{path}: a colour is not a number; export it again.")
                stacked = np.rint(stacked * (255.0 if stacked.max(initial=0.0) <= 1.0 else 1.0))
            elif stacked.dtype == np.uint16:
                stacked = stacked >> 8
            colours: NDArray[np.uint8] = np.clip(stacked, 0, 255).astype(np.uint8)
            return colours
    return None


def things_of_ids(
    ids: NDArray[np.int64] | None, count: int, table: Mapping[str, LabelEntry]
) -> tuple[tuple[Thing, ...], NDArray[np.int64], Counter[str]]:
    """Things, the thing of each of `count` triangles, and what was left out.

    `ids` are those of the triangles, negative where there is none; None makes one unknown thing.
    """
    if ids is None:
        return (Thing("0", UNKNOWN),), np.zeros(count, np.int64), Counter()
    unique, inverse = np.unique(ids, return_inverse=True)
    strange = not any(str(number) in table for number in unique.tolist())  # another file's table
    things: list[Thing] = []
    row = np.empty(len(unique), np.int64)
    unknown = -1
    for i, number in enumerate(unique.tolist()):
        entry = table.get(str(number))
        if number < 0 or (table and entry is None and not strange):
            if unknown < 0:
                unknown = len(things)
                things.append(Thing(UNKNOWN, UNKNOWN))
            row[i] = unknown
            continue
        row[i] = len(things)
        things.append(
            Thing(str(number), UNKNOWN)
            if entry is None
            else Thing(str(number), entry.label, entry.name, entry.attributes)
        )
    found = {t.id for t in things}
    left_out: Counter[str] = Counter()
    missing = sum(id_ not in found for id_ in table)
    if missing:
        left_out["labels of objects that are not there"] = missing
    return tuple(things), row[inverse], left_out


OBJECT_ID = "objectId"  # Property of a face that holds its object's id, as 3RScan calls it


def write_ply(
    path: str | PathLike[str],
    vertices: NDArray[Any],
    triangles: NDArray[Any],
    colours: NDArray[np.uint8] | None = None,
    *,
    objects: NDArray[Any] | None = None,
    comments: tuple[str, ...] = (),
) -> Path:
    """Write a mesh as binary PLY; the old file stays until the new one is complete.

    Parameters
    ----------
    vertices
        (V, 3) [m], written as float32.
    triangles
        (T, 3) rows of vertices.
    colours
        (V, 3) uint8, sRGB.
    objects
        (T,) whole numbers below 2^31, written as `objectId` of each face.
    comments
        Lines of the header.

    Raises
    ------
    OptionError
        Arrays do not fit each other, or a comment is not one line of ASCII.
    MapError, MapLockedError
        The file cannot be written.

    """
    for name, column, shape in (
        ("vertices", vertices, (len(vertices), 3)),
        ("triangles", triangles, (len(triangles), 3)),
        ("colours", colours, (len(vertices), 3)),
        ("objects", objects, (len(triangles),)),
    ):
        if column is not None and column.shape != shape:
            raise OptionError(f"{name}: shape {column.shape} where {shape} belongs.")
    if not all(line.isascii() and line.isprintable() for line in comments):
        raise OptionError(f"comments: {comments!r}; a comment is one line of ASCII.")
    points = [("at", "<f4", 3)] + ([] if colours is None else [("colour", "u1", 3)])
    rows = np.empty(len(vertices), points)
    rows["at"] = vertices
    if colours is not None:
        rows["colour"] = colours
    corners = [("count", "u1"), ("corners", "<i4", 3)]
    faces = np.empty(len(triangles), corners + ([] if objects is None else [("object", "<i4")]))
    faces["count"], faces["corners"] = 3, triangles
    if objects is not None:
        faces["object"] = objects
    head = _head(len(vertices), len(triangles), colours is not None, objects is not None, comments)
    return write_file(path, [head.encode("ascii"), rows.tobytes(), faces.tobytes()])


def _head(
    vertices: int, triangles: int, coloured: bool, owned: bool, comments: tuple[str, ...]
) -> str:
    """Header of a file of so many vertices and triangles."""
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {line}" for line in comments),
        f"element vertex {vertices}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {c}" for c in ("red", "green", "blue") if coloured),
        f"element face {triangles}",
        "property list uchar int vertex_indices",
        *(f"property int {name}" for name in (OBJECT_ID,) if owned),
        "end_header\n",
    ]
    return "\n".join(lines)
