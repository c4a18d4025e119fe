"""Files of a ZIP, read in place: no handle stays open, and nothing is unpacked to disk."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from pathlib import Path, PurePosixPath

from placegraph.core.files import regular
from placegraph.errors import InputError

_MOST = 1 << 28  # bytes of one file; images have some millions


class Archive:
    """Files of a ZIP by name, each found by the place that its directory says.

    Raises `InputError` where it is no ZIP, or a file of it is missing, damaged, or too large.
    """

    def __init__(self, path: Path, *, flat: bool = False) -> None:
        """Read the directory; `flat`: names are without folders."""
        self.path = path
        try:
            with zipfile.ZipFile(regular(path)) as archive:
                held = [entry for entry in archive.infolist() if not entry.is_dir()]
        except (zipfile.BadZipFile, OSError, ValueError, LookupError, RuntimeError) as error:
            raise InputError(f"{path} is no readable ZIP ({error}); copy it again.") from error
        self._entries = {PurePosixPath(e.filename).name if flat else e.filename: e for e in held}
        self.names = frozenset(self._entries)

    def where(self, name: str) -> str:
        """What a file is called in messages."""
        return f"{self.path}, {name}" if name else str(self.path)

    def read(self, name: str) -> bytes:
        """Content of a file."""
        entry = self._entries.get(name)
        if entry is None:
            raise InputError(f"{self.path} holds no {name}; export or download it again.")
        if entry.file_size > _MOST:
            raise InputError(
                f"{self.where(name)} would have {entry.file_size} bytes; it is refused."
            )
        try:
            with self.path.open("rb") as file:
                file.seek(entry.header_offset)
                head = struct.unpack("<4s22xHH", file.read(30))
                file.seek(head[1] + head[2], io.SEEK_CUR)
                packed = file.read(min(entry.compress_size, _MOST))
            data = packed
            if entry.compress_type == zipfile.ZIP_DEFLATED:
                data = zlib.decompressobj(-zlib.MAX_WBITS).decompress(packed, _MOST)
            good = zlib.crc32(data) == entry.CRC and not entry.flag_bits & 1
        except (OSError, struct.error, zlib.error, ValueError, OverflowError) as error:
            raise InputError(f"{self.where(name)} is damaged ({error}); copy it again.") from error
        if not good:
            raise InputError(f"{self.where(name)} is damaged or encrypted; copy it again.")
        return data
