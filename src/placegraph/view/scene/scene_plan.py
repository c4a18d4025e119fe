"""Pictures of an estimate in a scene map: particles pass by pass, as in SG2Loc's Fig. 3."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageColor

from placegraph.errors import OptionError
from placegraph.view.city.picture import STATUS_COLOR, length_words, round_length
from placegraph.view.draw.canvas import Frame, Item, Picture
from placegraph.view.draw.fonts import face_for
from placegraph.view.draw.lettering import Taken
from placegraph.view.draw.painter import SUPERSAMPLE, likely, paint_picture
from placegraph.view.draw.sheet import Sheet
from placegraph.view.draw.style import PALETTE
from placegraph.view.scene.plan_layout import CAPTION, FOOT, HEAD, Layout, evenly
from placegraph.view.scene.pose_items import (
    POSE_COLOR,
    TRUTH,
    core,
    error_in_words,
    in_words,
    mode_marks,
    opening_of,
    ring,
    sight,
    swarm,
    way,
    witness_marks,
    witnesses,
)
from placegraph.view.scene.room_painter import paint_room
from placegraph.view.scene.room_plan import RoomPlan
from placegraph.view.scene.room_style import plain_words

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from placegraph.estimate import PassRecord, PoseEstimate
    from placegraph.geometry import Camera, Floats
    from placegraph.indoor.scene_map import SceneMap

LEAST = 0.01
"""Probability of a mode that is drawn."""
NEAREST = 3.0
"""Smallest width of what a panel shows [m]."""
MOVING_WIDTH = 760
"""Of an animation [px]."""
MOST_MOVES = 60
"""Pictures of an animation; of a longer history some are left out."""
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
    dark: bool = False,
) -> Path:
    """Draw an estimate on the plan of its scene as a PNG.

    Where the estimate has a history (`FilterOptions.record`), a row of panels for each pass shows
    how the particles gathered; the large panel shows modes, the way through the map, and why the
    estimate has its status. x grows to the right, y upwards.

    Parameters
    ----------
    scene
        The map the estimate was made on. Of merged scenes the best mode's is drawn.
    estimate
        What to show.
    path
        Where to write.
    truth
        (T, 4, 4) map_from_camera of the frames, where it is known.
    title
        What was localized, such as the name of the capture.
    camera
        Whose field of view is drawn; 63 degrees where not given.
    width
        Of the picture [px]; 1600 with several passes, else 1200 where not given.
    dark
        Whether to draw it for a dark page.

    Raises
    ------
    OptionError
        The width is no width of a picture.

    """
    drawing = _Drawing(scene, estimate, truth, title, camera, dark=dark)
    steps = [len(record.steps) for record in estimate.history]
    layout = Layout.of(drawing.plan.bounds, steps, width=width)
    sheet = Sheet(layout.width, layout.height, dark=dark)
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
    dark: bool = False,
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
    drawing = _Drawing(scene, estimate, truth, title, camera, dark=dark)
    pictures = drawing.moves(width)
    # one palette for all, so that what stands still costs nothing
    few = [pictures[k] for k in evenly(len(pictures), 4)]
    width, height = few[0].size
    swatch = Image.new("RGB", (width, height * (len(few) + 1)))
    for k, picture in enumerate([*few, Image.fromarray(_swatch(width, height))]):
        swatch.paste(picture, (0, k * height))
    palette = swatch.quantize(COLOURS)
    flat = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    path = Path(path)
    times = [PAUSE] * (len(flat) - 1) + [REST]
    flat[0].save(path, "GIF", save_all=True, append_images=flat[1:], duration=times, loop=0)
    return path


def draw_scene(
    scene: SceneMap, path: str | Path, *, which: int = 0, width: int = 1200, dark: bool = False
) -> Path:
    """Draw the plan of a scene, or of scene number `which` of a merged map, as a PNG."""
    plan = RoomPlan(scene, which)
    layout = Layout.of(plan.bounds, [], width=width)
    sheet = Sheet(layout.width, layout.height - HEAD, dark=dark)
    frame = Frame.around(plan.bounds, *layout.large)
    items: list[Item] = [
        paint_room(plan, frame, dark=dark),
        *names(plan, frame, Taken(), small=True),
    ]
    sheet.paste(paint_picture(items, frame, dark=dark, reduce=False), (0, 0))
    measures(sheet, frame)
    count = len(plan.rows)
    rooms = len({room for row in plan.rows if (room := scene.attributes[row].get("room"))})
    within = f" in {rooms} room{'s' * (rooms != 1)}" if rooms else ""
    things = f"{count:,} object{'s' * (count != 1)}{within}, {len(plan.triangles):,} triangles"
    sheet.text((14, sheet.height - FOOT / 2), f"{scene.scenes[which]}: {things}", 12, "soft-ink")
    return sheet.save(path)


class _Drawing:
    """What all pictures of one estimate share."""

    def __init__(
        self,
        scene: SceneMap,
        estimate: PoseEstimate,
        truth: Floats | None,
        title: str | None,
        camera: Camera | None,
        *,
        dark: bool,
    ) -> None:
        best = estimate.best
        which = scene.scenes.index(best.scene) if best and best.scene in scene.scenes else 0
        self.plan = RoomPlan(scene, which)
        self.scene, self.estimate, self.which = scene, estimate, which
        self.title = title
        self.truth = None if truth is None else np.asarray(truth, np.float64).reshape(-1, 4, 4)
        self.opening = opening_of(camera)
        self.dark = dark

    def passes(self, sheet: Sheet, layout: Layout) -> None:
        """A row of panels for each pass; late passes are seen from nearer by."""
        for row, k in enumerate(layout.rows):
            record = self.estimate.history[k]
            steps = evenly(len(record.steps), layout.columns)
            frame = self.near(record, layout.small)
            room = paint_room(self.plan, frame, dark=self.dark)
            for column, step in enumerate(steps):
                left, top = layout.corner(row, column)
                sheet.paste(self.step(room, frame, record, step), (left, top))
                words = f"frame {record.steps[step][0]}"
                if column == 0:
                    words = f"pass {k + 1}, stride {record.stride:g}: {words}"
                    metres = round_length(0.2 * frame.width / frame.scale)
                    bar = left + 8, top + frame.height - 8
                    sheet.bar(bar, metres * frame.scale, length_words(metres))
                sheet.text((left + 6, top - CAPTION / 2), words, 12, "ink", room=frame.width - 12)

    def near(self, record: PassRecord, size: tuple[int, int]) -> Frame:
        """Frame that holds all particles of a pass, but for stray ones."""
        cores = [core(poses, weights) for _, poses, weights in record.steps if len(poses)]
        if not cores:
            return Frame.around(self.plan.bounds, *size)
        boxes = np.array(cores, np.float64)
        low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
        middle, half = (low + high) / 2, np.maximum(0.625 * (high - low), NEAREST / 2)
        west, south = (middle - half).tolist()
        east, north = (middle + half).tolist()
        zoomed = Frame.around((west, south, east, north), *size)
        whole = Frame.around(self.plan.bounds, *size)
        return zoomed if zoomed.scale > 1.5 * whole.scale else whole

    def step(self, room: Picture, frame: Frame, record: PassRecord, step: int) -> Image.Image:
        """Particles after one frame of a pass, and a ring around where that frame truly was."""
        index, poses, weights = record.steps[step]
        items: list[Item] = [room, swarm(poses, weights)]
        if self.truth is not None:
            for matrix in self.truth[np.flatnonzero(self.estimate.frames == index)[:1]]:
                items += ring(matrix, TRUTH, 9.0 / frame.scale)
        return paint_picture(items, frame, dark=self.dark, reduce=False)

    def result(self, frame: Frame) -> Image.Image:
        """Modes, the objects that spoke for or against the best one, and the way that was gone."""
        estimate, taken = self.estimate, Taken()
        color = POSE_COLOR[estimate.status]
        marks: list[Item] = []
        shown = [
            k
            for k, mode in enumerate(estimate.modes)
            if mode.scene == self.name and (k == 0 or mode.probability >= LEAST)
        ]
        for k in reversed(shown):
            marks.append(sight(self.plan, estimate, k, self.opening))
            x, y = estimate.modes[k].pose[:2] * frame.scale * (1.0, -1.0)
            taken.claim([(x, y, 14.0), (x + 28.0, y, 14.0)], force=True)
        if self.truth is not None:
            marks += way(self.truth, TRUTH, width=2.0)
        marked: dict[int, str] = {}
        if shown:
            marked = dict(witnesses(self.plan, estimate.modes[shown[0]]))
            marks += witness_marks(self.plan, estimate.modes[shown[0]])
            marks += way(estimate.trajectory, color, width=2.4)
        for k in reversed(shown):
            marks += mode_marks(estimate, k, numbered=len(shown) > 1)
        room = paint_room(self.plan, frame, dark=self.dark)
        items = [room, *names(self.plan, frame, taken, marked), *marks]
        return paint_picture(items, frame, dark=self.dark, reduce=False)

    @property
    def name(self) -> str:
        """Of the scene that is drawn."""
        return self.scene.scenes[self.which]

    def head(self, sheet: Sheet) -> None:
        """Status, reason, the pose in numbers, and what was localized where."""
        estimate = self.estimate
        end = sheet.chip((14, 12), estimate.status.name, STATUS_COLOR[estimate.status])
        sheet.text((end + 12, 22), estimate.reason, 14, "ink", room=sheet.width - end - 26)
        scene = self.name
        if len(self.scene.scenes) > 1:
            scene += f", one of {len(self.scene.scenes)} merged scenes"
        count = len(estimate.frames)
        frames = f"{count} frame{'s' * (count != 1)} in {scene}"
        said = [in_words(estimate), f"{self.title}, {frames}" if self.title else frames]
        if self.truth is not None:
            said.insert(1, error_in_words(estimate, self.truth))
        words = "     ".join(filter(None, said))
        sheet.text((14, 47), words, 13, "soft-ink", room=sheet.width - 28)

    def foot(self, sheet: Sheet, frame: Frame, *, particles: bool, result: bool = True) -> None:
        """Keys, as many as there is room for, scale bar and axes."""
        color = POSE_COLOR[self.estimate.status]
        best = self.estimate.best
        verdicts = {verdict for _, verdict in witnesses(self.plan, best)} if best else set[str]()
        keys: list[tuple[bool, str, Callable[..., float]]] = [
            (result, "way, and what is seen", partial(sheet.key_line, color=color)),
            (self.truth is not None, "true way", partial(sheet.key_line, color=TRUTH)),
            (particles, "particles, darker where it is likely", sheet.key_likely),
            (result and "for" in verdicts, "agrees", partial(sheet.key_line, color="for")),
            (
                result and "against" in verdicts,
                "disagrees",
                partial(sheet.key_line, color="against", dashed=True),
            ),
        ]
        x, y = 14.0, sheet.height - FOOT / 2
        end = measures(sheet, frame)
        for wanted, words, draw in keys:
            if wanted and x + 60.0 + face_for([words]).width(words, 12.0) < end:
                x = draw((x, y), words=words)

    def moves(self, width: int) -> list[Image.Image]:
        """Pictures of an animation."""
        layout = Layout.of(self.plan.bounds, [], width=width)
        frame = Frame.around(self.plan.bounds, *layout.large)
        room = paint_room(self.plan, frame, dark=self.dark)
        steps = [
            (k, step)
            for k, record in enumerate(self.estimate.history)
            for step in range(len(record.steps))
        ]
        pictures = []
        for k, step in (steps[i] for i in evenly(len(steps), MOST_MOVES)):
            record = self.estimate.history[k]
            index, poses, _ = record.steps[step]
            sheet = Sheet(layout.width, layout.height, dark=self.dark)
            sheet.paste(self.step(room, frame, record, step), layout.large_corner)
            words = f"pass {k + 1} of {len(self.estimate.history)}, stride {record.stride:g}"
            sheet.text((14, 22), words, 14, "ink")
            sheet.text((14, 47), f"frame {index}, {len(poses):,} particles", 13, "soft-ink")
            self.foot(sheet, frame, particles=True, result=False)
            pictures.append(sheet.image.reduce(SUPERSAMPLE))
        sheet = Sheet(layout.width, layout.height, dark=self.dark)
        sheet.paste(self.result(frame), layout.large_corner)
        self.head(sheet)
        self.foot(sheet, frame, particles=False)
        return [*pictures, sheet.image.reduce(SUPERSAMPLE)]


def names(
    plan: RoomPlan,
    frame: Frame,
    taken: Taken,
    marked: dict[int, str] | None = None,
    *,
    small: bool = False,
) -> list[Item]:
    """Names of the larger things of a plan, or of all, where there is room; `marked` ones first."""
    face = face_for(plain_words(label) for label in plan.scene.graph.labels)
    return [*plan.names(frame, face, taken, marked, small=small)]


def measures(sheet: Sheet, frame: Frame) -> float:
    """Scale bar and axes of a plan, at the right end of the strip below it; where they begin."""
    metres = round_length(0.15 * frame.width / frame.scale)
    length = metres * frame.scale
    x, y = sheet.width - 50.0, sheet.height - 10.0
    sheet.axes((x, y))
    sheet.bar((x - 24.0 - length, y), length, length_words(metres))
    return x - 24.0 - length


def _swatch(width: int, height: int) -> NDArray[np.uint8]:
    """Picture (height, width, 3) of the colours that marks have, so that a palette holds them."""
    ramp = likely(np.linspace(0.0, 1.0, width))[:, :3]
    named = [PALETTE[name][0] for name in (*POSE_COLOR.values(), TRUTH, "for", "against", "ink")]
    inks = np.array([ImageColor.getrgb(color) for color in named], np.uint8)
    blocks = inks[np.arange(width) * len(inks) // width]
    half = np.tile(ramp, (height - height // 2, 1, 1)), np.tile(blocks, (height // 2, 1, 1))
    return np.concatenate(half).astype(np.uint8)
