"""An MCAP that is still being written, or comes through a pipe: its messages from the first on."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from struct import unpack_from

from placegraph.errors import InputError
from placegraph_io.ros.containers import (
    CHUNK,
    MAGIC,
    MESSAGE,
    Channels,
    MissingIndexError,
    records,
    ros2_type,
)
from placegraph_io.ros.stream import Fault, Packet
from placegraph_io.storage import LARGEST_MESSAGE, CompressedBytes

_FOOTER, _DATA_END = 2, 15


def mcap_packets(read: Callable[[int], bytes], name: str) -> Iterator[Packet | Fault]:
    """Yield the messages of a stream of bytes, up to its end, or as far as it goes where it is cut off.

    Parameters
    ----------
    read
        Returns so many bytes, waiting for them; fewer where the stream ends.
    name
        What it is called in messages.

    Raises
    ------
    InputError
        It does not begin as an MCAP.

    """
    if read(len(MAGIC)) != MAGIC:
        raise InputError(
            f"{name} is no MCAP stream: it does not begin as one. Send the bytes of an .mcap from its "
            "beginning; other bags are named as files."
        )
    known = Channels()
    while len(head := read(9)) == 9:
        op, length = unpack_from("<BQ", head)
        if op in {_FOOTER, _DATA_END}:
            return
        if length > LARGEST_MESSAGE:
            yield Fault("", f"{name} is damaged: a record of {length:,} bytes; it ends here.")
            return
        data = read(length)
        whole = len(data) == length
        try:
            yield from _told(known, op, data, name) if whole or op == CHUNK else ()
        except (MissingIndexError, InputError, struct.error) as error:
            if whole:
                said = str(error) or "it is cut off"
                yield Fault("", f"{name}, a chunk: {said}; what follows is read.")
        if not whole:
            break
    yield Fault("", f"{name} was cut off, for it has no end; it is read as far as it goes.")


def _told(known: Channels, op: int, data: bytes, name: str) -> Iterator[Packet]:
    """Yield the messages of a record."""
    if op == CHUNK:
        _, _, size, _, letters = unpack_from("<QQQII", data)
        packing = data[32 : 32 + letters].decode("ascii", "replace")
        content = data[32 + letters + 8 :]
        if packing:
            content = CompressedBytes(content, packing, f"{name}, a chunk").read(0, size)
        for inner, at, length in records(content):
            yield from _told(known, inner, content[at : at + length], name)
    elif op == MESSAGE:
        number, _, time = unpack_from("<HIQ", data)
        channel = known.channels.get(number)
        if channel is not None and channel.encoding in {"cdr", "ros1"}:
            kind = ros2_type(channel.type)
            yield Packet(channel.topic, kind, time * 1e-9, data[22:], channel.encoding)
    else:
        known.add_record(op, data)
