"""Paths through a drawn flat that keep away from walls and furniture."""

from __future__ import annotations

import heapq
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from placegraph.core.geometry import (
    Camera,
    between,
    compose,
    level_from_camera,
    pose_matrix,
    split_pose,
    wrap_angle,
)
from placegraph.errors import OptionError
from placegraph.io.capture.tum import write_tum
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.interior import Interior
from placegraph_lab.worlds.flat.render import develop, simulate_depth

Floats64 = NDArray[np.float64]

STEP = 0.1  # side of the cells that a path is planned on [m]
BODY = 0.2  # least distance of a path from walls and furniture [m]
COMFORT = 0.55  # distance at which they no longer matter [m]


class FloorPlan:
    """Grid of places where a person may stand, and how far each is from walls and furniture."""

    def __init__(self, flat: Flat) -> None:
        self.flat = flat
        width, depth = flat.size
        shape = int(width / STEP), int(depth / STEP)
        blocked = np.ones(shape, bool)
        for i, j in np.ndindex(shape):
            row, column = flat.cell((i + 0.5) * STEP, (j + 0.5) * STEP)
            blocked[i, j] = flat.blocked[row, column]
        self.clear = _clearance(blocked)
        if not (self.clear >= BODY).any():
            raise OptionError(f"{flat.source}: nobody can stand anywhere in it; draw more floor.")

    def nearest(self, x: float, y: float) -> tuple[int, int]:
        """Cell nearest to x, y [m] where a person may stand."""
        cells = np.argwhere(self.clear >= BODY)
        distance = np.hypot(*((cells + 0.5) * STEP - (x, y)).T)
        i, j = cells[np.argmin(distance)].tolist()
        return i, j

    def way(self, stops: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
        """Cells from stop to stop."""
        path = [stops[0]]
        for goal in stops[1:]:
            path += self._leg(path[-1], goal)[1:]
        return path

    def any_way(self, length: float, rng: np.random.Generator) -> list[tuple[int, int]]:
        """Cells of a path of at least this length [m], as far as the floor allows."""
        cells = np.argwhere(self.clear >= min(COMFORT / 2, float(self.clear.max())))
        path = [(int(i), int(j)) for i, j in cells[rng.integers(len(cells))][None]]
        for _ in range(50):
            if len(path) * STEP > length + 1.0:
                break
            i, j = cells[rng.integers(len(cells))].tolist()
            try:
                path += self._leg(path[-1], (i, j))[1:]
            except OptionError:
                continue  # another part of the flat, behind a closed door
        return path

    def _leg(self, start: tuple[int, int], goal: tuple[int, int]) -> list[tuple[int, int]]:
        """Cheapest way on the grid (Dijkstra); it keeps away from walls where it can."""
        cost = 1.0 + 6.0 * np.maximum(0.0, 1.0 - self.clear / COMFORT) ** 2
        best = {start: 0.0}
        before: dict[tuple[int, int], tuple[int, int]] = {}
        queue = [(0.0, start)]
        while queue:
            spent, cell = heapq.heappop(queue)
            if cell == goal:
                break
            if spent > best[cell]:
                continue
            for di, dj in _NEIGHBOURS:
                there = (cell[0] + di, cell[1] + dj)
                if not (
                    0 <= there[0] < cost.shape[0]
                    and 0 <= there[1] < cost.shape[1]
                    and self.clear[there] >= BODY
                ):
                    continue
                total = spent + float(np.hypot(di, dj)) * float(cost[there])
                if total < best.get(there, np.inf):
                    best[there], before[there] = total, cell
                    heapq.heappush(queue, (total, there))
        if goal not in best:
            x, y = ((k + 0.5) * STEP for k in goal)
            raise OptionError(
                f"{self.flat.source}: no way leads to x = {x:.1f}, y = {y:.1f} m; "
                "open a door, or move what stands in the way."
            )
        path = [goal]
        while path[-1] != start:
            path.append(before[path[-1]])
        return path[::-1]

    def smooth(self, way: list[tuple[int, int]]) -> tuple[Floats64, Floats64]:
        """Line (N, 2) and its lengths (N,) [m]: as smooth as walls and furniture allow."""
        raw = (np.array(way) + 0.5) * STEP
        raw = np.repeat(raw, 2, axis=0)[: 2 * len(raw) - 1]
        raw[1::2] = (raw[0:-1:2] + raw[2::2]) / 2
        line = raw
        for sigma in (8.0, 5.0, 3.0, 1.5):  # of half cells
            line = _blurred(raw, sigma)
            i, j = (line / STEP).astype(int).T
            if (self.clear[i, j] >= BODY).all():
                break
        arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
        return line, arc


_NEIGHBOURS = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]


def _clearance(blocked: NDArray[np.bool_]) -> Floats64:
    """Distance [m] of every cell's middle from the nearest blocked one's, up to `COMFORT`."""
    reach = int(np.ceil(COMFORT / STEP))
    padded = np.pad(blocked, reach, constant_values=True)
    clear = np.full(blocked.shape, COMFORT)
    rows, columns = blocked.shape
    for i in range(2 * reach + 1):
        for j in range(2 * reach + 1):
            there = padded[i : i + rows, j : j + columns]
            distance = STEP * float(np.hypot(i - reach, j - reach))
            clear = np.where(there, np.minimum(clear, distance), clear)
    return clear


def _blurred(line: Floats64, sigma: float) -> Floats64:
    """Points (N, 2) averaged with their neighbours along the line; the ends stay."""
    reach = int(3 * sigma)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    weights /= weights.sum()
    # reflecting the line in its ends keeps them where they are
    start, end = 2 * line[0] - line[1 : reach + 1][::-1], 2 * line[-1] - line[-reach - 1 : -1][::-1]
    padded = np.concatenate([start, line, end]) if len(line) > reach else line
    if padded is line:
        return line
    return np.stack([np.convolve(padded[:, k], weights, "valid") for k in (0, 1)], axis=-1)


Floats = NDArray[np.float64]

TURN = 1.3  # how fast a person turns [rad/s]
CAMERA = Camera(320, 180, 230.0, 230.0, 160.0, 90.0)  # 70 degrees wide


@dataclass(frozen=True, eq=False)
class Walk:
    """Trajectory of a camera.

    `stamps`: (T,) [s]; `map_from_camera`: (T, 4, 4).
    """

    stamps: Floats
    map_from_camera: Floats

    def __len__(self) -> int:
        return len(self.stamps)


# ---------------------------------------------------------------------------------------- paths


def stroll(
    flat: Flat,
    rng: np.random.Generator,
    *,
    frames: int = 25,
    through: str = "",
    height: float = 1.6,
    speed: float = 0.8,
    rate: float = 5.0,
    tilt: float = 0.05,
) -> Walk:
    """Walk through a flat with a camera in the hand.

    `flat`: the flat; `rng`: draws the way where `through` does not say it, and how the camera
    wavers; `frames`: number of images; `through`: glyphs of rooms or spots to pass, in order, such
    as ``"312"``; empty: any way; `height`: of the camera above the floor [m]; `speed`, `rate`: most
    metres a second, and images a second; `tilt`: deviation of pitch and roll [rad].

    Raises `OptionError`: A number is out of its range, `through` names no place, or no way leads
    there.
    """
    if not (frames >= 1 and 0.3 <= height < flat.height and speed > 0 and rate > 0 and tilt >= 0):
        raise OptionError(
            f"frames={frames}, height={height}, speed={speed}, rate={rate}, tilt={tilt}: frames, "
            f"speed and rate must be greater than 0, height from 0.3 to {flat.height:g}."
        )
    floor = FloorPlan(flat)
    length = (frames - 1) * speed / rate
    if through:
        ways = [flat.position(glyph) for glyph in through]
        way = floor.way([floor.nearest(*place) for place in ways])
    else:
        way = floor.any_way(length, rng)
    line, arc = floor.smooth(way)
    stride = min(speed / rate, arc[-1] / max(1, frames - 1))
    return _hold(line, arc, stride * np.arange(frames), height, rate, tilt, rng)


def _hold(
    line: Floats,
    arc: Floats,
    at: Floats,
    height: float,
    rate: float,
    tilt: float,
    rng: np.random.Generator,
) -> Walk:
    """Carry a camera along a line (N, 2) with lengths (N,) to the places `at` (T,) [m]."""
    x, y = (np.interp(at, arc, line[:, k]) for k in (0, 1))
    ahead, behind = np.minimum(at + 0.4, arc[-1]), np.maximum(at - 0.4, 0.0)
    heading = np.arctan2(
        np.interp(ahead, arc, line[:, 1]) - np.interp(behind, arc, line[:, 1]),
        np.interp(ahead, arc, line[:, 0]) - np.interp(behind, arc, line[:, 0]),
    )
    for i in range(1, len(heading)):  # who turns back needs a while
        turn = float(wrap_angle(heading[i] - heading[i - 1]))
        heading[i] = heading[i - 1] + np.clip(turn, -TURN / rate, TURN / rate)
    stamps = np.arange(len(at)) / rate

    def sway(period: float) -> Floats:
        return np.sin(2 * np.pi * (stamps / period + rng.random()))

    yaw = heading + 0.45 * sway(7.0) + 0.1 * sway(2.3)
    down = 0.12 + tilt * (sway(4.1) + 0.4 * sway(1.3))
    roll = 0.4 * tilt * (sway(3.7) + sway(1.1))
    felt = np.stack([np.sin(roll), np.cos(roll) * np.cos(down), np.cos(roll) * np.sin(down)], -1)
    poses = np.stack([x, y, height + 0.02 * sway(0.9), yaw], axis=-1)
    return Walk(stamps, pose_matrix(poses, level_from_camera(felt)))


# ------------------------------------------------------------------------------------- captures


def add_drift(
    map_from_camera: Floats,
    rng: np.random.Generator,
    *,
    drift: float = 0.01,
    yaw_drift: float = 0.1 * np.pi / 180.0,
) -> Floats:
    """Odometry (T, 4, 4) of a camera, in a frame of its own that begins with it.

    Every step has errors of `drift` of its length along each axis, and of `yaw_drift` [rad], which
    accumulate; the tilt is known from gravity.
    """
    poses, level = split_pose(map_from_camera)
    steps = between(poses[:-1], poses[1:])
    lengths = np.linalg.norm(steps[:, :3], axis=1, keepdims=True)
    steps[:, :3] += drift * lengths * rng.standard_normal((len(steps), 3))
    steps[:, 3] += yaw_drift * rng.standard_normal(len(steps))
    found = [np.zeros(4)]
    for step in steps:
        found.append(compose(found[-1], step))
    return pose_matrix(np.array(found), level)


def write_walk(
    interior: Interior,
    walk: Walk,
    folder: str | Path,
    rng: np.random.Generator,
    *,
    camera: Camera = CAMERA,
    daylight: float = 0.5,
    labels: Literal["instances", "labels"] | None = "instances",
    depth: bool = True,
) -> Path:
    """Render a walk into a capture folder; depth and labels have half the camera's size.

    `interior`: the flat as it is now: `Interior.without` and `Interior.move_object` change it; `walk`:
    poses of the camera; `folder`: where to write; made if it is missing, and an older walk's images
    there go; `rng`: draws the light, the noise and the drift; `camera`: of the colour images;
    `daylight`: from 0, evening with lamps on, to 1, day with lamps off; `labels`: write the ids of
    objects, the numbers of their labels with `labels.json`, or neither; `depth`: write depth.
    """
    from placegraph_lab.worlds.flat.render import Stage

    folder = Path(folder)
    _clear(folder)
    for kind, wanted in (("rgb", True), ("depth", depth), (str(labels), labels)):
        if wanted:
            (folder / kind).mkdir(parents=True, exist_ok=True)
    half = camera.resize(camera.width // 2, camera.height // 2)
    light, sensor, motion = rng.spawn(3)
    stage = Stage(interior, light, daylight=daylight)
    numbers = _numbers(interior, labels)
    factors = exposures(len(walk), sensor)
    for i, (pose, exposure) in enumerate(zip(walk.map_from_camera, factors, strict=True)):
        picture = develop(stage.radiance(camera, pose), float(exposure), sensor)
        Image.fromarray(picture).save(folder / f"rgb/{i:06d}.jpg", quality=92)
        geometry = stage.geometry(half, pose)
        if depth:
            Image.fromarray(simulate_depth(geometry, sensor)).save(folder / f"depth/{i:06d}.png")
        if labels:
            ids = np.append(numbers, 0)[geometry.ids]  # -1 is the last
            Image.fromarray(ids.astype(np.uint16)).save(folder / f"{labels}/{i:06d}.png")
    content = camera.to_dict() | {"depth": half.to_dict() | {"scale": 1000}}
    if labels:
        content |= {labels: half.to_dict()}
    if labels == "instances":
        content |= {"instances_offset": 1}
    (folder / "camera.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
    write_tum(folder / "odometry.tum", walk.stamps, add_drift(walk.map_from_camera, motion))
    write_tum(folder / "trajectory.tum", walk.stamps, walk.map_from_camera)
    felt = gravity(walk.map_from_camera, motion)
    rows = zip(walk.stamps.tolist(), felt.tolist(), strict=True)
    lines = (f"{stamp:.4f} {x:.6f} {y:.6f} {z:.6f}" for stamp, (x, y, z) in rows)
    (folder / "gravity.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    if labels == "labels":
        names = sorted({thing.label for thing in interior.objects})
        text = json.dumps({str(k + 1): name for k, name in enumerate(names)}, indent=1)
        (folder / "labels.json").write_text(text, encoding="utf-8")
    return folder


def _clear(folder: Path) -> None:
    """Remove what an earlier, longer or otherwise labelled walk left in the folder."""
    for kind in ("rgb", "depth", "instances", "labels"):
        for image in (folder / kind).glob("[0-9]" * 6 + ".*"):
            image.unlink()
        if (folder / kind).is_dir() and not any((folder / kind).iterdir()):
            (folder / kind).rmdir()
    (folder / "labels.json").unlink(missing_ok=True)


def _numbers(interior: Interior, labels: str | None) -> NDArray[np.int64]:
    """Pixel value of every id; 0 is nothing."""
    names = sorted({thing.label for thing in interior.objects})
    numbers = np.zeros(max(thing.id for thing in interior.objects) + 1, np.int64)
    for thing in interior.objects:
        numbers[thing.id] = names.index(thing.label) + 1 if labels == "labels" else thing.id + 1
    return numbers


def exposures(n: int, rng: np.random.Generator) -> Floats:
    """Factors (n,) about 1 that wander slowly: automatic exposure at work."""
    steps = rng.standard_normal(n) * 0.4
    level = np.empty(n)
    level[0] = rng.standard_normal()
    for i in range(1, n):
        level[i] = 0.92 * level[i - 1] + steps[i]
    found: Floats = np.exp(0.25 * level)
    return found


def gravity(map_from_camera: Floats, rng: np.random.Generator) -> Floats:
    """Unit directions of gravity (T, 3) in the camera's axes, as a sensor feels them: to 0.1 deg."""
    down = -map_from_camera[:, 2, :3]
    down = down + 0.1 * np.pi / 180.0 * rng.standard_normal(down.shape)
    felt: Floats = down / np.linalg.norm(down, axis=1, keepdims=True)
    return felt
