"""One picture as somebody sent it: its pixels upright, and what its EXIF says of the camera."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from math import hypot
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import InputError, RequestError
from placegraph.io.capture.fixes import Fix, exif_fix
from placegraph.io.capture.images import opened
from placegraph_serve.options import ServeOptions

if TYPE_CHECKING:
    from PIL.Image import Image


LONGEST = 1280
"""Side of an image that is localized [px]; larger ones are made smaller."""
SMALLEST = 32
"""Side of the smallest that is worth a look [px]."""
SHORTEST = 0.1
"""Focal length in longest sides of an image, of the widest lens that is believed."""
USUAL = 26.0
"""Focal length of a phone's main camera, on film of 35 mm [mm]; taken where nothing is known."""
_FILM = hypot(36.0, 24.0)
_EXIF = 0x8769
_FOCAL, _FOCAL_FILM, _PLANE, _PLANE_UNIT = 0x920A, 0xA405, 0xA20E, 0xA210
_UNITS = {2: 25.4, 3: 10.0, 4: 1.0}
"""Millimetres in EXIF's units of length."""


@dataclass(frozen=True, slots=True, eq=False)
class Photo:
    """A picture, upright."""

    rgb: NDArray[np.uint8]
    """(H, W, 3), made smaller where it was large."""
    size: tuple[int, int]
    """Width and height as sent [px], upright."""
    focal: float | None
    """By its EXIF, in pixels as sent; None: it does not say."""
    fix: Fix | None
    """Where it was taken, by its EXIF."""

    def camera(self, given: Camera | None, name: str) -> Camera:
        """Intrinsics of `rgb`: those given, else by EXIF, else a phone's usual ones.

        Raises `InputError` where those given are of images of another shape, or in other units.
        """
        width, height = self.size
        if given is None:
            focal = self.focal or USUAL / _FILM * hypot(width, height)
            given = Camera(width, height, focal, focal, width / 2.0, height / 2.0)
        if abs(given.width * height - given.height * width) > max(width, height):
            raise InputError(
                f"{name} is {width} x {height}, and intrinsics are of images of {given.width} x "
                f"{given.height}; give those of the images as they are shown."
            )
        check_focal(given, name)
        return given.resized(self.rgb.shape[1], self.rgb.shape[0])


def read_photo(data: bytes, name: str, options: ServeOptions) -> Photo:
    """Decode a picture, told by what it is; `RequestError` where it is too large, `InputError` else."""
    if len(data) > options.image_bytes:
        raise RequestError(
            f"{name} has {len(data):,} bytes; send at most {options.image_bytes:,}.",
            status=413, code="image_size",
        )  # fmt: skip
    if not data:
        raise InputError(f"{name} is empty; send a JPEG, PNG or WebP.")
    with opened(BytesIO(data), name, bounded=True) as image:
        if image.format not in {"JPEG", "MPO", "PNG", "WEBP"}:
            raise InputError(f"{name} is {image.format}; send a JPEG, PNG or WebP.")
        check_size(image.size, name, options)
        exif = image.getexif()
        turned = exif.get(0x0112, 1) >= 5  # EXIF's orientation: lies on its side
        size = image.size[::-1] if turned else image.size
        return Photo(_pixels(image), size, _focal(exif, size), exif_fix(exif))


def read_depth(data: bytes, name: str, scale: float, options: ServeOptions) -> NDArray[np.float32]:
    """Depth (h, w) [m], NaN: no reading, of a PNG of 16 bits."""
    with opened(BytesIO(data), name, bounded=True) as image:
        if not image.mode.startswith("I"):
            raise InputError(f"{name} has pixels of mode {image.mode!r}; send a PNG of 16 bits.")
        check_size(image.size, name, options)
        units = np.asarray(image).astype(np.float32)
    return np.where(units > 0, units / np.float32(scale), np.float32(np.nan))


def fitted(size: tuple[int, int]) -> tuple[int, int]:
    """Width and height of an image once it is no larger than what is localized."""
    share = min(1.0, LONGEST / max(size))
    return max(1, round(size[0] * share)), max(1, round(size[1] * share))


def check_focal(camera: Camera, name: str) -> None:
    """Refuse focal lengths that are none in pixels."""
    shares = [focal / max(camera.width, camera.height) for focal in (camera.fx, camera.fy)]
    if not SHORTEST < min(shares) <= max(shares) < 1.0 / SHORTEST:
        raise InputError(
            f"{name}: a focal length of {camera.fx:g} px is none of images of {camera.width} x "
            f"{camera.height}; give it in their pixels."
        )


def check_size(size: tuple[int, int], name: str, options: ServeOptions) -> None:
    """Refuse what has too many pixels, or too few."""
    width, height = size
    if width * height > options.pixels:
        raise RequestError(
            f"{name} is {width} x {height}, more than {options.pixels / 1e6:g} megapixels; make it "
            "smaller.",
            status=413,
            code="pixels",
        )
    if min(size) < SMALLEST:
        raise InputError(
            f"{name} is {width} x {height} pixels; send an image of {SMALLEST} or more a side."
        )


def _pixels(image: Image) -> NDArray[np.uint8]:
    from PIL import ImageOps
    from PIL.Image import Resampling

    wanted = fitted(image.size)
    if wanted != image.size:
        image.draft("RGB", (2 * wanted[0], 2 * wanted[1]))  # a JPEG is decoded at a fraction
        exif = image.getexif()
        image = image.convert("RGB").resize(wanted, Resampling.BOX)
        image.info["exif"] = exif.tobytes()
    ImageOps.exif_transpose(image, in_place=True)
    return np.asarray(image.convert("RGB"))


def _focal(exif: Any, size: tuple[int, int]) -> float | None:  # noqa: ANN401  # Pillow's
    """Focal length [px] of images of a size, if EXIF tells it by film, or by the sensor's pixels."""
    with suppress(TypeError, ValueError, ZeroDivisionError, KeyError):
        told = exif.get_ifd(_EXIF)
        if film := float(told.get(_FOCAL_FILM, 0)):
            return film / _FILM * hypot(*size)
        per_unit, unit = float(told.get(_PLANE, 0)), _UNITS[told.get(_PLANE_UNIT, 2)]
        focal = float(told.get(_FOCAL, 0)) * per_unit / unit
        if max(size) * 0.3 < focal < max(size) * 20:
            return focal
    return None
