"""Maps and estimates as a cell of a notebook: a small picture, and what is most worth knowing."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Iterable, Sequence
from html import escape
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from PIL import Image

from placegraph.core.estimate import CityEstimate, Estimate, PoseEstimate
from placegraph.indoor.library import SceneLibrary
from placegraph.indoor.map.scene import Scene
from placegraph.outdoor.map.city import City
from placegraph.view.city.picture import draw_city, write_picture
from placegraph.view.scene.plan import draw_scene, write_plan

WIDTH = 640
"""Width of a picture [px]."""
COLOURS = 96
"""Number of colours of a picture, which a notebook stores as text."""
MAX_ROWS = 12
"""Rows of a table."""


def html(content: object) -> str:
    """Return a map or an estimate as self-contained HTML."""
    if isinstance(content, Estimate):
        return _estimate(content)
    if isinstance(content, City):
        return _picture(lambda path: draw_city(content, path, size=(WIDTH, 440))) + _line(content)  # type: ignore[arg-type]
    if isinstance(content, Scene):
        return _picture(lambda path: draw_scene(content, path, width=WIDTH)) + _line(content)  # type: ignore[arg-type]
    if isinstance(content, SceneLibrary):
        graphs = {name: content.entry(name).signature.graph for name in content.names[:MAX_ROWS]}
        rows = [(name, len(graph), _words(graph.labels)) for name, graph in graphs.items()]
        return _line(content) + _table(("scene", "objects", "among them"), rows, len(content))
    return _line(content)


def _estimate(estimate: Estimate[Any]) -> str:
    drawn = ""
    held: Any = estimate.map
    if isinstance(estimate, CityEstimate) and isinstance(held, City) and estimate.modes:
        drawn = _picture(lambda path: write_picture(held, estimate, path, size=(WIDTH, 480)))  # type: ignore[arg-type]
    elif isinstance(estimate, PoseEstimate) and isinstance(held, Scene) and estimate.modes:
        drawn = _picture(lambda path: write_plan(held, estimate, path, width=WIDTH))  # type: ignore[arg-type]
    said = f"<p><b>{escape(estimate.status.name)}</b>: {escape(estimate.reason)}</p>"
    return drawn + said + _modes(estimate.modes) + _evidence(estimate)


def _modes(modes: Sequence[Any]) -> str:
    """Return a table of the modes' numbers and names, without matrices."""
    plain = [mode.to_dict() for mode in modes[:MAX_ROWS]]
    keys = [k for k, v in plain[0].items() if isinstance(v, str | float | int)] if plain else []
    return _table(keys, [[mode.get(k, "") for k in keys] for mode in plain], len(modes))


def _evidence(estimate: Estimate[Any]) -> str:
    rows = [(e.verdict, e.statement, f"{e.weight:+.1f}", e.note) for e in estimate.evidence]
    return _table(
        ("", "evidence of the best", "log-likelihood ratio", ""), rows[:MAX_ROWS], len(rows)
    )


def _picture(draw: Callable[[Path], object]) -> str:
    """Return an image element with the bytes of a picture that `draw` writes to a file."""
    with TemporaryDirectory() as folder:
        draw(Path(folder) / "drawn.png")
        with Image.open(Path(folder) / "drawn.png") as drawn:
            small = drawn.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    png = BytesIO()
    small.save(png, "PNG", optimize=True)
    data = b64encode(png.getvalue()).decode()
    return f'<img alt="" style="max-width:100%" width="{WIDTH}" src="data:image/png;base64,{data}">'


def _table(heads: Sequence[str], rows: Iterable[Sequence[object]], count: int) -> str:
    """Return rows as a table, with the number of further rows; empty without rows."""
    lines = ["".join(f"<td>{escape(_text(cell))}</td>" for cell in row) for row in rows]
    if not lines:
        return ""
    head = "".join(f"<th>{escape(name)}</th>" for name in heads)
    more = f"<p>... {count} in all</p>" if count > len(lines) else ""
    return f"<table><tr>{head}</tr><tr>{'</tr><tr>'.join(lines)}</tr></table>{more}"


def _text(cell: object) -> str:
    return (
        f"{cell:.6g}"
        if isinstance(cell, float) and abs(cell) < 1.0
        else (f"{cell:.5f}".rstrip("0").rstrip(".") if isinstance(cell, float) else str(cell))
    )


def _words(labels: Sequence[str]) -> str:
    return ", ".join(list(dict.fromkeys(labels))[:5])


def _line(content: object) -> str:
    return f"<p>{escape(repr(content))}</p>"
