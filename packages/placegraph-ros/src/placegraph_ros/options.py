"""Options of a localizer, parameters of its node, and a summary of a stream's frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any, Literal, Self

from placegraph.core.estimate import Status
from placegraph.errors import OptionError
from placegraph_io.ros.topics import TopicChoice, read_topic_choice

Mode = Literal["continuous", "once"]

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
"""Parameters of the node and their defaults; `ament/config/localizer.yaml` explains each."""


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """Options of a `Localizer`."""

    mode: Mode = "continuous"
    """`once`: images are looked at until the pose is known, and again on request."""
    map_frame: str = "map"
    base_frame: str = ""
    """Of the robot; base_link, base_footprint or what odometry carries, if not given."""
    tolerance: float = 0.1
    """The transform map -> odom is stamped so far ahead [s], for lookups until then."""
    whole: bool = True
    """Also write what a robot knows already: images, where its camera sits, its odometry."""
    background: bool = True
    """Images are looked at while others come, and dropped where they come too fast; else one by one."""
    seed: int = 0

    def __post_init__(self) -> None:
        mode_of(self.mode)
        if not 0.0 <= self.tolerance < inf:
            raise OptionError(f"tolerance is {self.tolerance}; it is seconds, 0 or more.")

    @classmethod
    def from_parameters(cls, given: Mapping[str, Any]) -> Self:
        """Return the options of a node's parameters; raise `OptionError` for values out of range."""
        tolerance = given["transform_tolerance"]
        if type(tolerance) not in {int, float}:
            raise OptionError(f"transform_tolerance is {tolerance!r}; it is seconds, such as 0.1.")
        frames = {name: given[name].lstrip("/") for name in ("map_frame", "base_frame")}
        mode, seed = mode_of(given["mode"]), given["seed"]
        return cls(mode=mode, tolerance=tolerance, whole=False, seed=seed, **frames)


def mode_of(name: str) -> Mode:
    """Return a mode by its name; raise `OptionError` where there is none."""
    modes: dict[str, Mode] = {"continuous": "continuous", "once": "once"}
    if name in modes:
        return modes[name]
    raise OptionError(f"mode is {name!r}; it is 'continuous' or 'once'.")


def stream_name(given: Mapping[str, Any], name: str) -> Path:
    """Return what messages call a node's stream: the file `topics` without its ending, or `name`."""
    return Path(given["topics"].removesuffix(".json") or name)


def choice_of_parameters(given: Mapping[str, Any], name: str) -> TopicChoice:
    """Return the topics that a node's parameters and its file `topics` (NAME.json if not given) choose.

    The file is as one beside a bag; empty parameters say nothing. Raises `InputError` for its content.
    """
    chosen = {role: given[role] for role in TOPICS if given[role]}
    return read_topic_choice(stream_name(given, name), chosen)


@dataclass(slots=True)
class Summary:
    """What became of a stream's frames."""

    frames: int = 0
    """Images that could be looked at."""
    told: Counter[str] = field(default_factory=Counter)
    """Images that were looked at, by the status after each."""
    dropped: int = 0
    """Images that came too fast."""
    left_out: Counter[str] = field(default_factory=Counter)
    """Images and messages that could not be used, by reason."""
    lacks: tuple[str, ...] = ()
    """What is missing still for any frame, in sentences."""
    notes: tuple[str, ...] = ()
    """What was chosen, and found out, in sentences."""

    def to_dict(self) -> dict[str, Any]:
        """Return the plain numbers and strings."""
        looked = sum(self.told.values())
        return {
            "frames": self.frames, "told": dict(self.told), "dropped": self.dropped,
            "share_ok": self.told[Status.OK.name] / looked if looked else None,
            "left_out": dict(self.left_out), "lacks": list(self.lacks), "notes": list(self.notes),
        }  # fmt: skip
