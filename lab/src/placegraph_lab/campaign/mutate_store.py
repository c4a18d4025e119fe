"""Stores made wrong where it means something: in columns, metadata or head, with all checksums."""

from __future__ import annotations

import hashlib
import json
import tempfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

from placegraph.core.mapfile import DIGEST, MAGIC, PREFIX, read_map
from placegraph_lab.campaign.mutate_bytes import flipped
from placegraph_lab.campaign.mutate_json import changed


def restored(data: bytes, rng: Generator) -> bytes:
    """Columns, metadata or head of a store changed, with all checksums."""
    if rng.random() < 0.15:
        _, layout, length, _ = PREFIX.unpack_from(data)
        text = changed(data[PREFIX.size : PREFIX.size + length], rng)
        return _sealed(text, data[PREFIX.size + length : -DIGEST], layout)
    with tempfile.NamedTemporaryFile() as file:
        file.write(data)
        file.flush()
        head = json.loads(data[PREFIX.size : PREFIX.size + PREFIX.unpack_from(data)[2]])
        arrays = dict(read_map(Path(file.name), head["kind"], 1 << 30).arrays)
    if rng.random() < 0.2:
        head["meta"] = json.loads(changed(json.dumps(head["meta"]).encode(), rng))
    else:
        for _ in range(1 + int(rng.integers(2))):
            changed_column(arrays, rng)
    head["arrays"], body = [], b""
    for name, array in arrays.items():
        block = np.ascontiguousarray(array).tobytes()
        head["arrays"].append({
            "name": name, "dtype": array.dtype.str, "shape": array.shape, "codec": "raw",
            "filter": "none", "offset": len(body), "length": len(block), "crc32": zlib.crc32(block),
        })  # fmt: skip
        body += block
    return _sealed(json.dumps(head).encode(), body, 1)


def _sealed(text: bytes, body: bytes, layout: int) -> bytes:
    whole = PREFIX.pack(MAGIC, layout, len(text), zlib.crc32(text)) + text + body
    return whole + hashlib.sha256(whole).digest()


def changed_column(arrays: dict[str, Any], rng: Generator) -> None:
    """Change numbers, length, type or shape of one column; take it away, or another's for it."""
    name, other = (str(rng.choice(sorted(arrays))) for _ in range(2))
    array, kind = arrays[name].copy(), max(int(rng.integers(20)) - 8, 0)
    n = len(array)
    if kind < 5 and array.size:
        flat = array.reshape(-1)
        rows = rng.integers(0, flat.size, max(1, int(rng.choice([1, 1, 3, flat.size // 2]))))
        flat[rows] = _extreme(array.dtype, rng) if kind < 4 else rng.permutation(flat[rows])
    elif kind == 5:
        array = array[: int(rng.integers(n + 1))]
    elif kind == 6:
        array = np.concatenate([array, array[: int(rng.integers(n + 1))]])
    elif kind == 7:
        array = arrays[other]
    elif kind == 8:
        array = array.astype(rng.choice(["<f4", "<i8", "|u1", "<f8", "<u4"]), casting="unsafe")
    elif kind == 9:
        array = array.reshape(*array.shape, 1) if rng.integers(2) else array.reshape(-1)
    elif kind == 10:
        array = np.frombuffer(flipped(array.tobytes(), rng), np.uint8)
        whole = len(array) // arrays[name].itemsize * arrays[name].itemsize
        array = array[:whole].view(arrays[name].dtype)
    arrays[name] = array
    if kind == 11:
        del arrays[name]


def _extreme(dtype: np.dtype[Any], rng: Generator) -> Any:  # noqa: ANN401
    if dtype.kind == "f":
        return rng.choice(np.array([0, -1, np.nan, np.inf, -np.inf, 1e30, -1e30, 1e-30], dtype))
    if dtype.kind == "b":
        return bool(rng.integers(2))
    limits = np.iinfo(dtype)
    near = [0, 1, limits.min, limits.max, limits.max - 1, limits.max // 2, 255 & limits.max]
    return np.array(near[rng.integers(len(near))], dtype)
