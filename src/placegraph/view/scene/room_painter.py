"""Paints a plan of rooms: colours of things, light and shadow, walls where they are cut."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw, ImageFilter

from placegraph.core.geometry import Floats
from placegraph.view.draw.canvas import Frame, Picture
from placegraph.view.draw.painter import SUPERSAMPLE
from placegraph.view.draw.style import PALETTE
from placegraph.view.scene.room_plan import CUT, SCAN, RoomPlan
from placegraph.view.scene.room_style import ROOM_PAINTS
from placegraph.view.scene.top_view import look_down, solid

WALL = 0.07
"""Surfaces that are cut and enclose nothing, as in a scan, are drawn this thick [m]."""
VIVID = 0.5
"""Share of a scan's own colours; the rest is paper, so that marks stand out."""
BAND = 256
"""Rows that are coloured at a time: as floats, all of them would take most of the memory."""


def paint_room(plan: RoomPlan, frame: Frame, *, dark: bool = False) -> Picture:
    """Paint a plan as a picture that fills a frame, for `painter` to lay under the marks."""
    frame = Frame(
        frame.center,
        frame.scale * SUPERSAMPLE,
        frame.width * SUPERSAMPLE,
        frame.height * SUPERSAMPLE,
    )
    view = look_down(plan.scene.mesh.vertices, plan.triangles, plan.lifts(), frame)
    seen = view.triangle >= 0
    owner = np.where(seen, plan.object_of[view.triangle], -1) if seen.any() else view.triangle
    height = np.where(seen, np.clip(view.height - np.float32(plan.floor), 0.0, CUT), 0.0)
    masks = {paint: _mask(segments, frame, paint) for paint, segments in plan.cuts.items()}
    for paint, mask in masks.items():
        if paint != "curtain":
            height[mask] = CUT
    light = _light(height.astype(np.float32), owner, frame.scale)
    fills = _fills(plan, dark=dark)
    scanned = np.array([*(paint == SCAN for paint in plan.paints), False])
    picture = np.empty((*owner.shape, 3), np.uint8)
    for top in range(0, len(owner), BAND):
        rows = slice(top, top + BAND)
        pixels, bare = fills[owner[rows]], scanned[owner[rows]]
        if bare.any():
            own = plan.colours(view.triangle[rows][bare].astype(np.int64))
            pixels[bare] = VIVID * own + (1.0 - VIVID) * pixels[bare]
        pixels *= light[rows, :, None]
        picture[rows] = np.clip(pixels, 0.0, 255.0, out=pixels)
    for paint, mask in masks.items():
        picture[mask] = _color(paint, dark=dark)
    return Picture(picture, frame.bounds)


def _color(paint: str, *, dark: bool) -> tuple[int, ...]:
    look = ROOM_PAINTS["wall" if paint == SCAN else paint]
    return ImageColor.getrgb(look.dark if dark else look.light)


def _fills(plan: RoomPlan, *, dark: bool) -> NDArray[np.float32]:
    """Colour (N + 1, 3) of each object seen from above; the last row is the paper's."""
    fills = np.zeros((len(plan.scene) + 1, 3), np.float32)
    for row in plan.rows:
        flat = plan.role(row) in ("thing", "floor")
        fills[row] = _color(plan.paints[row] if flat else "thing", dark=dark)
    fills[-1] = ImageColor.getrgb(PALETTE["land"][dark])
    return fills


def _mask(segments: Floats, frame: Frame, paint: str) -> NDArray[np.bool_]:
    """Pixels (rows, columns) of what is cut: its inside, or, of open surfaces, a line."""
    inside = np.zeros((frame.height, frame.width), np.bool_)
    if paint != SCAN:
        inside = solid(segments, frame)
    px = frame.to_px(segments)
    length = np.hypot(*(px[:, 1] - px[:, 0]).T).sum()
    is_closed = inside.sum() > length
    width = SUPERSAMPLE if is_closed else max(SUPERSAMPLE, round(WALL * frame.scale))
    image = Image.fromarray(inside.astype(np.uint8) * 255)
    draw = ImageDraw.Draw(image)
    for line in px.reshape(-1, 4).tolist():
        draw.line(line, 255, width)
    return np.asarray(image) > 127


def _light(
    height: NDArray[np.float32], owner: NDArray[np.int32], scale: float
) -> NDArray[np.float32]:
    """Brightness (rows, columns): slopes to the light, shadows at the feet of things, outlines."""
    down, right = np.gradient(height * np.float32(scale))
    down += right
    down *= 0.06
    light: NDArray[np.float32] = 1.0 + np.clip(down, -0.10, 0.06, out=down)
    foot = Image.fromarray((height * (255.0 / CUT)).astype(np.uint8))
    around = np.asarray(foot.filter(ImageFilter.GaussianBlur(0.16 * scale))) * np.float32(CUT / 255)
    around -= height
    around *= 0.30
    light -= np.clip(around, 0.0, 0.22, out=around)
    outline = np.zeros(height.shape, np.bool_)
    outline[1:] |= owner[1:] != owner[:-1]
    outline[:, 1:] |= owner[:, 1:] != owner[:, :-1]
    light[outline] *= 0.72
    return light
