"""What a capture is made of: topics, cameras, transforms, and what is lacking for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from placegraph.errors import InputError
from placegraph.formats.ros.poses import Placing
from placegraph.formats.ros.register import Registration
from placegraph.formats.ros.views import View, camera_for, chosen_views, views_of

if TYPE_CHECKING:
    from placegraph.formats.ros.files.bag import Bag
    from placegraph.formats.ros.files.storage import Topic
    from placegraph.formats.ros.wishes import Wishes
    from placegraph.geometry import Camera


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
