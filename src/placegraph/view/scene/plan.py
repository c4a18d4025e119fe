"""Plan of a scene map with an estimate: poses, particles, passes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor

from placegraph.core.estimate import PassRecord, PoseEstimate, PoseMode, Status
from placegraph.core.geometry import Camera, Floats
from placegraph.errors import OptionError
from placegraph.view.city.city_items import SIGMAS
from placegraph.view.city.picture import STATUS_COLOR, length_words, round_length
from placegraph.view.draw.canvas import (
    Bounds,
    Disc,
    Frame,
    Item,
    Mark,
    ParticleMarks,
    Picture,
    Stroke,
    Text,
    choose_face,
)
from placegraph.view.draw.lettering import OccupiedPlaces
from placegraph.view.draw.painter import (
    SUPERSAMPLE,
    Sheet,
    colour_levels,
    paint_picture,
    write_image,
)
from placegraph.view.draw.style import PALETTE
from placegraph.view.scene.frame_marks import mark_agreement
from placegraph.view.scene.room_plan import RoomPlan, name_of, paint_room

if TYPE_CHECKING:
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.io.capture.frame import Frame as CameraFrame

POSE_COLOR = {Status.OK: "mode", Status.AMBIGUOUS: "amber", Status.LOST: "soft-ink"}
"""Colours of modes and ways."""
TRUTH = "transit"
"""Colour of the true way, where it is known."""
REACH = 3.5
"""Length of the wedge that shows what a mode sees [m]."""
ANYWHERE, CERTAIN = 3e-4, 0.3
"""Probabilities around a particle that are painted as unlikely and as certain."""
CELL, SECTOR = 0.4, np.pi / 6
"""Neighbourhood of a particle: distance [m] and rotation [rad]."""
VERDICTS = ("for", "against")
"""Verdicts that are drawn; each is also the name of its colour."""
SLIT = 5
"""Of the 65 angles of a view, gaps between walls that are narrower are cracks of a scan."""
OPENING = 1.1
"""Horizontal field of view where the camera is not known [rad]."""
MAX_FRAMES = 5000
"""Maximum number of frames; of longer trajectories some are left out."""


def particle_levels(poses: Floats, weights: Floats) -> Floats:
    """Return the probability (N,), 0 to 1, around each particle, relative to the highest.

    `poses`: (N, 4), x, y, z [m], yaw [rad]; `weights`: (N,), of any sum. What counts is the weight
    of all particles in a cell around: after resampling the weight of one says nothing.
    """
    total = weights.sum()
    if not total > 0.0:  # none, or none that is worth anything
        return np.zeros(len(poses))
    turns = round(2.0 * np.pi / SECTOR)
    low = poses[:, :2].min(axis=0)
    edge = max(CELL, float(np.ptp(poses[:, :2], axis=0).max()) / 500)
    spots = np.column_stack([(poses[:, :2] - low) / edge, poses[:, 3] / SECTOR % turns])
    shape = np.floor(spots.max(axis=0)).astype(np.int64) + 2
    shape[2] = turns
    # linear in x, y and yaw on the way to the cells, and on the way back
    corners = []
    for corner in product((0, 1), repeat=3):
        cells = np.floor(spots).astype(np.int64) + corner
        cells[:, 2] %= turns
        near = np.prod(1.0 - np.abs((spots - np.floor(spots)) - corner), axis=1)
        corners.append((np.ravel_multi_index(tuple(cells.T), tuple(shape)), near))
    density = np.zeros(int(np.prod(shape)))
    for cell, near in corners:
        density += np.bincount(cell, near * weights / total, len(density))
    share = sum((near * density[cell] for cell, near in corners), np.zeros(len(poses)))
    with np.errstate(divide="ignore"):
        level = np.log(share / ANYWHERE) / np.log(CERTAIN / ANYWHERE)
    clipped: Floats = np.clip(level, 0.0, 1.0)
    return clipped


def particle_marks(poses: Floats, weights: Floats) -> ParticleMarks:
    """Return particles (N, 4) with weights (N,) as marks, the smaller the more there are."""
    poses, weights = np.asarray(poses, np.float64), np.asarray(weights, np.float64)
    radius = float(np.interp(len(poses), [200, 1000, 5000], [2.0, 1.5, 0.7]))
    tick = 4.0 if len(poses) < 2500 else 0.0
    return ParticleMarks(poses[:, :2], poses[:, 3], particle_levels(poses, weights), radius, tick)


def core_bounds(poses: Floats, weights: Floats) -> Bounds:
    """Return the rectangle with 96 % of the weight along either axis: low x, low y, high x, high y."""
    weights = weights if weights.sum() > 0.0 else np.ones(len(poses))
    box = []
    for axis in (0, 1):
        order = np.argsort(poses[:, axis], kind="stable")
        share = np.cumsum(weights[order]) / weights.sum()
        ends = poses[order[np.searchsorted(share, (0.02, 0.98)).clip(0, len(order) - 1)], axis]
        box.append(ends.tolist())
    return box[0][0], box[1][0], box[0][1], box[1][1]


def field_of_view(camera: Camera | None) -> float:
    """Return the horizontal field of view [rad]."""
    if camera is None:
        return OPENING
    return float(
        np.arctan(camera.cx / camera.fx) + np.arctan((camera.width - camera.cx) / camera.fx)
    )


def view_ring(plan: RoomPlan, pose: Floats, opening: float, reach: float = REACH) -> Floats:
    """Return the closed ring (A + 2, 2) [m] of the view of a camera at a pose (4,)."""
    at = np.asarray(pose[:2], np.float64)
    angles = pose[3] + np.linspace(-opening / 2, opening / 2, 65)
    far = plan.view_range(at, angles, reach)
    # a look through a crack in a scanned wall is none: grey opening over SLIT angles
    for narrow in (np.min, np.max):
        padded = np.pad(far, SLIT // 2, mode="edge")
        far = narrow(np.lib.stride_tricks.sliding_window_view(padded, SLIT), axis=1)
    rim = at + far[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return np.concatenate([at[None], rim, at[None]])


def covariance_ring(mode: PoseMode) -> Floats:
    """Return a closed ring (49, 2) [m] around a mode: `SIGMAS` standard deviations in the plane."""
    turn = np.linspace(0.0, 2.0 * np.pi, 49)
    variances, axes = np.linalg.eigh(np.asarray(mode.covariance[:2, :2], np.float64))
    radii = SIGMAS * np.sqrt(np.maximum(variances, 0.0))
    ring: Floats = mode.pose[:2] + (np.stack([np.cos(turn), np.sin(turn)], axis=1) * radii) @ axes.T
    return ring


def trajectory_marks(map_from_camera: Floats, color: str, *, width: float = 2.0) -> list[Mark]:
    """Return a trajectory (T, 4, 4) as a line with dots."""
    shown = map_from_camera[spread_evenly(len(map_from_camera), MAX_FRAMES)]
    at = shown[:, :2, 3]
    marks: list[Mark] = [Stroke(at, color, width)] if len(at) > 1 else []
    return [*marks, *(Disc(point, 1.1 * width, color) for point in at)]


def camera_ring(map_from_camera: Floats, color: str, radius: float) -> list[Mark]:
    """Return a ring of a radius [m] around a camera (4, 4), with a line along its heading."""
    turn = np.linspace(0.0, 2.0 * np.pi, 33)
    at, forward = map_from_camera[:2, 3], map_from_camera[:2, 2]
    forward = forward / max(float(np.hypot(*forward)), 1e-6)
    circle = at + radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    look = np.stack([at + radius * forward, at + 2.0 * radius * forward])
    halo_first = (("paper", 4.0), (color, 2.0))
    return [Stroke(line, name, width) for name, width in halo_first for line in (look, circle)]


def mode_view(plan: RoomPlan, estimate: PoseEstimate, number: int, opening: float) -> Mark:
    """Return the view of a mode of an estimate (0 is the best)."""
    color, pose = POSE_COLOR[estimate.status], estimate.modes[number].pose
    best = number == 0
    return Stroke(
        view_ring(plan, pose, opening), color, 1.2 if best else 0.8, fill=0.2 if best else 0.1
    )


def mode_marks(estimate: PoseEstimate, number: int, *, numbered: bool) -> list[Mark]:
    """Return the marks of a mode (0 is the best): its ellipse, with number and probability if several."""
    mode, color = estimate.modes[number], POSE_COLOR[estimate.status]
    marks: list[Mark] = [Stroke(covariance_ring(mode), color, 1.6, (5.0, 3.0))]
    if not numbered:
        return [*marks, Disc(mode.pose[:2], 6.0, color)]
    percent = f"{mode.probability:.0%}"
    label = Text(mode.pose[:2], percent, 13.0, color, anchor="l", shift=(15.0, -1.0))
    return [*marks, Disc(mode.pose[:2], 10.0, color, text=str(number + 1)), label]


def evidence_rows(plan: RoomPlan, mode: PoseMode, most: int = 8) -> list[tuple[int, str]]:
    """Return rows and verdicts of the objects that support or contradict a mode, by decreasing weight.

    Walls, floors and ceilings are everywhere, and left out.
    """
    row_of = {id_: row for row, id_ in enumerate(plan.scene.graph.ids)}
    found: dict[int, str] = {}
    for evidence in sorted(mode.evidence, key=lambda e: -abs(e.weight)):
        for ref in evidence.objects if evidence.verdict in VERDICTS else ():
            row = row_of.get(ref.id, -1)
            if row >= 0 and plan.role(row) == "thing":
                found.setdefault(row, evidence.verdict)
    return list(found.items())[:most]


def evidence_marks(plan: RoomPlan, mode: PoseMode, opening: float) -> list[Item]:
    """Return lines from a mode to the objects that support it (solid) or contradict it (dashed).

    They end amid what a camera with a field of view `opening` [rad] sees of an object, on a disc: of
    an object without a name in its colour in the map.
    """
    marks: list[Item] = []
    for row, verdict in reversed(evidence_rows(plan, mode)):
        end, colour = plan.point_in_view(row, mode.pose, opening)
        ends = np.stack([mode.pose[:2], end])
        marks.append(Stroke(ends, verdict, 1.4, (5.0, 4.0) if verdict == "against" else None))
        marks.append(Disc(end, 3.5, verdict))
        if plan.is_bare[row]:
            marks.append(Disc(end, 7.0, colour, rim=verdict))
    return marks


READ_FRAMES = 3
"""Frames that are compared with the map, the last among them."""


def agreement_marks(
    plan: RoomPlan, estimate: PoseEstimate, capture: Iterable[CameraFrame]
) -> list[Disc]:
    """Return dots where frames of a capture agree with the map at the poses of an estimate, or not."""
    frame_of, count = {frame.index: frame for frame in capture}, len(estimate.frames)
    marks: list[Disc] = []
    for row in spread_evenly(count, READ_FRAMES) if frame_of else []:
        frame = frame_of.get(int(estimate.frames[row]))
        if frame is not None:
            marks += mark_agreement(plan.scene, plan.floor, frame, estimate.trajectory[row])
    return marks


def describe_pose(estimate: PoseEstimate) -> str:
    """Describe the best mode in numbers; empty where there is none."""
    best = estimate.best
    if best is None:
        return ""
    x, y, z, yaw = best.pose.tolist()
    deviation = np.sqrt(np.maximum(np.diagonal(best.covariance), 0.0))
    spread = 100.0 * float(np.hypot(*deviation[:2]))
    turn = float(np.degrees(deviation[5]))
    return (
        f"x {x:.2f}  y {y:.2f}  z {z:.2f} m,  yaw {np.degrees(yaw):.1f}°  "
        f"(± {spread:.{int(spread < 10)}f} cm, ± {turn:.1f}°)"
    )


def format_error(estimate: PoseEstimate, truth: Floats) -> str:
    """Describe the error of the last frame's pose; empty where there is no pose."""
    if estimate.best is None or not len(truth):
        return ""
    off = np.linalg.inv(truth[-1]) @ estimate.best.map_from_camera
    turn = np.arccos(np.clip((np.trace(off[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
    return f"error: {100 * np.linalg.norm(off[:3, 3]):.0f} cm and {np.degrees(turn):.1f}°"


HEAD, FOOT, GAP = 64, 46, 4
"""Height of the strips above and below the panels, and what lies between panels [px]."""
CAPTION = 20
"""Height of the strip above a small panel [px]."""
MOST_ROWS, MOST_COLUMNS = 4, 3
"""Passes that are shown, and frames of each."""
NARROWEST, WIDEST_PAGE = 320, 6000
"""Widths of pictures [px]."""
TALLEST, WIDEST = 1.6, 2.4
"""Panels have the scene's proportions up to these: height by width, and width by height."""


@dataclass(frozen=True)
class Layout:
    """Sizes and places in pixels."""

    width: int
    height: int
    rows: tuple[int, ...]
    """Numbers of the passes that have a row."""
    columns: int
    small: tuple[int, int]
    """Width and height of a small panel."""
    large: tuple[int, int]
    large_corner: tuple[int, int]

    @classmethod
    def of(cls, bounds: Bounds, steps: Sequence[int], *, width: int | None = None) -> Layout:
        """Return the layout for a scene with these bounds and so many steps in each pass.

        One pass stands above the large panel; several, and one of few steps, which would leave a row
        half empty, stand to its left: then rows and columns of small panels and the large one are as
        high as each other.

        Raises `OptionError` where the width is no width of a picture.
        """
        if width is not None and not (isinstance(width, int) and NARROWEST <= width <= WIDEST_PAGE):
            raise OptionError(f"width is {width}; give {NARROWEST} to {WIDEST_PAGE} px.")
        west, south, east, north = bounds
        shape = min(max((east - west) / (north - south), 1.0 / TALLEST), WIDEST)
        passes = [k for k, count in enumerate(steps) if count]
        rows = tuple(passes[k] for k in spread_evenly(len(passes), MOST_ROWS))
        columns = min(MOST_COLUMNS + (len(rows) == 1), max((steps[k] for k in rows), default=0))
        if len(rows) > 1 or 0 < columns < MOST_COLUMNS:
            width = width or 1600
            unit = (width - columns * GAP) // (columns + len(rows))
            small = unit, round(unit / shape)
            left = columns * (unit + GAP)
            tall = len(rows) * (CAPTION + small[1])
            return cls(
                width, HEAD + tall + FOOT, rows, columns, small, (width - left, tall), (left, HEAD)
            )
        width = width or 1200
        small, top = (0, 0), HEAD
        if rows:
            unit = (width - (columns - 1) * GAP) // max(columns, 3)
            small = unit, round(unit / shape)
            top += CAPTION + small[1] + GAP
        large = width, round(width / shape)
        return cls(width, top + large[1] + FOOT, rows, columns, small, large, (0, top))

    def corner(self, row: int, column: int) -> tuple[int, int]:
        """Return the upper left corner of a small panel."""
        wide, tall = self.small
        return column * (wide + GAP), HEAD + row * (tall + CAPTION) + CAPTION


def spread_evenly(count: int, most: int) -> list[int]:
    """Return at most so many of `count` indices, evenly spaced, with the first and the last."""
    if count <= most:
        return list(range(count))
    if most == 1:
        return [count - 1]
    return sorted({round(k * (count - 1) / (most - 1)) for k in range(most)})


LEAST = 0.01
"""Probability of a mode that is drawn."""
NEAREST = 3.0
"""Smallest width of what a panel shows [m]."""
MAX_MOVES = 60
"""Pictures of an animation; of a longer history some are left out."""


class Drawing:
    """Data shared by all pictures of one estimate."""

    def __init__(
        self,
        scene: SceneMap,
        estimate: PoseEstimate,
        truth: Floats | None,
        title: str | None,
        camera: Camera | None,
        capture: Iterable[CameraFrame] = (),
    ) -> None:
        best = estimate.best
        which = scene.scenes.index(best.scene) if best and best.scene in scene.scenes else 0
        self.plan = RoomPlan(scene, which)
        self.scene, self.estimate, self.which = scene, estimate, which
        self.title = title
        self.truth = None if truth is None else np.asarray(truth, np.float64).reshape(-1, 4, 4)
        self.opening = field_of_view(camera)
        self.agreement = agreement_marks(self.plan, estimate, capture) if best else []

    def passes(self, sheet: Sheet, layout: Layout) -> None:
        """Draw a row of panels for each pass, later passes enlarged."""
        for row, k in enumerate(layout.rows):
            record = self.estimate.history[k]
            steps = spread_evenly(len(record.steps), layout.columns)
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
        """Return a frame around all particles of a pass but outliers."""
        cores = [core_bounds(poses, weights) for _, poses, weights in record.steps if len(poses)]
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
        """Draw the particles after one frame of a pass, and a ring around the true pose."""
        index, poses, weights = record.steps[step]
        items: list[Item] = [room, particle_marks(poses, weights)]
        if self.truth is not None:
            for matrix in self.truth[np.flatnonzero(self.estimate.frames == index)[:1]]:
                items += camera_ring(matrix, TRUTH, 9.0 / frame.scale)
        return paint_picture(items, frame, reduce=False)

    def result(self, frame: Frame) -> Image.Image:
        """Draw modes, the objects that support or contradict the best one, and the trajectory."""
        estimate, occupied = self.estimate, OccupiedPlaces()
        color = POSE_COLOR[estimate.status]
        marks: list[Item] = []
        shown = [
            k
            for k, mode in enumerate(estimate.modes)
            if mode.scene == self.name and (k == 0 or mode.probability >= LEAST)
        ]
        for k in reversed(shown):
            marks.append(mode_view(self.plan, estimate, k, self.opening))
            x, y = estimate.modes[k].pose[:2] * frame.scale * (1.0, -1.0)
            occupied.claim([(x, y, 14.0), (x + 28.0, y, 14.0)], force=True)
        if self.truth is not None:
            marks += trajectory_marks(self.truth, TRUTH, width=2.0)
        marked: dict[int, str] = {}
        if shown:
            marked = dict(evidence_rows(self.plan, estimate.modes[shown[0]]))
            marks += self.agreement
            marks += evidence_marks(self.plan, estimate.modes[shown[0]], self.opening)
            marks += trajectory_marks(estimate.trajectory, color, width=2.4)
        for k in reversed(shown):
            marks += mode_marks(estimate, k, numbered=len(shown) > 1)
        room = paint_room(self.plan, frame)
        items = [room, *place_names(self.plan, frame, occupied, marked), *marks]
        return paint_picture(items, frame, reduce=False)

    @property
    def name(self) -> str:
        """Name of the drawn scene."""
        return self.scene.scenes[self.which]

    def head(self, sheet: Sheet) -> None:
        """Draw status, reason, the pose in numbers, and the names of capture and map."""
        estimate = self.estimate
        end = sheet.chip((14, 12), estimate.status.name, STATUS_COLOR[estimate.status])
        sheet.text((end + 12, 22), estimate.reason, 14, "ink", room=sheet.width - end - 26)
        scene = self.name
        if len(self.scene.scenes) > 1:
            scene += f", one of {len(self.scene.scenes)} merged scenes"
        count = len(estimate.frames)
        frames = f"{count} frame{'s' * (count != 1)} in {scene}"
        said = [describe_pose(estimate), f"{self.title}, {frames}" if self.title else frames]
        if self.truth is not None:
            said.insert(1, format_error(estimate, self.truth))
        words = "     ".join(filter(None, said))
        sheet.text((14, 47), words, 13, "soft-ink", room=sheet.width - 28)

    def foot(self, sheet: Sheet, frame: Frame, *, particles: bool, result: bool = True) -> None:
        """Draw as many keys as fit, scale bar and axes."""
        color = POSE_COLOR[self.estimate.status]
        best = self.estimate.best
        verdicts = (
            {verdict for _, verdict in evidence_rows(self.plan, best)} if best else set[str]()
        )
        keys: list[tuple[bool, str, Callable[..., float]]] = [
            (result, "path and view", partial(sheet.key_line, color=color)),
            (self.truth is not None, "true way", partial(sheet.key_line, color=TRUTH)),
            (particles, "particles, darker where more likely", sheet.key_likely),
            (result and "for" in verdicts, "object agrees", partial(sheet.key_line, color="for")),
            (
                result and "against" in verdicts,
                "object disagrees",
                partial(sheet.key_line, color="against", dashed=True),
            ),
        ]
        dots = [mark.color for mark in self.agreement]
        for verdict, words in zip(VERDICTS, ("agrees", "differs"), strict=True):
            share = f"frame {words}: {dots.count(verdict) / max(1, len(dots)):.0%}"
            keys.append((result and bool(dots), share, partial(sheet.key_disc, color=verdict)))
        x, y = 14.0, sheet.height - FOOT / 2
        end = draw_measures(sheet, frame)
        for wanted, words, draw in keys:
            if wanted and x + 60.0 + choose_face([words]).width(words, 12.0) < end:
                x = draw((x, y), words=words)

    def moves(self, width: int) -> list[Image.Image]:
        """Yield the pictures of an animation."""
        layout = Layout.of(self.plan.bounds, [], width=width)
        frame = Frame.around(self.plan.bounds, *layout.large)
        room = paint_room(self.plan, frame)
        steps = [
            (k, step)
            for k, record in enumerate(self.estimate.history)
            for step in range(len(record.steps))
        ]
        pictures = []
        for k, step in (steps[i] for i in spread_evenly(len(steps), MAX_MOVES)):
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


def place_names(
    plan: RoomPlan,
    frame: Frame,
    occupied: OccupiedPlaces,
    marked: dict[int, str] | None = None,
    *,
    small: bool = False,
) -> list[Item]:
    """Return names of the larger objects of a plan, or of all, where they fit; `marked` ones first."""
    face = choose_face(name_of(label) for label in plan.scene.graph.labels)
    return [*plan.names(frame, face, occupied, marked, small=small)]


def draw_measures(sheet: Sheet, frame: Frame) -> float:
    """Draw scale bar and axes at the right end of the strip below a plan; return their left end."""
    x = sheet.width - 50.0
    sheet.axes((x, sheet.height - 10.0))
    return draw_scale_bar(sheet, frame, x - 24.0)


def draw_scale_bar(sheet: Sheet, frame: Frame, end: float) -> float:
    """Draw a scale bar in the strip below a plan, up to an end [px]; return its left end."""
    metres = round_length(0.15 * frame.width / frame.scale)
    length = metres * frame.scale
    sheet.bar((end - length, sheet.height - 10.0), length, length_words(metres))
    return end - length


MOVING_WIDTH = 760
"""Width of an animation [px]."""
COLOURS = 128
"""Number of colours of an animation."""
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
    capture: Iterable[CameraFrame] = (),
    width: int | None = None,
) -> Path:
    """Draw an estimate on the plan of its scene as a PNG.

    Where the estimate has a history (`FilterOptions.record`), a row of panels for each pass shows
    how the particles gathered; the large panel shows modes, the way through the map, and why the
    estimate has its status. x grows to the right, y upwards.

    Raises `OptionError`: the width is no width of a picture.

    `scene`: the map the estimate was made on. Of merged scenes the best mode's is drawn.
    `truth`: (T, 4, 4) map_from_camera of the frames, where it is known.
    `title`: what was localized, such as the name of the capture.
    `camera`: whose field of view is drawn; 63 degrees where not given.
    `capture`: frames that were localized. Dots show where their depth and colours agree with the
        map: at a wrong place many differ.
    `width`: of the picture [px]; 1600 with several passes or few frames, else 1200 where not given.
    """
    drawing = Drawing(scene, estimate, truth, title, camera, capture)
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

    Raises `OptionError`: the estimate has no history, or the width is no width of a picture.
    """
    if not any(record.steps for record in estimate.history):
        raise OptionError(
            "The estimate has no history to animate; localize with FilterOptions(record=True)."
        )
    drawing = Drawing(scene, estimate, truth, title, camera)
    pictures = drawing.moves(width)
    # one palette for all, so that what stands still costs nothing
    few = [pictures[k] for k in spread_evenly(len(pictures), 4)]
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
        *place_names(plan, frame, OccupiedPlaces(), small=True),
    ]
    sheet.paste(paint_picture(items, frame, reduce=False), (0, 0))
    draw_measures(sheet, frame)
    count = len(plan.rows)
    rooms = len({room for row in plan.rows if (room := scene.attributes[row].get("room"))})
    within = f" in {rooms} room{'s' * (rooms != 1)}" if rooms else ""
    things = f"{count:,} object{'s' * (count != 1)}{within}, {len(plan.triangles):,} triangles"
    sheet.text((14, sheet.height - FOOT / 2), f"{scene.scenes[0]}: {things}", 12, "soft-ink")
    return sheet.save(path)


def _swatch(width: int, height: int) -> NDArray[np.uint8]:
    """Return a picture (height, width, 3) of the marks' colours, for the palette."""
    ramp = colour_levels(np.linspace(0.0, 1.0, width))[:, :3]
    named = [PALETTE[name][0] for name in (*POSE_COLOR.values(), TRUTH, "for", "against", "ink")]
    inks = np.array([ImageColor.getrgb(color) for color in named], np.uint8)
    blocks = inks[np.arange(width) * len(inks) // width]
    half = np.tile(ramp, (height - height // 2, 1, 1)), np.tile(blocks, (height // 2, 1, 1))
    return np.concatenate(half).astype(np.uint8)
