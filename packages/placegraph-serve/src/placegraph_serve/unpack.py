"""A capture that came as a ZIP: unpacked into a folder of its own, and nowhere else."""

from __future__ import annotations

import lzma
import stat
import zipfile
import zlib
from pathlib import Path, PurePosixPath

from placegraph.errors import InputError, RequestError
from placegraph.io.capture.capture import Capture, is_capture, open_capture
from placegraph_serve.options import ServeOptions
from placegraph_serve.photo import check_size

_BROKEN = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, OSError, ValueError, RuntimeError,
           EOFError)  # fmt: skip
"""What zipfile raises at damaged, encrypted and strange files."""
_CHUNK = 1 << 20
_EACH = 6
"""Files that a frame may have."""


def capture_in(path: Path, folder: Path, options: ServeOptions) -> Capture:
    """Capture of a ZIP, whose files are unpacked into an empty folder.

    Raises
    ------
    InputError
        It is no whole ZIP, a name leads out of it, or it holds no capture.
    RequestError
        It has too many files, or too large ones.

    """
    try:
        with zipfile.ZipFile(path) as archive:
            _unpack(archive, folder, options)
    except _BROKEN as error:
        raise InputError(
            f"capture: no whole ZIP ({' '.join(str(error).split())}); send it again."
        ) from error
    inside = [p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("__")]
    root = folder if is_capture(folder) or len(inside) != 1 else inside[0]
    capture = open_capture(root)
    if len(capture) > options.images:
        raise RequestError(
            f"capture: {len(capture)} frames; send at most {options.images}.",
            status=413, code="images",
        )  # fmt: skip
    for camera in (capture.camera, capture.depth_camera, capture.label_camera):
        if camera is not None:
            check_size((camera.width, camera.height), "capture", options)
    return capture


def _unpack(archive: zipfile.ZipFile, folder: Path, options: ServeOptions) -> None:
    entries = [e for e in archive.infolist() if not e.is_dir()]
    most = 100 + _EACH * options.images
    if len(entries) > most:
        raise _too_much(f"{len(entries)} files; send at most {most}")
    left = options.unpacked_bytes
    if sum(e.file_size for e in entries) > left:
        raise _too_much(f"more than {left:,} bytes unpacked; send fewer frames")
    for entry in entries:
        target = folder / _safe(entry)
        target.parent.mkdir(parents=True, exist_ok=True)
        with archive.open(entry) as packed, target.open("wb") as out:
            while chunk := packed.read(_CHUNK):  # counted, whatever its directory says
                left -= len(chunk)
                if left < 0:
                    raise _too_much("more than it says; send it as it was made")
                out.write(chunk)


def _safe(entry: zipfile.ZipInfo) -> PurePosixPath:
    """Path of an entry below the folder; `InputError` where it leads elsewhere, or is a link."""
    name = PurePosixPath(entry.filename)
    odd = name.is_absolute() or ".." in name.parts or "\\" in entry.filename or len(str(name)) > 200
    if odd or ":" in entry.filename or stat.S_ISLNK(entry.external_attr >> 16):
        raise InputError(
            f"capture: {entry.filename[:80]!r} leads out of the ZIP; pack the folder again."
        )
    return name


def _too_much(what: str) -> RequestError:
    return RequestError(f"capture: {what}.", status=413, code="unpacked")
