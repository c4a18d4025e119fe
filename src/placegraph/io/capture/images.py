"""Images read by Pillow: checked, converted to arrays, refused with a typed error."""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import check_regular
from placegraph.errors import InputError

if TYPE_CHECKING:
    from PIL.Image import Image

ENDINGS = (".png", ".jpg", ".jpeg")
"""Endings of image files, in lower case."""

MAX_PIXELS = 1 << 26
"""Largest frame [px], four times that of a good telephone."""
FREE_PIXELS, PIXELS_A_BYTE = 1 << 24, 64
"""Pixels that any image may have, and more for each byte of the file: Pillow allocates all pixels that
the header announces; real drawings stay below an eighth of this bound."""
_STRIP = 1 << 20
"""Pixels copied from Pillow at a time, since each copy exists in three forms for a moment."""

INTEGER_MODES = ("L", "P", "I;16", "I;16B", "I;16L", "I")
"""Pillow's modes of one integer a pixel; in mode P it is the palette's row."""

_BROKEN = (
    OSError, SyntaxError, ValueError, EOFError, TypeError, LookupError, MemoryError, OverflowError,
    AttributeError, RuntimeError, struct.error, zlib.error,
)  # fmt: skip
"""Errors of Pillow's decoders at damaged files (they have no common base class)."""


@contextmanager
def open_image(source: Path | IO[bytes], name: object, *, bounded: bool = False) -> Iterator[Image]:
    """Open an image; all errors of Pillow in the body become `InputError` about `name`.

    An image that announces far more pixels than its bytes can hold is refused, too, unless the caller
    is `bounded` itself.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(check_regular(source) if isinstance(source, Path) else source) as image:
            if not bounded and image.width * image.height > FREE_PIXELS:
                _check_bytes(image, source, name)
            yield image
    except InputError:
        raise
    except FileNotFoundError as error:
        raise InputError(
            f"{name} does not exist; it was there when the folder was read."
        ) from error
    except (*_BROKEN, Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        why = " ".join(str(error).split()) or type(error).__name__
        why = "of an unknown format" if isinstance(error, UnidentifiedImageError) else why
        raise InputError(
            f"{name} cannot be read as an image ({why}); it may be truncated: copy it again."
        ) from error


def list_images(folder: Path, endings: tuple[str, ...] = ENDINGS) -> dict[str, Path]:
    """Return the files of a folder with these endings by stem, in natural order: 2 comes before 10.

    A missing folder has none. Raises `InputError` where two files have the same stem.
    """
    if not folder.is_dir():
        return {}
    try:
        files = [p for p in folder.iterdir() if p.suffix.lower() in endings and p.name[0] != "."]
    except OSError as error:
        raise InputError(f"{folder} cannot be read: {error.strerror}.") from error
    images: dict[str, Path] = {}
    for file in sorted(files, key=lambda p: (natural_key(p.stem), p.name)):
        if file.stem in images:
            raise InputError(
                f"{file} and {images[file.stem].name} have the same name; keep one of them."
            )
        images[file.stem] = file
    return images


def natural_key(stem: str) -> list[tuple[int, int, str]]:
    """Return a key that sorts the numbers in names by value."""
    return [
        (0, int(part), part) if part.isascii() and part.isdigit() else (1, 0, part)
        for part in re.split(r"([0-9]{1,4000})", stem)
    ]


def image_size(path: Path) -> tuple[int, int]:
    """Return the width and height [px] in the header of an image file."""
    with open_image(path, path) as image:
        return image.size


def read_rgb(
    path: Path, size: tuple[int, int], source: IO[bytes] | None = None
) -> NDArray[np.uint8]:
    """Return the colours (H, W, 3) uint8 of an image that must have this width and height [px].

    Pixels stay as stored, unless the image has that size only after EXIF's rotation. `source` holds the
    bytes, if they are not in a file of that name.
    """
    with open_image(source or path, path) as image:
        if image.size != size and image.size[::-1] == size:
            from PIL import ImageOps

            ImageOps.exif_transpose(image, in_place=True)
        _check_size(image, path, size)
        return to_rgb(image)


def read_integers(path: Path, size: tuple[int, int], modes: tuple[str, ...]) -> NDArray[np.int32]:
    """Return the integers (H, W) int32 of an image of one channel, in one of these Pillow modes."""
    with open_image(path, path) as image:
        _check_size(image, path, size)
        if image.mode not in modes:
            raise InputError(
                f"{path} has pixels of mode {image.mode!r}; it must be a PNG with one "
                f"integer per pixel ({('16 bits' if 'L' not in modes else '8 or 16 bits')})."
            )
        return _pixels(image, image.mode, np.empty((size[1], size[0]), np.int32))


def to_rgb(image: Image) -> NDArray[np.uint8]:
    """Return the colours (H, W, 3) of an image, read-only."""
    out = _pixels(image, "RGB", np.empty((image.height, image.width, 3), np.uint8))
    out.flags.writeable = False
    return out


def _pixels(image: Image, mode: str, out: NDArray[Any]) -> NDArray[Any]:
    """Copy the pixels of an image in one of Pillow's modes, strip by strip."""
    rows = max(1, _STRIP // image.width)
    for top in range(0, image.height, rows):
        part = image
        if rows < image.height:
            part = image.crop((0, top, image.width, min(top + rows, image.height)))
        out[top : top + rows] = np.asarray(part if part.mode == mode else part.convert(mode))
    return out


def _check_bytes(image: Image, source: Path | IO[bytes], name: object) -> None:
    if isinstance(source, Path):
        size = source.stat().st_size
    else:
        position = source.tell()  # Pillow continues to read here
        size = source.seek(0, os.SEEK_END)
        source.seek(position)
    if image.width * image.height > FREE_PIXELS + PIXELS_A_BYTE * size:
        raise InputError(
            f"{name} declares {image.width} x {image.height} pixels in {size:,} bytes, so "
            "it is damaged or too large; make it smaller."
        )


def _check_size(image: Image, path: Path, size: tuple[int, int]) -> None:
    if image.width * image.height > MAX_PIXELS:  # before any is read: black ones take no bytes
        raise InputError(
            f"{path} has {image.width} x {image.height} pixels; the limit is {MAX_PIXELS >> 20} "
            "million: make the images smaller, and scale their intrinsics."
        )
    if image.size != size:
        raise InputError(
            f"{path} has {image.width} x {image.height} pixels, but its camera has "
            f"{size[0]} x {size[1]}; give intrinsics for this image size."
        )


def resize_image(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """Resize an image (H, W, 3) by the mean over areas."""
    from PIL import Image

    if image.shape[:2] == (height, width):
        return image
    small = Image.fromarray(image).resize((width, height), Image.Resampling.BOX)
    return np.asarray(small)


def lightness(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the lightness (H, W) float32, 0 to 1, of (H, W, 3) sRGB by the weights of Rec. 601."""
    weights = np.array([0.299, 0.587, 0.114], np.float32) / np.float32(255.0)
    return np.ascontiguousarray(image.astype(np.float32) @ weights)
