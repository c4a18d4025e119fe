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

Mode = Literal["continuous", "once"]

TOPICS = {
    "colour": "rgb/image",
    "depth": "depth/image",
    "camera": "rgb/camera_info",
    "depth_camera": "depth/camera_info",
    "odometry": "odom",
    "imu": "imu",
}
"""Topics of the node by role, to be remapped."""
PARAMETERS: dict[str, tuple[Any, str]] = {
    "map": ("", "Scene map, library, or folder of scenes; must be given."),
    "mode": ("continuous", "once: use images until the pose is known, and again on request."),
    "map_frame": ("map", "Frame of the map."),
    "base_frame": (
        "",
        "Frame of the base; base_link, base_footprint or odometry's child if empty.",
    ),
    "transform_tolerance": (1.0, "Time by which map -> odom is stamped ahead [s]."),
    "publish_tf": (True, "Whether map -> odom is published."),
    "topics": ("", "JSON file with intrinsics, transforms and names of topics, as beside a bag."),
    "discover": (False, "Choose among the topics of the namespace to which others listen."),
    "seed": (0, "Seed of all random numbers."),
    "device": ("auto", "cpu, cuda or auto."),
    "autostart_node": (False, "Configure and activate without a lifecycle manager."),
    "bond_heartbeat_period": (
        0.1,
        "Time between heartbeats to the lifecycle manager [s]; 0: none.",
    ),
}
"""Parameters of the node: defaults and descriptions."""
CHANGEABLE = ("mode", "transform_tolerance", "publish_tf")
"""Parameters that are used at once when set; the others are read-only."""
RANGES = {
    "transform_tolerance": (0.0, 60.0),
    "bond_heartbeat_period": (0.0, 10.0),
    "seed": (0, 2**31 - 1),
}
"""Smallest and largest values."""


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """Options of a `Localizer`."""

    mode: Mode = "continuous"  # `once`: use images until the pose is known, and again on request
    map_frame: str = "map"
    base_frame: str = ""  # Base frame; base_link, base_footprint or odometry's child if empty
    tolerance: float = 0.0  # Time by which the stamp of map -> odom is ahead, as a node needs [s]
    with_inputs: bool = (
        True  # Also write what a robot knows already: images, the camera's mount, odometry
    )
    background: bool = (
        True  # Use images in a thread and drop those that arrive too fast; else one by one
    )
    seed: int = 0

    def __post_init__(self) -> None:
        mode_of(self.mode)
        if not 0.0 <= self.tolerance < inf:
            raise OptionError(f"tolerance is {self.tolerance}; give seconds, at least 0.")

    @classmethod
    def from_parameters(cls, given: Mapping[str, Any]) -> Self:
        """Return the options of a node's parameters; `OptionError` for values out of range."""
        tolerance = given["transform_tolerance"]
        if type(tolerance) not in {int, float}:
            raise OptionError(f"transform_tolerance is {tolerance!r}; give seconds, such as 1.0.")
        frames = {name: given[name].lstrip("/") for name in ("map_frame", "base_frame")}
        mode, seed = mode_of(given["mode"]), given["seed"]
        return cls(mode=mode, tolerance=tolerance, with_inputs=False, seed=seed, **frames)


def mode_of(name: str) -> Mode:
    """Return a mode by its name; `OptionError` for unknown names."""
    modes: dict[str, Mode] = {"continuous": "continuous", "once": "once"}
    if name in modes:
        return modes[name]
    raise OptionError(f"mode is {name!r}; choose 'continuous' or 'once'.")


def stream_name(given: Mapping[str, Any], name: str) -> Path:
    """Return the name of a node's stream in messages: the file `topics` without its ending, or `name`."""
    return Path(given["topics"].removesuffix(".json") or name)


@dataclass(slots=True)
class Summary:
    """Counts of a stream's frames, what is missing, and notes."""

    frames: int = 0  # Usable images
    told: Counter[str] = field(default_factory=Counter)  # Used images by the status after each
    dropped: int = 0  # Images that arrived too fast
    left_out: Counter[str] = field(
        default_factory=Counter
    )  # Unusable images and messages by reason
    lacks: tuple[str, ...] = ()  # Sentences about what is missing for any frame
    notes: tuple[str, ...] = ()  # Sentences about choices and problems

    def to_dict(self) -> dict[str, Any]:
        """Return the plain numbers and strings."""
        total = sum(self.told.values())
        return {
            "frames": self.frames, "told": dict(self.told), "dropped": self.dropped,
            "share_ok": self.told[Status.OK.name] / total if total else None,
            "left_out": dict(self.left_out), "lacks": list(self.lacks), "notes": list(self.notes),
        }  # fmt: skip
