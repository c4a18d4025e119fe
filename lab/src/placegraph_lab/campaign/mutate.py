"""Files and folders made wrong, in ways that fit what they are: `spoil` changes one where it lies.

What a reader checks first is put right again afterwards: checksums of stores and PNGs, sizes of
ZIPs, chunks of GLB and PBF, so that what lies behind is reached.
"""

from __future__ import annotations

import bz2
import gzip
import io
import json
import os
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.random import Generator

from placegraph.core.files import regular
from placegraph.core.mapfile import DIGEST, MAGIC
from placegraph.errors import InputError
from placegraph_lab.campaign.mutate_bytes import flipped, remapped, remarked, reworded
from placegraph_lab.campaign.mutate_json import changed
from placegraph_lab.campaign.mutate_store import changed_column, restored

if TYPE_CHECKING:
    Change = Callable[[bytes, Generator], bytes]

TEXTS = {"txt", "csv", "tum", "obj", "mtl", "ply", "tsv", "yaml", "pgm", "traj", "pincam", "http"}
JSONS = {"json", "gltf", "jsonl", "geojson", "request"}
XMLS = {"osm", "osmag", "xml"}


def spoil(place: Path, rng: Generator) -> None:
    """Change a file, or one to three files of a folder, or what the folder holds."""
    if place.is_file():
        _spoil_file(place, rng)
        return
    files = sorted(p for p in place.rglob("*") if p.is_file())
    if rng.random() < 0.1:
        _rearrange(files[rng.integers(len(files))], files[rng.integers(len(files))], rng)
        return
    # what says how the rest is to be read is changed as often as all images together
    small = [p for p in files if p.suffix not in {".png", ".jpg", ".mp4"}]
    for _ in range(1 + int(rng.integers(3) == 0)):
        among = small if small and rng.random() < 0.7 else files
        _spoil_file(among[rng.integers(len(among))], rng)


def spoil_world(folder: Path, rng: Generator) -> None:
    """Change a world in shards, and let `world.json` tell the digests that its files have now."""
    spoil(folder, rng)
    senseless = OSError, RecursionError, LookupError, TypeError, ValueError, AttributeError
    with suppress(InputError, *senseless):
        told = json.loads(regular(folder / "world.json").read_bytes())
        for entry in (told["words"], *told["shards"]):
            entry["digest"] = regular(folder / entry["file"]).read_bytes()[-DIGEST:].hex()
        (folder / "world.json").write_text(json.dumps(told), "utf-8")


def _spoil_file(path: Path, rng: Generator) -> None:
    path.write_bytes(spoiled(path.read_bytes(), path.name, rng))


def _rearrange(one: Path, other: Path, rng: Generator) -> None:
    """Take a file away, or put another, a folder, a pipe or a link in its place."""
    kind = int(rng.integers(8))
    if kind == 1:
        one.write_bytes(other.read_bytes())
        return
    if kind == 2:
        shutil.copy(one, one.with_name(f"copy {one.name}"))
        return
    if kind == 3:
        one.rename(one.with_name(one.name[::-1] if rng.integers(2) else f"\x1b{one.name}"))
        return
    one.unlink()
    if kind == 4:
        one.mkdir()
    elif kind == 5:
        os.mkfifo(one)
    elif kind == 6:
        one.symlink_to(one if rng.integers(2) else "/dev/zero")
    elif kind == 7:
        one.touch()


def spoiled(data: bytes, name: str, rng: Generator) -> bytes:
    """Bytes of a file of this name, changed."""
    change = flipped if rng.random() < 0.25 else _fitting(data, name, rng)
    try:
        return change(data, rng)
    except Exception:  # noqa: BLE001  # what a spoiled file may lead to: its bytes are changed instead
        return flipped(data, rng)


def _fitting(data: bytes, name: str, rng: Generator) -> Change:
    ending = name.rpartition(".")[2].lower()
    told = {
        MAGIC: restored, b"PK": _zip, b"\x89PNG\r\n": _png, b"glTF": _glb,
        b"SQLite format 3": _database, b"\x1f\x8b": lambda d, g: _packed(d, name, gzip, g),
        b"\x93NUMPY": _column, b"PAR1": _parquet, b"BZh": lambda d, g: _packed(d, name, bz2, g),
    }  # fmt: skip
    for magic, change in told.items():
        if data.startswith(magic):
            return change
    if ending == "pbf":
        return _pbf
    if ending in JSONS or name == "metadata":
        return _json
    if ending in XMLS:
        return remapped if b"<osm" in data[:400] and rng.random() < 0.6 else remarked
    if ending in TEXTS and b"\0" not in data[:4096]:
        return reworded
    return flipped


def _json(data: bytes, rng: Generator) -> bytes:
    lines = data.split(b"\n")
    if len(lines) > 2 and lines[0].startswith(b"{") and lines[0].endswith(b"}"):  # one a line
        at = int(rng.integers(len(lines)))
        lines[at] = changed(lines[at], rng)
        return b"\n".join(lines)
    return changed(data, rng)


def _packed(data: bytes, name: str, packer: Any, rng: Generator) -> bytes:  # noqa: ANN401
    whole: bytes = packer.compress(spoiled(packer.decompress(data), name.rpartition(".")[0], rng))
    return whole


def _png(data: bytes, rng: Generator) -> bytes:
    """One chunk changed, with its checksum."""
    chunks, at = [], 8
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    k = 0 if rng.random() < 0.4 else int(rng.integers(len(chunks)))
    chunks[k] = chunks[k][0], flipped(chunks[k][1], rng)
    return data[:8] + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )


def _column(data: bytes, rng: Generator) -> bytes:
    """A NumPy array with other numbers, more or fewer."""
    arrays = {"": np.load(io.BytesIO(data))}
    changed_column(arrays, rng)
    out = io.BytesIO()
    np.save(out, arrays[""])
    return out.getvalue()


def _parquet(data: bytes, rng: Generator) -> bytes:
    """A row of a table changed in its values, or a column of it gone, renamed or of another type."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(io.BytesIO(data))
    at, kind = int(rng.integers(table.num_columns)), int(rng.integers(8))
    field, values = table.schema.field(at), table.column(at).to_pylist()
    row = int(rng.integers(len(values)))
    if kind == 0:
        table = table.remove_column(at)
    elif kind == 1:
        table = table.set_column(at, field.name, pa.array([str(v) for v in values]))
    else:
        held = values[row]
        values[row] = None if kind == 2 else flipped(held, rng) if isinstance(held, bytes) else (
            json.loads(changed(json.dumps(held).encode(), rng)))  # fmt: skip
        table = table.set_column(at, field, pa.array(values, None if kind == 3 else field.type))
    out = io.BytesIO()
    pq.write_table(table, out, row_group_size=1 + int(rng.integers(4)))
    return out.getvalue()


def _glb(data: bytes, rng: Generator) -> bytes:
    """JSON or binary chunk changed, with the lengths before them."""
    (length,) = struct.unpack_from("<I", data, 12)
    text, rest = data[20 : 20 + length], data[28 + length :]
    if rng.random() < 0.8:
        text = changed(text, rng)
        text += b" " * (-len(text) % 4)
    else:
        rest = flipped(rest, rng)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(rest), b"BIN\0") + rest
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _pbf(data: bytes, rng: Generator) -> bytes:
    """One block changed inside of its compression."""
    blocks, at = [], 0
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        head = data[at + 4 : at + 4 + length]
        kind = b"OSMHeader" if b"OSMHeader" in head else b"OSMData"
        size, shift = 0, 0
        for byte in head[head.rindex(kind) + len(kind) + 1 :]:  # the last field: datasize
            size |= (byte & 127) << shift
            shift += 7
        at += 4 + length
        blob = data[at : at + size]
        packed = blob.find(b"\x78")
        blocks.append((kind, zlib.decompress(blob[packed:]) if packed >= 0 else blob))
        at += size
    k = int(rng.integers(len(blocks)))
    blocks[k] = blocks[k][0], flipped(blocks[k][1], rng)
    return b"".join(_pbf_block(kind, body) for kind, body in blocks)


def _pbf_block(kind: bytes, body: bytes) -> bytes:
    packed = zlib.compress(body, 1)
    blob = b"\x10" + _varint(len(body)) + b"\x1a" + _varint(len(packed)) + packed
    head = b"\x0a" + _varint(len(kind)) + kind + b"\x18" + _varint(len(blob))
    return struct.pack(">I", len(head)) + head + blob


def _varint(number: int) -> bytes:
    out = b""
    while number > 127:
        out += bytes([number & 127 | 128])
        number >>= 7
    return out + bytes([number])


def _zip(data: bytes, rng: Generator) -> bytes:
    """An entry changed, renamed, doubled, gone, made a link or a bomb."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = [(info, archive.read(info)) for info in archive.infolist()]
    k, kind = int(rng.integers(len(entries))), int(rng.integers(8))
    info, body = entries[k]
    if kind < 3:
        entries[k] = info, spoiled(body, info.filename, rng)
    elif kind == 3:
        names = ["", "/", "../up", "a/../../b", "\0", "x" * 300, "con", info.filename.upper()]
        entries[k] = _entry(str(rng.choice(names))), body
    elif kind == 4:
        entries.append(entries[k])
    elif kind == 5:
        del entries[k]
    elif kind == 6:
        info.external_attr = 0o120777 << 16
    else:
        entries[k] = info, bytes(20_000_000)
    out = io.BytesIO()
    with suppress(UserWarning), zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for info, body in entries:
            archive.writestr(_entry(info.filename, info.external_attr), body)
    return flipped(out.getvalue(), rng) if rng.random() < 0.1 else out.getvalue()


def _entry(name: str, attributes: int = 0) -> zipfile.ZipInfo:
    made = zipfile.ZipInfo("x")
    made.filename, made.external_attr = name, attributes
    made.compress_type = zipfile.ZIP_DEFLATED
    return made


def _database(data: bytes, rng: Generator) -> bytes:
    """A value of a row changed, in its type or in another; or rows, or a table, gone."""
    import sqlite3

    with sqlite3.connect(":memory:") as base:
        base.deserialize(data)
        tables = [t for (t,) in base.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        table = str(rng.choice(tables))
        fields = [row[1] for row in base.execute(f'PRAGMA table_info("{table}")')]
        rows = [row[0] for row in base.execute(f'SELECT rowid FROM "{table}"')]  # noqa: S608
        kind, field = int(rng.integers(12)), str(rng.choice(fields))
        row = int(rng.choice(rows)) if rows else 0
        if kind == 0:
            base.execute(f'DELETE FROM "{table}" WHERE rowid >= ?', (row,))  # noqa: S608
        elif kind == 1:
            base.execute(f'DROP TABLE "{table}"')
        else:
            command = f'SELECT "{field}" FROM "{table}" WHERE rowid = ?'  # noqa: S608
            (held,) = base.execute(command, (row,)).fetchone()
            new: Any = flipped(held, rng) if isinstance(held, bytes) and kind < 9 else None
            if new is None:
                new = [None, -1, 1 << 40, 1e300, "x", b"", b"\0" * 99][rng.integers(7)]
            base.execute(f'UPDATE "{table}" SET "{field}" = ? WHERE rowid = ?', (new, row))  # noqa: S608
        base.commit()
        return base.serialize()
