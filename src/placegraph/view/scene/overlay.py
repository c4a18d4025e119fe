"""A photograph beside the map seen from the same pose: whether a pose is right, at a glance."""

from __future__ import annotations

from collections.abc import Iterable
from colorsys import hsv_to_rgb
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from placegraph.core.estimate import PoseEstimate
from placegraph.core.geometry import Floats
from placegraph.errors import OptionError
from placegraph.io.capture.frame import Frame
from placegraph.io.capture.images import resize_image
from placegraph.view.draw.canvas import choose_face
from placegraph.view.draw.painter import write_image

if TYPE_CHECKING:
    from placegraph.indoor.render import Rendering
    from placegraph.indoor.scene_map import SceneMap

JUMP = 0.04
"""Share of the depth by which a pixel lies nearer than the surface beside it goes on: an outline."""
CREASE = 0.12
"""1 - cosine between the mean normals of both sides (28 degrees): there walls meet."""
STEP = 36.0
"""Difference in lightness [of 255] of both sides: a border of colours."""
REACH = 3
"""Sides lie so many pixels from an edge, and are means over 5 x 5: scans are rough."""
LONELY = 5
"""Edges with fewer edge pixels than this among the 7 x 7 around them are specks, and left out."""
SQUARES = 8
"""Squares of the checkerboard along the longer side."""
LINE, FAINT = (255, 40, 160), (40, 230, 200)
"""Colours of edges of shapes and of edges of colours."""
EMPTY_COLOUR = (38, 40, 46)
"""Colour of pixels without a surface of the map."""
GAP = 8
"""Between pictures [px]."""
Key = tuple[tuple[tuple[int, int, int], str], ...]
"""Colours and what they stand for."""
EDGES: Key = ((LINE, "of shapes"), (FAINT, "of colours"))
CAPTIONS: tuple[tuple[str, Key], ...] = (
    ("query", ()),
    ("map, seen from the pose", ((EMPTY_COLOUR, "not mapped"),)),
    ("the map's edges on the query:", EDGES),
    ("query and map in turn", ()),
)
BEFORE: tuple[tuple[str, Key], ...] = (
    ("before the refinement, edges:", EDGES),
    ("before: query and map in turn", ()),
)
LARGEST = 960
"""Longer side of one picture [px]: in larger ones the lines would be too thin to be seen."""
_GOLDEN = 0.618033988749895


def write_overlay(
    scene: SceneMap, estimate: PoseEstimate, capture: Iterable[Frame], path: str | Path
) -> Path:
    """Draw the map over the last frame of an estimate, at its best pose, as a PNG.

    Where a refinement was accepted, two pictures more show the pose before it.

    Raises `OptionError`: the estimate has no pose, or its last frame is not among the frames;
    `InputError`: the image is broken.
    """
    from placegraph.indoor.refine.correspondences import (
        shrink_camera,  # compiled code: not for cities
    )
    from placegraph.indoor.render import Renderer

    best, refinement = estimate.best, estimate.refinement
    if best is None:
        raise OptionError(f"The estimate has no pose to show. {estimate.reason}")
    row = int(estimate.frames[-1])
    frame = next((frame for frame in capture if frame.index == row), None)
    if frame is None:
        raise OptionError(
            f"Frame {row}, the last of the estimate, is not in the given capture; give the "
            "capture that was localized."
        )
    renderer, camera = Renderer(scene), shrink_camera(frame.camera, LARGEST)
    drawn = []
    coarse = [refinement.coarse] if refinement is not None and refinement.accepted else []
    for mode in (best, *coarse):
        pose = mode.map_from_camera
        rendering = renderer.render(pose, camera, samples=4)
        drawn.append((rendering, rendering.normals(scene.mesh, pose)))
    query = resize_image(frame.rgb(), camera.width, camera.height)
    sheet = draw_overlay(query, *drawn[0], before=drawn[1] if coarse else None)
    return write_image(sheet, path, "PNG")


def draw_overlay(
    query: NDArray[np.uint8],
    rendering: Rendering,
    normals: NDArray[np.float32],
    *,
    before: tuple[Rendering, NDArray[np.float32]] | None = None,
) -> Image.Image:
    """Draw four pictures in one: query, map, the map's edges on the query, and a checkerboard of both.

    Under a right pose the lines lie on the query's own edges, and things go on from square to square.

    Raises `OptionError`: the pictures are of different sizes.

    `query`: (H, W, 3) uint8, sRGB.
    `rendering`: the map from the pose in question, of the same size.
    `normals`: (H, W, 3) of the rendering (`Rendering.normals`).
    `before`: rendering and normals from the pose before it was refined: two pictures more, below.
    """
    shown = _rendered_colours(query, rendering)
    pictures = [query, shown, *_overlay_edges(query, rendering, normals)]
    captions = CAPTIONS
    if before is not None:
        pictures += _overlay_edges(query, *before)
        captions = (*CAPTIONS, *BEFORE)
    height, width = query.shape[:2]
    size = max(12.0, height / 22)
    band = round(1.7 * size)
    rows = len(pictures) // 2
    sheet = Image.new("RGB", (2 * width + GAP, rows * (height + band + GAP) - GAP), "white")
    for k, (picture, (caption, key)) in enumerate(zip(pictures, captions, strict=True)):
        x, y = (k % 2) * (width + GAP), (k // 2) * (height + band + GAP)
        _write_caption(sheet, (x, y, width, band), caption, key)
        sheet.paste(Image.fromarray(picture), (x, y + band))
    return sheet


def _write_caption(
    sheet: Image.Image, box: tuple[int, int, int, int], caption: str, key: Key
) -> None:
    """Write a caption and its key into a box: left, top, width, height [px]; in small if it is long."""
    x, y, width, height = box
    pen, face, size = ImageDraw.Draw(sheet), choose_face([caption]), height / 1.7
    words = (caption, *(word for _, word in key))
    wanted = sum(pen.textlength(word, font=face.font(size)) for word in words) + size * (
        0.8 + 2.4 * len(key)
    )
    size *= min(1.0, width / wanted)
    at, middle, font = x + 0.4 * size, y + height / 2, face.font(size)
    pen.text((at, middle), caption, fill=(30, 30, 30), font=font, anchor="lm")
    at += pen.textlength(caption, font=font) + 0.8 * size
    for colour, word in key:
        pen.rectangle((at, middle - 0.2 * size, at + size, middle + 0.2 * size), fill=colour)
        pen.text((at + 1.3 * size, middle), word, fill=(30, 30, 30), font=font, anchor="lm")
        at += pen.textlength(word, font=font) + 2.4 * size


def _rendered_colours(query: NDArray[np.uint8], rendering: Rendering) -> NDArray[np.uint8]:
    """Return a rendering's colours in the query's size, dark where the map is empty."""
    if query.shape != rendering.colour.shape:
        raise OptionError(
            f"query: shape {query.shape}, but the rendering has {rendering.colour.shape}; render it "
            "with the query's camera."
        )
    shown = rendering.colour.copy()
    shown[~rendering.mask] = EMPTY_COLOUR
    return shown


def _overlay_edges(
    query: NDArray[np.uint8], rendering: Rendering, normals: NDArray[np.float32]
) -> list[NDArray[np.uint8]]:
    """Return the map's edges on the query, and a checkerboard of both."""
    lines = draw_outlines(query, find_edges(rendering, normals), find_colour_borders(rendering))
    return [lines, checkerboard(query, _rendered_colours(query, rendering))]


def find_edges(rendering: Rendering, normals: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Find pixels (H, W) at edges of the map: of objects, occlusions and walls.

    `normals`: (H, W, 3) of the rendering.
    """
    seen = rendering.mask
    found = np.zeros(seen.shape, np.bool_)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse: Floats = np.where(seen, 1.0 / rendering.depth, np.nan)  # linear of a plane
    for axis in (0, 1):
        ids, there = np.moveaxis(rendering.objects, axis, 0), np.moveaxis(seen, axis, 0)
        step: NDArray[np.bool_] = np.moveaxis(found, axis, 0)
        step[:-1] |= (ids[1:] != ids[:-1]) & there[1:] & there[:-1]
        d = np.moveaxis(inverse, axis, 0)
        with np.errstate(invalid="ignore"):
            jumps = np.abs(d[2:] - 2.0 * d[1:-1] + d[:-2]) > JUMP * d[1:-1]
        step[1:-1] |= jumps
    return _remove_specks(found | find_creases(normals))


def find_creases(normals: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Find pixels (H, W) where faces meet; `normals`: (H, W, 3), NaN without a surface."""
    known = np.asarray(np.isfinite(normals).all(axis=-1))
    total = _box(np.where(known[..., None], normals, 0.0), 5)
    length = np.linalg.norm(total, axis=-1, keepdims=True)
    mean = np.where(known[..., None], total / np.maximum(length, 1e-9), np.nan)
    found = np.zeros(known.shape, np.bool_)
    for axis in (0, 1):
        sides = np.moveaxis(mean, axis, 0)
        bend = 1.0 - np.einsum("...k,...k->...", sides[2 * REACH :], sides[: -2 * REACH])
        np.moveaxis(found, axis, 0)[REACH:-REACH] |= _is_ridge(bend) & (bend > CREASE)
    return found


def find_colour_borders(rendering: Rendering) -> NDArray[np.bool_]:
    """Find pixels (H, W) where the map's colours change, as on a flat wall."""
    seen = rendering.mask
    light = _box(rendering.colour.mean(axis=-1), 5) / 25.0
    light = np.where(_box(seen.astype(np.float64), 5) == 25.0, light, np.nan)
    found = np.zeros(seen.shape, np.bool_)
    for axis in (0, 1):
        sides = np.moveaxis(light, axis, 0)
        step = np.abs(sides[2 * REACH :] - sides[: -2 * REACH])
        np.moveaxis(found, axis, 0)[REACH:-REACH] |= _is_ridge(step) & (step > STEP)
    return _remove_specks(found)


def draw_outlines(
    picture: NDArray[np.uint8], edge: NDArray[np.bool_], border: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """Return a dimmed picture (H, W, 3) with edges and borders (H, W) as bright lines."""
    mixed: Floats = 0.8 * picture.astype(np.float64)
    for pixels, colour, opacity in ((border, FAINT, 0.6), (edge, LINE, 1.0)):
        halo = np.minimum(_box(pixels.astype(np.float64), 3), 1.0)[..., None]
        mixed = mixed * (1.0 - 0.5 * opacity * halo)
        share = opacity * pixels[..., None]
        mixed = mixed * (1.0 - share) + share * np.array(colour)
    return np.clip(np.rint(mixed), 0, 255).astype(np.uint8)


def checkerboard(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a checkerboard of two pictures (H, W, 3)."""
    height, width = one.shape[:2]
    side = max(max(height, width) / SQUARES, 1.0)
    row, column = np.ogrid[:height, :width]
    odd = (row // side + column // side) % 2 == 1
    return np.where(odd[..., None], other, one)


def colour_objects(
    objects: NDArray[np.int32], normals: NDArray[np.float32] | None = None
) -> NDArray[np.uint8]:
    """Return a picture (H, W, 3) with one colour for each object (H, W), -1: none.

    With `normals` (H, W, 3) faces that look elsewhere are darker.
    """
    rows = np.unique(objects[objects >= 0])
    table = np.array([EMPTY_COLOUR] + [_colour(int(row)) for row in rows], np.float64)
    picture: Floats = table[np.where(objects >= 0, np.searchsorted(rows, objects) + 1, 0)]
    if normals is not None:
        light = np.nan_to_num(np.abs(normals @ np.array([0.35, 0.6, 0.72], np.float32)), nan=1.0)
        picture = picture * (0.65 + 0.35 * light[..., None])
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def _colour(row: int) -> tuple[float, float, float]:
    """Return the colour of an object, unlike those of neighbouring rows."""
    hue = (row * _GOLDEN) % 1.0
    red, green, blue = hsv_to_rgb(hue, (0.45, 0.7, 0.85)[row % 3], (1.0, 0.8, 0.95)[row % 3])
    return 255.0 * red, 255.0 * green, 255.0 * blue


def _box(values: Floats, size: int) -> Floats:
    """Sum of the `size` x `size` pixels around each pixel of (H, W, ...); beyond the picture: 0."""
    half = size // 2
    for axis in (0, 1):
        wide = [(half + 1, half) if k == axis else (0, 0) for k in range(values.ndim)]
        sums = np.cumsum(np.pad(values, wide), axis=axis)
        sums = np.moveaxis(sums, axis, 0)
        values = np.moveaxis(sums[size:] - sums[:-size], 0, axis)
    return values


def _is_ridge(values: Floats) -> NDArray[np.bool_]:
    """Return whether values (N, ...) are the largest of the five around them along the first axis."""
    with np.errstate(invalid="ignore"):
        top = np.ones(values.shape, np.bool_)
        for k in (1, 2):
            top[k:] &= values[k:] >= values[:-k]
            top[:-k] &= values[:-k] > values[k:]
    return top


def _remove_specks(edge: NDArray[np.bool_]) -> NDArray[np.bool_]:
    kept: NDArray[np.bool_] = edge & (_box(edge.astype(np.float64), 7) >= LONELY)
    return kept
