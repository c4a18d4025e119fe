"""Messages as bytes, and their definitions as text."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.errors import MissingExtraError, OptionError
from placegraph_io.ros.decode import typestore
from placegraph_ros.message import Message

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


def cdr(message: Message) -> bytes:
    """A message as ROS 2 sends it: CDR, little endian, with its head.

    Raises
    ------
    OptionError
        Its type is unknown, or a field is not what the type's definition says.
    MissingExtraError
        `rosbags` is not installed.

    """
    return encoded(message, "cdr")


def encoded(message: Message, encoding: str) -> bytes:
    """A message as `cdr`, or as `ros1` writes it; raises as `cdr` does."""
    store = known(encoding)
    kind = known_type(message.type, store)
    serialize = store.serialize_ros1 if encoding == "ros1" else store.serialize_cdr
    try:
        return bytes(serialize(_maker(kind, encoding)(message.fields), kind))
    except OptionError:
        raise
    except Exception as error:  # what generated code raises at other values is anything
        raise OptionError(
            f"{message.topic}: a field of {message.type} is not what its definition says "
            f"({type(error).__name__}: {error})."
        ) from error


def definition(kind: str) -> str:
    """Definition of a type and of all types in it, as the schema `ros2msg` of MCAP wants it.

    Raises `OptionError` where the type is unknown, `MissingExtraError` without `rosbags`.
    """
    store = known("cdr")
    text, _ = store.generate_msgdef(known_type(kind, store), ros_version=2)
    return text


def known(encoding: str) -> Typestore:
    """All types; `MissingExtraError` where `rosbags` is not installed."""
    try:
        return typestore(encoding)
    except ImportError as error:
        raise MissingExtraError(
            'Messages of ROS need the extra `ros`: pip install "placegraph[ros]".'
        ) from error


def known_type(kind: str, store: Typestore) -> str:
    """Type as the store names it; `OptionError` where there is none."""
    name = kind if "/msg/" in kind else kind.replace("/", "/msg/")
    if name not in store.fielddefs:
        raise OptionError(f"type: {kind!r} is no message that ROS or placegraph defines.")
    return name


@lru_cache(maxsize=256)
def _maker(kind: str, encoding: str) -> Callable[[Mapping[str, Any]], Any]:
    """What makes a message of `rosbags` of fields; those that are left out are zero or empty."""
    store = typestore(encoding)
    cls: Any = store.types[kind]
    fields = store.fielddefs[kind][1]
    # ROS 1 writes some in capitals
    parts = [(name, name.lower(), _part(what, encoding)) for name, what in fields]
    names = {lower for _, lower, _ in parts}

    def made(given: Mapping[str, Any]) -> Any:  # noqa: ANN401  # of rosbags
        held = {name.lower(): value for name, value in given.items()}
        if not held.keys() <= names:
            unknown = ", ".join(sorted(held.keys() - names))
            raise OptionError(f"fields: {kind} has no {unknown}.")
        return cls(**{name: make(held.get(lower)) for name, lower, make in parts})

    return made


def _part(described: Any, encoding: str) -> Callable[[Any], Any]:  # noqa: ANN401  # of rosbags
    """What makes one field of a value, or of None."""
    from rosbags.interfaces import Nodetype

    node, what = described
    if node == Nodetype.BASE:
        empty: Any = "" if what[0] == "string" else 0
        return lambda value: empty if value is None else value
    if node == Nodetype.NAME:
        return lambda value: _maker(what, encoding)({} if value is None else value)
    (inner, name), length = what
    if inner == Nodetype.NAME:
        return lambda value: [_maker(name, encoding)(part) for part in value or ()]
    if name[0] == "string":
        return lambda value: list(value or ())
    kind = np.dtype("u1" if name[0] in {"octet", "byte", "char"} else name[0])
    size = length if node == Nodetype.ARRAY else 0
    return lambda value: np.zeros(size, kind) if value is None else np.asarray(value, kind).ravel()
