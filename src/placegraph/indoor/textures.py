"""Textures of a scene map: pictures made small, encoded for the file, decoded for use.

A map holds exactly what its file will hold: the encoded bytes are the truth, arrays are decoded
from them, so that a map just built and the same map opened give the same colours.
"""

from __future__ import annotations

import io
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import MapError, OptionError
from placegraph.formats.images import opened

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray
    from PIL.Image import Image

    from placegraph.formats.model import Picture

QUALITY = 85
"""JPEG quality of textures that are encoded anew."""
MAX_TEXTURE = 512
"""Longer sides [texels] are brought to this."""
_LARGEST = 1 << 14  # sides beyond this are refused where a map file is read


def linear_from_srgb(colours: NDArray[np.float64]) -> NDArray[np.float64]:
    """Linear intensities 0 to 1 of sRGB values 0 to 1 (IEC 61966-2-1)."""
    high = ((np.maximum(colours, 0.0) + 0.055) / 1.055) ** 2.4
    out: NDArray[np.float64] = np.where(colours <= 0.04045, colours / 12.92, high)
    return out


def srgb_from_linear(intensities: NDArray[np.float64]) -> NDArray[np.float64]:
    """SRGB values 0 to 1 of linear intensities 0 to 1 (IEC 61966-2-1)."""
    high = 1.055 * np.maximum(intensities, 0.0) ** (1 / 2.4) - 0.055
    out: NDArray[np.float64] = np.where(intensities <= 0.0031308, intensities * 12.92, high)
    return out


def encode_pictures(
    pictures: Sequence[Picture], max_texture: int, quality: int
) -> tuple[bytes, ...]:
    """Encoded textures of a model's pictures: shrunk to `max_texture`, base colour folded in.

    A JPEG that needs neither is kept as it is. Raises `InputError` where a picture is broken.
    """
    with ThreadPoolExecutor(2) as pool:  # Pillow works outside the interpreter's lock
        return tuple(pool.map(lambda p: _encode_picture(p, max_texture, quality), pictures))


def encode_arrays(
    textures: Iterable[NDArray[np.uint8]], quality: int = QUALITY
) -> tuple[bytes, ...]:
    """Encoded textures of arrays (h, w, 3) uint8."""
    from PIL import Image

    return tuple(_encode(Image.fromarray(np.asarray(a)), quality) for a in textures)


def decode(blobs: Sequence[bytes], path: object) -> tuple[NDArray[np.uint8], ...]:
    """Textures (h, w, 3) uint8 of encoded ones; `MapError` naming `path` where one is no image."""
    with ThreadPoolExecutor(2) as pool:
        return tuple(
            pool.map(lambda i: _decode(blobs[i], f"{path}: texture {i}"), range(len(blobs)))
        )


def check_options(max_texture: int, quality: int) -> None:
    """Raise `OptionError` where the options of encoding are out of range."""
    if not 1 <= max_texture <= _LARGEST:
        raise OptionError(f"max_texture is {max_texture}; it must be 1 to {_LARGEST} texels.")
    if not 1 <= quality <= 100:
        raise OptionError(f"quality is {quality}; JPEG's quality is 1 to 100.")


def _encode_picture(picture: Picture, max_texture: int, quality: int) -> bytes:
    from PIL import Image

    factor = np.clip(np.array(picture.factor, np.float64), 0.0, 1.0)
    if picture.data is None:
        flat = np.rint(255.0 * srgb_from_linear(factor)).astype(np.uint8)
        return _encode(Image.fromarray(flat.reshape(1, 1, 3)), quality)
    with opened(io.BytesIO(picture.data), picture.name) as image:
        whole = image.format == "JPEG" and image.mode == "RGB" and max(image.size) <= max_texture
        image.draft("RGB", (max_texture, max_texture))  # JPEG's own halving: quick
        image.load()
        if whole and (factor == 1.0).all() and not any(picture.mirrored):
            return picture.data
        small = image.convert("RGB")
    scale = max_texture / max(small.size)
    if scale < 1.0:
        size = tuple(max(1, round(side * scale)) for side in small.size)
        small = small.resize((size[0], size[1]), Image.Resampling.BOX)
    texels = np.asarray(small)
    if (factor != 1.0).any():
        steps = linear_from_srgb(np.arange(256) / 255.0)
        table = np.rint(255.0 * srgb_from_linear(steps[:, None] * factor)).astype(np.uint8)
        texels = np.stack([table[texels[:, :, c], c] for c in range(3)], axis=2)
    for axis, mirrored in ((1, picture.mirrored[0]), (0, picture.mirrored[1])):
        if mirrored:  # twice as large, then to be repeated: the coordinates were halved
            texels = np.concatenate([texels, np.flip(texels, axis)], axis=axis)
    return _encode(Image.fromarray(texels), quality)


def _encode(image: Image, quality: int) -> bytes:
    """PNG where that is smaller, as for flat colours and drawings; else JPEG."""
    forms = []
    for form, options in (("PNG", {"optimize": True}), ("JPEG", {"quality": quality})):
        file = io.BytesIO()
        image.save(file, form, **options)
        forms.append(file.getvalue())
    return min(forms, key=len) if image.width * image.height > 64 else forms[0]


def _decode(blob: bytes, name: str) -> NDArray[np.uint8]:
    from placegraph.errors import InputError

    try:
        with opened(io.BytesIO(blob), name) as image:
            if max(image.size) > _LARGEST or image.format not in {"JPEG", "PNG"}:
                raise MapError(f"{name} is no JPEG or PNG of up to {_LARGEST} texels a side.")
            return np.asarray(image.convert("RGB"))
    except InputError as error:
        raise MapError(f"{error} Build the map again.") from error
