"""The map of a page: detail around the modes, the whole city in outline, lettering by scale."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from placegraph.estimate import Status
from placegraph.outdoor.map.objects import simplify
from placegraph.view.city.coast import sea
from placegraph.view.city.estimate_items import (
    Witness,
    ellipse,
    evidence_marks,
    heat_of,
    mode_bounds,
    place_of,
    rivals,
    witnesses,
)
from placegraph.view.city.items import city_bounds, extents, item_of, labels_of
from placegraph.view.draw.canvas import (
    Area,
    Bounds,
    Line,
    MapItem,
    Points,
    Stroke,
    Text,
    in_painters_order,
)
from placegraph.view.draw.clip import overlap
from placegraph.view.draw.fonts import face_for
from placegraph.view.draw.lettering import Taken, covering, letter
from placegraph.view.draw.style import LINE, PAINTS
from placegraph.view.draw.svg import Svg, clean, in_layers

if TYPE_CHECKING:
    from placegraph.estimate import CityEstimate, Place
    from placegraph.geometry import Floats
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.map.objects import CityObjects

DETAIL_BYTES = 1_600_000
"""Objects are drawn in detail, those nearest to a mode first, until so much is written."""
OUTLINE_BYTES = 300_000
"""The whole city is outlined, large things first, until so much is written."""
OUTLINED = frozenset(
    ("sea", "park", "wood", "water", "river", "rail", "motorway", "main-road", "street")
)
"""Paints of the outline."""
COARSE = 6.0
"""The outline is simplified to this error [m]."""
TIERS = (0.12, 0.25, 0.5, 1.0, 2.0, 4.0)
"""Names appear at these scales [px/m], and stay at all larger ones."""
MOST_NAMES = 1500
CLOSE, MOST_NAMED = 0.5, 6000
"""From this scale on [px/m], only so many objects are named, those nearest to a mode."""
HEAT_REACH = 150.0
"""Heat is shown so far around a mode [m]."""
HEAT_PIXEL, HEAT_SIDE = 3.0, 500
"""Side of a pixel of heat [m], unless more than so many stood side by side."""


@dataclass
class PageMap:
    """What a page shows of a city and an estimate, as SVG text."""

    svg: Svg

    outline: str
    """The whole city, coarsely."""
    is_whole: bool
    """Whether the detail is the whole city, so that the outline adds nothing to it."""
    detail: str
    heat: str
    names: str
    evidence: list[str]
    """By mode."""
    pins: str
    box: tuple[float, float, float, float]
    """The whole city: x, y, width, height [units]."""
    start: tuple[float, float, float, float]
    """What is shown first."""
    mode_boxes: list[tuple[float, float, float, float]]
    tips: list[str] = field(default_factory=list)
    """What is told of objects, by index."""


def page_map(city: CityMap, estimate: CityEstimate) -> PageMap:
    """Draw what a page shows of a city and an estimate."""
    bounds = _with_modes(city, estimate)
    svg = Svg(((bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2))
    items = _near_first(city, estimate, bounds)
    tips = _Tips(city.objects)
    water = sea(city.objects, bounds)
    shore: list[MapItem] = [Area(water, "sea")] if water else []
    kept = _within_budget(svg, items)
    layers = in_painters_order([*shore, *_large_first(kept)])
    boxes = [_box(svg, mode_bounds(city, mode)) for mode in estimate.modes]
    everything = _box(svg, bounds)
    return PageMap(
        svg=svg,
        outline=_outline(svg, [*shore, *items]),
        is_whole=len(kept) == len(items),
        detail=in_layers(svg, layers, tips.attributes),
        heat="".join(_heat(svg, city, estimate)),
        names=_names(svg, city, estimate, kept),
        evidence=[_evidence(svg, city, mode) for mode in estimate.modes],
        pins="".join(
            _pin(svg, city, mode, k, ranked=estimate.ranked)
            for k, mode in reversed([*enumerate(estimate.modes)])
        ),
        box=everything,
        start=_box(svg, _start(city, estimate, bounds)),
        mode_boxes=boxes,
        tips=tips.known,
    )


class _Tips:
    """Texts told of objects, each kept once."""

    def __init__(self, objects: CityObjects) -> None:
        self.objects = objects
        self.known: list[str] = []
        self._index: dict[str, int] = {}

    def attributes(self, item: MapItem) -> str:
        """Attributes that lead from a shape to OpenStreetMap's id and to the text."""
        if item.row < 0:
            return ""
        tip = self.objects.name(item.row) + "\n" + " · ".join(labels_of(self.objects, item.row))
        index = self._index.setdefault(tip, len(self.known))
        if index == len(self.known):
            self.known.append(tip)
        return f' data-o="{self.objects.osm(item.row)}" data-t="{index}"'


def _with_modes(city: CityMap, estimate: CityEstimate) -> Bounds:
    """Rectangle of the city that also holds every mode's surroundings."""
    boxes = np.array([city_bounds(city.objects), *(mode_bounds(city, m) for m in estimate.modes)])
    low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
    return (*low.tolist(), *high.tolist())


def _start(city: CityMap, estimate: CityEstimate, bounds: Bounds) -> Bounds:
    """Rectangle that is shown first: the best mode, all rivals, or the city where all is lost."""
    if estimate.status is Status.LOST or not estimate.modes:
        return bounds
    shown = rivals(estimate, len(estimate.modes) if estimate.status is Status.AMBIGUOUS else 1)
    boxes = np.array([mode_bounds(city, mode) for mode in shown])
    return (*boxes[:, :2].min(axis=0).tolist(), *boxes[:, 2:].max(axis=0).tolist())


def _box(svg: Svg, bounds: Bounds) -> tuple[float, float, float, float]:
    """Rectangle in units: x, y, width, height."""
    west, south, east, north = bounds
    (x, y), (right, bottom) = svg.units(np.array([(west, north), (east, south)])).tolist()
    return x, y, right - x, bottom - y


def _near_first(city: CityMap, estimate: CityEstimate, bounds: Bounds) -> list[MapItem]:
    """Items of the objects in a rectangle, those nearest to a mode first."""
    boxes = extents(city.objects)
    centers = [place_of(city, mode) for mode in estimate.modes]
    if not centers:
        centers = [np.array([(bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2])]
    gaps = [
        np.hypot(*np.maximum(np.maximum(boxes[:, :2] - at, at - boxes[:, 2:]), 0.0).T)
        for at in centers
    ]
    order = np.argsort(np.min(gaps, axis=0), kind="stable")
    found = (item_of(city.objects, int(row), bounds) for row in order)
    return [item for item in found if item]


def _within_budget(svg: Svg, items: list[MapItem]) -> list[MapItem]:
    """Return the first items, as many as can be written in detail."""
    left = DETAIL_BYTES
    for k, item in enumerate(items):
        left -= len(svg.shape(item, ' data-o="way/123456789" data-t="123"'))
        if left < 0:
            return items[:k]
    return items


def _large_first(items: list[MapItem]) -> list[MapItem]:
    def spread(item: MapItem) -> float:
        return float(np.ptp(item.rings[0], axis=0).prod()) if isinstance(item, Area) else 0.0

    return sorted(items, key=lambda item: (-spread(item), item.row))


def _outline(svg: Svg, items: list[MapItem]) -> str:
    """Write the whole city coarsely, for what lies beyond the detail and for the inset."""
    chosen: list[tuple[float, str, str]] = []
    for item in items:
        if item.paint not in OUTLINED or not isinstance(item, Area | Line):
            continue
        closed = isinstance(item, Area)
        parts = [_coarse(part) for part in (item.rings if isinstance(item, Area) else item.parts)]
        parts = [part for part in parts if len(part) > (3 if closed else 1)]
        size = sum(float(np.ptp(part, axis=0).max()) for part in parts)
        data = svg.path(parts, closed=closed)
        if data and size > 4 * COARSE:
            # streets last: they are many
            chosen.append((-size if item.paint != "street" else 1.0 / size, item.paint, data))
    layers: dict[str, list[str]] = {}
    left = OUTLINE_BYTES
    for _, paint, data in sorted(chosen):
        left -= len(data)
        if left >= 0:
            layers.setdefault(paint, []).append(data)
    order = [name for name in PAINTS if name in layers]
    return "".join(f'<path class="{name}" d="{"".join(layers[name])}"/>' for name in order)


def _coarse(points: Points) -> Floats:
    """Simplify a line or ring to `COARSE`."""
    line = np.ascontiguousarray(points, np.float64)
    return simplify(line, np.array([0, len(line)]), COARSE)[0]


def _heat(svg: Svg, city: CityMap, estimate: CityEstimate) -> list[str]:
    """Write images of the posterior around the modes; windows that overlap become one."""
    windows: list[Bounds] = []
    for mode in estimate.modes:
        x, y = place_of(city, mode).tolist()
        new = x - HEAT_REACH, y - HEAT_REACH, x + HEAT_REACH, y + HEAT_REACH
        while hit := next((w for w in windows if overlap(w, new)), None):
            windows.remove(hit)
            new = (
                min(new[0], hit[0]), min(new[1], hit[1]), max(new[2], hit[2]), max(new[3], hit[3])
            )  # fmt: skip
        windows.append(new)
    glows = []
    for window in windows:
        side = max(window[2] - window[0], window[3] - window[1])
        glow = heat_of(city, estimate, window, max(HEAT_PIXEL, side / HEAT_SIDE))
        if glow:
            glows.append(svg.mark(glow))
    return glows


def _names(svg: Svg, city: CityMap, estimate: CityEstimate, items: list[MapItem]) -> str:
    """Write names by the scale from which there is room for them."""
    objects = city.objects
    face = face_for(objects.name(item.row) for item in items if item.row >= 0)
    placed: list[Text] = []
    skip: set[int] = {w.row for mode in estimate.modes[:1] for w in witnesses(city, mode)}
    groups = []
    for scale in TIERS:
        taken = Taken()
        for mode in estimate.modes:
            x, y = place_of(city, mode).tolist()
            taken.claim([(x * scale, -y * scale, 14.0)], force=True)
        for text in placed:
            width = face.width(text.text, text.size)
            taken.claim(covering(text, width + 4.0, scale), force=True)
        near = items if scale < CLOSE else items[:MOST_NAMED]
        shown = [item for item in near if PAINTS[item.paint].since <= scale]
        new = letter(objects, shown, scale, face, taken, skip=frozenset(skip), already=placed)
        new = new[: MOST_NAMES - len(placed)]
        placed += new
        skip |= {text.row for text in new if objects.kind[text.row] != LINE}
        groups.append(f'<g data-since="{scale:g}">{"".join(map(svg.text, new))}</g>')
    return "".join(groups)


def _evidence(svg: Svg, city: CityMap, mode: Place) -> str:
    """Write the marks and names of a mode's witnesses."""
    at = place_of(city, mode)
    marks = "".join(map(svg.mark, evidence_marks(city, mode)))
    names = "".join(svg.text(_beside(witness, at)) for witness in witnesses(city, mode))
    return f'{marks}<g data-since="{TIERS[2]}">{names}</g>'


def _beside(witness: Witness, at: Floats) -> Text:
    """Name a witness on the side that looks away from the mode."""
    words, ink = witness.words, witness.verdict
    if np.hypot(*(witness.at - at)) < 1.0:  # the mode stands in it
        return Text(at, words, 14.0, ink, shift=(0.0, 24.0))
    if witness.at[0] < at[0] - 1.0:
        return Text(witness.at, words, 14.0, ink, 0.0, "r", (-9.0, 0.0))
    return Text(witness.at, words, 14.0, ink, 0.0, "l", (9.0, 0.0))


def _pin(svg: Svg, city: CityMap, mode: Place, k: int, *, ranked: bool) -> str:
    """Write a mode: its ellipse and its number."""
    ring = svg.mark(Stroke(ellipse(city, mode), "mode", 1.6, (6.0, 4.0)))
    at = place_of(city, mode)
    words = clean(f"Place {k + 1}" if ranked else f"Place {k + 1}, {mode.probability:.0%}")
    return (
        f'{ring}<g class="k pin" data-mode="{k}" role="button" tabindex="0" aria-label="{words}" '
        f'style="{svg.place(at)}"><circle r="13"/><text dy="5">{k + 1}</text></g>'
    )
