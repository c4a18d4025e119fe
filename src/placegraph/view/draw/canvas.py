"""The drawing model: a display list in metres, clipping, and typefaces.

Map items (`Area`, `Line`, `Dot`) name a paint of `style.PAINTS`; marks that stand on the map
(`Stroke`, `Disc`, `Text`, `HeatLayer`) name colours of `style.PALETTE` and have sizes in pixels.
Positions are east, north [m].
"""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ImageFont

from placegraph.core.geometry import Floats
from placegraph.view.draw.style import LAYER

Points = NDArray[np.floating[Any]]
Bounds = tuple[float, float, float, float]
"""West, south, east, north [m]."""


@dataclass(frozen=True, slots=True)
class Frame:
    """A rectangle of the map and the pixels that show it; the map keeps its proportions."""

    center: tuple[float, float]
    """East, north [m]."""
    scale: float
    """Pixels per metre."""
    width: int
    height: int

    @classmethod
    def around(cls, bounds: Bounds, width: int, height: int) -> Frame:
        """Return a frame that shows at least these bounds: west, south, east, north [m]."""
        west, south, east, north = bounds
        scale = min(width / max(east - west, 1.0), height / max(north - south, 1.0))
        return cls(((west + east) / 2, (south + north) / 2), scale, width, height)

    @property
    def bounds(self) -> Bounds:
        """West, south, east, north [m]."""
        half_width, half_height = self.width / self.scale / 2, self.height / self.scale / 2
        east, north = self.center
        return east - half_width, north - half_height, east + half_width, north + half_height

    def to_px(self, points: Points) -> NDArray[np.float64]:
        """Convert east, north (..., 2) [m] to pixels (..., 2), x right, y down."""
        east_north: NDArray[np.float64] = np.asarray(points, np.float64)
        x = (east_north[..., 0] - self.center[0]) * self.scale + self.width / 2
        y = (self.center[1] - east_north[..., 1]) * self.scale + self.height / 2
        return np.stack([x, y], axis=-1)

    def to_map(self, pixels: Points) -> NDArray[np.float64]:
        """Convert pixels (..., 2), x right, y down, to east, north (..., 2) [m]."""
        at: NDArray[np.float64] = np.asarray(pixels, np.float64)
        east = (at[..., 0] - self.width / 2) / self.scale + self.center[0]
        north = self.center[1] - (at[..., 1] - self.height / 2) / self.scale
        return np.stack([east, north], axis=-1)


@dataclass(frozen=True, slots=True)
class Area:
    """A polygon: its rings are filled by the even-odd rule."""

    rings: Sequence[Points]
    paint: str
    row: int = -1
    """Row of the map object, for tooltips."""


@dataclass(frozen=True, slots=True)
class Line:
    """A line of one or more parts."""

    parts: Sequence[Points]
    paint: str
    row: int = -1


@dataclass(frozen=True, slots=True)
class Dot:
    """A point object."""

    at: Points
    paint: str
    row: int = -1


@dataclass(frozen=True, slots=True)
class Stroke:
    """A line or closed ring on top of the map, with widths in pixels."""

    points: Points
    color: str
    width: float
    dash: tuple[float, float] | None = None
    fill: float = 0.0
    """Opacity of the inside, of a ring."""


@dataclass(frozen=True, slots=True)
class Disc:
    """A round mark on top of the map, with a text in it where there is one."""

    at: Points
    radius: float
    """[px]"""
    color: str
    """Name in the palette, or #rrggbb."""
    rim: str = "paper"
    text: str = ""


@dataclass(frozen=True, slots=True)
class Text:
    """A line of lettering with a halo of paper."""

    at: Points
    text: str
    size: float
    """[px]"""
    ink: str
    angle: float = 0.0
    """Counter-clockwise [rad]."""
    anchor: str = "m"
    """Part of the text at the position: its start (l), middle (m) or end (r)."""
    shift: tuple[float, float] = (0.0, 0.0)
    """Offset, right and down [px]."""
    row: int = -1
    """Row of the map object it names."""


@dataclass(frozen=True, slots=True)
class HeatLayer:
    """Density on a grid, painted as heat."""

    density: NDArray[np.float64]
    """(rows, columns), 0 to 1; row 0 is the northernmost."""
    bounds: Bounds
    """West, south, east, north [m]."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture that lies under all else, such as rooms seen from above."""

    pixels: NDArray[np.uint8]
    """(rows, columns, 3) sRGB; row 0 is the northernmost."""
    bounds: Bounds
    """West, south, east, north [m]."""


@dataclass(frozen=True, slots=True)
class ParticleMarks:
    """Many small marks that look somewhere: the particles of a filter."""

    at: Points
    """(N, 2)"""
    heading: NDArray[np.float64]
    """(N,) counter-clockwise from east [rad]."""
    level: NDArray[np.float64]
    """(N,) 0 to 1, painted as colour; the higher lies on top."""
    radius: float
    """[px]"""
    tick: float = 0.0
    """Length of the line that shows where a mark looks [px]."""


MapItem = Area | Line | Dot
Mark = Stroke | Disc | Text | HeatLayer
Item = MapItem | Mark | Picture | ParticleMarks


def sort_by_layer(items: Iterable[Item]) -> list[tuple[str, list[MapItem]]]:
    """Map items by paint, lowest layer first; marks keep out."""
    layers: dict[str, list[MapItem]] = {}
    for item in items:
        if isinstance(item, MapItem):
            layers.setdefault(item.paint, []).append(item)
    return sorted(layers.items(), key=lambda layer: LAYER[layer[0]])


def clip_line(points: Points, bounds: Bounds) -> list[Floats]:
    """Clip a line (N, 2) to bounds (Liang and Barsky); return pieces (n, 2)."""
    line = np.asarray(points, np.float64)
    low, high = np.array(bounds[:2]), np.array(bounds[2:])
    if ((line >= low) & (line <= high)).all():
        return [line]
    start, delta = line[:-1], np.diff(line, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        at_low, at_high = (low - start) / delta, (high - start) / delta
    still = delta == 0.0
    inside = (start >= low) & (start <= high)
    enter = np.where(still, np.where(inside, -np.inf, np.inf), np.minimum(at_low, at_high))
    leave = np.where(still, np.where(inside, np.inf, -np.inf), np.maximum(at_low, at_high))
    first, last = np.maximum(enter.max(axis=1), 0.0), np.minimum(leave.min(axis=1), 1.0)
    pieces: list[list[Floats]] = []
    through = False
    for i in np.flatnonzero(first < last):
        a, b = start[i] + first[i] * delta[i], start[i] + last[i] * delta[i]
        if through and first[i] == 0.0:
            pieces[-1].append(b)
        else:
            pieces.append([a, b])
        through = last[i] == 1.0
    return [np.array(piece) for piece in pieces]


def clip_ring(ring: Points, bounds: Bounds) -> Floats:
    """Clip a closed ring (N, 2) to bounds (Sutherland and Hodgman); the result (n, 2) may be empty."""
    corners: Floats = np.asarray(ring, np.float64)
    sides = ((0, 1, bounds[0]), (1, 1, bounds[1]), (0, -1, bounds[2]), (1, -1, bounds[3]))
    for axis, sign, limit in sides:
        inside = sign * corners[:, axis] >= sign * limit
        if inside.all():
            continue
        ahead, ahead_inside = np.roll(corners, -1, axis=0), np.roll(inside, -1)
        kept: list[Floats] = []
        for a, b, a_in, b_in in zip(corners, ahead, inside, ahead_inside, strict=True):
            if a_in:
                kept.append(a)
            if a_in != b_in:
                kept.append(a + (limit - a[axis]) / (b[axis] - a[axis]) * (b - a))
        if not kept:
            return np.zeros((0, 2))
        corners = np.array(kept)
    return corners if (corners[0] == corners[-1]).all() else np.concatenate([corners, corners[:1]])


def cut_dashes(points: Points, drawn: float, blank: float) -> list[Floats]:
    """Cut a polyline into dashes; the dashed length starts and ends with half a dash."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    along = np.concatenate(([0.0], np.cumsum(steps)))
    starts = np.arange(-drawn / 2, along[-1], drawn + blank)
    pieces = []
    for start in starts:
        a, b = max(start, 0.0), min(start + drawn, along[-1])
        inner = along[(along > a) & (along < b)]
        at = np.concatenate(([a], inner, [b]))
        pieces.append(np.stack([np.interp(at, along, points[:, k]) for k in range(2)], axis=1))
    return pieces


FACES = ("", "DejaVuSans.ttf", "NotoSans-Regular.ttf", "LiberationSans-Regular.ttf", "Arial.ttf")
"""Files by preference; the empty one is Pillow's built-in face, which knows little beyond ASCII."""
MAX_LETTERS = 1000
"""Letters of a text that are drawn."""

_PLAIN = str.maketrans({"ß": "ss", "ı": "i", "ø": "o", "ł": "l", "đ": "d", "æ": "ae", "œ": "oe",
                        "Ø": "O", "Ł": "L", "Đ": "D", "–": "-", "—": "-", "’": "'", "“": '"',
                        "”": '"', "„": '"', "…": "...", "•": "·"})  # fmt: skip


@dataclass(frozen=True)
class Face:
    """A typeface."""

    file: str

    def font(self, size: float) -> ImageFont.FreeTypeFont:
        """Return the font of a size [px]."""
        return _font(self.file, max(1, round(size)))

    def width(self, text: str, size: float) -> float:
        """Return the width of a text [px]."""
        return self.font(32).getlength(self.drawable(text)) * size / 32

    def draws(self, text: str) -> bool:
        """Return whether the face has every letter of a text."""
        return all(_has_glyph(self.file, letter) for letter in set(text) if not letter.isspace())

    def drawable(self, text: str) -> str:
        """Return the text, without accents where the face lacks them; "" where that is no help.

        Of a longer text as many letters as the widest picture has room for: drawing costs by letters.
        """
        text = text[:MAX_LETTERS]
        if self.draws(text):
            return text
        apart = unicodedata.normalize("NFKD", text.translate(_PLAIN))
        plain = "".join(letter for letter in apart if not unicodedata.combining(letter))
        return plain if self.draws(plain) else ""


@cache
def _installed_faces() -> tuple[Face, ...]:
    """Return the installed faces."""
    found = []
    for file in FACES:
        try:
            _font(file, 16)
        except OSError:
            continue
        found.append(Face(file))
    return tuple(found)


def choose_face(texts: Iterable[str]) -> Face:
    """Return the first face that has every letter of all texts, or that draws most of them."""
    wanted = list(texts)
    return max(_installed_faces(), key=lambda face: sum(map(face.draws, wanted)))


@lru_cache(maxsize=256)
def _font(file: str, size: int) -> ImageFont.FreeTypeFont:
    font = ImageFont.truetype(file, size) if file else ImageFont.load_default(size)
    if not isinstance(font, ImageFont.FreeTypeFont):
        raise OSError("this Pillow was built without FreeType; install Pillow's own wheel")
    return font


@lru_cache(maxsize=8192)
def _has_glyph(file: str, letter: str) -> bool:
    """Return whether a letter has a glyph other than that of missing letters."""
    font = _font(file, 16)
    return bytes(font.getmask(letter)) != bytes(font.getmask("\U0010ffff"))
