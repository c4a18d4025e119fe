"""Reader and writer of PLY meshes whose vertices or faces carry object ids."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import write_file
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.json_files import LabelEntry
from placegraph.io.mesh.model import (
    UNKNOWN,
    Z_UP,
    Model,
    ModelObject,
    Texture,
    read_bytes,
    triangulate_fans,
)

Ints = NDArray[np.int64]

OBJECT_ID = "objectId"
"""Property of a face that holds its object's id, as 3RScan calls it."""
OBJECT_PROPERTIES = (
    "objectid", "object_id", "object", "instanceid", "instance_id", "instance", "segment_id",
    "segmentid", "label", "label_id",
)  # fmt: skip
"""Names of properties that hold object ids, first come first; upper and lower case are alike."""
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


@dataclass(frozen=True, slots=True)
class _Property:
    name: str
    dtype: str  # without byte order
    count: str = ""  # type of a list's length; empty: a single number


@dataclass(frozen=True, slots=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """Numbers of an element, by property."""

    single: dict[str, NDArray[Any]] = field(default_factory=dict)
    """(N,) numbers in the file's own type."""
    lists: dict[str, tuple[Ints, NDArray[Any]]] = field(default_factory=dict)
    """Lengths (N,) and all entries, one list after the other."""


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
        What the ids are called: `placegraph.io.capture.json_files.read_label_table`.

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
    face = elements.get("face", Columns())
    vertices = np.stack([vertex.single[axis].astype(np.float64) for axis in "xyz"], axis=1)
    triangles, face_of = _read_triangles(path, face, len(vertices))
    ids = _read_object_ids(path, vertex, face, triangles, face_of, object_property)
    colours = _read_colours(path, vertex.single)
    if colours is None:
        by_face = _read_colours(path, face.single)
        if by_face is not None:  # colours belong to corners: faces no longer share them
            vertices = vertices[triangles.ravel()]
            colours = np.repeat(by_face[face_of], 3, axis=0)
            triangles = np.arange(len(vertices)).reshape(-1, 3)
    things, object_of, left_out = make_objects(ids, len(triangles), table or {})
    return Model(
        path=path,
        objects=things,
        vertices=vertices @ Z_UP.T if up == "y" else vertices,
        triangles=triangles,
        object_of=object_of,
        colours=np.full(vertices.shape, 255, np.uint8) if colours is None else colours,
        uv=np.zeros((len(vertices), 2)),
        picture_of=np.zeros(len(triangles), np.int64),
        pictures=(Texture(None),),
        left_out=left_out,
    )


def _read_triangles(path: Path, face: Columns, count: int) -> tuple[Ints, Ints]:
    """Return triangles (T, 3) of the faces, polygons as fans, and the face of each."""
    names = ("vertex_indices", "vertex_index")
    found = next((face.lists[name] for name in names if name in face.lists), None)
    if found is None:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    lengths, entries = found[0], found[1].astype(np.int64)
    if entries.size and not 0 <= int(entries.min()) <= int(entries.max()) < count:
        raise InputError(
            f"{path}: a face refers to a vertex outside 0 to {count - 1}; export it again."
        )
    corners, face_of = triangulate_fans(lengths)
    return entries[corners], face_of


def _read_object_ids(
    path: Path,
    vertex: Columns,
    face: Columns,
    triangles: Ints,
    face_of: Ints,
    wanted: str | None,
) -> Ints | None:
    """Return the object id of each triangle, -1 without one; None where the file has no ids."""
    names = OBJECT_PROPERTIES if wanted is None else (wanted.lower(),)
    for columns, by_face in ((face.single, True), (vertex.single, False)):
        known = {name.lower(): column for name, column in columns.items()}
        for name in names:
            if name in known:
                ids = to_integers(known[name])
                return ids[face_of] if by_face else majority_vote(ids[triangles])
    if wanted is not None:
        there = ", ".join(sorted(vertex.single.keys() | face.single.keys()))
        raise InputError(f"{path} has no property {wanted!r}; it has {there}.")
    return None


def to_integers(column: NDArray[Any]) -> Ints:
    """Return ids as int64, -1 where there is none."""
    if column.dtype.kind == "f":
        good = np.isfinite(column) & (np.abs(column) < 2**53)
        return np.where(good, np.where(good, column, 0), -1).astype(np.int64)
    ids = column.astype(np.int64)  # what uint64 holds beyond becomes negative: no id
    none = ids < 0
    if column.dtype.kind == "u":  # where -1 did not fit
        none |= column == np.iinfo(column.dtype).max
    return np.where(none, -1, ids)


def majority_vote(ids: Ints) -> Ints:
    """Return the value (T,) of two of three corners (T, 3), or else of the first."""
    a, b, c = ids.T
    voted: Ints = np.where(b == c, b, a)
    return voted


def _read_colours(path: Path, columns: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8] | None:
    """Convert red, green, blue to (N, 3) uint8: integers unchanged, fractions times 255."""
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


def make_objects(
    ids: Ints | None, count: int, table: Mapping[str, LabelEntry]
) -> tuple[tuple[ModelObject, ...], Ints, Counter[str]]:
    """Return objects, the object of each of `count` triangles, and what was left out.

    `ids` are those of the triangles, negative where there is none; None makes one unknown object.
    """
    if ids is None:
        return (ModelObject("0", UNKNOWN),), np.zeros(count, np.int64), Counter()
    unique, inverse = np.unique(ids, return_inverse=True)
    strange = not any(str(number) in table for number in unique.tolist())  # another file's table
    things: dict[str, ModelObject] = {}
    row = np.empty(len(unique), np.int64)
    rows: dict[str, int] = {}
    for i, number in enumerate(unique.tolist()):
        entry, id_ = table.get(str(number)), str(number)
        if number < 0 or (table and entry is None and not strange):
            id_, entry = UNKNOWN, None
        row[i] = rows.setdefault(id_, len(rows))
        things[id_] = (
            ModelObject(id_, UNKNOWN)
            if entry is None
            else ModelObject(id_, entry.label, entry.name, entry.attributes)
        )
    left_out: Counter[str] = Counter()
    if missing := sum(id_ not in things for id_ in table):
        left_out["labels of missing objects"] = missing
    return tuple(things.values()), row[inverse], left_out


def read_columns(path: Path) -> dict[str, Columns]:
    """Read the elements of a PLY file by name.

    Raises `InputError` where it is missing, not PLY, or shorter than its header announces.
    """
    data = read_bytes(path)
    if not data:
        raise InputError(f"{path} is empty; export it again.")
    end = data.find(b"end_header", 0, _MAX_HEADER)
    if not data.startswith(b"ply") or end < 0:
        raise InputError(
            f"{path} is not a PLY file: it lacks `ply` or `end_header`; export it again."
        )
    # nothing may follow, or lines may end with carriage returns alone
    at = data.find(b"\n", end, end + 32) + 1 or end + len(b"end_header\r")
    try:
        order, elements = _parse_header(data[:end].decode("latin-1").splitlines())
    except (KeyError, ValueError, IndexError) as error:
        raise InputError(
            f"{path}: its header cannot be parsed ({error!r}); export it again."
        ) from error
    if not order:
        data, at = _parse_numbers(path, data[at:]).tobytes(), 0
    found: dict[str, Columns] = {}
    for element in elements:
        try:
            found[element.name], at = _read_element(element, data, at, order)
        except (IndexError, ValueError, OverflowError) as error:
            raise InputError(
                f"{path} is truncated or damaged in its {element.count} {element.name} "
                "entries; copy it again."
            ) from error
    return found


def _parse_header(lines: list[str]) -> tuple[str, list[_Element]]:
    """Return byte order ("": text) and elements; KeyError, ValueError or IndexError for invalid lines."""
    order: list[str] = []
    elements: list[_Element] = []
    for line in lines:
        match line.split():
            case ["format", form, *_]:
                order.append(_ORDERS[form])
            case ["element", name, count]:
                elements.append(_Element(name, int(count), []))
            case ["property", "list", length, kind, name]:
                elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[length]))
            case ["property", kind, name]:
                elements[-1].properties.append(_Property(name, _TYPES[kind]))
            case ["element" | "property" | "format", *_]:
                raise ValueError(line)
    if not all(0 <= e.count < _MOST for e in elements):
        raise ValueError("an impossible count")
    return order[0], elements


def _parse_numbers(path: Path, body: bytes) -> NDArray[np.float64]:
    """Parse the numbers after the header; `InputError` for other words."""
    text = np.frombuffer(body.translate(_BLANKS), np.uint8)
    blank = text == ord(" ")
    words = int((blank[:-1] & ~blank[1:]).sum()) + int(bool(text.size and not blank[0]))
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            numbers: NDArray[np.float64] = np.fromstring(text.tobytes(), np.float64, sep=" ")
        except (DeprecationWarning, ValueError):
            numbers = np.zeros(0)
    if words and len(numbers) == words:
        return numbers
    tokens = body.split() or [b"0"]
    if max(map(len, tokens)) > _LONGEST_NUMBER:  # NumPy would make room for as much in every row
        raise InputError(f"{path} contains a value with too many digits; export it again.")
    try:
        return np.array(tokens).astype(np.float64)
    except ValueError as error:
        raise InputError(
            f"{path} contains a value that is not a number ({error}); export it again."
        ) from error


def _read_element(element: _Element, data: bytes, at: int, order: str) -> tuple[Columns, int]:
    """Return the columns of an element from byte `at` on, and its end; numbers of a text are float64.

    Rows as long as the first are read in one go, others one by one.
    """
    n, properties = element.count, element.properties
    kinds = [
        (order + (p.count or "u1"), order + p.dtype) if order else ("f8", "f8") for p in properties
    ]
    columns = Columns()
    if not n or not properties:
        values, lengths = [np.zeros(0)] * len(properties), [np.zeros(0, np.int64)] * len(properties)
    else:
        fields: list[tuple[str, str, tuple[int, ...]]] = []
        place, firsts = at, []
        for i, (p, (length_kind, kind)) in enumerate(zip(properties, kinds, strict=True)):
            length = 1
            if p.count:
                length = _read_length(data, place, length_kind)
                fields.append((f"n{i}", length_kind, ()))
                place += np.dtype(length_kind).itemsize
            fields.append((f"v{i}", kind, (length,) if p.count else ()))
            place += np.dtype(kind).itemsize * length
            firsts.append(length)
        row = np.dtype(fields)
        table = None
        if at + n * row.itemsize <= len(data):
            table = np.frombuffer(data, row, n, at)
            for i, (p, length) in enumerate(zip(properties, firsts, strict=True)):
                if p.count and not (table[f"n{i}"] == length).all():
                    table = None
                    break
        if table is not None:
            at += n * row.itemsize
            values = [table[f"v{i}"].ravel() for i in range(len(properties))]
            lengths = [np.full(n, length, np.int64) for length in firsts]
        else:
            values, lengths, at = _read_one_by_one(element, kinds, data, at)
    for p, numbers, counts in zip(properties, values, lengths, strict=True):
        column = _cast(numbers, p.dtype)
        if p.count:
            columns.lists[p.name] = counts, column
        else:
            columns.single[p.name] = column
    return columns, at


def _read_one_by_one(
    element: _Element, kinds: list[tuple[str, str]], data: bytes, at: int
) -> tuple[list[NDArray[Any]], list[Ints], int]:
    values: list[list[float]] = [[] for _ in kinds]
    counts: list[list[int]] = [[] for _ in kinds]
    types = [(np.dtype(length), np.dtype(kind)) for length, kind in kinds]
    for _ in range(element.count):
        for i, (length_type, kind) in enumerate(types):
            length = 1
            if element.properties[i].count:
                length = _read_length(data, at, kinds[i][0])
                at += length_type.itemsize
            if length:
                values[i] += np.frombuffer(data, kind, length, at).tolist()
            counts[i].append(length)
            at += length * kind.itemsize
    return [np.array(v) for v in values], [np.array(c, np.int64) for c in counts], at


def _read_length(data: bytes, at: int, dtype: str) -> int:
    """Check the length of a list; IndexError where it is negative or beyond the file."""
    kind = np.dtype(dtype)
    if at + kind.itemsize > len(data):
        raise IndexError(at)
    length = int(np.frombuffer(data, kind, 1, at)[0])
    if not 0 <= length <= len(data):
        raise IndexError(at)
    return length


def _cast(column: NDArray[Any], dtype: str) -> NDArray[Any]:
    """Cast numbers to the header's type; ValueError where they do not fit."""
    kind = np.dtype(dtype)
    if kind.kind != "f" and column.size and column.dtype.kind == "f":
        limits = np.iinfo(kind)
        if not (column.min() >= limits.min and column.max() <= limits.max):
            raise ValueError(dtype)
    with np.errstate(over="ignore"):
        return column.astype(kind)


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
            raise OptionError(f"{name}: shape is {column.shape}, expected {shape}.")
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
    coloured, owned = colours is not None, objects is not None
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {line}" for line in comments),
        f"element vertex {len(vertices)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {c}" for c in ("red", "green", "blue") if coloured),
        f"element face {len(triangles)}",
        "property list uchar int vertex_indices",
        *(f"property int {name}" for name in (OBJECT_ID,) if owned),
        "end_header\n",
    ]
    return write_file(path, ["\n".join(lines).encode("ascii"), rows.tobytes(), faces.tobytes()])
