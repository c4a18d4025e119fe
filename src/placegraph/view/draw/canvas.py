"""The drawing model: a display list in metres, which `painter` draws.

Map items (`Area`, `Line`, `Dot`) name a paint of `style.PAINTS`; marks that stand on the map
(`Stroke`, `Disc`, `Text`, `Glow`) name colours of `style.PALETTE` and have sizes in pixels.
Positions are east, north [m].
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
        """Frame that shows at least these bounds: west, south, east, north [m]."""
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
        """East, north (..., 2) [m] to pixels (..., 2), x right, y down."""
        east_north: NDArray[np.float64] = np.asarray(points, np.float64)
        x = (east_north[..., 0] - self.center[0]) * self.scale + self.width / 2
        y = (self.center[1] - east_north[..., 1]) * self.scale + self.height / 2
        return np.stack([x, y], axis=-1)


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
    """What of the text stands at the place: its start (l), middle (m) or end (r)."""
    shift: tuple[float, float] = (0.0, 0.0)
    """Offset, right and down [px]."""
    row: int = -1
    """Row of the map object it names."""


@dataclass(frozen=True, slots=True)
class Glow:
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
class Swarm:
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
Mark = Stroke | Disc | Text | Glow
Item = MapItem | Mark | Picture | Swarm


def in_painters_order(items: Iterable[Item]) -> list[tuple[str, list[MapItem]]]:
    """Map items by paint, lowest layer first; marks keep out."""
    layers: dict[str, list[MapItem]] = {}
    for item in items:
        if isinstance(item, MapItem):
            layers.setdefault(item.paint, []).append(item)
    return sorted(layers.items(), key=lambda layer: LAYER[layer[0]])
