"""The back end that writes a display list as SVG, for pages.

One unit of the drawing is half a metre, so that whole numbers say enough; x grows to the east of
`origin`, y to the south of it. Colours are CSS variables of the palette. Widths of map items scale
with the map; marks and lettering keep their size on the screen by the CSS variable ``--k``, the
units of a pixel.
"""

from __future__ import annotations

import base64
import io
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from placegraph.view.draw.canvas import Area, Disc, Dot, Glow, Line, MapItem, Mark, Stroke, Text
from placegraph.view.draw.painter import heat
from placegraph.view.draw.style import CASED, PAINTS, PALETTE, Paint

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from placegraph.geometry import Floats
    from placegraph.view.draw.canvas import Points

UNIT = 0.5
"""Metres in a unit of the drawing."""
CASING = 1.4
"""Casings of roads are this much wider than roads [m]."""


class Svg:
    """Writes items as SVG text around an origin, east and north [m]."""

    def __init__(self, origin: tuple[float, float]) -> None:
        self.origin = np.array(origin, np.float64)

    def units(self, points: Points) -> Floats:
        """East, north (..., 2) [m] to whole units (..., 2), x right, y down."""
        units = np.round((np.asarray(points, np.float64) - self.origin) / UNIT)
        return np.stack([units[..., 0], -units[..., 1]], axis=-1)

    def place(self, at: Points) -> str:
        """Style that puts a mark of constant size at a place."""
        x, y = self.units(at)
        return f"--x:{int(x)};--y:{int(y)}"

    def path(self, parts: Iterable[Points], *, closed: bool = False) -> str:
        """Path data of lines or rings; empty where nothing is left after rounding."""
        data = []
        for part in parts:
            corners = self.units(part)
            steps = np.diff(corners, axis=0)
            steps = steps[steps.any(axis=1)]
            if not len(steps):
                continue
            if closed:
                steps = steps[:-1]
            numbers = "".join(f"{int(n):+d}" for n in steps.ravel())
            data.append(f"M{int(corners[0, 0])} {int(corners[0, 1])}l{_tight(numbers)}"
                        + "z" * closed)  # fmt: skip
        return "".join(data)

    def shape(self, item: MapItem, attributes: str = "") -> str:
        """Write one map item; empty where it vanishes."""
        match item:
            case Area(rings):
                data = self.path(rings, closed=True)
            case Line(parts):
                data = self.path(parts)
            case Dot(at):
                x, y = self.units(at)
                data = f"M{int(x)} {int(y)}h0"
        return f'<path d="{data}"{attributes}/>' if data else ""

    def layer(self, paint: str, shapes: Sequence[str]) -> tuple[str, str]:
        """Return what lies below all roads or dots (casings, rims), and the layer itself."""
        look, name = PAINTS[paint], f"p-{paint}"
        since = f'data-since="{look.since:g}"'
        body = f'<g class="{paint}" {since}><g id="{name}">{"".join(shapes)}</g></g>'
        if look.edge and look.form != "area":
            return f'<use href="#{name}" class="{paint}-edge" {since}/>', body
        return "", body

    def mark(self, item: Mark) -> str:
        """Write one mark."""
        match item:
            case Stroke():
                return self._stroke(item)
            case Disc():
                return self._disc(item)
            case Text():
                return self.text(item)
            case Glow():
                return self._glow(item)

    def text(self, item: Text) -> str:
        """Write lettering; its halo is a stroke below the letters."""
        x, y = item.shift
        turn = f";--r:{-np.degrees(item.angle):.1f}deg" if item.angle else ""
        side = {"l": ' class="k l"', "m": ' class="k"', "r": ' class="k r"'}[item.anchor]
        shift = (f' dx="{x:g}"' if x else "") + f' dy="{y + 0.36 * item.size:.1f}"'
        style = f"{self.place(item.at)}{turn};fill:var(--{item.ink});font-size:{item.size:g}px"
        return f'<text{side} style="{style}"{shift}>{clean(item.text)}</text>'

    def _stroke(self, item: Stroke) -> str:
        closed = len(item.points) > 2 and bool((item.points[0] == item.points[-1]).all())
        dash = f";stroke-dasharray:{item.dash[0]:g} {item.dash[1]:g}" if item.dash else ""
        fill = f"var(--{item.color});fill-opacity:{item.fill:g}" if item.fill else "none"
        style = f"stroke:var(--{item.color});stroke-width:{item.width:g}px;fill:{fill}{dash}"
        units = (np.asarray(item.points, np.float64) - self.origin) / UNIT * (1.0, -1.0)
        data = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in units[: -1 if closed else None])
        return f'<path class="mark" d="{data}{"Z" * closed}" style="{style}"/>'

    def _disc(self, item: Disc) -> str:
        text = f'<text dy="{0.42 * item.radius:.1f}">{clean(item.text)}</text>' if item.text else ""
        style = f"{self.place(item.at)};fill:var(--{item.color});stroke:var(--{item.rim})"
        return f'<g class="k disc" style="{style}"><circle r="{item.radius:g}"/>{text}</g>'

    def _glow(self, item: Glow) -> str:
        west, south, east, north = item.bounds
        (x, y), (right, bottom) = self.units(np.array([(west, north), (east, south)]))
        file = io.BytesIO()
        heat(item.density).save(file, "PNG", optimize=True)
        data = base64.b64encode(file.getvalue()).decode("ascii")
        return (f'<image x="{x:.0f}" y="{y:.0f}" width="{right - x:.0f}" height="{bottom - y:.0f}" '
                f'preserveAspectRatio="none" href="data:image/png;base64,{data}"/>')  # fmt: skip


def _tight(numbers: str) -> str:
    """Leave out the plus signs that separate nothing."""
    out, after_digit = [], False
    for character in numbers:
        if character == "+":
            out.append(" " if after_digit else "")
        else:
            out.append(character)
        after_digit = character not in "+-"
    return "".join(out)


def clean(text: str) -> str:
    """Escape a text, and leave out what is not to be printed (controls, changes of direction)."""
    joiners = "\u200c\u200d"
    return escape("".join(c if c.isprintable() or c in joiners else " " for c in text))


def in_layers(
    svg: Svg, layers: Iterable[tuple[str, list[MapItem]]], attributes: Callable[[MapItem], str]
) -> str:
    """Write map items by layers, lowest first, with casings below all roads, rims below dots."""
    written = []
    below: list[str] = []
    for paint, items in layers:
        shapes = [shape for item in items if (shape := svg.shape(item, attributes(item)))]
        if not shapes:
            continue
        edge, body = svg.layer(paint, shapes)
        if edge and paint in CASED:
            below.append(edge)
        written.append((paint, edge if paint not in CASED else "", body))
    out = []
    for paint, edge, body in written:
        if paint in CASED and below:
            out += below
            below = []
        out += [edge, body]
    return "".join(out)


def style_sheet() -> str:
    """CSS of the palette (light and dark) and of the paints."""
    light, dark = (
        "".join(f"--{name}:{colors[k]};" for name, colors in PALETTE.items()) for k in (0, 1)
    )
    rules = [
        f":root{{color-scheme:light dark;{light}}}",
        f"@media (prefers-color-scheme:dark){{:root{{{dark}}}}}",
    ]
    for name, paint in PAINTS.items():
        rules += _rules(name, paint)
    return "\n".join(rules)


def _rules(name: str, paint: Paint) -> list[str]:
    """CSS of one paint."""
    color, edge = f"var(--{paint.fill})", f"var(--{paint.edge})"
    fixed = f"#p-{name} path{{vector-effect:non-scaling-stroke}}"
    if paint.form == "area":
        outline = f";stroke:{edge};stroke-width:1px" if paint.edge else ""
        rule = f".{name}{{fill:{color};fill-rule:evenodd{outline}}}"
        return [rule, fixed] if paint.edge else [rule]
    if paint.form in ("line", "crown"):
        width = paint.width / UNIT
        dash = ";stroke-linecap:round"
        if paint.dash:
            drawn, blank = (length / UNIT for length in paint.dash)
            dash = f";stroke-linecap:butt;stroke-dasharray:{drawn:g} {blank:g}"
        rules = [f".{name}{{fill:none;stroke:{color};stroke-width:{width:g}{dash}}}"]
        if paint.edge:
            rules.append(
                f".{name}-edge{{fill:none;stroke:{edge};stroke-width:{width + CASING / UNIT:g}"
                ";stroke-linecap:round}"
            )
        return rules
    square = paint.form == "square"
    width, cap = paint.width * (0.8 if square else 1.0), "square" if square else "round"
    look = f"{{stroke:{color};stroke-width:{width:g}px;stroke-linecap:{cap}}}"
    rim = f"{{stroke:{edge};stroke-width:{width + 2.5:g}px;stroke-linecap:{cap}}}"
    return [f".{name}{look}", fixed, *([f".{name}-edge{rim}"] if paint.edge else [])]
