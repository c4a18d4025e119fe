"""What `placegraph scene localize` and `scene refine` are asked: frames, matchers, options."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from placegraph.cli.command import Argument, Option
from placegraph.errors import OptionError

if TYPE_CHECKING:
    from placegraph.indoor.refine.matching import Matcher
    from placegraph.io.capture.capture import Capture

KNOWN = "What is known"
USED = "What is used of the frames"
REFINED = "How the pose is refined"
WRITTEN = "What is written"

MapFile = Annotated[Path, Argument(help="Scene map (.scene), made by `placegraph scene build`.")]
CaptureFolder = Annotated[
    Path,
    Argument(
        help="Folder with rgb/, camera.json, odometry.tum (depth/ and labels help), or what another "
        "recorder wrote: Record3D, Polycam, Stray Scanner, ScanNet, a bag of ROS, ..."
    ),
]
Frames = Annotated[
    str | None,
    Option(help="Which frames, as in Python: 10:20, -5:, ::2; 7 is frame 7 alone.", panel=USED),
]
Seed = Annotated[int, Option(help="The same seed gives the same answer.")]
Device = Annotated[str, Option(help="auto, cpu or cuda.")]
UseDepth = Annotated[bool, Option("--depth/--no-depth", help="Use depth images.", panel=USED)]
UseColour = Annotated[
    bool, Option("--colour/--no-colour", help="Use colours where the map has some.", panel=USED)
]
MatcherName = Annotated[
    str,
    Option(
        help="What matches images with renderings of the map where depth does not fix the pose: "
        "guided (nothing to install), sift, xfeat, roma, romav2, or auto: guided, but for the paper's "
        "six views roma, or sift where that is not at hand.",
        panel=REFINED,
    ),
]
Weights = Annotated[
    Path | None,
    Option(
        help="File with the weights of --matcher xfeat or roma; else from its own hub.",
        panel=REFINED,
    ),
]
PlanFile = Annotated[
    Path | None, Option(help="Write a plan with the pose and the way to it.", panel=WRITTEN)
]
TumFile = Annotated[
    Path | None,
    Option(help="Write every frame's pose, map_from_camera, as TUM text.", panel=WRITTEN),
]
OverlayFile = Annotated[
    Path | None,
    Option(
        help="Write a picture of the last frame with the map's edges on it, at the pose answered "
        "and before the refinement: whether it is right, at a glance.",
        panel=WRITTEN,
    ),
]
NoProgress = Annotated[bool, Option("--quiet", help="No progress.")]

_OWN = ("auto", "guided")  # without weights; the refiner makes them as each round wants them


def matcher_of(name: str, weights: Path | None, device: str) -> str | Matcher:
    """What `scene.localize` takes as `matcher`.

    Raises as `placegraph.indoor.refine.matching.matcher`, `OptionError` for a name that there is not.
    """
    from placegraph.indoor.refine.matching import MATCHERS, matcher

    known = dict.fromkeys([*_OWN, *MATCHERS])
    if name not in known:
        raise OptionError(f"--matcher is {name!r}; there are {', '.join(known)}.")
    if name in _OWN:
        if weights is not None:
            raise OptionError(
                f"--weights belongs to a matcher that has some, such as --matcher xfeat; {name} has "
                "none."
            )
        return name
    return matcher(name, weights=weights, device="cuda" if device.startswith("cuda") else "cpu")


def chosen_frames(capture: Capture, frames: str | None) -> Capture:
    """Frames of a capture by a text such as 10:20, -5:, ::2 or 7; all where there is none.

    Raises
    ------
    OptionError
        The text is no such thing, goes backwards, or selects nothing.

    """
    if frames is None:
        return capture
    chosen = capture[rows_of(frames)]
    if not len(chosen):
        raise OptionError(
            f"--frames {frames} selects none of the {len(capture)} frames of {capture.path}; "
            f"they are 0 to {len(capture) - 1}."
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
