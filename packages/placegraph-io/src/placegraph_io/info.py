"""Facts about a bag: its topics, their roles in a capture, and what each use lacks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from placegraph.errors import InputError
from placegraph.io.capture.frame import Capture
from placegraph_io.ros.capture import capture_of_plan
from placegraph_io.ros.containers import Topic, open_bag
from placegraph_io.ros.poses import MAP_FRAMES, is_static
from placegraph_io.ros.topics import CapturePlan, plan_capture, read_topic_choice

USES = ("localize", "refine", "build", "track")


def describe_bag(path: Path, topics: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Describe a bag in plain numbers and strings.

    `topics`: an entry for each, with its roles as `used`; `chosen`: topics by role; `transforms`: parent,
    child, and whether they are fixed; `uses`: by use, sentences about what it lacks. Raises the errors of
    `open_bag` and `read_topic_choice`.
    """
    plan = plan_capture(open_bag(path), read_topic_choice(path, topics))
    capture: Capture | None = None
    if not plan.missing:
        try:
            capture = capture_of_plan(plan)
        except InputError as error:
            plan.missing["poses"] = str(error)
    recorded = [t for t in plan.bag.topics.values() if len(t)]
    first = min(int(t.times[0]) for t in recorded)
    last = max(int(t.times[-1]) for t in recorded)
    used = _find_roles(plan)
    tree = plan.pose_reader.tree if plan.pose_reader else None
    return {
        "bag": str(path),
        "duration_s": round((last - first) * 1e-9, 3),
        "messages": sum(len(t) for t in recorded),
        "topics": [_describe_topic(plan, topic, used) for topic in plan.bag.topics.values()],
        "transforms": [
            {"parent": parent, "child": child, "fixed": edge.fixed}
            for (parent, child), edge in (tree.edges.items() if tree else ())
        ],
        "chosen": {role: name for name, roles in used.items() for role in roles},
        "poses_in": plan.pose_reader.frame if plan.pose_reader else "",
        "frames": len(capture) if capture else 0,
        "left_out": dict(capture.left_out) if capture else {},
        "uses": {use: _find_lacks(plan, use) for use in USES},
        "notes": list(capture.notes if capture else plan.notes),
    }


def _find_roles(plan: CapturePlan) -> dict[str, list[str]]:
    """Return the roles of the topics by name."""
    roles: list[tuple[str, Topic | None]] = [
        ("colour", plan.colour.topic if plan.colour else None),
        ("camera", plan.camera_reader.topic if plan.camera_reader else None),
        ("depth", plan.depth.topic if plan.depth else None),
        ("depth_camera", plan.depth_camera_reader.topic if plan.depth_camera_reader else None),
    ]  # fmt: skip
    if plan.pose_reader:
        roles += [("odometry", plan.pose_reader.odometry), ("imu", plan.pose_reader.imu)]
        roles += [
            ("static_transforms" if is_static(topic.name) else "transforms", topic)
            for topic in plan.pose_reader.transform_topics
        ]
    out: dict[str, list[str]] = {}
    for role, topic in roles:
        if topic is not None:
            out.setdefault(topic.name, []).append(role)
    return out


def _describe_topic(plan: CapturePlan, topic: Topic, used: dict[str, list[str]]) -> dict[str, Any]:
    view = next((v for v in plan.views if v.topic is topic), None)
    seconds = float(topic.times[-1] - topic.times[0]) * 1e-9 if len(topic) else 0.0
    entry: dict[str, Any] = {
        "topic": topic.name,
        "type": topic.short,
        "messages": len(topic),
        "rate_hz": round((len(topic) - 1) / seconds, 2) if seconds > 0 else None,
        "used": used.get(topic.name, []),
    }
    if view is not None:
        entry |= {"encoding": view.encoding, "size": list(view.size), "frame": view.frame}
        entry |= {"problem": view.problem} if view.problem else {}
    return entry


def _find_lacks(plan: CapturePlan, use: str) -> list[str]:
    """Return sentences about what a use lacks; empty where it is possible."""
    lacks = list(plan.missing.values())
    path, pose_reader = plan.bag.path, plan.pose_reader
    if use == "build" and plan.colour is not None and plan.depth is None:
        lacks.append(
            f"{path} contains no depth, which a map needs; record the depth camera's image topic, "
            "16UC1 or 32FC1, with its CameraInfo."
        )
    if use == "track" and pose_reader is not None and pose_reader.frame in MAP_FRAMES:
        lacks.append(
            f"{path}: poses are in {pose_reader.frame}, the result of a localization; record odometry: the "
            "transform odom -> base_link, or nav_msgs/Odometry."
        )
    return lacks
