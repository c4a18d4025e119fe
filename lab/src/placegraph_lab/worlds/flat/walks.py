"""Walks through a drawn flat: paths that avoid the furniture, and captures rendered along them.

`stroll` plans where a camera goes, `write_walk` renders what it sees into a capture folder as
`docs/formats.md` describes it: with noise, holes and drift, and with light of its own.
"""

from __future__ import annotations

import json
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
    wrap,
)
from placegraph.errors import OptionError
from placegraph.io.capture.tum import write_tum
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.interior import Interior
from placegraph_lab.worlds.flat.paths import FloorPlan
from placegraph_lab.worlds.flat.sensors import develop, measured

Floats = NDArray[np.float64]

TURN = 1.3
"""How fast a person turns [rad/s]."""
CAMERA = Camera(320, 180, 230.0, 230.0, 160.0, 90.0)
"""70 degrees wide."""


@dataclass(frozen=True, eq=False)
class Walk:
    """Where a camera was when.

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

    Parameters
    ----------
    flat
        The flat.
    rng
        Draws the way where `through` does not say it, and how the camera wavers.
    frames
        Number of images.
    through
        Glyphs of rooms or spots to pass, in order, such as ``"312"``; empty: any way.
    height
        Of the camera above the floor [m].
    speed, rate
        Most metres a second, and images a second.
    tilt
        Deviation of pitch and roll [rad].

    Raises
    ------
    OptionError
        A number is out of its range, `through` names no place, or no way leads there.

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
        turn = float(wrap(heading[i] - heading[i - 1]))
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


def drifted(
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

    Parameters
    ----------
    interior
        The flat as it is now: `Interior.without` and `Interior.moved` change it.
    walk
        Poses of the camera.
    folder
        Where to write; made if it is missing, and an older walk's images there go.
    rng
        Draws the light, the noise and the drift.
    camera
        Of the colour images.
    daylight
        From 0, evening with lamps on, to 1, day with lamps off.
    labels
        Write the ids of objects, the numbers of their labels with `labels.json`, or neither.
    depth
        Write depth.

    """
    from placegraph_lab.worlds.flat.render import Stage

    folder = Path(folder)
    _clear(folder)
    for kind, wanted in (("rgb", True), ("depth", depth), (str(labels), labels)):
        if wanted:
            (folder / kind).mkdir(parents=True, exist_ok=True)
    half = camera.resized(camera.width // 2, camera.height // 2)
    light, sensor, motion = rng.spawn(3)
    stage = Stage(interior, light, daylight=daylight)
    numbers = _numbers(interior, labels)
    factors = exposures(len(walk), sensor)
    for i, (pose, exposure) in enumerate(zip(walk.map_from_camera, factors, strict=True)):
        picture = develop(stage.radiance(camera, pose), float(exposure), sensor)
        Image.fromarray(picture).save(folder / f"rgb/{i:06d}.jpg", quality=92)
        shot = stage.shot(half, pose)
        if depth:
            Image.fromarray(measured(shot, sensor)).save(folder / f"depth/{i:06d}.png")
        if labels:
            ids = np.append(numbers, 0)[shot.ids]  # -1 is the last
            Image.fromarray(ids.astype(np.uint16)).save(folder / f"{labels}/{i:06d}.png")
    _write_texts(folder, walk, camera, half, labels, motion)
    if labels == "labels":
        names = sorted({thing.label for thing in interior.things})
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
    names = sorted({thing.label for thing in interior.things})
    numbers = np.zeros(max(thing.id for thing in interior.things) + 1, np.int64)
    for thing in interior.things:
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


def _write_texts(
    folder: Path,
    walk: Walk,
    camera: Camera,
    half: Camera,
    labels: str | None,
    rng: np.random.Generator,
) -> None:
    """Camera, odometry, gravity, and the truth, which is for evaluation alone."""
    content = camera.to_dict() | {"depth": half.to_dict() | {"scale": 1000}}
    if labels:
        content |= {labels: half.to_dict()}
    if labels == "instances":
        content |= {"instances_offset": 1}
    (folder / "camera.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
    write_tum(folder / "odometry.tum", walk.stamps, drifted(walk.map_from_camera, rng))
    write_tum(folder / "trajectory.tum", walk.stamps, walk.map_from_camera)
    felt = gravity(walk.map_from_camera, rng)
    rows = zip(walk.stamps.tolist(), felt.tolist(), strict=True)
    lines = (f"{stamp:.4f} {x:.6f} {y:.6f} {z:.6f}" for stamp, (x, y, z) in rows)
    (folder / "gravity.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
