"""The back end that paints a display list as a picture, with Pillow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageChops, ImageColor, ImageDraw

from placegraph.core.geometry import Floats
from placegraph.view.draw.canvas import (
    Area,
    Disc,
    Dot,
    Frame,
    Glow,
    Item,
    Line,
    MapItem,
    Picture,
    Points,
    Stroke,
    Swarm,
    Text,
    in_painters_order,
)
from placegraph.view.draw.clip import clip_line, dashes
from placegraph.view.draw.fonts import face_for
from placegraph.view.draw.style import CASED, PAINTS, PALETTE, Paint

RGBA = tuple[int, int, int, int]

SUPERSAMPLE = 2
"""Pictures are painted this many times as large and then reduced, which smooths edges."""


def heat(density: Floats) -> Image.Image:
    """Colours (RGBA) of a density: from nothing over amber to red."""
    stops = np.array([0.02, 0.12, 0.4, 0.7, 1.0])
    colors = np.array(
        [(255, 205, 90, 0), (255, 190, 80, 70), (246, 138, 52, 125), (224, 74, 50, 150),
         (176, 30, 50, 165)], np.float64)  # fmt: skip
    level = np.clip(density, 0.0, 1.0) ** 0.7  # weak places show, too
    channels = [np.interp(level, stops, colors[:, k]) for k in range(4)]
    return Image.fromarray(np.stack(channels, axis=-1).round().astype(np.uint8), "RGBA")


def likely(level: Floats) -> NDArray[np.uint8]:
    """Colours (..., 4) RGBA of levels (...) from 0, unlikely, to 1, certain."""
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
        self.face = face_for(item.text for item in items if isinstance(item, Text | Disc))
        self.image = Image.new("RGB", (self.frame.width, self.frame.height), self.color("land"))
        self.draw = ImageDraw.Draw(self.image, "RGBA")

    def color(self, name: str, opacity: float = 1.0) -> RGBA:
        red, green, blue = ImageColor.getrgb(PALETTE[name][self.dark])[:3]
        return red, green, blue, round(255 * opacity)

    def paint(self, items: Sequence[Item]) -> Image.Image:
        layers = in_painters_order(items)
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
            case Glow():
                self.glow(item)
            case Swarm():
                self.swarm(item)
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
            for piece in (p for part in clip_line(points, seen) for p in dashes(part, *dash)):
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

    def glow(self, item: Glow) -> None:
        west, south, east, north = item.bounds
        corners = self.frame.to_px(np.array([(west, north), (east, south)])).round().astype(int)
        size = corners[1] - corners[0]
        if (size < 1).any() or not item.density.any():
            return
        image = heat(item.density).resize(tuple(size.tolist()), Image.Resampling.BICUBIC)
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

    def swarm(self, item: Swarm) -> None:
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
        colors = likely(levels)
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
