"""A city as tiles that a page draws: squares of the plane, at coarser scales with less in them.

A tile of level 0 is `SIDE` metres wide and has everything in it; each level up is twice as wide and
half as fine. Tile (x, y) of a level covers [x, x + 1) by [y, y + 1) sides, counted east and north
from the plane's origin. A page draws level 0 from `FINEST` pixels per metre on, each level up at
half the scale of the one below it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.outdoor.map.objects import simplify
from placegraph.view.city.coast import sea
from placegraph.view.city.examples import examples
from placegraph.view.city.items import city_bounds, extents, item_of, labels_of
from placegraph.view.draw.canvas import Area, Bounds, Dot, Line, MapItem, Points, in_painters_order
from placegraph.view.draw.clip import clip_ring
from placegraph.view.draw.style import CASED, CASING, LINE, PAINTS, POINT, paint_of

if TYPE_CHECKING:
    from placegraph.outdoor.map.city import City

SIDE = 1024.0
"""Side of a tile of level 0 [m]."""
UNIT = 0.5
"""Metres in a unit of level 0; coordinates are whole units from the tile's south-west corner."""
FINEST = 0.5
"""Level 0 is drawn from this scale on [px/m]."""
MARGIN = 0.04
"""A tile holds what lies so far beyond its border, so that wide roads are whole [sides]."""
SMALLEST = 2.0
"""What is smaller than this on the screen is left out [px]."""
TOP_LEVEL = 12
THROUGH = frozenset(("motorway", "main-road", "rail", "river", "shore"))
"""Paints that make long lines of short pieces, which are kept at every scale."""

Tile = dict[str, Any]


class CityTiles:
    """Tiles of a city, made when asked for."""

    def __init__(self, city: City) -> None:
        self.city = city
        self._boxes = extents(city.objects)
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
        return [paint_of(labels_of(objects, row), int(kind))
                for row, kind in enumerate(objects.kind)]  # fmt: skip

    @cached_property
    def _since(self) -> Floats:
        """Scale (N,) from which an object is drawn [px/m]."""
        since = {name: paint.since for name, paint in PAINTS.items()} | {"": np.inf}
        smallest = SMALLEST / np.maximum(self._spread, 1e-3)
        smallest[[paint in THROUGH for paint in self._paints]] = 0.0
        smallest[self.city.objects.kind == POINT] = FINEST
        street = np.array([paint == "street" for paint in self._paints])
        smallest[street] = np.minimum(smallest[street], FINEST / 8)
        wanted: Floats = np.maximum([since[paint] for paint in self._paints], smallest)
        return wanted

    @cached_property
    def _sea(self) -> list[Floats]:
        return sea(self.city.objects, self.bounds)

    def index(self) -> dict[str, Any]:
        """Return what a page must know before it asks for tiles."""
        plane = self.city.plane
        return {
            "origin": [plane.longitude, plane.latitude],
            "metres_per_degree": list(plane.metres_per_degree),
            "bounds": [round(value, 1) for value in self.bounds],
            "side": SIDE,
            "unit": UNIT,
            "finest": FINEST,
            "top": self.top,
            "paints": {name: asdict(paint) for name, paint in PAINTS.items()},
            "cased": sorted(CASED),
            "casing": CASING,
            "source": self.city.source,
            "objects": len(self.city.objects),
            "cells": len(self.city.cells),
            "examples": examples(self.city, self._paints),
        }

    def within(self, bounds: Bounds, level: int) -> list[tuple[int, int, int]]:
        """Tiles (level, x, y) of a level that a rectangle touches."""
        side = SIDE * 2**level
        west, south, east, north = (int(np.floor(value / side)) for value in bounds)
        return [(level, x, y) for y in range(south, north + 1) for x in range(west, east + 1)]

    def cut(self, bounds: Bounds) -> Bounds:
        """Part of a rectangle that lies in the city, or its nearest corner."""
        low, high = np.array(self.bounds[:2]), np.array(self.bounds[2:])
        west, south = np.clip(bounds[:2], low, high).tolist()
        east, north = np.clip(bounds[2:], low, high).tolist()
        return west, south, east, north

    def tile(self, level: int, x: int, y: int) -> Tile:
        """One tile: tables of names and labels, and its layers in the order in which they are laid.

        A layer names its paint; of each shape it has OpenStreetMap's id, rows of the tables (-1
        for none), and parts: first point and steps, in units (x east, y north).
        """
        side, unit = SIDE * 2**level, UNIT * 2**level
        west, south = x * side, y * side
        margin = MARGIN * side
        window = west - margin, south - margin, west + side + margin, south + side + margin
        names, labels = _Table(), _Table()
        layers = []
        for paint, items in in_painters_order(self._items(window, level)):
            layer: dict[str, Any] = {
                "paint": paint, "osm": [], "name": [], "label": [], "shapes": []
            }  # fmt: skip
            for item in items:
                parts = _coded(item, np.array([west, south]), unit, level)
                if not parts:
                    continue
                known = item.row >= 0
                layer["osm"].append(self.city.objects.osm(item.row) if known else "")
                layer["name"].append(names.row(self.city.objects.name(item.row) if known else ""))
                layer["label"].append(
                    labels.row(" · ".join(labels_of(self.city.objects, item.row)) if known else "")
                )
                layer["shapes"].append(parts)
            if layer["shapes"]:
                layers.append(layer)
        return {"names": names.texts, "labels": labels.texts, "layers": layers}

    def _items(self, window: Bounds, level: int) -> Iterator[MapItem]:
        """Items of a tile, cut to its window, large ones first."""
        if self._sea:
            rings = [ring for ring in (clip_ring(r, window) for r in self._sea) if len(ring) > 3]
            if rings:
                yield Area(rings, "sea")
        objects = self.city.objects
        for row in self._rows(window, level):
            item = item_of(objects, int(row), window, self._paints[row])
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
            hit &= self._since <= 1.5 * FINEST / 2**level
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


def _coded(item: MapItem, corner: Floats, unit: float, level: int) -> list[list[int]]:
    """Parts of an item as first point and steps [units]; empty where nothing is left of it."""
    match item:
        case Area(rings):
            parts, least = rings, 4
        case Line(lines):
            parts, least = lines, 2
        case Dot(at):
            parts, least = [np.asarray(at)[None]], 1
    found = []
    for part in parts:
        points = np.round((_coarse(part, unit) if level else np.asarray(part)) - corner, 3)
        units = np.round(points / unit).astype(np.int64)
        moved = np.concatenate([[True], (np.diff(units, axis=0) != 0).any(axis=1)])
        units = units[moved]
        if len(units) >= least:
            found.append(np.concatenate([units[:1], np.diff(units, axis=0)]).ravel().tolist())
    return found


def _coarse(part: Points, error: float) -> Floats:
    """Simplify a line or ring to an error [m]."""
    line = np.ascontiguousarray(part, np.float64)
    return simplify(line, np.array([0, len(line)]), error)[0]
