"""A pose estimate as a display list: particles, modes with what they see, the way that was gone."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.estimate import PoseEstimate, PoseMode, Status
from placegraph.core.geometry import Camera, Floats
from placegraph.view.city.estimate_items import SIGMAS
from placegraph.view.draw.canvas import Bounds, Disc, Item, Mark, Stroke, Swarm, Text
from placegraph.view.scene.plan_layout import evenly

if TYPE_CHECKING:
    from placegraph.view.scene.room_plan import RoomPlan

POSE_COLOR = {Status.OK: "mode", Status.AMBIGUOUS: "amber", Status.LOST: "soft-ink"}
"""Colours of modes and ways."""
TRUTH = "transit"
"""Colour of the true way, where it is known."""
REACH = 3.5
"""Length of the wedge that shows what a mode sees [m]."""
ANYWHERE, CERTAIN = 3e-4, 0.3
"""Probabilities around a particle that are painted as unlikely and as certain."""
CELL, SECTOR = 0.4, np.pi / 6
"""What lies around a particle: this far [m], turned by this much [rad]."""
VERDICTS = ("for", "against")
"""Verdicts that are drawn; each is also the name of its colour."""
OPENING = 1.1
"""Horizontal field of view where the camera is not known [rad]."""
MOST_FRAMES = 5000
"""Of a longer way some are left out."""


def levels(poses: Floats, weights: Floats) -> Floats:
    """How likely (N,), 0 to 1, it is to be around each particle.

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


def swarm(poses: Floats, weights: Floats) -> Swarm:
    """Particles (N, 4) with weights (N,) as marks, the smaller the more there are."""
    poses, weights = np.asarray(poses, np.float64), np.asarray(weights, np.float64)
    radius = float(np.interp(len(poses), [200, 1000, 5000], [2.0, 1.5, 0.7]))
    tick = 4.0 if len(poses) < 2500 else 0.0
    return Swarm(poses[:, :2], poses[:, 3], levels(poses, weights), radius, tick)


def core(poses: Floats, weights: Floats) -> Bounds:
    """Rectangle that holds 96 % of the weight along either axis: low x, low y, high x, high y."""
    weights = weights if weights.sum() > 0.0 else np.ones(len(poses))
    box = []
    for axis in (0, 1):
        order = np.argsort(poses[:, axis], kind="stable")
        share = np.cumsum(weights[order]) / weights.sum()
        ends = poses[order[np.searchsorted(share, (0.02, 0.98)).clip(0, len(order) - 1)], axis]
        box.append(ends.tolist())
    return box[0][0], box[1][0], box[0][1], box[1][1]


def opening_of(camera: Camera | None) -> float:
    """Horizontal field of view [rad]."""
    if camera is None:
        return OPENING
    return float(
        np.arctan(camera.cx / camera.fx) + np.arctan((camera.width - camera.cx) / camera.fx)
    )


def wedge(plan: RoomPlan, pose: Floats, opening: float, reach: float = REACH) -> Floats:
    """Closed ring (A + 2, 2) [m] of what a camera at a pose (4,) sees on the plan."""
    at = np.asarray(pose[:2], np.float64)
    angles = pose[3] + np.linspace(-opening / 2, opening / 2, 65)
    far = plan.sight(at, angles, reach)
    rim = at + far[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return np.concatenate([at[None], rim, at[None]])


def ellipse(mode: PoseMode) -> Floats:
    """Closed ring (49, 2) [m] around a mode: `SIGMAS` standard deviations in the plane."""
    turn = np.linspace(0.0, 2.0 * np.pi, 49)
    variances, axes = np.linalg.eigh(np.asarray(mode.covariance[:2, :2], np.float64))
    radii = SIGMAS * np.sqrt(np.maximum(variances, 0.0))
    ring: Floats = mode.pose[:2] + (np.stack([np.cos(turn), np.sin(turn)], axis=1) * radii) @ axes.T
    return ring


def way(
    map_from_camera: Floats, color: str, *, width: float = 2.0, looks: float = 0.0
) -> list[Mark]:
    """A way (T, 4, 4) through the map: a line with a dot, and where it looks `looks` [m], a frame."""
    shown = map_from_camera[evenly(len(map_from_camera), MOST_FRAMES)]
    at = shown[:, :2, 3]
    marks: list[Mark] = [Stroke(at, color, width)] if len(at) > 1 else []
    for matrix in shown:
        forward = matrix[:2, 2] / max(float(np.hypot(*matrix[:2, 2])), 1e-6)
        if looks:
            ends = np.stack([matrix[:2, 3], matrix[:2, 3] + looks * forward])
            marks.append(Stroke(ends, color, 0.6 * width))
        marks.append(Disc(matrix[:2, 3], 1.1 * width, color))
    return marks


def ring(map_from_camera: Floats, color: str, radius: float) -> list[Mark]:
    """A ring of a radius [m] around a camera (4, 4), with a line where it looks."""
    turn = np.linspace(0.0, 2.0 * np.pi, 33)
    at, forward = map_from_camera[:2, 3], map_from_camera[:2, 2]
    forward = forward / max(float(np.hypot(*forward)), 1e-6)
    circle = at + radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    look = np.stack([at + radius * forward, at + 2.0 * radius * forward])
    halo_first = (("paper", 4.0), (color, 2.0))
    return [Stroke(line, name, width) for name, width in halo_first for line in (look, circle)]


def sight(plan: RoomPlan, estimate: PoseEstimate, number: int, opening: float) -> Mark:
    """What a mode of an estimate (0 is the best) sees."""
    color, pose = POSE_COLOR[estimate.status], estimate.modes[number].pose
    best = number == 0
    return Stroke(
        wedge(plan, pose, opening), color, 1.2 if best else 0.8, fill=0.2 if best else 0.1
    )


def mode_marks(estimate: PoseEstimate, number: int, *, numbered: bool) -> list[Mark]:
    """A mode of an estimate (0 is the best): its ellipse, or that with number and probability."""
    mode, color = estimate.modes[number], POSE_COLOR[estimate.status]
    marks: list[Mark] = [Stroke(ellipse(mode), color, 1.6, (5.0, 3.0))]
    if not numbered:
        return [*marks, Disc(mode.pose[:2], 6.0, color)]
    percent = f"{mode.probability:.0%}"
    label = Text(mode.pose[:2], percent, 13.0, color, anchor="l", shift=(15.0, -1.0))
    return [*marks, Disc(mode.pose[:2], 10.0, color, text=str(number + 1)), label]


def witnesses(plan: RoomPlan, mode: PoseMode, most: int = 8) -> list[tuple[int, str]]:
    """Rows of the objects that spoke for or against a mode, and their verdicts, weightiest first.

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


def witness_marks(plan: RoomPlan, mode: PoseMode) -> list[Item]:
    """Lines from a mode to the objects that spoke for it (whole) or against it (dashed)."""
    marks: list[Item] = []
    for row, verdict in reversed(witnesses(plan, mode)):
        ends = np.stack([mode.pose[:2], plan.middle(row)])
        marks.append(Stroke(ends, verdict, 1.4, (5.0, 4.0) if verdict == "against" else None))
        marks.append(Disc(ends[1], 3.5, verdict))
    return marks


def in_words(estimate: PoseEstimate) -> str:
    """The best mode in numbers; empty where there is none."""
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


def error_in_words(estimate: PoseEstimate, truth: Floats) -> str:
    """How far the last frame's pose is from the truth; empty where there is no pose."""
    if estimate.best is None or not len(truth):
        return ""
    off = np.linalg.inv(truth[-1]) @ estimate.best.map_from_camera
    turn = np.arccos(np.clip((np.trace(off[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
    return f"{100 * np.linalg.norm(off[:3, 3]):.0f} cm and {np.degrees(turn):.1f}° off the truth"
