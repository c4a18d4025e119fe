"""Arguments and options that commands of scenes and libraries share, and poses given on the command line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from placegraph.cli.command import Argument, Option
from placegraph.cli.common import numbers_of
from placegraph.errors import InputError, OptionError

if TYPE_CHECKING:
    from placegraph.core.geometry import Floats
    from placegraph.indoor.encode import Encoder
    from placegraph.indoor.refine.matching import Matcher
    from placegraph.io.capture.capture import Capture
    from placegraph.io.capture.frame import Frame

KNOWN = "Prior knowledge"
USED = "Frame data"
REFINED = "How the pose is refined"
WRITTEN = "Output"

MapFile = Annotated[Path, Argument(help="Scene map (.scene), made by `placegraph scene build`.")]
CaptureFolder = Annotated[
    Path,
    Argument(
        help="Folder with rgb/, camera.json and odometry.tum (optionally depth/ and labels), or "
        "a recording of Record3D, Polycam, Stray Scanner, ScanNet, ROS, ..."
    ),
]
Frames = Annotated[
    str | None,
    Option(help="Frames as a Python slice (10:20, -5:, ::2) or a single index (7).", panel=USED),
]
Seed = Annotated[int, Option(help="The same seed gives the same answer.")]
Device = Annotated[str, Option(help="auto, cpu or cuda.")]
MatcherName = Annotated[
    str,
    Option(
        help="Matcher between images and renderings of the map, used where depth does not fix "
        "the pose: guided (nothing to install), sift, xfeat, roma, romav2 or auto (guided; "
        "with the paper's six views roma, or sift if roma is not installed).",
        panel=REFINED,
    ),
]
Weights = Annotated[
    Path | None,
    Option(
        help="File with the weights of --matcher xfeat or roma; downloaded if not given.",
        panel=REFINED,
    ),
]
PlanFile = Annotated[
    Path | None, Option(help="Write a plan with the pose and the camera's path.", panel=WRITTEN)
]
TumFile = Annotated[
    Path | None,
    Option(help="Write every frame's pose, map_from_camera, as TUM text.", panel=WRITTEN),
]
OverlayFile = Annotated[
    Path | None,
    Option(
        help="Write the last frame with the map's edges drawn over it, at the estimated pose and "
        "before the refinement.",
        panel=WRITTEN,
    ),
]
NoProgress = Annotated[bool, Option("--quiet", help="No progress.")]

_OWN = ("auto", "guided")  # without weights; the refiner makes them as each round wants them


def matcher_of(name: str, weights: Path | None, device: str) -> str | Matcher:
    """Return a matcher as `scene.localize` takes it.

    Raises as `placegraph.indoor.refine.matching.matcher`, `OptionError` for a name that there is not.
    """
    from placegraph.indoor.refine.matching import MATCHERS, matcher

    known = dict.fromkeys([*_OWN, *MATCHERS])
    if name not in known:
        raise OptionError(f"--matcher is {name!r}; choose one of {', '.join(known)}.")
    if name in _OWN:
        if weights is not None:
            raise OptionError(
                "--weights applies only to matchers with weights, such as --matcher xfeat, "
                f"but {name} has none; remove it."
            )
        return name
    return matcher(name, weights=weights, device="cuda" if device.startswith("cuda") else "cpu")


def chosen_frames(capture: Capture, frames: str | None) -> Capture:
    """Frames of a capture by a text such as 10:20, -5:, ::2 or 7; all where there is none.

    Raises `OptionError`: the text is no such thing, goes backwards, or selects nothing.
    """
    if frames is None:
        return capture
    chosen = capture[rows_of(frames)]
    if not len(chosen):
        raise OptionError(
            f"--frames {frames} selects none of the {len(capture)} frames of "
            f"{capture.path}; choose from 0 to {len(capture) - 1}."
        )
    return chosen


def rows_of(frames: str) -> slice:
    """Rows of a text such as 10:20, -5:, ::2 or 7; `OptionError` where it is no such thing."""
    parts = frames.split(":")
    try:
        numbers = [int(part) if part.strip() else None for part in parts]
    except ValueError:
        numbers = []
    first, last, step = [*numbers, None, None, None][:3]
    if not 1 <= len(numbers) <= 3 or (len(parts) == 1 and first is None):
        raise OptionError(f"--frames is {frames!r}; give frames as 10:20, -5:, ::2 or 7.")
    if step is not None and step < 1:
        raise OptionError(f"--frames is {frames!r}; time runs forward, so the step is 1 or more.")
    if len(parts) == 1 and first is not None:
        last = first + 1 or None  # -1 is the last frame, and -1:0 would be none
    return slice(first, last, step)


def map_from_camera_of(text: str, down: Floats | None = None) -> Floats:
    """Pose (4, 4) of a text X,Y,Z,YAW_DEG[,PITCH_DEG[,ROLL_DEG]].

    The yaw is that of `geometry.split_pose`, as `scene localize` prints it. `down`: gravity (3,) in
    the camera's axes, for a text without pitch and roll; upright if not given. Raises `OptionError`.
    """
    import numpy as np

    from placegraph.core.geometry import level_from_camera, pose_matrix

    mend = (
        "give x, y, z in metres and yaw, optionally also pitch and roll, in degrees, such "
        "as 1.5,2,1.6,90 or 1.5,2,1.6,90,-10,0."
    )
    numbers = numbers_of(text, "--pose", {4, 5, 6}, mend)
    x, y, z = numbers[:3]
    if down is not None and len(numbers) == 4:
        return pose_matrix([x, y, z, np.deg2rad(numbers[3])], level_from_camera(down))
    yaw, pitch, roll = np.deg2rad([*numbers[3:], 0.0, 0.0][:3])
    if abs(pitch) > np.pi / 2:
        raise OptionError(f"--pose is {text!r}; pitch_deg is from -90 to 90.")
    gravity = [np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch), -np.sin(pitch)]
    return pose_matrix([x, y, z, yaw], level_from_camera(gravity))


def pose_of_estimate(path: Path, mode: int = 1, frame: Frame | None = None) -> Floats:
    """Pose (4, 4) of one frame of an estimate's JSON, the last if not given, under a mode from 1.

    Raises `OptionError`: there is no such mode, or the estimate does not tell of the frame;
    `InputError`: the file is no such JSON, or holds no pose.
    """
    modes, frames, trajectory = read_estimate(path)
    if not 1 <= mode <= len(modes):
        raise OptionError(
            f"--mode is {mode}, but {path} has modes 1 to {len(modes)}; choose one of these."
        )
    if frame is None or (frame.index == frames[-1]):
        return modes[mode - 1]
    if mode != 1:
        raise OptionError(
            f"--mode {mode} is known only for the last frame, {frames[-1]}; remove --frame."
        )
    if frame.index not in frames:
        raise OptionError(
            f"--frame is {frame.index}, but {path} has poses of frames "
            f"{', '.join(map(str, frames))}; choose one of these."
        )
    pose: Floats = trajectory[frames.index(frame.index)]
    return pose


def read_estimate(path: Path) -> tuple[list[Floats], list[int], Floats]:
    """Poses of the modes, rows of the frames and their poses (T, 4, 4) of an estimate's JSON.

    Raises `InputError` where the file is no such JSON, or holds no pose.
    """
    import numpy as np

    from placegraph.io.capture.json_files import read_json

    content = read_json(path)
    try:
        modes = [_matrix(mode["map_from_camera"]) for mode in content["modes"]]
        frames = [int(row) for row in content["frames"]]
        trajectory = np.array([_matrix(pose) for pose in content["trajectory"]]).reshape(-1, 4, 4)
        reason, status = str(content["reason"]), str(content["status"])
    except (TypeError, KeyError, ValueError, OverflowError) as error:
        raise InputError(
            f"{path} is not output of `placegraph scene localize --json` "
            f"({type(error).__name__}: {error}); redirect that output to a file and name "
            "the file."
        ) from error
    if not modes or not frames or len(frames) != len(trajectory):
        raise InputError(f"{path} contains no pose; its status is {status}. {reason}")
    return modes, frames, trajectory


def _matrix(values: Any) -> Floats:  # noqa: ANN401  # whatever the file holds
    import numpy as np

    matrix = np.array(values, np.float64)
    if matrix.shape != (4, 4):
        raise ValueError(f"map_from_camera has shape {matrix.shape}")
    return matrix


WITH_WEIGHTS = ("features", "scenegraphloc")
"""Encoders that read a file of weights."""
WITH_CAPTURES = ("features", "scenegraphloc")
"""Encoders that know objects by images of the map."""

WeightsFile = Annotated[
    Path | None,
    Option(
        "--weights",
        help="File with the weights of the encoder: required for scenegraphloc (from `scene "
        "train`), downloaded for features if not given.",
    ),
]


def encoders_of(names: Sequence[str], weights: Path | None) -> list[Encoder]:
    """Encoders by name, the one that has weights with those of a file.

    Raises `OptionError`: there is none of a name, or weights belong to none of them or to several;
    `InputError`, `MapError`, `MissingExtraError` or `ServiceError`: as the encoders themselves.
    """
    from placegraph.indoor.encode import encoder, parse_encoder

    own = [name for name in names if parse_encoder(name)[0] in WITH_WEIGHTS]
    if weights is not None and len(own) != 1:
        raise OptionError(
            "--weights applies to exactly one encoder with weights "
            f"({', '.join(WITH_WEIGHTS)}), but the encoders are "
            f"{', '.join(names) or 'none'}; give that one with --encoder."
        )
    return [
        encoder(name, weights=weights) if weights is not None and name in own else encoder(name)
        for name in names
    ]
