"""A page (HTML) that shows an estimate on the map: one file that opens without a network."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from placegraph.view.city.page_map import PageMap, page_map
from placegraph.view.city.page_panel import panel
from placegraph.view.draw.svg import UNIT, clean, style_sheet

if TYPE_CHECKING:
    from placegraph.estimate import CityEstimate
    from placegraph.outdoor.city import CityMap


def write_page(
    city: CityMap,
    estimate: CityEstimate,
    path: str | Path,
    *,
    title: str | None = None,
    question: str | None = None,
) -> Path:
    """Write an estimate as one HTML file with map, heat, modes and evidence.

    The file loads nothing else: style, script and map stand in it. It is about 2 MB at most,
    however large the city: around the modes everything is drawn, beyond that an outline.

    Parameters
    ----------
    city
        The map the estimate was made on.
    estimate
        What to show.
    path
        Where to write.
    title
        Title of the page.
    question
        The question that would tell the modes apart, as of `CityEstimate.next_question`.

    """
    path = Path(path)
    title = title or f"Where am I? {city.source.partition('.')[0].replace('_', ' ')}"
    drawn = page_map(city, estimate)

    slots = _slots(city, estimate, drawn, question) | {"title": clean(title)}
    pieces = _shipped("page.html").split("{{")
    page = pieces[0] + "".join(
        slots[slot] + rest for slot, rest in (piece.split("}}", 1) for piece in pieces[1:])
    )
    path.write_text(page, encoding="utf-8")
    return path


def _slots(
    city: CityMap, estimate: CityEstimate, drawn: PageMap, question: str | None
) -> dict[str, str]:
    """What stands in the page's template, by name."""

    def at(longitude: float, latitude: float) -> str:
        x, y = drawn.svg.units(city.plane.to_plane((longitude, latitude))).tolist()
        return f'data-x="{x:.0f}" data-y="{y:.0f}"'

    return {
        "css": style_sheet() + "\n" + _shipped("page.css"),
        "script": _shipped("page.js"),
        "status": estimate.status.name,
        "panel": panel(estimate, question, at),
        "source": clean(f"{city.source}: {len(city.objects):,} objects, {len(city.cells):,} cells"),
        "data": _json(_data(drawn)),
        "start": " ".join(f"{n:.0f}" for n in drawn.start),
        "box": " ".join(f"{n:.0f}" for n in drawn.box),
        "outline": drawn.outline,
        "beyond": "" if drawn.is_whole else '<use href="#outline"/>',
        "detail": drawn.detail,
        "heat": drawn.heat,
        "names": drawn.names,
        "evidence": "".join(
            f'<g class="of" data-of="{k}"{"" if k == 0 else " hidden"}>{marks}</g>'
            for k, marks in enumerate(drawn.evidence)
        ),
        "pins": drawn.pins,
        "k": f"{max(drawn.start[2:]) / 900:.4f}",
    }


def _shipped(name: str) -> str:
    return (resources.files("placegraph.view.city") / name).read_text("utf-8")


def _data(drawn: PageMap) -> dict[str, object]:
    """What the script needs to know."""
    return {
        "unit": UNIT,
        "box": drawn.box,
        "start": drawn.start,
        "modes": drawn.mode_boxes,
        "tips": drawn.tips,
    }


def _json(data: object) -> str:
    """JSON that can stand in a script element, whatever names hold."""
    text = json.dumps(data, ensure_ascii=False, separators=(",", ":"), default=np.ndarray.tolist)
    for character, code in (("<", "\\u003c"), (">", "\\u003e"), ("&", "\\u0026"),
                            ("\u2028", "\\u2028"), ("\u2029", "\\u2029")):  # fmt: skip
        text = text.replace(character, code)
    return text
