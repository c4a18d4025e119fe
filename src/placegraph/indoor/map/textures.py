"""Textures of a scene map, and how much of a source a map keeps."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import cached_property
from threading import Lock
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError, MapError, OptionError
from placegraph.indoor.map.mesh import GRAIN, UV_GRAIN, Mesh
from placegraph.io.capture.images import FREE_PIXELS, PIXELS_A_BYTE, open_image, to_rgb

if TYPE_CHECKING:
    from PIL.Image import Image

    from placegraph.io.mesh.model import Texture

_LARGEST_SIDE = 1 << 14  # texels a side


@dataclass(frozen=True, slots=True)
class Detail:
    """Level of detail of a map; the defaults cost no recall (docs/benchmarks/indoor.md)."""

    error: float | None = 0.005
    """Greatest distance of the simplified surface's vertices from the source's [m]; None: the
    source's triangles as they are."""
    texel: float = 0.003
    """Least length of a texel on the surface [m]: finer textures are made smaller; 0: as they are."""
    baked: float = 0.01
    """Length of a texel of textures made from colours of vertices or from a capture's images [m]."""
    max_texture: int = 512
    """Longer sides of the source's textures are brought to this many texels."""
    quality: int = 80
    """Quality of WebP, 1 to 100; 0 keeps JPEG and PNG of the source where possible."""
    grain: float = 8 * GRAIN
    """Step of vertices [m], a power of two: 0.98 mm."""
    uv_grain: float = 4 * UV_GRAIN
    """Step of texture coordinates, a power of two."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None and not (np.isfinite(value) and value >= 0):
                raise OptionError(f"{field.name} is {value}; it must be 0 or more.")
        if not 1 <= self.max_texture <= _LARGEST_SIDE:
            raise OptionError(
                f"max_texture is {self.max_texture}; it must be 1 to {_LARGEST_SIDE} texels."
            )
        if self.quality > 100:
            raise OptionError(
                f"quality is {self.quality}; it must be 1 to 100, or 0 to keep images as they are."
            )
        if not 1e-3 <= self.baked <= 1.0:
            raise OptionError(f"baked is {self.baked} m; texels must be 0.001 to 1 m.")
        for name, least in (("grain", GRAIN), ("uv_grain", UV_GRAIN)):
            if getattr(self, name) < least or np.log2(getattr(self, name)) % 1.0:
                raise OptionError(
                    f"{name} is {getattr(self, name)}; it must be a power of two, at least {least}."
                )


FULL = Detail(error=None, texel=0.0, quality=0, grain=GRAIN, uv_grain=UV_GRAIN)
DETAILS = {
    "full": FULL,
    "fine": Detail(error=0.002, texel=0.002),
    "default": Detail(),
    "small": Detail(error=0.01, texel=0.01, baked=0.02, quality=70),
    "tiny": Detail(error=0.03, texel=0.04, baked=0.05, quality=60),
}
"""By name, as `--detail` takes them."""


def get_detail(detail: str | Detail) -> Detail:
    """Return detail of a name; `OptionError` where there is none of this name."""
    if isinstance(detail, Detail):
        return detail
    if detail not in DETAILS:
        raise OptionError(f"detail is {detail!r}; choose one of {', '.join(DETAILS)}.")
    return DETAILS[detail]


QUALITY = 90  # WebP quality of textures for which none is asked
FINEST = 0.25  # Share of a texture's surface that may ask for smaller texels than it gets
FORMATS = ("WEBP", "PNG", "JPEG")  # Formats of textures in a map file
_SLACK = 2.0  # what PNG's best may save of its quickest


def linear_from_srgb(colours: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return linear intensities 0 to 1 of sRGB values 0 to 1 (IEC 61966-2-1)."""
    high = ((np.maximum(colours, 0.0) + 0.055) / 1.055) ** 2.4
    out: NDArray[np.float64] = np.where(colours <= 0.04045, colours / 12.92, high)
    return out


def srgb_from_linear(intensities: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return SRGB values 0 to 1 of linear intensities 0 to 1 (IEC 61966-2-1)."""
    high = 1.055 * np.maximum(intensities, 0.0) ** (1 / 2.4) - 0.055
    out: NDArray[np.float64] = np.where(intensities <= 0.0031308, intensities * 12.92, high)
    return out


def encode_pictures(
    pictures: Sequence[Texture], detail: Detail, needed: NDArray[np.float64] | None = None
) -> tuple[bytes, ...]:
    """Return encoded textures of a model's pictures: made small, base colour folded in.

    `needed` (K, 2): width and height in texels that each picture needs at most on its surface
    (`measure_needed_texels`). With quality 0 a JPEG or PNG that needs nothing done is kept as it is. Raises
    `InputError` where a picture is broken.
    """
    limits = np.full((len(pictures), 2), np.inf) if needed is None else needed
    with ThreadPoolExecutor(2) as pool:  # Pillow works outside the interpreter's lock
        return tuple(
            pool.map(
                lambda i: _encode_picture(pictures[i], detail, limits[i]), range(len(pictures))
            )
        )


def encode_arrays(
    textures: Iterable[NDArray[np.uint8]], quality: int = QUALITY
) -> tuple[bytes, ...]:
    """Return encoded textures of arrays (h, w, 3) uint8."""
    from PIL import Image

    return tuple(_encode(Image.fromarray(np.asarray(a)), quality) for a in textures)


def measure_needed_texels(mesh: Mesh, texel: float) -> NDArray[np.float64]:
    """Return width and height (K, 2) in texels at which each texture's texels are `texel` [m] long.

    By the finest quarter of the surface that bears it; infinite where nothing does, or texel is 0.
    """
    needed = np.full((len(mesh.textures), 2), np.inf)
    place, uv = (column[mesh.triangles].astype(np.float64) for column in (mesh.vertices, mesh.uv))
    (e1, e2), (d1, d2) = ((c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]) for c in (place, uv))
    det = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    good = np.abs(det) > 1e-12
    along_u = np.linalg.norm(e1 * d2[:, 1:] - e2 * d1[:, 1:], axis=1)  # times det
    along_v = np.linalg.norm(e2 * d1[:, :1] - e1 * d2[:, :1], axis=1)
    area = np.linalg.norm(np.cross(e1, e2), axis=1)
    for k in np.unique(mesh.texture_of[good]).tolist() if texel > 0 else ():
        rows = np.flatnonzero(good & (mesh.texture_of == k) & (area > 0))
        for axis, along in enumerate((along_u, along_v)):
            length = along[rows] / np.abs(det[rows])  # of one unit of the coordinate [m]
            order = np.argsort(length)
            total = np.cumsum(area[rows][order])
            if rows.size:
                metres = length[order[np.searchsorted(total, FINEST * total[-1])]]
                needed[k, axis] = max(np.ceil(metres / texel), 1.0)
    return needed


@dataclass(frozen=True, eq=False)
class EncodedTextures(Sequence[NDArray[np.uint8]]):
    """Encoded textures, which are all decoded when the first one is asked for.

    That raises `MapError` as `decode_textures` does.
    """

    blobs: tuple[bytes, ...]
    path: object
    """What an error names."""

    def __len__(self) -> int:
        return len(self.blobs)

    @overload
    def __getitem__(self, row: int) -> NDArray[np.uint8]: ...
    @overload
    def __getitem__(self, row: slice) -> tuple[NDArray[np.uint8], ...]: ...
    def __getitem__(self, row: int | slice) -> Any:
        return self._decoded[row]

    @cached_property
    def _decoded(self) -> tuple[NDArray[np.uint8], ...]:
        return decode_textures(self.blobs, self.path)


def decode_textures(blobs: Sequence[bytes], path: object) -> tuple[NDArray[np.uint8], ...]:
    """Decode textures (h, w, 3) uint8 of encoded ones.

    Raises `MapError` naming `path` where one is no image, or where all together would fill memory.
    """
    size, lock = sum(map(len, blobs)), Lock()
    left = 4 * FREE_PIXELS + PIXELS_A_BYTE * size

    def decoded(i: int) -> NDArray[np.uint8]:
        nonlocal left
        name = f"{path}: texture {i}"
        try:
            with open_image(io.BytesIO(blobs[i]), name) as image:
                if max(image.size) > _LARGEST_SIDE or image.format not in FORMATS:
                    raise MapError(
                        f"{name} is not a WebP, PNG or JPEG image of at most "
                        f"{_LARGEST_SIDE} texels per side."
                    )
                with lock:
                    left -= image.width * image.height
                if left < 0:
                    raise MapError(
                        f"{path}: its textures declare more texels than {size:,} bytes can "
                        "encode; the file is damaged or malicious. Build the map again."
                    )
                return to_rgb(image)
        except InputError as error:
            raise MapError(f"{error} Build the map again.") from error

    with ThreadPoolExecutor(2) as pool:  # Pillow works outside the interpreter's lock
        return tuple(pool.map(decoded, range(len(blobs))))


def _encode_picture(picture: Texture, detail: Detail, needed: NDArray[np.float64]) -> bytes:
    from PIL import Image

    factor = np.clip(np.array(picture.factor, np.float64), 0.0, 1.0)
    if picture.data is None:
        flat = np.rint(255.0 * srgb_from_linear(factor)).astype(np.uint8)
        return _encode(Image.fromarray(flat.reshape(1, 1, 3)), detail.quality)
    with open_image(io.BytesIO(picture.data), picture.name) as image:
        width, height = _limit_size(image.size, detail.max_texture, needed)
        whole = image.format in FORMATS and image.mode == "RGB" and (width, height) == image.size
        image.draft("RGB", (width, height))  # JPEG's own halving: quick
        image.load()
        if whole and not detail.quality and (factor == 1.0).all() and not any(picture.mirrored):
            return picture.data
        small = image if image.mode == "RGB" else image.convert("RGB")
    if small.size != (width, height):
        small = small.resize((width, height), Image.Resampling.BOX)
    texels = np.asarray(small)
    if (factor != 1.0).any():
        steps = linear_from_srgb(np.arange(256) / 255.0)
        table = np.rint(255.0 * srgb_from_linear(steps[:, None] * factor)).astype(np.uint8)
        texels = np.stack([table[texels[:, :, c], c] for c in range(3)], axis=2)
    for axis, mirrored in ((1, picture.mirrored[0]), (0, picture.mirrored[1])):
        if mirrored:  # twice as large, then to be repeated: the coordinates were halved
            texels = np.concatenate([texels, np.flip(texels, axis)], axis=axis)
    return _encode(Image.fromarray(texels), detail.quality)


def _limit_size(
    size: tuple[int, int], largest: int, needed: NDArray[np.float64]
) -> tuple[int, int]:
    """Return width and height [texels] that a picture is brought to; never more than it has."""
    scale = min(largest / max(size), 1.0)
    width, height = (
        max(1, round(min(side * scale, most))) for side, most in zip(size, needed, strict=True)
    )
    return width, height


def _encode(image: Image, quality: int) -> bytes:
    """Return PNG where that is smaller, as for flat colours and drawings; else WebP."""
    from PIL import Image

    if image.width * image.height <= 64:
        return _save_image(image, "PNG", optimize=True)
    webp = _save_image(image, "WEBP", quality=quality or QUALITY, method=4)
    lines = np.arange(image.height) // 8 % 4 == 0  # PNG's best takes long: a quarter will tell
    some = Image.fromarray(np.asarray(image)[lines])
    if len(_save_image(some, "PNG", compress_level=1)) > _SLACK * len(webp) * lines.mean():
        return webp
    return min(webp, _save_image(image, "PNG", optimize=True), key=len)


def _save_image(image: Image, form: str, **options: Any) -> bytes:  # noqa: ANN401  # of Pillow's encoder
    file = io.BytesIO()
    image.save(file, form, **options)
    return file.getvalue()
