"""Pictures of an estimate in a scene map: particles pass by pass, as in SG2Loc's Fig. 3."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor

from placegraph.core.estimate import PoseEstimate
from placegraph.core.geometry import Camera, Floats
from placegraph.errors import OptionError
from placegraph.view.draw.canvas import Frame, Item
from placegraph.view.draw.lettering import Taken
from placegraph.view.draw.painter import likely, paint_picture
from placegraph.view.draw.sheet import Sheet, write_image
from placegraph.view.draw.style import PALETTE
from placegraph.view.scene.plan_drawing import Drawing, measures, names
from placegraph.view.scene.plan_layout import FOOT, HEAD, Layout, evenly
from placegraph.view.scene.pose_items import (
    POSE_COLOR,
    TRUTH,
)
from placegraph.view.scene.room_painter import paint_room
from placegraph.view.scene.room_plan import RoomPlan

if TYPE_CHECKING:
    from placegraph.indoor.scene_map import SceneMap

MOVING_WIDTH = 760
"""Of an animation [px]."""
COLOURS = 128
"""Of an animation."""
PAUSE, REST = 220, 3000
"""Time of one picture of an animation, and of the last [ms]."""


def write_plan(
    scene: SceneMap,
    estimate: PoseEstimate,
    path: str | Path,
    *,
    truth: Floats | None = None,
    title: str | None = None,
    camera: Camera | None = None,
    width: int | None = None,
) -> Path:
    """Draw an estimate on the plan of its scene as a PNG.

    Where the estimate has a history (`FilterOptions.record`), a row of panels for each pass shows
    how the particles gathered; the large panel shows modes, the way through the map, and why the
    estimate has its status. x grows to the right, y upwards.

    Parameters
    ----------
    scene
        The map the estimate was made on. Of merged scenes the best mode's is drawn.
    truth
        (T, 4, 4) map_from_camera of the frames, where it is known.
    title
        What was localized, such as the name of the capture.
    camera
        Whose field of view is drawn; 63 degrees where not given.
    width
        Of the picture [px]; 1600 with several passes, else 1200 where not given.

    Raises
    ------
    OptionError
        The width is no width of a picture.

    """
    drawing = Drawing(scene, estimate, truth, title, camera)
    steps = [len(record.steps) for record in estimate.history]
    layout = Layout.of(drawing.plan.bounds, steps, width=width)
    sheet = Sheet(layout.width, layout.height)
    drawing.passes(sheet, layout)
    frame = Frame.around(drawing.plan.bounds, *layout.large)
    sheet.paste(drawing.result(frame), layout.large_corner)
    drawing.head(sheet)
    drawing.foot(sheet, frame, particles=bool(layout.rows))
    return sheet.save(path)


def write_plan_animation(
    scene: SceneMap,
    estimate: PoseEstimate,
    path: str | Path,
    *,
    truth: Floats | None = None,
    title: str | None = None,
    camera: Camera | None = None,
    width: int = MOVING_WIDTH,
) -> Path:
    """Draw the particles of every pass and frame as an animated GIF that ends with the result.

    Parameters as of `write_plan`.

    Raises
    ------
    OptionError
        The estimate has no history, or the width is no width of a picture.

    """
    if not any(record.steps for record in estimate.history):
        raise OptionError(
            "The estimate has no history to animate; localize with FilterOptions(record=True)."
        )
    drawing = Drawing(scene, estimate, truth, title, camera)
    pictures = drawing.moves(width)
    # one palette for all, so that what stands still costs nothing
    few = [pictures[k] for k in evenly(len(pictures), 4)]
    width, height = few[0].size
    swatch = Image.new("RGB", (width, height * (len(few) + 1)))
    for k, picture in enumerate([*few, Image.fromarray(_swatch(width, height))]):
        swatch.paste(picture, (0, k * height))
    palette = swatch.quantize(COLOURS)
    flat = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    times = [PAUSE] * (len(flat) - 1) + [REST]
    moving = {"save_all": True, "append_images": flat[1:], "duration": times, "loop": 0}
    return write_image(flat[0], path, "GIF", **moving)


def draw_scene(scene: SceneMap, path: str | Path, *, width: int = 1200) -> Path:
    """Draw the plan of a scene, or of the first of a merged map, as a PNG."""
    plan = RoomPlan(scene)
    layout = Layout.of(plan.bounds, [], width=width)
    sheet = Sheet(layout.width, layout.height - HEAD)
    frame = Frame.around(plan.bounds, *layout.large)
    items: list[Item] = [
        paint_room(plan, frame),
        *names(plan, frame, Taken(), small=True),
    ]
    sheet.paste(paint_picture(items, frame, reduce=False), (0, 0))
    measures(sheet, frame)
    count = len(plan.rows)
    rooms = len({room for row in plan.rows if (room := scene.attributes[row].get("room"))})
    within = f" in {rooms} room{'s' * (rooms != 1)}" if rooms else ""
    things = f"{count:,} object{'s' * (count != 1)}{within}, {len(plan.triangles):,} triangles"
    sheet.text((14, sheet.height - FOOT / 2), f"{scene.scenes[0]}: {things}", 12, "soft-ink")
    return sheet.save(path)


def _swatch(width: int, height: int) -> NDArray[np.uint8]:
    """Picture (height, width, 3) of the colours that marks have, so that a palette holds them."""
    ramp = likely(np.linspace(0.0, 1.0, width))[:, :3]
    named = [PALETTE[name][0] for name in (*POSE_COLOR.values(), TRUTH, "for", "against", "ink")]
    inks = np.array([ImageColor.getrgb(color) for color in named], np.uint8)
    blocks = inks[np.arange(width) * len(inks) // width]
    half = np.tile(ramp, (height - height // 2, 1, 1)), np.tile(blocks, (height // 2, 1, 1))
    return np.concatenate(half).astype(np.uint8)
