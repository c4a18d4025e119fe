"""What a capture is made of, by the bag and by what the user says of it (or `BAG.json` beside it)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from placegraph.core.geometry import Camera
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.camera import read_json
from placegraph_io.ros.files.bag import Bag
from placegraph_io.ros.files.storage import Topic
from placegraph_io.ros.poses import Placing
from placegraph_io.ros.register import Registration
from placegraph_io.ros.transforms import Samples
from placegraph_io.ros.views import View, camera_for, chosen_views, views_of

_NAMES = ("colour", "depth", "odometry", "imu", "frame")
_CAMERAS = ("camera", "depth_camera")
_KEYS = (*_NAMES, *_CAMERAS, "depth_scale", "transforms")


@dataclass(frozen=True, slots=True)
class Wishes:
    """Topics and frames by their role; None: found by type."""

    colour: str | None = None
    depth: str | None = None
    odometry: str | None = None
    imu: str | None = None
    frame: str | None = None
    """In which poses are told."""
    camera: str | dict[str, Any] | None = None
    """A CameraInfo's topic, or intrinsics."""
    depth_camera: str | dict[str, Any] | None = None
    depth_scale: float | None = None
    """Units of depth in a metre."""
    transforms: Samples = field(default_factory=dict)
    """That the bag lacks; they never change."""
    with_depth: bool = True
    with_imu: bool = True


def wishes_of(path: Path, given: Mapping[str, Any] | None) -> Wishes:
    """What `BAG.json` says, and over it what is given.

    Raises `InputError` of the file's content, `OptionError` of what is given.
    """
    file = Path(f"{path}.json")
    content = read_json(file) if file.is_file() else {}
    if not isinstance(content, dict):
        raise InputError(f"{file} must be a JSON object with {', '.join(_KEYS)}.")
    _check(content, f"{file}: ", InputError)
    _check(given or {}, "topics: ", OptionError)
    said = {**content, **(given or {})}
    out: dict[str, Any] = {k: said[k] for k in (*_NAMES, *_CAMERAS, "depth_scale") if k in said}
    out["transforms"] = {
        (row["parent"], row["child"]): [np.array([[0.0, *row["xyz"], *row["xyzw"]]])]
        for row in said.get("transforms") or ()
    }
    for role in ("depth", "imu"):
        out[f"with_{role}"] = not (role in said and said[role] is None)
    return Wishes(**out)


def _check(said: Mapping[str, Any], name: str, error: type[InputError | OptionError]) -> None:
    for key, value in said.items():
        good = {
            **dict.fromkeys(_NAMES, value is None or isinstance(value, str)),
            **dict.fromkeys(_CAMERAS, isinstance(value, str | dict)),
            "depth_scale": isinstance(value, int | float) and 0 < value < float("inf"),
            "transforms": isinstance(value, list) and all(_is_transform(row) for row in value),
        }
        if key not in good:
            raise error(f"{name}{key!r} is not known; there are {', '.join(_KEYS)}.")
        if not good[key]:
            raise error(f"{name}{key} is {str(value)[:60]!r}; {_WANTED.get(key, 'it is a name')}.")


_WANTED = {
    "camera": "it is a topic or an object with fx, fy, cx, cy",
    "depth_camera": "it is a topic or an object with fx, fy, cx, cy",
    "depth_scale": "it is how many units of depth make a metre, such as 1000",
    "transforms": 'it is a list of {"parent", "child", "xyz": [x, y, z], "xyzw": [x, y, z, w]}',
}


def _is_transform(row: Any) -> bool:  # noqa: ANN401  # whatever the file holds
    if not (isinstance(row, dict) and set(row) == {"parent", "child", "xyz", "xyzw"}):
        return False
    numbers = [row["xyz"], row["xyzw"]]
    return (
        isinstance(row["parent"], str)
        and isinstance(row["child"], str)
        and all(isinstance(n, list) for n in numbers)
        and [len(n) for n in numbers] == [3, 4]
        and all(isinstance(v, int | float) and abs(v) < 1e300 for n in numbers for v in n)
    )


@dataclass(eq=False)
class Plan:
    """What was found in a bag for a capture. Nothing is raised: what is lacking is told."""

    bag: Bag
    wishes: Wishes
    views: list[View] = field(default_factory=list)
    colour: View | None = None
    camera: Camera | None = None
    camera_topic: Topic | None = None
    depth: View | None = None
    depth_camera: Camera | None = None
    """Of the depth as a capture has it."""
    depth_camera_topic: Topic | None = None
    registration: Registration | None = None
    """Where depth was measured by another camera."""
    placing: Placing | None = None
    lacks: dict[str, str] = field(default_factory=dict)
    """By role (colour, camera, poses, depth) the sentence of the error."""
    notes: list[str] = field(default_factory=list)

    def tried(self, role: str, step: Callable[[], None]) -> None:
        """Do a step, and keep what it lacks."""
        try:
            step()
        except InputError as error:
            self.lacks.setdefault(role, str(error))


def plan_of(bag: Bag, wishes: Wishes) -> Plan:
    """Choose what a capture is made of, and read what is needed to place its frames."""
    plan = Plan(bag, wishes, views_of(bag), notes=list(bag.notes))
    plan.tried("colour", lambda: _choose(plan))
    if plan.colour is None:
        return plan
    plan.tried("camera", lambda: _camera(plan))
    plan.placing = Placing(bag, wishes, plan.colour, plan.depth)
    plan.tried("poses", plan.placing.read)
    plan.notes += plan.placing.notes
    plan.tried("depth", lambda: _depth(plan))
    return plan


def _choose(plan: Plan) -> None:
    wishes = plan.wishes
    plan.colour, plan.depth = chosen_views(
        plan.bag, plan.views, wishes.colour, wishes.depth, with_depth=wishes.with_depth
    )
    plan.notes.append(f"Colour is {plan.colour.said}.")
    if plan.depth is not None:
        plan.notes.append(f"Depth is {plan.depth.said}.")


def _camera(plan: Plan) -> None:
    assert plan.colour is not None  # noqa: S101  # chosen before
    found = camera_for(plan.bag, plan.colour, plan.wishes.camera, "camera")
    plan.camera, plan.camera_topic = found


def _depth(plan: Plan) -> None:
    colour, depth, wishes = plan.colour, plan.depth, plan.wishes
    if depth is None or colour is None or plan.placing is None:
        return
    same = depth.frame == colour.frame
    try:
        found = camera_for(plan.bag, depth, wishes.depth_camera, "depth_camera")
        camera, plan.depth_camera_topic = found
    except InputError:
        if not (same and plan.camera is not None and depth.size == colour.size):
            raise
        camera = plan.camera
    plan.depth_camera = camera
    if same or plan.camera is None:
        return
    if plan.placing.tree.path(colour.frame, depth.frame) is None:
        raise InputError(
            f"{plan.bag.path}: no transform joins {colour.frame!r}, where colours are seen, and "
            f"{depth.frame!r}, where depth is measured; record /tf_static, or write it as "
            f'"transforms" in {plan.bag.path}.json, or do without depth: "depth": null.'
        )
    plan.registration = Registration(plan.camera, camera)
    plan.depth_camera = plan.registration.camera
    plan.notes.append(f"Depth is brought from {depth.frame} to {colour.frame} by the transforms.")
