"""Parameters of the node: their names, what they are if nobody sets them, and what they mean."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from placegraph.errors import OptionError
from placegraph.formats.ros.wishes import wishes_of
from placegraph.ros.options import LiveOptions, mode_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from placegraph.formats.ros.wishes import Wishes

TOPICS = ("colour", "depth", "camera", "depth_camera", "odometry", "imu", "frame")
PARAMETERS: dict[str, Any] = {
    "map": "",
    "mode": "continuous",
    "map_frame": "map",
    "base_frame": "",
    "transform_tolerance": 0.1,
    "publish_tf": True,
    "topics": "",
    **dict.fromkeys(TOPICS, ""),
    "seed": 0,
    "device": "auto",
}
"""`config/localizer.yaml` of the package says what each means."""


def options_of(given: Mapping[str, Any]) -> LiveOptions:
    """How the localizer works by the parameters; `OptionError` where one is out of its range."""
    tolerance = given["transform_tolerance"]
    if type(tolerance) not in {int, float}:
        raise OptionError(f"transform_tolerance is {tolerance!r}; it is seconds, such as 0.1.")
    return LiveOptions(
        mode=mode_of(given["mode"]),
        map_frame=given["map_frame"].lstrip("/"),
        base_frame=given["base_frame"].lstrip("/"),
        tolerance=tolerance,
        whole=False,
        seed=given["seed"],
    )


def beside(given: Mapping[str, Any], name: str) -> Path:
    """What the stream is called: the file `topics` without its ending, or a name."""
    return Path(given["topics"].removesuffix(".json") or name)


def wishes_of_parameters(given: Mapping[str, Any], name: str) -> Wishes:
    """What is said of topics, by the parameters and by the file `topics` (NAME.json if not given).

    The file is as one beside a bag; empty parameters say nothing. Raises `InputError` of its content.
    """
    said = {role: given[role] for role in TOPICS if given[role]}
    return wishes_of(beside(given, name), said)
