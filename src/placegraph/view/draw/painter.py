"""Painting a display list with Pillow, and the sheet around maps: lettering, keys, scale bar, arrow."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageChops, ImageColor, ImageDraw

from placegraph.core.files import write_output
from placegraph.core.geometry import Floats
from placegraph.errors import OptionError
from placegraph.view.draw.canvas import (
    Area,
    Disc,
    Dot,
    Face,
    Frame,
    HeatLayer,
    Item,
    Line,
    MapItem,
    ParticleMarks,
    Picture,
    Points,
    Stroke,
    Text,
    choose_face,
    clip_line,
    cut_dashes,
    sort_by_layer,
)
from placegraph.view.draw.style import CASED, PAINTS, PALETTE, Paint

RGBA = tuple[int, int, int, int]

SUPERSAMPLE = 2
"""Pictures are painted this many times as large and then reduced, which smooths edges."""


def colour_density(density: Floats) -> Image.Image:
    """Colour a density (RGBA): from transparent over amber to red."""
    stops = np.array([0.02, 0.12, 0.4, 0.7, 1.0])
    colors = np.array(
        [(255, 205, 90, 0), (255, 190, 80, 70), (246, 138, 52, 125), (224, 74, 50, 150),
         (176, 30, 50, 165)], np.float64)  # fmt: skip
    level = np.clip(density, 0.0, 1.0) ** 0.7  # weak places show, too
    channels = [np.interp(level, stops, colors[:, k]) for k in range(4)]
    return Image.fromarray(np.stack(channels, axis=-1).round().astype(np.uint8), "RGBA")


def colour_levels(level: Floats) -> NDArray[np.uint8]:
    """Return colours (..., 4) RGBA of levels (...) from 0, unlikely, to 1, certain."""
    stops = np.array([0.0, 0.35, 0.7, 1.0])
    colors = np.array(
        [(245, 190, 66, 150), (240, 128, 40, 200), (200, 38, 40, 235), (110, 8, 52, 255)],
        np.float64,
    )
    channels = [np.interp(level, stops, colors[:, k]) for k in range(4)]
    return np.stack(channels, axis=-1).round().astype(np.uint8)


def paint_picture(
    items: Sequence[Item], frame: Frame, *, dark: bool = False, reduce: bool = True
) -> Image.Image:
    """Paint a display list as a picture (RGB) of the frame's size.

    Where it is not to be reduced yet, the picture is `SUPERSAMPLE` times as large.
    """
    large = _Painter(items, frame, dark=dark).paint(items)
    return large.reduce(SUPERSAMPLE) if reduce else large


class _Painter:
    """Paints one picture at `SUPERSAMPLE` times its size."""

    def __init__(self, items: Sequence[Item], frame: Frame, *, dark: bool) -> None:
        self.frame = Frame(
            frame.center,
            frame.scale * SUPERSAMPLE,
            frame.width * SUPERSAMPLE,
            frame.height * SUPERSAMPLE,
        )
        self.dark = dark
        self.face = choose_face(item.text for item in items if isinstance(item, Text | Disc))
        self.image = Image.new("RGB", (self.frame.width, self.frame.height), self.color("land"))
        self.draw = ImageDraw.Draw(self.image, "RGBA")

    def color(self, name: str, opacity: float = 1.0) -> RGBA:
        shown = name if name.startswith("#") else PALETTE[name][self.dark]
        red, green, blue = ImageColor.getrgb(shown)[:3]
        return red, green, blue, round(255 * opacity)

    def paint(self, items: Sequence[Item]) -> Image.Image:
        layers = sort_by_layer(items)
        casings = [(paint, drawn) for paint, drawn in layers if paint in CASED]
        for paint, drawn in layers:
            if paint in CASED and casings:
                for cased, lines in casings:  # below every road, so that junctions stay open
                    self.lines(lines, PAINTS[cased], casing=True)
                casings = []
            self.map_items(drawn, PAINTS[paint])
        for item in items:
            self.mark(item)
        return self.image

    def mark(self, item: Item) -> None:
        match item:
            case Picture():
                self.picture(item)
            case HeatLayer():
                self.paint_heat(item)
            case ParticleMarks():
                self.paint_particles(item)
            case Stroke():
                self.stroke(item)
            case Disc():
                self.disc(item)
            case Text():
                self.text(item)
            case _:
                pass

    def map_items(self, items: list[MapItem], paint: Paint) -> None:
        self.lines(items, paint)
        for item in items:
            if isinstance(item, Area):
                self.area(item, paint)
            elif isinstance(item, Dot):
                self.dot(item, paint)

    def lines(self, items: list[MapItem], paint: Paint, *, casing: bool = False) -> None:
        width = paint.width * self.frame.scale
        if casing:
            width, color = width + 2.2 * SUPERSAMPLE, self.color(paint.edge)
        else:
            color = self.color(paint.fill)
        for item in items:
            if not isinstance(item, Line):
                continue
            for part in item.parts:
                points = self.frame.to_px(part)
                dash = paint.dash and (
                    paint.dash[0] * self.frame.scale,
                    paint.dash[1] * self.frame.scale,
                )
                self.polyline(points, color, max(width, SUPERSAMPLE), dash)

    def polyline(
        self,
        points: Points,
        color: RGBA,
        width: float,
        dash: tuple[float, float] | None = None,
    ) -> None:
        if dash and min(dash) >= SUPERSAMPLE:
            seen = (0.0, 0.0, float(self.frame.width), float(self.frame.height))
            for piece in (p for part in clip_line(points, seen) for p in cut_dashes(part, *dash)):
                self.draw.line(piece.ravel().tolist(), color, round(width))
            return
        self.draw.line(points.ravel().tolist(), color, round(width), joint="curve")
        if width > 2 * SUPERSAMPLE:
            for end in (points[0], points[-1]):
                self.circle(end, width / 2 - 0.5, color)

    def circle(self, at: Points, radius: float, color: RGBA) -> None:
        x, y = at.tolist()
        self.draw.ellipse((x - radius, y - radius, x + radius, y + radius), color)

    def area(self, item: Area, paint: Paint) -> None:
        rings = [self.frame.to_px(ring) for ring in item.rings]
        if len(rings) == 1:
            self.draw.polygon(rings[0].ravel().tolist(), self.color(paint.fill))
        else:
            self.fill_even_odd(rings, self.color(paint.fill))
        if paint.edge:
            for ring in rings:
                self.draw.line(ring.ravel().tolist(), self.color(paint.edge), SUPERSAMPLE)

    def fill_even_odd(self, rings: list[Floats], color: RGBA) -> None:
        corners = np.concatenate(rings)
        low = np.maximum(np.floor(corners.min(axis=0)), 0).astype(int)
        high = np.minimum(np.ceil(corners.max(axis=0)) + 1, self.image.size).astype(int)
        if (high <= low).any():
            return
        mask = Image.new("1", tuple((high - low).tolist()))
        for ring in rings:
            one = Image.new("1", mask.size)
            ImageDraw.Draw(one).polygon((ring - low).ravel().tolist(), 1)
            mask = ImageChops.logical_xor(mask, one)
        self.image.paste(color[:3], (int(low[0]), int(low[1])), mask)

    def dot(self, item: Dot, paint: Paint) -> None:
        at = self.frame.to_px(item.at)
        radius = paint.width / 2 * SUPERSAMPLE
        if paint.form == "crown":
            radius = paint.width / 2 * self.frame.scale
            self.circle(at, max(radius, SUPERSAMPLE), self.color(paint.fill, 0.8))
            return
        # far out, symbols shrink rather than cover the map
        radius *= min(1.0, 0.4 + 0.6 * self.frame.scale / SUPERSAMPLE)
        if paint.edge:
            self.symbol(at, radius + SUPERSAMPLE, paint.form, self.color(paint.edge))
        self.symbol(at, radius, paint.form, self.color(paint.fill))

    def symbol(self, at: Points, radius: float, form: str, color: RGBA) -> None:
        x, y = at.tolist()
        if form == "square":
            r = radius * 0.85
            self.draw.rounded_rectangle((x - r, y - r, x + r, y + r), r / 3, color)
        elif form == "cross":
            arm = radius * 0.42
            self.draw.rectangle((x - radius, y - arm, x + radius, y + arm), color)
            self.draw.rectangle((x - arm, y - radius, x + arm, y + radius), color)
        else:
            self.circle(at, radius, color)

    def paint_heat(self, item: HeatLayer) -> None:
        west, south, east, north = item.bounds
        corners = self.frame.to_px(np.array([(west, north), (east, south)])).round().astype(int)
        size = corners[1] - corners[0]
        if (size < 1).any() or not item.density.any():
            return
        image = colour_density(item.density).resize(tuple(size.tolist()), Image.Resampling.BICUBIC)
        self.image.paste(image, tuple(corners[0].tolist()), image)

    def picture(self, item: Picture) -> None:
        west, south, east, north = item.bounds
        corners = self.frame.to_px(np.array([(west, north), (east, south)])).round().astype(int)
        size = corners[1] - corners[0]
        if (size < 1).any():
            return
        image = Image.fromarray(item.pixels)
        if image.size != tuple(size):
            image = image.resize(tuple(size.tolist()), Image.Resampling.BOX)
        self.image.paste(image, tuple(corners[0].tolist()))

    def paint_particles(self, item: ParticleMarks) -> None:
        """Stamp every mark into a picture of levels, where the highest wins, then colour it."""
        at = self.frame.to_px(item.at)
        radius, tick = item.radius * SUPERSAMPLE, item.tick * SUPERSAMPLE
        reach = np.arange(-np.ceil(radius), np.ceil(radius) + 1)
        disc = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
        disc = disc[np.hypot(*disc.T) <= radius]
        looks = np.stack([np.cos(item.heading), -np.sin(item.heading)], axis=-1)
        stamps = [at + offset for offset in disc]
        stamps += [at + looks * length for length in np.arange(radius, radius + tick, 0.7)]
        levels = np.zeros((self.frame.height, self.frame.width))
        painted = 1e-3 + item.level  # the lowest level, too, is a mark
        for stamp in stamps:
            x, y = np.floor(stamp).astype(int).T
            inside = (x >= 0) & (y >= 0) & (x < self.frame.width) & (y < self.frame.height)
            np.maximum.at(levels, (y[inside], x[inside]), painted[inside])
        colors = colour_levels(levels)
        colors[levels == 0.0, 3] = 0
        image = Image.fromarray(colors, "RGBA")
        self.image.paste(image, (0, 0), image)

    def stroke(self, item: Stroke) -> None:
        points = self.frame.to_px(item.points)
        if item.fill:
            self.draw.polygon(points.ravel().tolist(), self.color(item.color, item.fill))
        dash = item.dash and (item.dash[0] * SUPERSAMPLE, item.dash[1] * SUPERSAMPLE)
        self.polyline(points, self.color(item.color), item.width * SUPERSAMPLE, dash)

    def disc(self, item: Disc) -> None:
        at, radius = self.frame.to_px(item.at), item.radius * SUPERSAMPLE
        self.circle(at, radius + 1.5 * SUPERSAMPLE, self.color(item.rim))
        self.circle(at, radius, self.color(item.color))
        if item.text:
            font = self.face.font(1.25 * radius)
            self.draw.text(at.tolist(), item.text, self.color("on-mode"), font, anchor="mm")

    def text(self, item: Text) -> None:
        font = self.face.font(item.size * SUPERSAMPLE)
        halo = round(1.6 * SUPERSAMPLE)
        text = self.face.drawable(item.text)
        ink, paper = self.color(item.ink), self.color("land")
        x, y = (self.frame.to_px(item.at) + np.multiply(item.shift, SUPERSAMPLE)).tolist()
        anchor = f"{item.anchor}m"
        if not item.angle:
            self.draw.text((x, y), text, paper, font, anchor, stroke_width=halo)
            self.draw.text((x, y), text, ink, font, anchor)
            return
        width = int(font.getlength(text)) + 4 * halo
        height = int(item.size * SUPERSAMPLE * 1.5) + 4 * halo
        for color, stroke in ((paper, halo), (ink, 0)):
            mask = Image.new("L", (width, height))
            ImageDraw.Draw(mask).text(
                (width / 2, height / 2), text, 255, font, "mm", stroke_width=stroke
            )
            turned = mask.rotate(np.degrees(item.angle), Image.Resampling.BICUBIC, expand=True)
            corner = round(x - turned.width / 2), round(y - turned.height / 2)
            self.image.paste(color[:3], corner, turned)


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
        """Write a line, cut behind a word to fit its room; return where it ends.

        The line is centred on the height of `at`.
        """
        face = choose_face([text])
        text = face.drawable(text)
        if room is not None:
            text = next(iter(wrap_text(face, text, size, room, 1)), "")
        font = face.font(size * SUPERSAMPLE)
        self.draw.text(_scale_up(at), text, self._color(color), font, anchor=f"{anchor}m")
        return at[0] + face.width(text, size)

    def chip(self, corner: XY, text: str, color: str) -> float:
        """Write a word on a coloured chip; return where it ends."""
        width = choose_face([text]).width(text, 13.0)
        right = corner[0] + width + 20
        self.draw.rounded_rectangle(
            (*_scale_up(corner), *_scale_up((right, corner[1] + 21))),
            10 * SUPERSAMPLE,
            self._color(color),
        )
        self.text((corner[0] + 10, corner[1] + 11), text, 13, "paper")
        return right

    def label(self, corner: XY, text: str, size: float) -> None:
        """Write a line on a card of paper."""
        width = choose_face([text]).width(text, size)
        self._box((*corner, corner[0] + width + 20, corner[1] + size + 14))
        self.text((corner[0] + 10, corner[1] + size / 2 + 7), text, size, "ink")

    def card(self, corner: XY, lines: Sequence[tuple[str, str]], room: float) -> None:
        """Write statements, each with its verdict and in two lines at most, on a card of paper."""
        left, top = corner
        face = choose_face(text for _, text in lines)
        rows = [
            (verdict if k == 0 else None, text)
            for verdict, statement in lines
            for k, text in enumerate(wrap_text(face, statement, 13, room - 44, 2))
        ]
        width = 44 + max(face.width(text, 13) for _, text in rows)
        self._box((left, top, left + width, top + 20 * len(rows) + 14))
        for k, (verdict, text) in enumerate(rows):
            y = top + 17 + 20 * k
            self.verdict((left + 14, y), verdict or "")
            self.text((left + 28, y), text, 13, "soft-ink" if verdict == "" else "ink")

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
            points = [coordinate for point in stroke for coordinate in _scale_up(point)]
            self.draw.line(points, color, 2 * SUPERSAMPLE, joint="curve")

    def bar(self, at: XY, length: float, words: str) -> None:
        """Draw a scale bar [px] that starts at its lower left end."""
        (x, y), ink = at, self._color("ink")
        end = x + length
        for color, width in ((self._color("land"), 5), (ink, 2)):
            ticks = [(x, y - 5), (x, y), (end, y), (end, y - 5)]
            points = [coordinate for tick in ticks for coordinate in _scale_up(tick)]
            self.draw.line(points, color, width * SUPERSAMPLE, joint="curve")
        font = choose_face([words]).font(12 * SUPERSAMPLE)
        middle = _scale_up((x + length / 2, y - 9))
        halo = self._color("land")
        self.draw.text(middle, words, ink, font, "mm", stroke_width=3, stroke_fill=halo)

    def north(self, at: XY) -> None:
        """Draw a north arrow around a place."""
        x, y = at
        left, right = (
            [(x, y - 14), (x - 7, y + 8), (x, y + 3)],
            [(x, y - 14), (x + 7, y + 8), (x, y + 3)],
        )
        outline = [_scale_up(p) for p in (left[0], left[1], left[2], right[1], left[0])]
        self.draw.line(
            [c for p in outline for c in p], self._color("land"), 4 * SUPERSAMPLE, "curve"
        )
        self.draw.polygon([c for p in left for c in _scale_up(p)], self._color("ink"))
        self.draw.polygon([c for p in right for c in _scale_up(p)], self._color("soft-ink"))
        font = choose_face(["N"]).font(12 * SUPERSAMPLE)
        ink, halo = self._color("ink"), self._color("land")
        self.draw.text(
            _scale_up((x, y + 16)), "N", ink, font, "mm", stroke_width=3, stroke_fill=halo
        )

    def axes(self, at: XY) -> None:
        """Draw the map's axes, x to the right and y upwards, from their origin."""
        (x, y), length, size = at, 16.0, 3.5
        ink, halo = self._color("ink"), self._color("land")
        for dx, dy, name in ((1.0, 0.0, "x"), (0.0, -1.0, "y")):
            end = x + dx * length, y + dy * length
            tip = x + dx * (length + 2 * size), y + dy * (length + 2 * size)
            for color, width in ((halo, 5), (ink, 2)):
                self.draw.line((*_scale_up(at), *_scale_up(end)), color, width * SUPERSAMPLE)
            wings = [(end[0] + dy * side, end[1] + dx * side) for side in (-size, size)]
            self.draw.polygon([c for p in (tip, *wings) for c in _scale_up(p)], ink)
            font = choose_face([name]).font(12 * SUPERSAMPLE)
            beside = tip[0] + 7 * dx, tip[1] + 7 * dy
            self.draw.text(
                _scale_up(beside), name, ink, font, "mm", stroke_width=3, stroke_fill=halo
            )

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
                (*_scale_up((x + a, y)), *_scale_up((x + b, y))),
                self._color(color),
                2 * SUPERSAMPLE,
            )
        self._disc((x + 26, y), 4.0, color)
        return self.text((x + 36, y), words, 12, "ink") + 22

    def key_heat(self, at: XY, words: str) -> float:
        """Explain the heat; return where the next key starts."""
        return self._key_colors(at, colour_density, words)

    def key_likely(self, at: XY, words: str) -> float:
        """Explain the colours of particles; return where the next key starts."""
        return self._key_colors(
            at, lambda level: Image.fromarray(colour_levels(level), "RGBA"), words
        )

    def _key_colors(self, at: XY, colored: Callable[[Floats], Image.Image], words: str) -> float:
        width, height = 48 * SUPERSAMPLE, 12 * SUPERSAMPLE
        colors = colored(np.tile(np.linspace(0.0, 1.0, width), (height, 1)))
        corner = round(at[0] * SUPERSAMPLE), round((at[1] - 6) * SUPERSAMPLE)
        self.image.paste(self._color("land"), (*corner, corner[0] + width, corner[1] + height))
        self.image.paste(colors, corner, colors)
        return self.text((at[0] + 56, at[1]), words, 12, "ink") + 22

    def _disc(self, at: XY, radius: float, color: str) -> None:
        x, y = at
        box = (*_scale_up((x - radius, y - radius)), *_scale_up((x + radius, y + radius)))
        self.draw.ellipse(box, self._color(color))

    def _box(self, box: tuple[float, float, float, float]) -> None:
        radius = 7 * SUPERSAMPLE
        large = (*_scale_up(box[:2]), *_scale_up(box[2:]))
        self.draw.rounded_rectangle(large, radius, (*self._color("paper"), 235), width=0)

    def _color(self, name: str) -> tuple[int, int, int]:
        red, green, blue = ImageColor.getrgb(PALETTE[name][0])[:3]
        return red, green, blue


def wrap_text(face: Face, text: str, size: float, room: float, most: int) -> list[str]:
    """Break a text between words into at most so many lines that fit their room [px].

    Three dots stand for what is left out. A word that is longer than a line is cut.
    """
    lines: list[str] = []
    rest = text
    while rest and len(lines) < most:
        dots = "" if face.width(rest, size) <= room else "..." if len(lines) == most - 1 else ""
        fits = bisect_right(
            range(len(rest) + 1), room, key=lambda count: face.width(rest[:count] + dots, size)
        )
        line, rest = rest[: max(fits - 1, 1)], rest[max(fits - 1, 1) :]
        words, space, begun = line.rpartition(" ")
        if rest and not rest.startswith(" ") and space:
            line, rest = words, begun + rest
        lines.append(line.rstrip() + dots)
        rest = rest.lstrip()
    return lines


def write_image(image: Image.Image, path: str | Path, form: str, **options: Any) -> Path:  # noqa: ANN401  # Pillow's
    """Write a picture, whole or not at all.

    Raises `InputError` where it cannot be written, `OptionError` where it is named as of another form.
    """
    own = f".{form.lower()}"
    if Path(path).suffix.lower() in FORMS - {own}:
        raise OptionError(f"{path} would contain a {form}; use the ending {own}.")
    written = BytesIO()
    image.save(written, form, **options)
    return write_output(path, written.getvalue())


def _scale_up(at: XY) -> XY:
    return at[0] * SUPERSAMPLE, at[1] * SUPERSAMPLE
