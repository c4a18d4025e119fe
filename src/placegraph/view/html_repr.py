"""Maps and estimates as a cell of a notebook: a small picture, and what is most worth knowing."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from html import escape
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image

from placegraph.core.estimate import CityEstimate, Estimate, PoseEstimate, SceneEstimate
from placegraph.errors import PlacegraphError
from placegraph.indoor.library import SceneLibrary
from placegraph.indoor.map.scene import Scene
from placegraph.io.capture.frame import Capture
from placegraph.outdoor.map.city import City
from placegraph.view.city.picture import draw_city, write_picture
from placegraph.view.scene.plan import draw_scene, write_plan
from placegraph.world.estimate import WorldEstimate
from placegraph.world.world import World

WIDTH = 640
"""Width of a picture [px]."""
COLOURS = 96
"""Number of colours of a picture, which a notebook stores as text."""
MAX_ROWS = 12
"""Rows of a table."""
MAX_FRAMES = 4
"""Frames of a capture in its picture."""


def html(content: object) -> str:
    """Return a map, a capture or an estimate as self-contained HTML."""
    if isinstance(content, Estimate):
        said = f"<p><b>{escape(content.status.name)}</b>: {escape(content.reason)}</p>"
        return _draw_estimate(content) + said + _modes(content.modes) + _evidence(content)
    return _draw(content) + _line(content) + _list_scenes(content)


def _draw(content: Any) -> str:  # noqa: ANN401  # a map or a capture
    """Draw a map, the first map of several, or the first frames of a capture; empty if there is none."""
    if isinstance(content, City):
        return _picture(lambda path: draw_city(content, path, size=(WIDTH, 440)))  # type: ignore[arg-type]
    if isinstance(content, Scene):
        return _picture(lambda path: draw_scene(content, path, width=WIDTH))  # type: ignore[arg-type]
    if isinstance(content, Capture):
        return _picture(lambda path: _draw_frames(content, path))
    if isinstance(content, World):
        return next(
            (_draw(m) for maps in (content.cities, content.scenes) for m in maps.values()), ""
        )
    if isinstance(content, SceneLibrary) and len(content):
        return _draw_scene_of(content, content.names[0])
    return ""


def _draw_frames(capture: Capture, path: Path) -> None:
    """Draw `MAX_FRAMES` colour images, evenly spaced in time, side by side."""
    rows = np.linspace(0, len(capture) - 1, min(MAX_FRAMES, len(capture))).round().astype(int)
    images = [Image.fromarray(capture[i].rgb()) for i in rows.tolist()]
    width = WIDTH // len(images)
    sheet = Image.new("RGB", (WIDTH, width * images[0].height // images[0].width), "white")
    for k, image in enumerate(images):
        sheet.paste(image.resize((width - 4, sheet.height)), (k * width, 0))
    sheet.save(path)


def _draw_scene_of(library: SceneLibrary, name: str) -> str:
    """Draw a scene of a library; empty if its map file is not there."""
    with suppress(PlacegraphError):
        return _draw(library.scene(name))
    return ""


def _draw_estimate(estimate: Estimate[Any]) -> str:
    """Draw the best mode on its map; empty without a mode or a map."""
    held: Any = estimate.map
    if not estimate.modes:
        return ""
    best = estimate.modes[0]
    if isinstance(estimate, CityEstimate) and isinstance(held, City):
        return _picture(lambda path: write_picture(held, estimate, path, size=(WIDTH, 480)))  # type: ignore[arg-type]
    if isinstance(estimate, PoseEstimate) and isinstance(held, Scene):
        return _picture(lambda path: write_plan(held, estimate, path, width=WIDTH))  # type: ignore[arg-type]
    if isinstance(estimate, SceneEstimate) and isinstance(held, SceneLibrary):
        return _draw_scene_of(held, best.scene)
    if isinstance(estimate, WorldEstimate):
        parts: list[Estimate[Any]] = [*estimate.cities.values(), *estimate.poses.values()]
        own = (e for e in parts if {best.place, best.pose} & set(e.modes))
        there = isinstance(held, World) and best.scene in held.scenes
        scene = held.scenes[best.scene] if there else None
        return next(filter(None, map(_draw_estimate, own)), "") or _draw(scene)
    return ""


def _list_scenes(content: object) -> str:
    """Return a table of the scenes of a library; empty for other maps."""
    if not isinstance(content, SceneLibrary):
        return ""
    graphs = {name: content.entry(name).signature.graph for name in content.names[:MAX_ROWS]}
    rows = [(name, len(graph), _words(graph.labels)) for name, graph in graphs.items()]
    return _table(("scene", "objects", "among them"), rows, len(content))


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
    """Return a cell as text; numbers have five decimals and no exponent."""
    if not isinstance(cell, float):
        return str(cell)
    tiny = 0.0 < abs(cell) < 5e-6
    return "< 0.00001" if tiny else f"{cell:.5f}".rstrip("0").rstrip(".")


def _words(labels: Sequence[str]) -> str:
    return ", ".join(list(dict.fromkeys(labels))[:5])


def _line(content: object) -> str:
    return f"<p>{escape(repr(content))}</p>"
