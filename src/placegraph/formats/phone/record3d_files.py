"""Files of Record3D: in a folder or a ZIP, with depth packed by LZFSE or as OpenEXR."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError, MissingExtraError
from placegraph.files import regular
from placegraph.formats.capture.archive import Archive
from placegraph.formats.capture.camera import read_json
from placegraph.formats.capture.frame_files import check_shape

if TYPE_CHECKING:
    from placegraph.geometry import Camera

_END = b"bvx$"  # of an LZFSE stream


class Folder:
    """Files of a folder and its subfolders, by name."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.names = frozenset(
            p.relative_to(path).as_posix() for pattern in ("*", "*/*") for p in path.glob(pattern)
        )

    def open(self, name: str) -> IO[bytes]:
        """File for reading."""
        try:
            return regular(self.path / name).open("rb")
        except OSError as error:
            raise InputError(f"{self.path / name} cannot be read: {error.strerror}.") from error

    def read(self, name: str) -> bytes:
        """Content of a file."""
        with self.open(name) as stream:
            return stream.read()

    def json(self, name: str) -> dict[str, Any]:
        """Content of a JSON file, an object."""
        return _object(read_json(self.path / name), f"{self.path / name}")


class Zipped(Archive):
    """Files of a ZIP, by name."""

    def open(self, name: str) -> IO[bytes]:
        """File for reading."""
        return io.BytesIO(self.read(name))

    def json(self, name: str) -> dict[str, Any]:
        """Content of a JSON file, an object."""
        where = self.where(name)
        try:
            return _object(json.loads(self.read(name).decode("utf-8-sig")), where)
        except (ValueError, RecursionError) as error:
            raise InputError(f"{where} is not JSON ({error}).") from error


def _object(content: object, where: str) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise InputError(f"{where} must be a JSON object with poses, K, w and h.")
    return content


# ---------------------------------------------------------------------------------------- depth


def lzfse_depth(data: bytes, camera: Camera, where: str) -> NDArray[np.float32]:
    """Depth (h, w) float32 [m], NaN: no reading, of an LZFSE stream; `InputError` as its size."""
    return _readings(np.frombuffer(_unpacked(data, camera, 4, where), "<f4"), camera)


def confidences(data: bytes, camera: Camera, where: str) -> NDArray[np.uint8]:
    """Confidences (h, w) uint8 of an LZFSE stream."""
    values = np.frombuffer(_unpacked(data, camera, 1, where), np.uint8)
    return values.reshape(camera.height, camera.width)


def exr_depth(path: Path, camera: Camera) -> NDArray[np.float32]:
    """Depth (h, w) float32 [m], NaN: no reading, of the first channel of an OpenEXR file."""
    try:
        import OpenEXR
    except ImportError as error:
        raise MissingExtraError(
            f'{path} is OpenEXR, whose reader is not installed: pip install "placegraph[record3d]".'
        ) from error
    if not path.is_file():
        raise InputError(f"{path} does not exist; it was there when the folder was read.")
    try:
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
        name = next(n for n in ("R", "Z", "Y", *channels) if n in channels)
        metres = np.array(channels[name].pixels, np.float32)
    except (RuntimeError, ValueError, TypeError, StopIteration, MemoryError) as error:
        why = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path} cannot be read as OpenEXR ({why}); copy it again.") from error
    check_shape(metres, camera, path)
    return _readings(metres, camera)


def _readings(metres: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
    image = metres.astype(np.float32).reshape(camera.height, camera.width)
    image[~(np.isfinite(image) & (image > 0))] = np.nan
    return image


def _unpacked(data: bytes, camera: Camera, each: int, where: str) -> bytes:
    """Bytes of an LZFSE stream, `each` a pixel."""
    wanted = camera.width * camera.height * each
    if len(data) == wanted and not data.startswith(b"bvx"):
        return data  # some tools write them unpacked
    try:
        import liblzfse
    except ImportError as error:
        raise MissingExtraError(
            f"{where} is packed by LZFSE, which is not installed: "
            'pip install "placegraph[record3d]".'
        ) from error
    if not (data.startswith(b"bvx") and data.endswith(_END)):
        raise InputError(f"{where} is no whole LZFSE stream; it may be truncated: copy it again.")
    try:
        unpacked: bytes = liblzfse.decompress(data)
    except (liblzfse.error, MemoryError, ValueError) as error:
        raise InputError(f"{where} is a damaged LZFSE stream; copy it again.") from error
    if len(unpacked) != wanted:
        raise InputError(
            f"{where} has {len(unpacked) // each} pixels, but metadata says {camera.width} x "
            f"{camera.height}; export the recording again."
        )
    return unpacked
