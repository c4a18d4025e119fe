"""Which frames the indoor benchmark asks about, and where they truly were.

Only evaluation reads `trajectory.tum`. A window's capture is a plain slice of the folder's, with
nothing of the truth in it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, rotation_from_vector
from placegraph.errors import InputError, OptionError
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture, open_capture, replace_poses
from placegraph.io.capture.frame import Images
from placegraph.io.capture.tum import read_tum
from placegraph_lab.worlds.flat.walks import add_drift

LENGTHS = (5, 10, 25)
EVERY = 5  # frames from the start of a window of the house to the next
HARD = 13  # one more start: from this frame of seq01 the paper's recipe always failed
HALVES = {"b in a": ((0, 186), (186, 373)), "a in b": ((186, 373), (0, 186))}
"""Frames of the office that make the map, and those that are asked about."""
OFFICE_EVERY = 9
OFFICE_STRIDE = 2
OFFICE_LENGTH = 10
COVERED = (
    0.6  # A window of the office counts as covered if the map holds this share of its last frame
)
TILT = np.radians(0.2)
"""Noise of gravity where a recording has none of its own, as the office's is [rad]."""
TOLERANCE = 0.10
"""A reading is covered where the map's surface is this near to it along the optical axis [m]."""


@dataclass(frozen=True)
class Odometry:
    """Source of the odometry and gravity of windows whose truth is known.

    Both are the truth with these errors. The papers use the truth itself (`EXACT`), but for Table 14.
    """

    drift: float = 0.01
    """Error of a step along each axis, as a share of its length."""
    yaw_drift: float = float(np.radians(0.1))
    """Error of a step in yaw [rad]."""
    tilt: float = float(TILT)
    """Error of gravity along each axis [rad]."""
    trajectories: Path | None = None
    """File in TUM's format, or a folder with NAME.tum of each recording: a SLAM system's poses, used
    instead of the truth with errors. Gravity is the true one."""

    @classmethod
    def of_name(cls, text: str) -> Odometry:
        """Return the source of a name: ``exact``, ``drift``, or a path (`trajectories`)."""
        known = {"exact": EXACT, "drift": DRIFTING}
        if text in known:
            return known[text]
        if not Path(text).exists():
            raise InputError(
                f"odometry: {text!r} does not exist; give exact, drift, a trajectory in TUM's format, "
                "or a folder with NAME.tum of each recording."
            )
        return replace(EXACT, trajectories=Path(text))

    def digest(self) -> str:
        """Return hexadecimal digits of the contents of all trajectories; empty without any."""
        if self.trajectories is None:
            return ""
        files = sorted(self.trajectories.glob("*.tum")) or [self.trajectories]
        texts = [file.read_bytes() for file in files if file.is_file()]
        return hashlib.sha256(b"\0".join(texts)).hexdigest()[:12]

    def apply(
        self, name: str, capture: Capture, truth: Floats, rng: Generator
    ) -> tuple[Capture, Floats]:
        """Return a recording with this odometry and gravity, and its truth (T, 4, 4).

        `name`: of the recording. Frames without a pose in its trajectory are left out.
        """
        if self.trajectories is not None:
            folder = self.trajectories
            known = replace_poses(capture, folder / f"{name}.tum" if folder.is_dir() else folder)
            used = {frame.index for frame in known}
            truth = truth[[frame.index in used for frame in capture]]
            capture, odometry = known, known.odometry
        else:
            odometry = add_drift(truth, rng, drift=self.drift, yaw_drift=self.yaw_drift)
        down = -truth[:, 2, :3]  # the third row of map_from_camera: the map's z in the camera
        if self.tilt:
            down = capture.gravity + self.tilt * rng.standard_normal(capture.gravity.shape)
        down = down / np.linalg.norm(down, axis=1, keepdims=True)
        frames = tuple(
            replace(frame, odometry=pose, gravity=its)
            for frame, pose, its in zip(capture, odometry, down, strict=True)
        )
        return replace(capture, frames=frames), truth


EXACT = Odometry(0.0, 0.0, 0.0)
"""Quasi ground truth, as in Tables 1 to 13 of SG2Loc."""
DRIFTING = Odometry()
"""Drift of a good SLAM system, which the tables have by default."""


@dataclass(frozen=True, eq=False)
class Window:
    """Consecutive frames of a capture, and the truth of the last."""

    place: str  # sequence or half: `seq01`
    capture: Capture
    truth: Floats  # (4, 4) map_from_camera of the last frame
    changed: bool | None = None
    coverage: float | None = None

    @property
    def name(self) -> str:
        rows = [frame.index for frame in self.capture]
        step = f":{rows[1] - rows[0]}" if len(rows) > 1 and rows[1] - rows[0] > 1 else ""
        return f"{self.place} {rows[0]}:{rows[-1] + 1}{step}"

    @property
    def fields(self) -> dict[str, Any]:
        """Fields of an `Answer` that describe the window."""
        found = {k: getattr(self, k) for k in ("place", "changed", "coverage")}
        return found | {"window": self.name, "frames": len(self.capture)}


def starts(count: int, length: int, every: int = EVERY, more: Sequence[int] = ()) -> list[int]:
    last = count - length
    return sorted({s for s in (*range(0, last + 1, every), *more) if 0 <= s <= last})


def house_windows(
    folder: Path, length: int, *, every: int = EVERY, sequences: Sequence[str] = ()
) -> list[Window]:
    """Windows of all sequences of the house, or of those named."""
    found = []
    for path in sorted(folder.glob("seq[0-9]*")):
        if sequences and path.name not in sequences:
            continue
        capture, truth = open_capture(path), true_poses(path)
        changed = is_changed(path / "changes.json")
        for start in starts(len(capture), length, every, (HARD,)):
            rows = slice(start, start + length)
            found.append(
                Window(path.name, capture[rows], truth[start + length - 1], changed=changed)
            )
    return found


def office_windows(
    path: Path,
    half: str,
    *,
    length: int = OFFICE_LENGTH,
    stride: int = OFFICE_STRIDE,
    every: int = OFFICE_EVERY,
) -> list[Window]:
    """Windows of the half of the office that the map was not made of; see `HALVES`."""
    capture, truth = open_capture(path), true_poses(path)
    low, high = HALVES[half][1]
    span = (length - 1) * stride + 1
    return [
        Window(half, capture[low + s : low + s + span : stride], truth[low + s + span - 1])
        for s in starts(min(high, len(capture)) - low, span, every)
    ]


def true_poses(path: Path) -> Floats:
    """True map_from_camera (T, 4, 4) of every frame of a capture's folder."""
    return read_tum(path / "trajectory.tum").poses


def measure_coverage(scene: SceneMap, window: Window, step: int = 3) -> Window:
    """The same window with its coverage: what share of its last frame the map holds.

    Of the valid depth readings, on every `step`-th line and column, those count where the ray from
    the true pose meets the map within `TOLERANCE` of the reading.
    """
    frame = window.capture[-1]
    depth, camera = frame.depth(), frame.depth_camera
    if depth is None or camera is None:
        return window
    v, u = np.mgrid[step // 2 : depth.shape[0] : step, step // 2 : depth.shape[1] : step]
    read = np.isfinite(depth[v, u])
    if not read.any():
        return replace(window, coverage=0.0)
    rays = camera.directions(np.stack([u[read], v[read]], axis=-1) + 0.5)
    directions = rays @ window.truth[:3, :3].T
    origins = np.broadcast_to(window.truth[:3, 3], directions.shape)
    hits = scene.caster.cast(origins, directions)  # the rays' z is 1: distance is depth
    off = np.abs(hits.distance - depth[v, u][read])
    return replace(window, coverage=float(((hits.triangle >= 0) & (off <= TOLERANCE)).mean()))


def sample_frames(capture: Capture, every: int) -> Capture:
    """Frames of a capture whose number is a multiple of `every`: left-out frames shift nothing."""
    if every < 1:
        raise OptionError(f"every is {every}; it is 1 or more.")
    return replace(capture, frames=tuple(f for f in capture if f.index % every == 0))


def drifting_windows(
    place: str,
    capture: Capture,
    truth: Floats,
    length: int,
    rng: np.random.Generator,
    *,
    changed: bool | None = None,
    odometry: Odometry = Odometry(),  # frozen
    recording: str = "",
) -> list[Window]:
    """Windows of `length` frames that do not overlap, of a recording whose truth is known.

    `truth`: (T, 4, 4) map_from_camera, of which `odometry` makes odometry and gravity; `recording`:
    name of its trajectory, `place` if not given. Raises `OptionError` where `length` is less than 1.
    """
    if length < 1:
        raise OptionError(f"length is {length}; it is 1 or more.")
    if odometry.trajectories is not None:  # whose frames may be fewer
        capture, truth = odometry.apply(recording or place, capture, truth, rng)
    found = []
    for s in starts(len(capture), length, length):
        part, poses = capture[s : s + length], truth[s : s + length]
        if odometry.trajectories is None:
            part, poses = odometry.apply(place, part, poses, rng)
        found.append(Window(place, part, poses[-1], changed))
    return found


def is_changed(path: Path) -> bool | None:
    """Read `changed` of a `changes.json`; None where there is none, `InputError` where it is broken."""
    if not path.exists():
        return None
    try:
        return bool(json.loads(path.read_text(encoding="utf-8"))["changed"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f'{path} must be a JSON object with "changed".') from error


SHIFT = 0.2  # length of the step from the true position [m]
TURN = 10.0  # angle between the true rotation and the start's [deg]
RISE = 0.3  # most that the step climbs or falls, as a share of its horizontal way
LEAN = 10.0  # most that the axis of the turn is away from the vertical [deg]


def disturb_pose(
    truth: Floats, rng: Generator, metres: float = SHIFT, degrees: float = TURN
) -> Floats:
    """A pose (4, 4) that is exactly so far off, and turned by exactly so much.

    The direction of the step is even in azimuth and climbs or falls by up to `RISE`; the axis of
    the turn lies within `LEAN` of the vertical, even in angle, and either way round is as likely.
    So are the errors of a pose whose tilt is known from gravity.
    """
    azimuth, rise = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-RISE, RISE)
    step = np.array([np.cos(azimuth), np.sin(azimuth), rise])
    lean, towards = np.radians(rng.uniform(0.0, LEAN)), rng.uniform(0.0, 2.0 * np.pi)
    axis = np.array([np.sin(lean) * np.cos(towards), np.sin(lean) * np.sin(towards), np.cos(lean)])
    turn = np.radians(degrees) * rng.choice([-1.0, 1.0]) * axis
    start = truth.copy()
    start[:3, 3] += metres * step / np.linalg.norm(step)
    start[:3, :3] = rotation_from_vector(turn) @ truth[:3, :3]
    return start


def without_depth(capture: Capture) -> Capture:
    frames = tuple(replace(f, depth_camera=None, images=_Flat(f.images)) for f in capture)
    return replace(capture, frames=frames, depth_camera=None)


@dataclass(frozen=True, slots=True, eq=False)
class _Flat:
    """Images of a frame without the depth."""

    images: Images

    def rgb(self) -> NDArray[np.uint8]:
        return self.images.rgb()

    def depth(self) -> None:
        return None

    def labels(self) -> NDArray[np.int32] | None:
        return self.images.labels()
