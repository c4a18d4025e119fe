"""Bytes and text made wrong: flips, cuts, repetitions, lengths and numbers at their extremes."""

from __future__ import annotations

import re
import struct

import numpy as np
from numpy.random import Generator

NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
WORDS = (
    b"nan", b"inf", b"-inf", b"1e999", b"-1e308", b"1e308", b"1e-320", b"0", b"-0.0", b"-1", b"2",
    b"4294967295", b"2147483648", b"-2147483649", b"18446744073709551616", b"9" * 400, b"0x10",
    b"1_000", b"1,5", b"", b" ", b"x", b"null", b"true", b"[", b"\xff", b"\0", "\u202e".encode(),
    b"\x1b[2J", "²".encode(), "٣".encode(), b"#", b"\n", b"\r", b"a" * 5000,
)  # fmt: skip
"""What may stand where a number or a word stood."""
VALUE = re.compile(rb"\"[^\"]*\"|'[^']*'")
ELEMENT = re.compile(rb"<[^<>?/]*/>")
TAG, PLACED, NODE = (
    re.compile(rb" %s=[\"']([^\"']*)[\"']" % key) for key in (b"[kv]", b"l(?:at|on)", b"ref")
)
WHOLE = re.compile(rb"(<(?:nd|tag|member) [^>]*/>)")
"""Of OpenStreetMap: what a tag says, where a node lies, which one it is, and what holds all that."""
SAID = (
    b"0", b"1", b"-1", b"0;1", b"-1-3", b"0.5", b"9999", b"-40000", b"door", b"room", b"corridor", b"area",
    b"yes", b"no", b"stairs", b"elevator", b"level", b"indoor", b"height", b"repeat_on", b"name", b"layer",
    b"3 m", b"1e9", b"-5", b"10'", b"nan", b"inner", b"outer", b"multipolygon", b"building", b"osmAG:type",
    b"osmAG:from", b"structure", b"passage", b"\xe2\x80\xae", b"x" * 255, b"",
)  # fmt: skip
"""What may stand in a tag."""
STEERING = re.compile("[\x00-\x08\x0b-\x1f\ufffd]")  # what XML does not allow
SIZES = ("<B", "<H", "<I", "<Q", ">I", "<q", "<d", "<f")


def flipped(data: bytes, rng: Generator) -> bytes:
    """One to five changes anywhere, few of them large."""
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
    """Set what is likely a length, a count or an offset to another one."""
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


def remapped(data: bytes, rng: Generator) -> bytes:
    """What OpenStreetMap's XML says changed, so that its readers go on: tags, nodes, places."""
    for _ in range(int(rng.choice([1, 2, 4, 9, 30]))):
        kind = int(rng.integers(7))
        found = list((TAG, PLACED, NODE, WHOLE)[kind // 2].finditer(data))
        if not found:
            continue
        one, other = (found[rng.integers(len(found))] for _ in range(2))
        new = other[1] if kind < 6 else b""
        if kind == 0:
            new = SAID[rng.integers(len(SAID))]
        elif kind in {2, 3}:
            step = float(rng.choice([1e-7, 1e-5, 1e-3, 0.1])) * rng.normal()
            new = b"%.7f" % (float(one[1]) + step)
        data = data[: one.start(1)] + new + data[one.end(1) :]
    return remarked(data, rng) if rng.random() < 0.1 else data


def remarked(data: bytes, rng: Generator) -> bytes:
    """Values, keys and elements of XML changed, which stays XML."""
    for _ in range(int(rng.choice([1, 1, 2, 4, 9]))):
        data = _remarked(data, rng)
    return data


def _remarked(data: bytes, rng: Generator) -> bytes:
    kind = int(rng.integers(8))
    found = list((VALUE if kind < 5 else ELEMENT).finditer(data))
    if not found:
        return flipped(data, rng)
    one, other = (found[rng.integers(len(found))] for _ in range(2))
    if kind < 3:
        word = WORDS[rng.integers(len(WORDS))].decode("utf-8", "replace")
        new = STEERING.sub("", word).replace("<", "").encode()
    elif kind < 6:
        new = other[0].strip(b"\"'") if kind < 5 else other[0]
    else:
        new = b"" if kind == 6 else 2 * one[0]
    quoted = b'"' + new.replace(b'"', b"").replace(b"&", b"") + b'"'
    return data[: one.start()] + (quoted if kind < 5 else new) + data[one.end() :]


def reworded(data: bytes, rng: Generator) -> bytes:
    """Numbers, words and lines of a text changed."""
    for _ in range(int(rng.choice([1, 1, 2, 4]))):
        data = _reworded(data, rng)
    return data


def _reworded(data: bytes, rng: Generator) -> bytes:
    kind = int(rng.integers(8))
    if kind < 4:
        found = list(NUMBER.finditer(data)) if kind < 3 else list(re.finditer(rb"[\w.]+", data))
        if not found:
            return flipped(data, rng)
        # the head of a text says most of the rest
        most = len(found) if rng.integers(2) else min(len(found), 40)
        at = found[rng.integers(most)]
        return data[: at.start()] + WORDS[rng.integers(len(WORDS))] + data[at.end() :]
    if kind == 4:
        return flipped(data, rng)
    lines = data.splitlines(keepends=True) or [b""]
    a, b = (int(rng.integers(len(lines))) for _ in range(2))
    if kind == 5:
        del lines[a]
    elif kind == 6:
        lines.insert(a, lines[b])
    else:
        lines[a], lines[b] = lines[b], lines[a]
    return b"".join(lines)
