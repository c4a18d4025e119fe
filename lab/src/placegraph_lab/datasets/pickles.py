"""Safe reader of published pickles: only the data set's classes and numpy arrays, no imports or calls."""

from __future__ import annotations

import mmap
import os
import pickle
import stat
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError

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
"""Names that make arrays and numbers, and their meanings here."""

_DTYPES = frozenset(["f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "b1"])
_MOST_DIMENSIONS = 4


@dataclass(frozen=True)
class Release:
    """A published data set, as its pickles name it."""

    name: str
    module: str
    classes: tuple[str, ...]  # their instances become `Record`s

    @cached_property
    def names(self) -> Mapping[tuple[str, str], str]:
        """Every allowed name and its meaning here."""
        return {**_NUMPY, **{(self.module, name): name for name in self.classes}}


@dataclass(slots=True)
class Record:
    """An instance of one of the published classes: its name and its fields."""

    kind: str
    fields: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Name:
    """Meaning of a name in the file."""

    meaning: str


@dataclass(slots=True)
class DType:
    """Type of an array's numbers; its byte order comes afterwards."""

    code: str
    order: str = "<"

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type in numpy."""
        return np.dtype(("<" if self.order in "=|" else self.order) + self.code)


@dataclass(slots=True)
class Array:
    """An array under construction: pickles make it empty and fill it afterwards."""

    value: NDArray[Any] | None = None


class RefusedError(Exception):
    """Reason why a pickle is refused, the end of a sentence."""


class Machine(Protocol):
    """State of the unpickler that calls need."""

    encoded: int  # bytes that were written as text, so far

    @property
    def size(self) -> int:
        """Bytes of the pickle."""


def array_of(raw: object, dtype: object, shape: object, order: object) -> NDArray[Any]:
    """Return the array of raw bytes, whose length must fit."""
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


def _scalar(_: Machine, arguments: tuple[Any, ...]) -> Any:  # noqa: ANN401
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


_Base: Any = pickle._Unpickler  # noqa: SLF001  # the one whose opcodes can be replaced


def read_pickle(path: str | os.PathLike[str], release: Release) -> Any:  # noqa: ANN401
    """Plain data of one pickle: lists, tuples, dicts, strings, numbers, `Record`s and arrays.

    Arrays are read-only.

    Raises `InputError`: the file is missing, empty, cut short, or no pickle of protocol 2 to 5; or
    it asks for anything else than the release's classes and numpy arrays. Nothing of it was run.
    """
    data = _mapped(Path(path))
    try:
        return unwrap_array(_Reader(data, release).load())
    except RefusedError as error:
        raise InputError(
            f"{path}, before byte {data.tell():,}: {error}. It is not a file of {release.name}, or "
            "it is damaged; nothing of it was run. Download it again from where you trust it."
        ) from None


def unwrap_array(value: Any) -> Any:  # noqa: ANN401
    """Return the array of an `Array`; other values unchanged."""
    return value.value if isinstance(value, Array) else value


def _mapped(path: Path) -> mmap.mmap:
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise InputError(f"{path} cannot be read: {why}.") from error
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{path} is not a plain file; name the pickle itself.")
        if not status.st_size:
            raise InputError(f"{path} is empty; download it again.")
        return mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ)
    finally:
        os.close(descriptor)


class _Reader(_Base):  # type: ignore[misc]  # untyped
    """Python's unpickler in Python, restricted to the names and calls of `CALLS`."""

    def __init__(self, data: mmap.mmap, release: Release) -> None:
        super().__init__(data)
        self.data, self.release, self.encoded, self.size = data, release, 0, len(data)

    def load(self) -> Any:  # noqa: ANN401
        """Value that the pickle leaves behind."""
        head = self.data[:2]
        if len(head) < 2 or head[0] != 0x80 or not 2 <= head[1] <= 5:
            raise RefusedError("it is not a pickle of protocol 2 to 5")
        try:
            return super().load()
        except RefusedError:
            raise
        except EOFError:
            raise RefusedError("the file ends here") from None
        except Exception as error:  # noqa: BLE001  # whatever damage leads to
            raise RefusedError(f"it is out of order ({type(error).__name__}: {error})") from None

    def find_class(self, module: str, name: str) -> Name:
        """Return the stand-in for a pickled name; nothing is imported."""
        meaning = self.release.names.get((module, name))
        if meaning is None:
            raise RefusedError(f"it asks for {module[:80]}.{name[:80]}")
        return Name(meaning)

    def make_record(self) -> None:
        """Make an instance of a published class."""
        arguments, cls = self.stack.pop(), self.stack.pop()
        if not (isinstance(cls, Name) and cls.meaning in self.release.classes and arguments == ()):
            raise RefusedError("it makes an object of no published class")
        self.stack.append(Record(cls.meaning))

    def call(self) -> None:
        """Carry out one of the few calls that arrays need."""
        arguments, function = self.stack.pop(), self.stack.pop()
        meaning = function.meaning if isinstance(function, Name) else None
        if meaning is None or meaning not in CALLS or type(arguments) is not tuple:
            raise RefusedError("it calls what is not to be called")
        self.stack.append(CALLS[meaning](self, arguments))

    def set_state(self) -> None:
        """Give a record its fields, an array its numbers, a dtype its byte order."""
        state, target = self.stack.pop(), self.stack[-1]
        if isinstance(target, Record):
            if type(state) is not dict or not all(type(key) is str for key in state):
                raise RefusedError(f"the state of a {target.kind} is not a dict of fields")
            target.fields.update(state)
        elif isinstance(target, Array) and target.value is None:
            if type(state) is not tuple or len(state) != 5:
                raise RefusedError("an array's state is not understood")
            _, shape, dtype, fortran, raw = state
            target.value = array_of(raw, dtype, shape, "F" if fortran is True else "C")
        elif isinstance(target, DType):
            plain = (
                type(state) is tuple and 2 <= len(state) <= 9 and state[1] in ("<", ">", "|", "=")
            )
            if not plain or any(part is not None for part in state[2:5]):
                raise RefusedError("a dtype is not one of plain numbers")
            target.order = str(state[1])
        else:
            raise RefusedError("it sets the state of what has none")

    def take_bytes(self) -> None:
        """Read bytes with their length before them; more than there are refused before any room is made."""
        (length,) = struct.unpack("<Q", self.read(8))
        if length > self.size:
            raise RefusedError("the file ends here")
        self.stack.append(bytes(self.read(length)))

    def refuse(self) -> None:
        """Refuse an opcode that plain data do not need."""
        raise RefusedError("an opcode is not one that plain data need")


_UNNEEDED = (
    pickle.PERSID, pickle.BINPERSID, pickle.INST, pickle.OBJ, pickle.NEWOBJ_EX, pickle.EXT1,
    pickle.EXT2, pickle.EXT4, pickle.NEXT_BUFFER, pickle.READONLY_BUFFER,
    pickle.EMPTY_SET, pickle.ADDITEMS, pickle.FROZENSET,
)  # fmt: skip
_OWN = {
    pickle.NEWOBJ: "make_record", pickle.REDUCE: "call", pickle.BUILD: "set_state",
    pickle.BYTEARRAY8: "take_bytes", pickle.BINBYTES8: "take_bytes",
}  # fmt: skip
_Reader.dispatch = {
    **_Base.dispatch,
    **{code[0]: getattr(_Reader, name) for code, name in _OWN.items()},
    **{code[0]: _Reader.refuse for code in _UNNEEDED},
}


RELEASE = Release("GOTPR", "scene_graph", ("SceneGraph", "Node"))  # the published classes
LONGEST = 4096  # numbers of a word vector at most


@dataclass(frozen=True, eq=False)
class Graph:
    """A scene graph of n nodes and e edges."""

    labels: tuple[str, ...]
    nodes: NDArray[np.int64]  # (n,) rows of `Graphs.vectors`
    ends: NDArray[np.int64]  # (2, e) source and target of each edge, rows of nodes
    edges: NDArray[np.int64]  # (e,) rows of `Graphs.vectors`: what the relation is called


@dataclass(frozen=True, eq=False)
class Graphs:
    """The graphs of one file."""

    graphs: dict[str, Graph]  # by their ids
    vectors: NDArray[np.float32]  # (V, d) word vectors, each once


def read_graphs(path: str | PathLike[str]) -> Graphs:
    """Read a file of scene graphs; nothing in it is run.

    Raises `InputError`: the file is missing, damaged, or no such pickle; or a graph is not what it
    should be: the message names its id and the field.
    """
    value = read_pickle(path, RELEASE)
    if type(value) is not dict or not value:
        raise InputError(f"{path} contains no graphs by id; download it again.")
    vectors = _Vectors()
    found = {str(key): _graph(graph, f"{path}, {key}", vectors) for key, graph in value.items()}
    return Graphs(found, np.stack(vectors.rows))


def file_of(folder: str | PathLike[str], pattern: str) -> Path:
    """Return the only file of a folder that fits a pattern; `InputError` where there is none or several."""
    found = sorted(Path(folder).glob(pattern))
    if len(found) != 1:
        what = f"{len(found)} files" if found else "no file"
        raise InputError(
            f"{folder} holds {what} {pattern}; name the folder `data` of GOTPR with one of them."
        )
    return found[0]


class _Vectors:
    """Word vectors, each kept once: released graphs repeat those of four relations by the million."""

    def __init__(self) -> None:
        self.rows: list[NDArray[np.float32]] = []
        self.known: dict[bytes, int] = {}
        self.seen: dict[int, int] = {}

    def row(self, value: Any, where: str) -> int:  # noqa: ANN401
        if id(value) not in self.seen:  # the whole file stays in memory: ids do not change hands
            vector = _vector(unwrap_array(value), where)
            if self.rows and len(vector) != len(self.rows[0]):
                raise InputError(
                    f"{where} has {len(vector)} numbers, others {len(self.rows[0])}; "
                    "download the file again."
                )
            key = vector.tobytes()
            if key not in self.known:
                self.known[key] = len(self.rows)
                self.rows.append(vector)
            self.seen[id(value)] = self.known[key]
        return self.seen[id(value)]


def _vector(value: object, where: str) -> NDArray[np.float32]:
    if isinstance(value, list | tuple) and all(type(x) in (int, float) for x in value):
        value = np.array(value, np.float64)
    if not isinstance(value, np.ndarray) or value.ndim != 1 or not 1 <= len(value) <= LONGEST:
        raise InputError(f"{where} is not a vector; download the file again.")
    if not (np.abs(value.astype(np.float64)) < 1e9).all():
        raise InputError(
            f"{where} contains something that is not a number; download the file again."
        )
    return value.astype(np.float32)


def _graph(value: object, where: str, vectors: _Vectors) -> Graph:
    nodes = _field(value, "SceneGraph", "nodes", dict, where)
    (sources, targets), features = _edges(value, where)
    rows: dict[int, int] = {}
    labels, words = [], []
    for row, (key, node) in enumerate(nodes.items()):
        at = f"{where}, node {key}"
        rows[_field(node, "Node", "idx", int, at)] = row
        labels.append(str(_field(node, "Node", "label", object, at)))
        features_of = _field(node, "Node", "features", object, at)
        words.append(vectors.row(features_of, f"{at}: features"))
    if len(rows) != len(nodes) or not nodes:
        raise InputError(f"{where}: nodes are missing or there twice; download the file again.")
    try:
        ends = [[rows[int(end)] for end in side] for side in (sources, targets)]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{where}: edge_idx names a node that is not there ({error}); download the file again."
        ) from error
    edges = [vectors.row(v, f"{where}: edge_features, {i}") for i, v in enumerate(features)]
    return Graph(
        tuple(labels),
        np.array(words, np.int64),
        np.array(ends, np.int64).reshape(2, -1),
        np.array(edges, np.int64),
    )


def _edges(value: object, where: str) -> tuple[list[list[Any]], list[Any]]:
    """Return the ends and the features of the edges."""
    ends = _field(value, "SceneGraph", "edge_idx", list, where)
    features = _field(value, "SceneGraph", "edge_features", list, where)
    if len(ends) != 2 or any(type(e) is not list or len(e) != len(features) for e in ends):
        raise InputError(
            f"{where}: edge_idx does not have two ends for each of {len(features)} edge_features; "
            "download the file again."
        )
    return ends, features


def _field(value: object, kind: str, name: str, type_: type, where: str) -> Any:  # noqa: ANN401
    """Return a field of a record; `InputError` for another record or type."""
    if not isinstance(value, Record) or value.kind != kind:
        raise InputError(f"{where} is not of type {kind}; download the file again.")
    if name not in value.fields:
        raise InputError(f"{where} has no {name}; is this another release of the data?")
    found = value.fields[name]
    if not isinstance(found, type_) or type(found) is bool:
        raise InputError(
            f"{where}: {name} is not of type {type_.__name__}; download the file again."
        )
    return found
