"""The paper around maps: lettering, keys, scale bar and north arrow, in pixels."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageColor, ImageDraw

from placegraph.core.files import put
from placegraph.core.geometry import Floats
from placegraph.errors import OptionError
from placegraph.view.draw.fonts import face_for
from placegraph.view.draw.painter import SUPERSAMPLE, heat, likely
from placegraph.view.draw.style import PALETTE

XY = tuple[float, float]
FORMS = {".png", ".gif", ".jpg", ".jpeg", ".webp"}


class Sheet:
    """A sheet of paper to lay maps and their furniture on; drawn large and reduced when saved."""

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        size = width * SUPERSAMPLE, height * SUPERSAMPLE
        self.image = Image.new("RGB", size, self._color("paper"))
        self.draw = ImageDraw.Draw(self.image, "RGBA")

    def save(self, path: str | Path) -> Path:
        """Write the sheet as a PNG."""
        # the best level takes ten times as long
        return write_image(self.image.reduce(SUPERSAMPLE), path, "PNG", compress_level=6)

    def paste(self, picture: Image.Image, corner: tuple[int, int]) -> None:
        """Lay a picture that is `SUPERSAMPLE` times as large on the sheet."""
        self.image.paste(picture, (corner[0] * SUPERSAMPLE, corner[1] * SUPERSAMPLE))

    def text(
        self,
        at: XY,
        text: str,
        size: float,
        color: str,
        *,
        anchor: str = "l",
        room: float | None = None,
    ) -> float:
        """Write a line, cut to its room, centred on the height of `at`; return where it ends."""
        face = face_for([text])
        text = face.drawable(text)
        if room is not None and face.width(text, size) > room:
            fits = bisect_right(
                range(len(text)), room, key=lambda count: face.width(text[:count] + "...", size)
            )
            text = text[: max(fits - 1, 0)].rstrip() + "..."
        font = face.font(size * SUPERSAMPLE)
        self.draw.text(_up(at), text, self._color(color), font, anchor=f"{anchor}m")
        return at[0] + face.width(text, size)

    def chip(self, corner: XY, text: str, color: str) -> float:
        """Write a word on a coloured chip; return where it ends."""
        width = face_for([text]).width(text, 13.0)
        right = corner[0] + width + 20
        self.draw.rounded_rectangle(
            (*_up(corner), *_up((right, corner[1] + 21))), 10 * SUPERSAMPLE, self._color(color)
        )
        self.text((corner[0] + 10, corner[1] + 11), text, 13, "paper")
        return right

    def label(self, corner: XY, text: str, size: float) -> None:
        """Write a line on a card of paper."""
        width = face_for([text]).width(text, size)
        self._box((*corner, corner[0] + width + 20, corner[1] + size + 14))
        self.text((corner[0] + 10, corner[1] + size / 2 + 7), text, size, "ink")

    def card(self, corner: XY, lines: Sequence[tuple[str, str]], room: float) -> None:
        """Write lines, each with its verdict, on a card of paper."""
        left, top = corner
        face = face_for(text for _, text in lines)
        longest = max(face.width(text, 13) for _, text in lines)
        width = min(room, longest + 40)
        self._box((left, top, left + width, top + 20 * len(lines) + 14))
        for k, (verdict, text) in enumerate(lines):
            y = top + 17 + 20 * k
            self.verdict((left + 14, y), verdict)
            self.text((left + 28, y), text, 13, "ink" if verdict else "soft-ink", room=width - 38)

    def verdict(self, at: XY, verdict: str) -> None:
        """Draw a tick (for), a cross (against) or a stroke (silent) around a place."""
        x, y = at
        strokes: dict[str, list[list[XY]]] = {
            "for": [[(x - 5, y), (x - 1.5, y + 4), (x + 5, y - 4.5)]],
            "against": [[(x - 4, y - 4), (x + 4, y + 4)], [(x - 4, y + 4), (x + 4, y - 4)]],
            "silent": [[(x - 4, y), (x + 4, y)]],
        }
        color = self._color(verdict if verdict in ("for", "against") else "soft-ink")
        for stroke in strokes.get(verdict, []):
            points = [coordinate for point in stroke for coordinate in _up(point)]
            self.draw.line(points, color, 2 * SUPERSAMPLE, joint="curve")

    def bar(self, at: XY, length: float, words: str) -> None:
        """Draw a scale bar [px] that starts at its lower left end."""
        (x, y), ink = at, self._color("ink")
        end = x + length
        for color, width in ((self._color("land"), 5), (ink, 2)):
            ticks = [(x, y - 5), (x, y), (end, y), (end, y - 5)]
            points = [coordinate for tick in ticks for coordinate in _up(tick)]
            self.draw.line(points, color, width * SUPERSAMPLE, joint="curve")
        font = face_for([words]).font(12 * SUPERSAMPLE)
        middle = _up((x + length / 2, y - 9))
        halo = self._color("land")
        self.draw.text(middle, words, ink, font, "mm", stroke_width=3, stroke_fill=halo)

    def north(self, at: XY) -> None:
        """Draw a north arrow around a place."""
        x, y = at
        left, right = (
            [(x, y - 14), (x - 7, y + 8), (x, y + 3)],
            [(x, y - 14), (x + 7, y + 8), (x, y + 3)],
        )
        outline = [_up(p) for p in (left[0], left[1], left[2], right[1], left[0])]
        self.draw.line(
            [c for p in outline for c in p], self._color("land"), 4 * SUPERSAMPLE, "curve"
        )
        self.draw.polygon([c for p in left for c in _up(p)], self._color("ink"))
        self.draw.polygon([c for p in right for c in _up(p)], self._color("soft-ink"))
        font = face_for(["N"]).font(12 * SUPERSAMPLE)
        ink, halo = self._color("ink"), self._color("land")
        self.draw.text(_up((x, y + 16)), "N", ink, font, "mm", stroke_width=3, stroke_fill=halo)

    def axes(self, at: XY) -> None:
        """Draw the map's axes, x to the right and y upwards, from their origin."""
        (x, y), length, size = at, 16.0, 3.5
        ink, halo = self._color("ink"), self._color("land")
        for dx, dy, name in ((1.0, 0.0, "x"), (0.0, -1.0, "y")):
            end = x + dx * length, y + dy * length
            tip = x + dx * (length + 2 * size), y + dy * (length + 2 * size)
            for color, width in ((halo, 5), (ink, 2)):
                self.draw.line((*_up(at), *_up(end)), color, width * SUPERSAMPLE)
            wings = [(end[0] + dy * side, end[1] + dx * side) for side in (-size, size)]
            self.draw.polygon([c for p in (tip, *wings) for c in _up(p)], ink)
            font = face_for([name]).font(12 * SUPERSAMPLE)
            beside = tip[0] + 7 * dx, tip[1] + 7 * dy
            self.draw.text(_up(beside), name, ink, font, "mm", stroke_width=3, stroke_fill=halo)

    def key_disc(self, at: XY, color: str, words: str) -> float:
        """Explain a round mark; return where the next key starts."""
        self._disc((at[0] + 6, at[1]), 6.0, color)
        return self.text((at[0] + 18, at[1]), words, 12, "ink") + 22

    def key_line(self, at: XY, color: str, words: str, *, dashed: bool = False) -> float:
        """Explain a line; return where the next key starts."""
        x, y = at
        pieces = [(0, 7), (11, 18), (22, 26)] if dashed else [(0, 26)]
        for a, b in pieces:
            self.draw.line(
                (*_up((x + a, y)), *_up((x + b, y))), self._color(color), 2 * SUPERSAMPLE
            )
        self._disc((x + 26, y), 4.0, color)
        return self.text((x + 36, y), words, 12, "ink") + 22

    def key_heat(self, at: XY, words: str) -> float:
        """Explain the heat; return where the next key starts."""
        return self._key_colors(at, heat, words)

    def key_likely(self, at: XY, words: str) -> float:
        """Explain the colours of particles; return where the next key starts."""
        return self._key_colors(at, lambda level: Image.fromarray(likely(level), "RGBA"), words)

    def _key_colors(self, at: XY, colored: Callable[[Floats], Image.Image], words: str) -> float:
        width, height = 48 * SUPERSAMPLE, 12 * SUPERSAMPLE
        colors = colored(np.tile(np.linspace(0.0, 1.0, width), (height, 1)))
        corner = round(at[0] * SUPERSAMPLE), round((at[1] - 6) * SUPERSAMPLE)
        self.image.paste(self._color("land"), (*corner, corner[0] + width, corner[1] + height))
        self.image.paste(colors, corner, colors)
        return self.text((at[0] + 56, at[1]), words, 12, "ink") + 22

    def _disc(self, at: XY, radius: float, color: str) -> None:
        x, y = at
        box = (*_up((x - radius, y - radius)), *_up((x + radius, y + radius)))
        self.draw.ellipse(box, self._color(color))

    def _box(self, box: tuple[float, float, float, float]) -> None:
        radius = 7 * SUPERSAMPLE
        large = (*_up(box[:2]), *_up(box[2:]))
        self.draw.rounded_rectangle(large, radius, (*self._color("paper"), 235), width=0)

    def _color(self, name: str) -> tuple[int, int, int]:
        red, green, blue = ImageColor.getrgb(PALETTE[name][0])[:3]
        return red, green, blue


def write_image(image: Image.Image, path: str | Path, form: str, **options: Any) -> Path:  # noqa: ANN401  # Pillow's
    """Write a picture, whole or not at all.

    Raises `InputError` where it cannot be written, `OptionError` where it is named as of another form.
    """
    own = f".{form.lower()}"
    if Path(path).suffix.lower() in FORMS - {own}:
        raise OptionError(f"{path} would hold a {form}; let its name end in {own}.")
    written = BytesIO()
    image.save(written, form, **options)
    return put(path, written.getvalue())


def _up(at: XY) -> XY:
    return at[0] * SUPERSAMPLE, at[1] * SUPERSAMPLE
