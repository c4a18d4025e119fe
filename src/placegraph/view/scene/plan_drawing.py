"""What the pictures of one estimate share: panels of particles, the result, head, foot and names."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.estimate import PassRecord, PoseEstimate
from placegraph.core.geometry import Camera, Floats
from placegraph.view.city.picture import STATUS_COLOR, length_words, round_length
from placegraph.view.draw.canvas import Frame, Item, Picture
from placegraph.view.draw.fonts import face_for
from placegraph.view.draw.lettering import Taken
from placegraph.view.draw.painter import SUPERSAMPLE, paint_picture
from placegraph.view.draw.sheet import Sheet
from placegraph.view.scene.plan_layout import CAPTION, FOOT, Layout, evenly
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
    from PIL import Image

    from placegraph.indoor.scene_map import SceneMap

LEAST = 0.01
"""Probability of a mode that is drawn."""
NEAREST = 3.0
"""Smallest width of what a panel shows [m]."""
MOST_MOVES = 60
"""Pictures of an animation; of a longer history some are left out."""


class Drawing:
    """What all pictures of one estimate share."""

    def __init__(
        self,
        scene: SceneMap,
        estimate: PoseEstimate,
        truth: Floats | None,
        title: str | None,
        camera: Camera | None,
    ) -> None:
        best = estimate.best
        which = scene.scenes.index(best.scene) if best and best.scene in scene.scenes else 0
        self.plan = RoomPlan(scene, which)
        self.scene, self.estimate, self.which = scene, estimate, which
        self.title = title
        self.truth = None if truth is None else np.asarray(truth, np.float64).reshape(-1, 4, 4)
        self.opening = opening_of(camera)

    def passes(self, sheet: Sheet, layout: Layout) -> None:
        """A row of panels for each pass; late passes are seen from nearer by."""
        for row, k in enumerate(layout.rows):
            record = self.estimate.history[k]
            steps = evenly(len(record.steps), layout.columns)
            frame = self.near(record, layout.small)
            room = paint_room(self.plan, frame)
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
        return paint_picture(items, frame, reduce=False)

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
        room = paint_room(self.plan, frame)
        items = [room, *names(self.plan, frame, taken, marked), *marks]
        return paint_picture(items, frame, reduce=False)

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
        room = paint_room(self.plan, frame)
        steps = [
            (k, step)
            for k, record in enumerate(self.estimate.history)
            for step in range(len(record.steps))
        ]
        pictures = []
        for k, step in (steps[i] for i in evenly(len(steps), MOST_MOVES)):
            record = self.estimate.history[k]
            index, poses, _ = record.steps[step]
            sheet = Sheet(layout.width, layout.height)
            sheet.paste(self.step(room, frame, record, step), layout.large_corner)
            words = f"pass {k + 1} of {len(self.estimate.history)}, stride {record.stride:g}"
            sheet.text((14, 22), words, 14, "ink")
            sheet.text((14, 47), f"frame {index}, {len(poses):,} particles", 13, "soft-ink")
            self.foot(sheet, frame, particles=True, result=False)
            pictures.append(sheet.image.reduce(SUPERSAMPLE))
        sheet = Sheet(layout.width, layout.height)
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
    x = sheet.width - 50.0
    sheet.axes((x, sheet.height - 10.0))
    return scale_bar(sheet, frame, x - 24.0)


def scale_bar(sheet: Sheet, frame: Frame, end: float) -> float:
    """Scale bar of a plan in the strip below it, to an end [px]; where it begins."""
    metres = round_length(0.15 * frame.width / frame.scale)
    length = metres * frame.scale
    sheet.bar((end - length, sheet.height - 10.0), length, length_words(metres))
    return end - length
