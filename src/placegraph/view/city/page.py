"""A page (HTML) that shows an estimate on the map: one file that opens without a network."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.core.estimate import CityEstimate
from placegraph.core.files import put
from placegraph.view.city.estimate_items import place_of, rivals
from placegraph.view.city.tiles import CityTiles, Tile
from placegraph.view.draw.style import clean, style_sheet

if TYPE_CHECKING:
    from placegraph.outdoor.city import CityMap

SCRIPTS = ("base", "gestures", "tiles", "letters", "map", "marks", "panel", "answer", "still")
"""Modules of the page, each after those it imports."""
MOST_BYTES = 1_800_000
"""Tiles are added, the whole city first, then those around the modes, until so much is written."""
AROUND = 1200.0
"""Everything is drawn so far around a mode [m]."""
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

    Parameters
    ----------
    city
        The map the estimate was made on.
    question
        The question that would tell the modes apart, as of `CityEstimate.next_question`.

    """
    heading = f"Where am I? {city.source.partition('.')[0].replace('_', ' ')}"
    tiles = CityTiles(city)
    data = {
        "index": tiles.index(),
        "tiles": {"/".join(map(str, key)): tile for key, tile in _chosen(tiles, city, estimate)},
        "answer": told(estimate) | {"question": {"text": question} if question else None},
    }
    slots = {
        "title": clean(_cut(title or heading)),
        "heading": clean(heading),
        "css": style_sheet() + "\n" + part("style.css"),
        "source": clean(f"{city.source}: {len(city.objects):,} objects, {len(city.cells):,} cells"),
        "data": _json(data),
        "script": _joined(),
    }
    pieces = part("still.html").split("{{")
    page = pieces[0] + "".join(
        slots[slot] + rest for slot, rest in (piece.split("}}", 1) for piece in pieces[1:])
    )
    return put(path, page.encode())


def told(estimate: CityEstimate) -> dict[str, Any]:
    """An estimate as a page takes it: the dictionary, and the posterior's heaviest points."""
    support = np.round(estimate.support, 6).tolist()
    return {"estimate": estimate.to_dict(), "support": support, "ranked": estimate.ranked}


def part(name: str) -> str:
    """A file of pages."""
    return (resources.files("placegraph.view") / "page" / name).read_text("utf-8")


def _chosen(
    tiles: CityTiles, city: CityMap, estimate: CityEstimate
) -> Iterator[tuple[tuple[int, int, int], Tile]]:
    """Tiles of a page: the whole city coarsely, then each level around what is shown first."""
    wanted = dict.fromkeys(tiles.within(tiles.bounds, tiles.top))
    shown = rivals(estimate, len(estimate.modes))
    for level in range(tiles.top - 1, -1, -1):
        reach = AROUND * 2**level
        for mode in shown:
            x, y = place_of(city, mode).tolist()
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


def _cut(title: str) -> str:
    """Cut a title after a whole word."""
    if len(title) <= TITLE:
        return title
    return title[: TITLE + 1].rsplit(maxsplit=1)[0].rstrip(" ,;:.") + " …"


def _joined() -> str:
    """All modules as one script: imports and exports fall away, names are unique among them."""
    modules = "\n".join(map(part, (f"{name}.js" for name in SCRIPTS)))
    body = re.sub(r'^import [^;]+ from "[^"]+";\n', "", modules, flags=re.MULTILINE)
    return '"use strict";\n(() => {\n' + re.sub(r"^export ", "", body, flags=re.MULTILINE) + "})();"


def _json(data: object) -> str:
    """JSON that can stand in a script element, whatever names hold."""
    text = json.dumps(data, ensure_ascii=False, separators=(",", ":"))
    for character, code in (("<", "\\u003c"), (">", "\\u003e"), ("&", "\\u0026"),
                            ("\u2028", "\\u2028"), ("\u2029", "\\u2029")):  # fmt: skip
        text = text.replace(character, code)
    return text
