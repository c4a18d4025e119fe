"""Mutations of files: flipped bytes, cuts, repetitions, and extreme lengths and numbers."""

from __future__ import annotations

import bz2
import copy
import gzip
import hashlib
import io
import json
import os
import re
import shutil
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

from placegraph.core.files import check_regular
from placegraph.core.mapfile import DIGEST_SIZE, MAGIC, PREFIX, read_map
from placegraph.errors import InputError

NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
WORDS = (
    b"nan", b"inf", b"-inf", b"1e999", b"-1e308", b"1e308", b"1e-320", b"0", b"-0.0", b"-1", b"2",
    b"4294967295", b"2147483648", b"-2147483649", b"18446744073709551616", b"9" * 400, b"0x10",
    b"1_000", b"1,5", b"", b" ", b"x", b"null", b"true", b"[", b"\xff", b"\0", "\u202e".encode(),
    b"\x1b[2J", "²".encode(), "٣".encode(), b"#", b"\n", b"\r", b"a" * 5000,
)  # fmt: skip
"""Replacements of a number or a word."""
VALUE = re.compile(rb"\"[^\"]*\"|'[^']*'")
ELEMENT = re.compile(rb"<[^<>?/]*/>")
TAG, COORDINATE, REFERENCE = (
    re.compile(rb" %s=[\"']([^\"']*)[\"']" % key) for key in (b"[kv]", b"l(?:at|on)", b"ref")
)
MEMBER = re.compile(rb"(<(?:nd|tag|member) [^>]*/>)")
"""OpenStreetMap's values of tags, coordinates, references, and whole elements."""
TAG_VALUES = (
    b"0", b"1", b"-1", b"0;1", b"-1-3", b"0.5", b"9999", b"-40000", b"door", b"room", b"corridor", b"area",
    b"yes", b"no", b"stairs", b"elevator", b"level", b"indoor", b"height", b"repeat_on", b"name", b"layer",
    b"3 m", b"1e9", b"-5", b"10'", b"nan", b"inner", b"outer", b"multipolygon", b"building", b"osmAG:type",
    b"osmAG:from", b"structure", b"passage", b"\xe2\x80\xae", b"x" * 255, b"",
)  # fmt: skip
"""Replacements of a value of a tag."""
CONTROL = re.compile("[\x00-\x08\x0b-\x1f\ufffd]")  # characters that XML does not allow
SIZES = ("<B", "<H", "<I", "<Q", ">I", "<q", "<d", "<f")


def flip_bytes(data: bytes, rng: Generator) -> bytes:
    """Change bytes in one to five places."""
    bad = bytearray(data)
    for _ in range(int(rng.choice([1, 1, 1, 2, 2, 3, 5]))):
        if not bad:
            return bytes(rng.integers(0, 256, 8, dtype=np.uint8))
        at = int(rng.integers(len(bad)))
        kind = int(rng.integers(11))
        span = int(rng.choice([1, 4, 8, 40, 1 + len(bad) // 8]))
        if kind < 2:
            bad[at] ^= 1 << int(rng.integers(8))
        elif kind == 2:
            bad[at] = int(rng.choice([0, 1, 127, 128, 254, 255]))
        elif kind == 3:
            del bad[at : at + span]
        elif kind == 4:
            bad[at:at] = bad[at : at + span]
        elif kind == 5:
            source = int(rng.integers(len(bad)))
            bad[at : at + span] = bad[source : source + span]
        elif kind == 6:
            del bad[at:]
        elif kind < 10:
            _number(bad, rng)
        else:
            bad[at:at] = WORDS[rng.integers(len(WORDS))]
    return bytes(bad)


def _number(bad: bytearray, rng: Generator) -> None:
    """Change a number that is likely a length, a count or an offset."""
    form = SIZES[rng.integers(len(SIZES))]
    size = struct.calcsize(form)
    if len(bad) < size:
        return
    if form[-1] in "df":
        at = int(rng.integers(len(bad) - size + 1)) // 4 * 4
        struct.pack_into(form, bad, min(at, len(bad) - size), _float(rng))
        return
    sites = rng.integers(0, len(bad) - size + 1, 40)
    if rng.integers(2):
        sites = sites % min(64, len(bad) - size + 1)  # heads stand at the beginning
    likely = [k for k in sites if 0 < struct.unpack_from(form, bad, k)[0] <= 2 * len(bad)]
    at = int(likely[0] if likely else sites[0])
    held = struct.unpack_from(form, bad, at)[0]
    top = (1 << (8 * size - (form[-1] == "q"))) - 1
    wanted = [0, 1, held + 1, held - 1, 2 * held, top, top // 2, top // 2 + 1, 1 << 20, len(bad)]
    struct.pack_into(form, bad, at, min(max(wanted[rng.integers(len(wanted))], 0), top))


def _float(rng: Generator) -> float:
    return float(rng.choice([np.nan, np.inf, -np.inf, 0.0, -1.0, 1e30, -1e30, 1e-30, 1e6]))


def change_osm(data: bytes, rng: Generator) -> bytes:
    """Change tags, nodes and positions of OpenStreetMap's XML, which stays readable."""
    for _ in range(int(rng.choice([1, 2, 4, 9, 30]))):
        kind = int(rng.integers(7))
        found = list((TAG, COORDINATE, REFERENCE, MEMBER)[kind // 2].finditer(data))
        if not found:
            continue
        one, other = (found[rng.integers(len(found))] for _ in range(2))
        new = other[1] if kind < 6 else b""
        if kind == 0:
            new = TAG_VALUES[rng.integers(len(TAG_VALUES))]
        elif kind in {2, 3}:
            step = float(rng.choice([1e-7, 1e-5, 1e-3, 0.1])) * rng.normal()
            new = b"%.7f" % (float(one[1]) + step)
        data = data[: one.start(1)] + new + data[one.end(1) :]
    return change_xml(data, rng) if rng.random() < 0.1 else data


def change_xml(data: bytes, rng: Generator) -> bytes:
    """Change values, keys and elements of XML, which stays XML."""
    for _ in range(int(rng.choice([1, 1, 2, 4, 9]))):
        data = _change_xml_once(data, rng)
    return data


def _change_xml_once(data: bytes, rng: Generator) -> bytes:
    kind = int(rng.integers(8))
    found = list((VALUE if kind < 5 else ELEMENT).finditer(data))
    if not found:
        return flip_bytes(data, rng)
    one, other = (found[rng.integers(len(found))] for _ in range(2))
    if kind < 3:
        word = WORDS[rng.integers(len(WORDS))].decode("utf-8", "replace")
        new = CONTROL.sub("", word).replace("<", "").encode()
    elif kind < 6:
        new = other[0].strip(b"\"'") if kind < 5 else other[0]
    else:
        new = b"" if kind == 6 else 2 * one[0]
    quoted = b'"' + new.replace(b'"', b"").replace(b"&", b"") + b'"'
    return data[: one.start()] + (quoted if kind < 5 else new) + data[one.end() :]


def change_text(data: bytes, rng: Generator) -> bytes:
    """Change numbers, words and lines of a text."""
    for _ in range(int(rng.choice([1, 1, 2, 4]))):
        data = _change_text_once(data, rng)
    return data


def _change_text_once(data: bytes, rng: Generator) -> bytes:
    kind = int(rng.integers(8))
    if kind < 4:
        found = list(NUMBER.finditer(data)) if kind < 3 else list(re.finditer(rb"[\w.]+", data))
        if not found:
            return flip_bytes(data, rng)
        # the head of a text says most of the rest
        most = len(found) if rng.integers(2) else min(len(found), 40)
        at = found[rng.integers(most)]
        return data[: at.start()] + WORDS[rng.integers(len(WORDS))] + data[at.end() :]
    if kind == 4:
        return flip_bytes(data, rng)
    lines = data.splitlines(keepends=True) or [b""]
    a, b = (int(rng.integers(len(lines))) for _ in range(2))
    if kind == 5:
        del lines[a]
    elif kind == 6:
        lines.insert(a, lines[b])
    else:
        lines[a], lines[b] = lines[b], lines[a]
    return b"".join(lines)


VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 0.5, -0.0, 2**31, 2**53 + 1, 2**63, 2**64, -(2**63) - 1, 1e300,
    -1e300, 1e-300, 10**400, float("nan"), float("inf"), "", "x", "0", "1e5", "\0", "\u202e\x1b[2J",
    "\ud800", "../..", "/dev/zero", "a" * 3000, [], {}, [[]], [None], {"": 0}, [0] * 3000, "true",
)  # fmt: skip
"""Replacements of a JSON value."""


def change_json(data: bytes, rng: Generator) -> bytes:
    """Change one to three values of JSON; of other data change bytes."""
    try:
        root = {"": json.loads(data)}
    except (ValueError, RecursionError):
        return flip_bytes(data, rng)
    if rng.random() < 0.03:
        deep = int(rng.choice([500, 20_000]))
        return b"[" * deep + data + b"]" * deep
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        holder, key = _choose_site(root, rng)
        kind = int(rng.integers(10))
        value = holder[key]
        if kind < 4:
            holder[key] = VALUES[rng.integers(len(VALUES))]
        elif kind == 4 and isinstance(value, int | float):
            holder[key] = value * float(rng.choice([-1.0, 0.001, 1e3, 1e9])) + float(
                rng.integers(-2, 3)
            )
        elif kind == 5 and holder is not root:
            del holder[key]
        elif kind == 6 and isinstance(value, list):
            holder[key] = value * int(rng.choice([2, 50])) if len(value) < 1000 else value[:1]
        elif kind == 7 and isinstance(holder, dict):
            holder[str(rng.choice(["", "x", "\0", "__class__", "id"]))] = copy.deepcopy(value)
        elif kind == 8 and isinstance(value, str):
            holder[key] = flip_bytes(value.encode(), rng).decode("utf-8", "replace")
        else:
            other, at = _choose_site(root, rng)
            holder[key] = copy.deepcopy(other[at])
    text = json.dumps(root.get(""))
    return text.encode("utf-8", "surrogatepass")


def _choose_site(root: dict[str, Any], rng: Generator) -> tuple[Any, Any]:
    """Choose where a value stands, after a random number of steps from the root."""
    holder: Any = root
    key: Any = ""
    depth = 0
    while (
        isinstance(holder[key], dict | list)
        and holder[key]
        and rng.random() < (0.98, 0.9)[depth > 1]
    ):
        depth += 1
        holder = holder[key]
        key = rng.integers(len(holder)) if isinstance(holder, list) else None
        key = int(key) if key is not None else list(holder)[rng.integers(len(holder))]
    return holder, key


def change_store(data: bytes, rng: Generator) -> bytes:
    """Change columns, metadata or the head of a store, with valid checksums."""
    if rng.random() < 0.15:
        _, layout, length, _ = PREFIX.unpack_from(data)
        text = change_json(data[PREFIX.size : PREFIX.size + length], rng)
        return _seal_store(text, data[PREFIX.size + length : -DIGEST_SIZE], layout)
    with tempfile.NamedTemporaryFile() as file:
        file.write(data)
        file.flush()
        head = json.loads(data[PREFIX.size : PREFIX.size + PREFIX.unpack_from(data)[2]])
        arrays = dict(read_map(Path(file.name), head["kind"], 1 << 30).arrays)
    if rng.random() < 0.2:
        head["meta"] = json.loads(change_json(json.dumps(head["meta"]).encode(), rng))
    else:
        for _ in range(1 + int(rng.integers(2))):
            change_column(arrays, rng)
    head["arrays"], body = [], b""
    for name, array in arrays.items():
        block = np.ascontiguousarray(array).tobytes()
        head["arrays"].append({
            "name": name, "dtype": array.dtype.str, "shape": array.shape, "codec": "raw",
            "filter": "none", "offset": len(body), "length": len(block), "crc32": zlib.crc32(block),
        })  # fmt: skip
        body += block
    return _seal_store(json.dumps(head).encode(), body, 1)


def _seal_store(text: bytes, body: bytes, layout: int) -> bytes:
    whole = PREFIX.pack(MAGIC, layout, len(text), zlib.crc32(text)) + text + body
    return whole + hashlib.sha256(whole).digest()


def change_column(arrays: dict[str, Any], rng: Generator) -> None:
    """Change numbers, length, type or shape of one column, remove it, or replace it by another."""
    name, other = (str(rng.choice(sorted(arrays))) for _ in range(2))
    array, kind = arrays[name].copy(), max(int(rng.integers(20)) - 8, 0)
    n = len(array)
    if kind < 5 and array.size:
        flat = array.reshape(-1)
        rows = rng.integers(0, flat.size, max(1, int(rng.choice([1, 1, 3, flat.size // 2]))))
        flat[rows] = _extreme_value(array.dtype, rng) if kind < 4 else rng.permutation(flat[rows])
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
        array = np.frombuffer(flip_bytes(array.tobytes(), rng), np.uint8)
        whole = len(array) // arrays[name].itemsize * arrays[name].itemsize
        array = array[:whole].view(arrays[name].dtype)
    arrays[name] = array
    if kind == 11:
        del arrays[name]


def _extreme_value(dtype: np.dtype[Any], rng: Generator) -> Any:  # noqa: ANN401
    if dtype.kind == "f":
        return rng.choice(np.array([0, -1, np.nan, np.inf, -np.inf, 1e30, -1e30, 1e-30], dtype))
    if dtype.kind == "b":
        return bool(rng.integers(2))
    limits = np.iinfo(dtype)
    near = [0, 1, limits.min, limits.max, limits.max - 1, limits.max // 2, 255 & limits.max]
    return np.array(near[rng.integers(len(near))], dtype)


Change = Callable[[bytes, Generator], bytes]

TEXTS = {"txt", "csv", "tum", "obj", "mtl", "ply", "tsv", "yaml", "pgm", "traj", "pincam", "http"}
JSONS = {"json", "gltf", "jsonl", "geojson", "request"}
XMLS = {"osm", "osmag", "xml"}


def mutate_path(place: Path, rng: Generator) -> None:
    """Mutate a file, one or two files of a folder, or the folder's content."""
    if place.is_file():
        _mutate_file(place, rng)
        return
    files = sorted(p for p in place.rglob("*") if p.is_file())
    if rng.random() < 0.1:
        _rearrange(files[rng.integers(len(files))], files[rng.integers(len(files))], rng)
        return
    # files that are no images are chosen more often
    small = [p for p in files if p.suffix not in {".png", ".jpg", ".mp4"}]
    for _ in range(1 + int(rng.integers(3) == 0)):
        candidates = small if small and rng.random() < 0.7 else files
        _mutate_file(candidates[rng.integers(len(candidates))], rng)


def mutate_world(folder: Path, rng: Generator) -> None:
    """Mutate a world in shards, with valid digests in `world.json`."""
    mutate_path(folder, rng)
    unreadable = OSError, RecursionError, LookupError, TypeError, ValueError, AttributeError
    with suppress(InputError, *unreadable):
        manifest = json.loads(check_regular(folder / "world.json").read_bytes())
        for entry in (manifest["words"], *manifest["shards"]):
            entry["digest"] = (
                check_regular(folder / entry["file"]).read_bytes()[-DIGEST_SIZE:].hex()
            )
        (folder / "world.json").write_text(json.dumps(manifest), "utf-8")


def _mutate_file(path: Path, rng: Generator) -> None:
    path.write_bytes(mutate_bytes(path.read_bytes(), path.name, rng))


def _rearrange(one: Path, other: Path, rng: Generator) -> None:
    """Remove a file, or replace it by another file, a folder, a pipe or a link."""
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


def mutate_bytes(data: bytes, name: str, rng: Generator) -> bytes:
    """Return mutated bytes of a file of this name."""
    change = flip_bytes if rng.random() < 0.25 else _choose_change(data, name, rng)
    try:
        return change(data, rng)
    except Exception:  # noqa: BLE001  # of files mutated before
        return flip_bytes(data, rng)


def _choose_change(data: bytes, name: str, rng: Generator) -> Change:
    ending = name.rpartition(".")[2].lower()
    changes = {
        MAGIC: change_store, b"PK": _zip, b"\x89PNG\r\n": _png, b"glTF": _glb,
        b"SQLite format 3": _database, b"\x1f\x8b": lambda d, g: _packed(d, name, gzip, g),
        b"\x93NUMPY": _column, b"PAR1": _parquet, b"BZh": lambda d, g: _packed(d, name, bz2, g),
    }  # fmt: skip
    for magic, change in changes.items():
        if data.startswith(magic):
            return change
    if ending == "pbf":
        return _pbf
    if ending in JSONS or name == "metadata":
        return _json
    if ending in XMLS:
        return change_osm if b"<osm" in data[:400] and rng.random() < 0.6 else change_xml
    if ending in TEXTS and b"\0" not in data[:4096]:
        return change_text
    return flip_bytes


def _json(data: bytes, rng: Generator) -> bytes:
    lines = data.split(b"\n")
    if len(lines) > 2 and lines[0].startswith(b"{") and lines[0].endswith(b"}"):  # one a line
        at = int(rng.integers(len(lines)))
        lines[at] = change_json(lines[at], rng)
        return b"\n".join(lines)
    return change_json(data, rng)


def _packed(data: bytes, name: str, packer: Any, rng: Generator) -> bytes:  # noqa: ANN401
    whole: bytes = packer.compress(
        mutate_bytes(packer.decompress(data), name.rpartition(".")[0], rng)
    )
    return whole


def _png(data: bytes, rng: Generator) -> bytes:
    """Change one chunk of a PNG, with a valid checksum."""
    chunks, at = [], 8
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    k = 0 if rng.random() < 0.4 else int(rng.integers(len(chunks)))
    chunks[k] = chunks[k][0], flip_bytes(chunks[k][1], rng)
    return data[:8] + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )


def _column(data: bytes, rng: Generator) -> bytes:
    """Change a NumPy array."""
    arrays = {"": np.load(io.BytesIO(data))}
    change_column(arrays, rng)
    out = io.BytesIO()
    np.save(out, arrays[""])
    return out.getvalue()


def _parquet(data: bytes, rng: Generator) -> bytes:
    """Change a value of a Parquet table, or remove, rename or retype a column."""
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
        values[row] = None if kind == 2 else flip_bytes(held, rng) if isinstance(held, bytes) else (
            json.loads(change_json(json.dumps(held).encode(), rng)))  # fmt: skip
        table = table.set_column(at, field, pa.array(values, None if kind == 3 else field.type))
    out = io.BytesIO()
    pq.write_table(table, out, row_group_size=1 + int(rng.integers(4)))
    return out.getvalue()


def _glb(data: bytes, rng: Generator) -> bytes:
    """Change the JSON or the binary chunk of a GLB, with valid lengths."""
    (length,) = struct.unpack_from("<I", data, 12)
    text, rest = data[20 : 20 + length], data[28 + length :]
    if rng.random() < 0.8:
        text = change_json(text, rng)
        text += b" " * (-len(text) % 4)
    else:
        rest = flip_bytes(rest, rng)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(rest), b"BIN\0") + rest
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _pbf(data: bytes, rng: Generator) -> bytes:
    """Change one block of a PBF inside its compression."""
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
    blocks[k] = blocks[k][0], flip_bytes(blocks[k][1], rng)
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
    """Change, rename, double or remove an entry of a ZIP, or make it a link or a bomb."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = [(info, archive.read(info)) for info in archive.infolist()]
    k, kind = int(rng.integers(len(entries))), int(rng.integers(8))
    info, body = entries[k]
    if kind < 3:
        entries[k] = info, mutate_bytes(body, info.filename, rng)
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
    return flip_bytes(out.getvalue(), rng) if rng.random() < 0.1 else out.getvalue()


def _entry(name: str, attributes: int = 0) -> zipfile.ZipInfo:
    made = zipfile.ZipInfo("x")
    made.filename, made.external_attr = name, attributes
    made.compress_type = zipfile.ZIP_DEFLATED
    return made


def _database(data: bytes, rng: Generator) -> bytes:
    """Change a value of a database, or remove rows or a table."""
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
            new: Any = flip_bytes(held, rng) if isinstance(held, bytes) and kind < 9 else None
            if new is None:
                new = [None, -1, 1 << 40, 1e300, "x", b"", b"\0" * 99][rng.integers(7)]
            base.execute(f'UPDATE "{table}" SET "{field}" = ? WHERE rowid = ?', (new, row))  # noqa: S608
        base.commit()
        return base.serialize()
