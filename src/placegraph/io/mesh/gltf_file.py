"""The bytes of glTF files: chunks of a .glb, JSON, files beside it."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

from placegraph.core.files import regular
from placegraph.errors import InputError

Json = dict[str, Any]

MAGIC = 0x46546C67
_JSON, _BIN = 0x4E4F534A, 0x004E4942


def chunks_of(path: Path, data: memoryview) -> tuple[Json, memoryview]:
    """JSON and binary chunk of a .glb file; `InputError` where it is none."""
    if not len(data):
        raise InputError(f"{path} is empty; export it again.")
    if len(data) < 20 or struct.unpack_from("<I", data)[0] != MAGIC:
        if bytes(data[:1]) == b"{":
            raise InputError(f"{path} is glTF as text; let its name end in .gltf.")
        raise InputError(f"{path} is not glTF 2.0 binary; export it as one .glb file.")
    version, total = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise InputError(f"{path} is glTF {version}; export it as glTF 2.0.")
    if total > len(data):
        raise InputError(
            f"{path} has {len(data)} of {total} bytes: it is truncated; copy it again."
        )
    parts: dict[int, memoryview] = {}
    at = 12
    while at + 8 <= total:
        length, kind = struct.unpack_from("<II", data, at)
        if at + 8 + length > total:
            raise InputError(f"{path} ends within a chunk: it is damaged; copy it again.")
        parts.setdefault(kind, data[at + 8 : at + 8 + length])
        at += 8 + length + (-length % 4)
    return json_of(path, bytes(parts.get(_JSON, b""))), parts.get(_BIN, memoryview(b""))


def json_of(path: Path, data: bytes) -> Json:
    """The object that JSON text is; `InputError` where it is none."""
    try:
        content = json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path} has no JSON that can be read; copy or export it again."
        ) from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: its JSON is not an object; export it again.")
    return content


def content_of(path: Path) -> bytes:
    """Bytes of a file; `InputError` where it cannot be read."""
    try:
        return regular(path).read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist.") from error
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise InputError(f"{path} cannot be read: {why}.") from error
