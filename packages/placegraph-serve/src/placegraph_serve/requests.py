"""Requests: their schema, images, cameras, and captures in archives."""

from __future__ import annotations

import binascii
import lzma
import stat
import zipfile
import zlib
from base64 import b64decode
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from io import BytesIO
from math import cos, hypot, log, sin, sqrt
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from placegraph.core.geo import Anchor
from placegraph.core.geometry import Camera
from placegraph.core.options import options_of
from placegraph.errors import InputError, OptionError, RequestError
from placegraph.indoor.pose.prior import Prior
from placegraph.io.capture.capture import Capture, is_capture, open_capture
from placegraph.io.capture.fixes import Fix, parse_exif
from placegraph.io.capture.frame import Frame
from placegraph.io.capture.images import open_image
from placegraph.outdoor.options import LocateOptions
from placegraph_serve.options import ServeOptions
from placegraph_serve.problem import make_request_error

if TYPE_CHECKING:
    from PIL.Image import Image

Near = Annotated[
    list[float] | None,
    Field(min_length=2, max_length=2, description="Longitude and latitude [deg], in this order."),
]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


def option_field(name: str, **bounds: float) -> Any:  # noqa: ANN401  # a default, to mypy
    """Return a field of a body that stands for one of `LocateOptions`; null takes its default."""
    entry = next(entry for entry in options_of(LocateOptions) if entry.name == name)
    default = "" if entry.default is None else f" Default: {entry.default}."
    settings: Any = {"description": entry.info.text + default} | entry.info.bounds | bounds
    return Field(None, **settings)


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=False)

    @classmethod
    def read(cls, text: str | bytes, name: str) -> Self:
        """Read what came as text, and is named so; `RequestError` says what is wrong with it."""
        try:
            return cls.model_validate_json(text)
        except ValidationError as error:
            raise make_request_error(error.errors(), name) from None


class QuestionObject(_Body):
    """Object of a question."""

    words: str = Field(max_length=200)
    label: str = Field("", max_length=200)
    wind: str = Field("", max_length=10)


class QuestionBody(_Body):
    """A question of an earlier answer, as it came."""

    text: str = Field(max_length=1000)
    options: list[str] = Field(max_length=20)
    things: list[QuestionObject] = Field(max_length=20)
    gain: float = 0.0


class AnswerBody(_Body):
    """An answer to a question."""

    question: QuestionBody
    option: str = Field(max_length=200)


class Locate(_Body):
    """A sentence, and what is known beside it."""

    text: str = Field(description="Description of the speaker's surroundings.")
    map: str | None = Field(None, description="Name of a map; all maps if not given.")
    near: Near = None
    radius: float | None = option_field("radius")
    heading_deg: Finite | None = option_field("heading_deg")
    answers: list[AnswerBody] = Field(default=[], max_length=30)
    language: str | None = Field(None, max_length=20)
    top: int | None = option_field("top", le=50)


class Intrinsics(_Body):
    """Intrinsics of upright images; width and height may be those of larger ones."""

    fx: Positive
    fy: Positive | None = None
    cx: Finite | None = None
    cy: Finite | None = None
    width: int | None = Field(None, ge=1, le=65536)
    height: int | None = Field(None, ge=1, le=65536)
    distortion: list[Finite] = Field(default=[], max_length=8)
    model: Literal["opencv", "fisheye"] = "opencv"


class PriorPose(_Body):
    """Roughly where the first image was taken, in the map."""

    x: Finite
    y: Finite
    z: Finite | None = None
    yaw_deg: Finite | None = None
    spread: Positive | None = None
    turn_deg: Positive | None = None


class Localize(_Body):
    """Request to localize images, in order of time."""

    map: str | None = Field(None, description="Name of a map; all maps if not given.")
    intrinsics: Intrinsics | None = Field(
        None, description="Camera intrinsics; from EXIF if not given."
    )
    gravity: list[list[Finite]] | None = Field(
        None, max_length=1000, description="Direction of gravity in each camera's axes (x, y, z)."
    )
    odometry: list[list[list[Finite]]] | None = Field(
        None, max_length=1000, description="odometry_from_camera (4, 4) of every image [m]."
    )
    stamps: list[Finite] | None = Field(None, max_length=1000)
    depth_scale: Positive = Field(1000.0, description="Depth units per metre.")
    description: str | None = Field(None, max_length=2000)
    prior: PriorPose | None = None
    near: Near = None
    radius: Positive = Field(100.0, le=1e7, description="Radius of `near` [m].")
    heading_deg: Finite | None = None
    pictures: list[Literal["plan", "overlay", "animation"]] = Field(default=[], max_length=3)
    seed: int = Field(0, ge=0)


class BeginSession(_Body):
    """Whom to follow: somebody in a city, or a camera in a scene."""

    map: str | None = None
    near: Near = None
    radius: float | None = option_field("radius")
    heading_deg: Finite | None = option_field("heading_deg")
    camera: Intrinsics | None = None
    description: str | None = Field(None, max_length=2000)
    seed: int = Field(0, ge=0)


class Step(_Body):
    """One step: words and way in a city, a frame in a scene."""

    text: str | None = Field(None, max_length=2000)
    answers: list[AnswerBody] = Field(default=[], max_length=30)
    east: Finite | None = None
    north: Finite | None = None
    sigma: Finite | None = None
    distance: Finite | None = None
    bearing_deg: Finite | None = None
    image: str | None = Field(None, description="JPEG or PNG in base64.")
    camera: Intrinsics | None = Field(None, description="Intrinsics, where the lens refocused.")
    depth: str | None = Field(None, description="16-bit PNG in base64.")
    depth_scale: Positive = 1000.0
    odometry: list[list[Finite]] | None = Field(
        None, description="odometry_from_camera (4, 4) [m]."
    )
    gravity: list[Finite] | None = Field(
        None, description="Direction of gravity in the camera's axes."
    )
    stamp: Finite | None = None


class Live(Locate):
    """The same while one types; `id` comes back with the answer."""

    id: int | str = 0
    changes: bool = Field(False, description="Send only what differs from the answer before.")


Layer = Literal[
    "house", "street", "locality", "district", "city", "county", "state", "country", "other"
]


class _Filter(_Body):
    """Parameters that Photon's routes share."""

    layer: list[Layer] = Field([], description="Layer of the features; repeatable.")
    osm_tag: list[str] = Field(
        [], max_length=20, description="Tag as key, key:value, :value; `!` excludes; repeatable."
    )
    lang: str = Field("", max_length=35, description="Ignored: names are in the local language.")
    key: str = Field("", description="API key, where the server has keys.")


class Reverse(_Filter):
    """A point to describe; the parameters of Photon's `/reverse`."""

    lat: float = Field(ge=-90, le=90, description="Latitude [deg].")
    lon: float = Field(ge=-540, le=540, description="Longitude [deg].")
    radius: float = Field(1.0, gt=0, le=5000, description="Distance of the farthest feature [km].")
    limit: int = Field(1, ge=1, le=50, description="Maximum number of features.")


Box = tuple[float, float, float, float]


class Search(_Filter):
    """A text of a search box; the parameters of Photon's `/api`."""

    q: str = Field(max_length=500, description="Name, kind of things, or a sentence.")
    lat: float | None = Field(None, ge=-90, le=90, description="Latitude to prefer [deg].")
    lon: float | None = Field(None, ge=-540, le=540, description="Longitude to prefer [deg].")
    limit: int = Field(15, ge=1, le=50, description="Maximum number of features.")
    bbox: Box | None = Field(
        None, description="Box of the features: minLon,minLat,maxLon,maxLat [deg]."
    )
    zoom: float = Field(12.0, ge=0, le=24, description="Zoom of the map: reach of the preference.")
    location_bias_scale: float = Field(
        0.4, ge=0, le=1, description="Weight of the name against the distance."
    )
    dedupe: int = Field(1, ge=0, le=1, description="0: each way of a street is a feature.")

    @field_validator("bbox", mode="before")
    @classmethod
    def _split(cls, given: Any) -> Any:  # noqa: ANN401  # as it came
        text = given[0] if isinstance(given, list) and len(given) == 1 else given
        return text.split(",") if isinstance(text, str) else text

    @field_validator("bbox")
    @classmethod
    def _check_box(cls, box: Box | None) -> Box | None:
        if box is not None and not (box[0] <= box[2] and box[1] <= box[3]):
            raise ValueError("the box is empty; give minLon,minLat,maxLon,maxLat")
        return box


LONGEST = 1280
"""Side of an image that is localized [px]; larger ones are made smaller."""
SMALLEST = 32
"""Side of the smallest that is worth a look [px]."""
SHORTEST = 0.1
"""Focal length in longest sides of an image, of the widest lens that is believed."""
USUAL = 26.0
"""Focal length of a phone's main camera, on film of 35 mm [mm]; taken where nothing is known."""
GUESSED = 0.08
"""Deviation of that guess, as a share: main cameras have 23 to 28 mm."""
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
    """Position of the photo by its EXIF."""

    def camera(self, given: Camera | None, name: str) -> Camera:
        """Intrinsics of `rgb`: those given, else by EXIF, else a phone's usual ones.

        Raises `InputError` where those given are of images of another shape, or in other units.
        """
        width, height = self.size
        if given is None:
            focal = self.focal or USUAL / _FILM * hypot(width, height)
            error = 0.0 if self.focal else GUESSED
            given = Camera(
                width, height, focal, focal, width / 2.0, height / 2.0, focal_error=error
            )
        if abs(given.width * height - given.height * width) > max(width, height):
            raise InputError(
                f"{name} is {width} x {height}, but the intrinsics are for images of {given.width} "
                f"x {given.height}; send the intrinsics of the upright images."
            )
        check_focal(given, name)
        return given.resize(self.rgb.shape[1], self.rgb.shape[0])


def read_photo(data: bytes, name: str, options: ServeOptions) -> Photo:
    """Decode a picture, told by what it is; `RequestError` where it is too large, `InputError` else."""
    if len(data) > options.image_bytes:
        raise RequestError(
            f"{name} has {len(data):,} bytes; send at most {options.image_bytes:,}.",
            status=413, code="image_size",
        )  # fmt: skip
    if not data:
        raise InputError(f"{name} is empty; send a JPEG, PNG or WebP.")
    with open_image(BytesIO(data), name, bounded=True) as image:
        if image.format not in {"JPEG", "MPO", "PNG", "WEBP"}:
            raise InputError(f"{name} is {image.format}; send a JPEG, PNG or WebP.")
        check_size(image.size, name, options)
        exif = image.getexif()
        turned = exif.get(0x0112, 1) >= 5  # EXIF's orientation: lies on its side
        size = image.size[::-1] if turned else image.size
        return Photo(_pixels(image), size, _focal(exif, size), parse_exif(exif))


def read_depth(data: bytes, name: str, scale: float, options: ServeOptions) -> NDArray[np.float32]:
    """Depth (h, w) [m], NaN: no reading, of a PNG of 16 bits."""
    with open_image(BytesIO(data), name, bounded=True) as image:
        if not image.mode.startswith("I"):
            raise InputError(f"{name} has pixels of mode {image.mode!r}; send a 16-bit PNG.")
        check_size(image.size, name, options)
        units = np.asarray(image).astype(np.float32)
    return np.where(units > 0, units / np.float32(scale), np.float32(np.nan))


def fit_size(size: tuple[int, int]) -> tuple[int, int]:
    """Width and height of an image once it is no larger than what is localized."""
    share = min(1.0, LONGEST / max(size))
    return max(1, round(size[0] * share)), max(1, round(size[1] * share))


def check_focal(camera: Camera, name: str) -> None:
    """Refuse focal lengths that are none in pixels."""
    shares = [focal / max(camera.width, camera.height) for focal in (camera.fx, camera.fy)]
    if not SHORTEST < min(shares) <= max(shares) < 1.0 / SHORTEST:
        raise InputError(
            f"{name}: a focal length of {camera.fx:g} px is implausible for images of "
            f"{camera.width} x {camera.height}; give it in their pixels."
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
            f"{name} has {width} x {height} pixels; send an image of at least {SMALLEST} pixels "
            "per side."
        )


def _pixels(image: Image) -> NDArray[np.uint8]:
    from PIL import ImageOps
    from PIL.Image import Resampling

    wanted = fit_size(image.size)
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


LEVEL = (0.0, 1.0, 0.0)
"""Gravity in the axes of a camera that is held upright."""
TILTS = (0.17, -0.17)
"""Angles below the horizon that are tried after level, where nobody says how the camera was held [rad]."""
FAR_OFF, HOUSE = 5.0, 200.0
"""A fix so many radii and so far [m] from a map says nothing of where in it an image was taken."""
HALF = sqrt(2.0 * log(2.0))
"""Standard deviations of a round Gaussian in the radius within which half of it lies."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hints:
    """Location prior, besides images."""

    map: str | None = None
    description: str | None = None
    prior: Prior | None = None
    """In the map's own axes."""
    near: tuple[float, float] | None = None
    """Longitude and latitude [deg]."""
    radius: float = 100.0
    """Within which half of the prior lies [m]."""
    height: float | None = None
    """Above the ellipsoid [m]."""
    heading: float | None = None
    """Heading of the camera, clockwise from north [rad]."""
    seed: int = 0

    def prior_in(self, anchors: Sequence[Anchor]) -> Prior | None:
        """Prior in a map's axes: the one given, or the fix, by the map's likeliest anchor."""
        if self.prior is not None or self.near is None or not anchors:
            return self.prior
        anchor = anchors[0]
        height = anchor.height if self.height is None else self.height
        x, y, z = anchor.to_map((*self.near, height)).tolist()
        if self.is_far(hypot(x, y)):  # one of the two is wrong; images decide
            return None
        # the map's y axis points to the anchor's heading, and yaw is counted from x the other way
        yaw = None if self.heading is None else np.pi / 2.0 + anchor.heading - self.heading
        return Prior(
            x, y, None if self.height is None else z, yaw, spread=max(self.radius / HALF, 0.05)
        )

    def notes(self, name: str, anchors: Sequence[Anchor]) -> list[str]:
        """Return which hints could not be used in a map, and why."""
        if self.prior is not None or self.near is None or not anchors:
            return []
        away, swapped = (
            hypot(*anchors[0].to_map((*near, anchors[0].height))[:2])
            for near in (self.near, self.near[::-1])
        )
        if not self.is_far(away):
            return []
        said = (
            f"The given position lies {away / 1000.0:.1f} km from map {name!r}, so it was ignored; "
        )
        if not self.is_far(swapped):
            return [said + "swapped, it lies there: longitude comes first."]
        return [said + "check the position, or the anchor of the map."]

    def is_far(self, distance: float) -> bool:
        """Whether a fix is so far from a map [m] that it says nothing of where in it one is."""
        return distance > FAR_OFF * self.radius + HOUSE


@dataclass(frozen=True, slots=True, eq=False)
class Images:
    """Frames to be localized, and what was not said of them."""

    frames: tuple[Frame, ...]
    moved: bool
    """Whether odometry says how the camera moved from one to the next; else each stands alone."""
    leveled: bool
    """Whether gravity is known."""


def tilt_camera(frame: Frame, tilt: float) -> Frame:
    """Return a frame of a camera that looks so far below the horizon [rad]."""
    return replace(frame, gravity=np.array([0.0, cos(tilt), sin(tilt)]))


def camera_of(given: dict[str, Any] | None, photo: Photo | None) -> Camera | None:
    """Camera of intrinsics as JSON has them, of a photo's size if they tell none; None of none."""
    if given is None:
        return None
    width, height = (given["width"], given["height"]) if photo is None else photo.size
    width, height = given["width"] or width, given["height"] or height
    if width is None or height is None:
        raise OptionError("camera: width and height are missing; give those of the images.")
    cx = width / 2.0 if given["cx"] is None else given["cx"]
    cy = height / 2.0 if given["cy"] is None else given["cy"]
    fy = given["fy"] or given["fx"]
    return Camera(
        width, height, given["fx"], fy, cx, cy, tuple(given["distortion"]), given["model"]
    )


def images_of(photos: Sequence[Photo], depths: Sequence[Any], parameters: dict[str, Any]) -> Images:
    """Return frames of photos and depth images, with the parameters of `Localize`.

    Raises `InputError` where intrinsics or depth are of other images, `OptionError` where there are
    more or fewer of one than of another.
    """
    count = len(photos)
    for name in ("gravity", "odometry", "stamps"):
        if parameters.get(name) is not None and len(parameters[name]) != count:
            raise OptionError(
                f"{name}: {len(parameters[name])} for {count} images; send one per image."
            )
    if depths and len(depths) != count:
        raise OptionError(f"depth: {len(depths)} for {count} images; send one per image, or none.")
    cameras = [
        photo.camera(camera_of(parameters.get("intrinsics"), photo), f"images[{i}]")
        for i, photo in enumerate(photos)
    ]
    gravity, odometry = parameters.get("gravity"), parameters.get("odometry")
    stamps = parameters.get("stamps") or list(range(count))
    frames = [
        Frame.from_arrays(
            photo.rgb, camera,
            depth=depths[i] if depths else None,
            odometry=None if odometry is None else odometry[i],
            gravity=gravity[i] if gravity else None if odometry else LEVEL,
            stamp=stamps[i], index=i,
        )
        for i, (photo, camera) in enumerate(zip(photos, cameras, strict=True))
    ]  # fmt: skip
    together = odometry is not None
    if together and len({(f.camera.width, f.camera.height) for f in frames}) > 1:
        raise InputError("images: their sizes differ; send images of one camera.")
    leveled = gravity is not None or together
    return Images(tuple(frames), together or count == 1, leveled)


_BROKEN = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, OSError, ValueError, RuntimeError,
           EOFError)  # fmt: skip
"""Errors of zipfile for damaged, encrypted and strange files."""
_CHUNK = 1 << 20
_EACH = 6
"""Files that a frame may have."""


def capture_in(path: Path, folder: Path, options: ServeOptions) -> Capture:
    """Capture of a ZIP, whose files are unpacked into an empty folder.

    Raises `InputError`: it is no whole ZIP, a name leads out of it, or it holds no capture;
    `RequestError`: it has too many files, or too large ones.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            _unpack(archive, folder, options)
    except _BROKEN as error:
        raise InputError(
            f"capture: not a complete ZIP ({' '.join(str(error).split())}); send it again."
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
        raise _too_much(f"more than {left:,} bytes after unpacking; send fewer frames")
    for entry in entries:
        target = folder / _safe(entry)
        target.parent.mkdir(parents=True, exist_ok=True)
        with archive.open(entry) as packed, target.open("wb") as out:
            while chunk := packed.read(_CHUNK):  # counted, whatever its directory says
                left -= len(chunk)
                if left < 0:
                    raise _too_much("more than it declares; send the original file")
                out.write(chunk)


def _safe(entry: zipfile.ZipInfo) -> PurePosixPath:
    """Path of an entry below the folder; `InputError` where it leads elsewhere, or is a link."""
    name = PurePosixPath(entry.filename)
    odd = name.is_absolute() or ".." in name.parts or "\\" in entry.filename or len(str(name)) > 200
    if odd or ":" in entry.filename or stat.S_ISLNK(entry.external_attr >> 16):
        raise InputError(
            f"capture: {entry.filename[:80]!r} points outside the ZIP; pack the folder again."
        )
    return name


def _too_much(what: str) -> RequestError:
    return RequestError(f"capture: {what}.", status=413, code="unpacked")


def image_bytes(text: object) -> bytes:
    """Bytes of base64, of either alphabet, with or without padding and the head of a data URL."""
    if not isinstance(text, str):
        raise InputError("imageBytes: not text; send base64.")
    coded = text.partition(",")[2] if text.startswith("data:") else text
    coded = "".join(coded.split()).translate(str.maketrans("-_", "+/")).rstrip("=")
    try:
        return b64decode(coded + "=" * (-len(coded) % 4), validate=True)
    except (binascii.Error, ValueError) as error:
        raise InputError(f"imageBytes: not base64 ({error}); encode the image again.") from None
