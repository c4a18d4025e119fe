"""The page of a city and an estimate: one HTML file that needs no server, and the map's tiles."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import CityEstimate
from placegraph.core.files import write_output
from placegraph.core.geometry import Floats
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.map.objects import POINT, simplify
from placegraph.view.city.city_items import (
    bounding_boxes,
    city_bounds,
    competing_modes,
    draw_item,
    find_sea,
    label_words,
    list_labels,
    mode_position,
)
from placegraph.view.draw.canvas import (
    Area,
    Bounds,
    Dot,
    Line,
    MapItem,
    Points,
    clip_ring,
    sort_by_layer,
)
from placegraph.view.draw.style import (
    CASED,
    CASING,
    LINE,
    PAINTS,
    escape_text,
    find_paint,
    style_sheet,
)

if TYPE_CHECKING:
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.map.city import City

SIDE = 1024.0
"""Side of a tile of level 0 [m]."""
UNIT = 0.5
"""Metres in a unit of level 0; coordinates are whole units from the tile's south-west corner."""
MAX_LEVEL = 0.5
"""Level 0 is drawn from this scale on [px/m]."""
MARGIN = 0.04
"""A tile holds what lies so far beyond its border, so that wide roads are whole [sides]."""
SMALLEST = 2.0
"""Minimum size on the screen of what is drawn [px]."""
TOP_LEVEL = 12
THROUGH = frozenset(("motorway", "main-road", "rail", "river", "shore"))
"""Paints that make long lines of short pieces, which are kept at every scale."""

Tile = dict[str, Any]


class CityTiles:
    """Tiles of a city, made when asked for."""

    def __init__(self, city: City) -> None:
        self.city = city
        self._boxes = bounding_boxes(city.objects)
        self._spread = (self._boxes[:, 2:] - self._boxes[:, :2]).max(axis=1)

    @cached_property
    def bounds(self) -> Bounds:
        """Rectangle that is worth showing: west, south, east, north [m]."""
        return city_bounds(self.city.objects)

    @cached_property
    def top(self) -> int:
        """Level at which two by two tiles or fewer show the city."""
        west, south, east, north = self.bounds
        level = int(np.ceil(np.log2(max(east - west, north - south) / SIDE)))
        return min(max(level, 0), TOP_LEVEL)

    @cached_property
    def _paints(self) -> list[str]:
        objects = self.city.objects
        return [find_paint(list_labels(objects, row), int(kind))
                for row, kind in enumerate(objects.kind)]  # fmt: skip

    @cached_property
    def _since(self) -> Floats:
        """Scale (N,) from which an object is drawn [px/m]."""
        since = {name: paint.since for name, paint in PAINTS.items()} | {"": np.inf}
        smallest = SMALLEST / np.maximum(self._spread, 1e-3)
        smallest[[paint in THROUGH for paint in self._paints]] = 0.0
        smallest[self.city.objects.kind == POINT] = MAX_LEVEL
        street = np.array([paint == "street" for paint in self._paints])
        smallest[street] = np.minimum(smallest[street], MAX_LEVEL / 8)
        wanted: Floats = np.maximum([since[paint] for paint in self._paints], smallest)
        return wanted

    @cached_property
    def _sea(self) -> list[Floats]:
        return find_sea(self.city.objects, self.bounds)

    def index(self) -> dict[str, Any]:
        """Return the settings that a page needs before it requests tiles."""
        plane = self.city.plane
        return {
            "origin": [plane.longitude, plane.latitude],
            "metres_per_degree": list(plane.metres_per_degree),
            "bounds": [round(value, 1) for value in self.bounds],
            "side": SIDE,
            "unit": UNIT,
            "finest": MAX_LEVEL,
            "top": self.top,
            "paints": {name: asdict(paint) for name, paint in PAINTS.items()},
            "cased": sorted(CASED),
            "casing": CASING,
            "source": self.city.source,
            "objects": len(self.city.objects),
            "cells": len(self.city.cells),
            "examples": example_sentences(self.city, self._paints),
        }

    def within(self, bounds: Bounds, level: int) -> list[tuple[int, int, int]]:
        """Return the tiles (level, x, y) of a level that a rectangle touches."""
        side = SIDE * 2**level
        west, south, east, north = (int(np.floor(value / side)) for value in bounds)
        return [(level, x, y) for y in range(south, north + 1) for x in range(west, east + 1)]

    def cut(self, bounds: Bounds) -> Bounds:
        """Return the part of a rectangle in the city, or its nearest corner."""
        low, high = np.array(self.bounds[:2]), np.array(self.bounds[2:])
        west, south = np.clip(bounds[:2], low, high).tolist()
        east, north = np.clip(bounds[2:], low, high).tolist()
        return west, south, east, north

    def tile(self, level: int, x: int, y: int) -> Tile:
        """Return one tile: tables of names and labels, and layers in painting order.

        A layer names its paint; of each shape it has OpenStreetMap's id, rows of the tables (-1
        for none), and parts: first point and steps, in units (x east, y north).
        """
        side, unit = SIDE * 2**level, UNIT * 2**level
        west, south = x * side, y * side
        margin = MARGIN * side
        window = west - margin, south - margin, west + side + margin, south + side + margin
        names, labels = _Table(), _Table()
        layers = []
        for paint, items in sort_by_layer(self._items(window, level)):
            layer: dict[str, Any] = {
                "paint": paint, "osm": [], "name": [], "label": [], "shapes": []
            }  # fmt: skip
            for item in items:
                parts = _encode_parts(item, np.array([west, south]), unit, level)
                if not parts:
                    continue
                known = item.row >= 0
                layer["osm"].append(self.city.objects.osm(item.row) if known else "")
                layer["name"].append(names.row(self.city.objects.name(item.row) if known else ""))
                layer["label"].append(
                    labels.row(
                        " · ".join(list_labels(self.city.objects, item.row)) if known else ""
                    )
                )
                layer["shapes"].append(parts)
            if layer["shapes"]:
                layers.append(layer)
        return {"names": names.texts, "labels": labels.texts, "layers": layers}

    def _items(self, window: Bounds, level: int) -> Iterator[MapItem]:
        """Return the items of a tile, cut to its window, large ones first."""
        if self._sea:
            rings = [ring for ring in (clip_ring(r, window) for r in self._sea) if len(ring) > 3]
            if rings:
                yield Area(rings, "sea")
        objects = self.city.objects
        for row in self._rows(window, level):
            item = draw_item(objects, int(row), window, self._paints[row])
            if item:
                yield item

    def _rows(self, window: Bounds, level: int) -> NDArray[np.int64]:
        boxes = self._boxes
        hit = (
            (boxes[:, 0] <= window[2])
            & (boxes[:, 2] >= window[0])
            & (boxes[:, 1] <= window[3])
            & (boxes[:, 3] >= window[1])
        )
        if level:
            hit &= self._since <= 1.5 * MAX_LEVEL / 2**level
        rows = np.flatnonzero(hit)
        is_line = self.city.objects.kind[rows] == LINE
        return rows[np.lexsort((rows, np.where(is_line, 0.0, -self._spread[rows])))]


class _Table:
    """Texts, each kept once."""

    def __init__(self) -> None:
        self.texts: list[str] = []
        self._rows: dict[str, int] = {"": -1}

    def row(self, text: str) -> int:
        row = self._rows.setdefault(text, len(self.texts))
        if row == len(self.texts):
            self.texts.append(text)
        return row


def _encode_parts(item: MapItem, corner: Floats, unit: float, level: int) -> list[list[int]]:
    """Encode parts of an item as first point and steps [units]; empty where nothing is left."""
    match item:
        case Area(rings):
            parts, least = rings, 4
        case Line(lines):
            parts, least = lines, 2
        case Dot(at):
            parts, least = [np.asarray(at)[None]], 1
    found = []
    for part in parts:
        points = np.round((_simplify(part, unit) if level else np.asarray(part)) - corner, 3)
        units = np.round(points / unit).astype(np.int64)
        moved = np.concatenate([[True], (np.diff(units, axis=0) != 0).any(axis=1)])
        units = units[moved]
        if len(units) >= least:
            found.append(np.concatenate([units[:1], np.diff(units, axis=0)]).ravel().tolist())
    return found


def _simplify(part: Points, error: float) -> Floats:
    """Simplify a line or ring to an error [m]."""
    line = np.ascontiguousarray(part, np.float64)
    return simplify(line, np.array([0, len(line)]), error)[0]


KEYS = ("shop", "amenity", "leisure", "tourism", "railway", "highway")
"""Things of these kinds are spoken of."""
DULL = frozenset(
    ("parking", "bicycle parking", "parking entrance", "vending machine", "waste basket", "crossing",
     "street lamp", "give way", "turning circle", "motorway junction", "shop", "switch", "level crossing",
     "signal", "buffer stop", "vacant")
)  # fmt: skip
NEAR, FAR = 12.0, 120.0
"""Nearest and farthest distance of mentioned objects [m]."""
WINDS = ("north", "east", "south", "west")


def example_sentences(city: City, paints: Sequence[str], most: int = 3) -> list[str]:
    """Return example sentences for a city, of two or three objects in as many directions."""
    objects = city.objects
    rows = np.flatnonzero(objects.kind == POINT)
    rows = np.array(
        [row for row in rows.tolist() if _score_object(objects.label(row), paints[row])]
    )
    found: list[str] = []
    if not len(rows):
        return found
    spoken = Vocabulary.default().name_label
    names = [spoken(objects.label(row)) for row in rows.tolist()]
    at = objects.center[rows].astype(np.float64)
    # from all over the city, the same each time
    for start in range(0, len(rows), max(1, len(rows) // 40)):
        here = at[start] - (0.0, 20.0)
        sentence = _describe_place(here, at, names)
        if sentence and sentence not in found:
            found.append(sentence)
        if len(found) == most:
            break
    return found


def _score_object(label: str, paint: str) -> bool:
    plain = not label.endswith(("s", "water"))  # a toilets, a drinking water
    spoken = label.partition("=")[0] in KEYS and label_words(label) not in DULL
    return plain and bool(paint) and spoken


def _describe_place(here: Floats, at: Floats, names: Sequence[str]) -> str:
    """Describe the objects around a place in the four directions; empty where there are too few."""
    delta = at - here
    distance = np.hypot(*delta.T)
    things: dict[str, str] = {}
    for k in np.argsort(distance, kind="stable"):
        if distance[k] > FAR:
            break
        turn = np.degrees(np.arctan2(delta[k, 0], delta[k, 1])) % 360.0
        wind = round(turn / 90.0)
        name = names[k]
        if distance[k] < NEAR or abs(turn - 90.0 * wind) > 25.0 or name in things.values():
            continue
        things.setdefault(WINDS[wind % 4], name)
    if len(things) < 2:
        return ""
    (wind, name), *others = list(things.items())[:3]
    told = [f"{_a(name).capitalize()} is {wind} of me"]
    told += [f"{_a(name)} is to the {wind}" for wind, name in others]
    return f"{', '.join(told[:-1])} and {told[-1]}."


def _a(name: str) -> str:
    return f"{'an' if name[0] in 'aeiou' else 'a'} {name}"


SCRIPTS = ("base", "gestures", "tiles", "letters", "map", "marks", "panel", "answer", "still")
"""Modules of the page, each after those it imports."""
MOST_BYTES = 1_800_000
"""Tiles are added, the whole city first, then those around the modes, until so much is written."""
AROUND = 1200.0
"""Everything is drawn so far around a mode [m] ..."""
CLOSE = 150.0
"""... and so far in any case."""
TITLE = 70
"""Characters of a title, which ends with a whole word."""


def write_page(
    city: CityMap,
    estimate: CityEstimate,
    path: str | Path,
    *,
    title: str | None = None,
    question: str | None = None,
) -> Path:
    """Write an estimate as one HTML file with map, heat, modes and evidence.

    The file loads nothing else: style, scripts and map stand in it. It is about 2 MB at most,
    however large the city: around the modes everything is drawn, beyond that an outline.

    `city`: the map the estimate was made on.
    `question`: the question that would tell the modes apart, as of `CityEstimate.next_question`.
    """
    name = city.source.partition(".")[0].replace("_", " ")
    heading = f"Where am I? {name[:1].upper()}{name[1:]}"
    tiles = CityTiles(city)
    data = {
        "index": tiles.index(),
        "tiles": {
            "/".join(map(str, key)): tile for key, tile in _choose_tiles(tiles, city, estimate)
        },
        "answer": page_estimate(estimate) | {"question": {"text": question} if question else None},
    }
    slots = {
        "title": escape_text(_clip(title or heading)),
        "heading": escape_text(heading),
        "css": style_sheet() + "\n" + read_part("style.css"),
        "source": escape_text(
            f"{city.source}: {len(city.objects):,} objects, {len(city.cells):,} cells"
        ),
        "data": _json(data),
        "script": _join_scripts(),
    }
    pieces = read_part("still.html").split("{{")
    page = pieces[0] + "".join(
        slots[slot] + rest for slot, rest in (piece.split("}}", 1) for piece in pieces[1:])
    )
    return write_output(path, page.encode())


def page_estimate(estimate: CityEstimate) -> dict[str, Any]:
    """Return an estimate for a page: its dictionary, and the posterior's heaviest points."""
    support = np.round(estimate.support, 6).tolist()
    return {"estimate": estimate.to_dict(), "support": support, "ranked": estimate.ranked}


def read_part(name: str) -> str:
    """Return the text of a file of the page."""
    return (resources.files("placegraph.view") / "page" / name).read_text("utf-8")


def _choose_tiles(
    tiles: CityTiles, city: CityMap, estimate: CityEstimate
) -> Iterator[tuple[tuple[int, int, int], Tile]]:
    """Return the tiles of a page: the city coarsely, modes finely, then each level around them."""
    wanted = dict.fromkeys(tiles.within(tiles.bounds, tiles.top))
    shown = competing_modes(estimate, len(estimate.modes))
    levels = [(level, AROUND * 2**level) for level in range(tiles.top - 1, -1, -1)]
    for level, reach in [(0, CLOSE), *levels]:
        for mode in shown:
            x, y = mode_position(city, mode).tolist()
            around = (x - reach, y - reach, x + reach, y + reach)
            wanted |= dict.fromkeys(tiles.within(tiles.cut(around), level))
        if not shown:
            wanted |= dict.fromkeys(tiles.within(tiles.bounds, level))
    left = MOST_BYTES
    for key in wanted:
        tile = tiles.tile(*key)
        left -= len(_json(tile))
        if left < 0:
            return
        yield key, tile


def _clip(title: str) -> str:
    """Cut a title after a whole word."""
    if len(title) <= TITLE:
        return title
    return title[: TITLE + 1].rsplit(maxsplit=1)[0].rstrip(" ,;:.") + " …"


def _join_scripts() -> str:
    """Join all modules into one script without imports and exports; their names are unique."""
    modules = "\n".join(map(read_part, (f"{name}.js" for name in SCRIPTS)))
    body = re.sub(r'^import [^;]+ from "[^"]+";\n', "", modules, flags=re.MULTILINE)
    return '"use strict";\n(() => {\n' + re.sub(r"^export ", "", body, flags=re.MULTILINE) + "})();"


def _json(data: object) -> str:
    """Return JSON that is safe in a script element."""
    text = json.dumps(data, ensure_ascii=False, separators=(",", ":"))
    for character, code in (("<", "\\u003c"), (">", "\\u003e"), ("&", "\\u0026"),
                            ("\u2028", "\\u2028"), ("\u2029", "\\u2029")):  # fmt: skip
        text = text.replace(character, code)
    return text
