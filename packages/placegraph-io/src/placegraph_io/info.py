"""Facts about a bag: topics, the topics that a capture is made of, what each use lacks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from placegraph.errors import InputError
from placegraph.io.capture.frame import Capture
from placegraph_io.ros.capture import capture_from
from placegraph_io.ros.containers import Topic, open_bag
from placegraph_io.ros.poses import OF_OTHERS
from placegraph_io.ros.topics import Plan, plan_of, read_topic_choice

USES = ("localize", "refine", "build", "track")


def bag_facts(path: Path, topics: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the plain numbers and strings about a bag; errors as of `open_bag` and `read_topic_choice`.

    `topics`: one entry each, with what it is `used` for; `chosen`: by role; `transforms`: parent,
    child, and whether they never change; `uses`: by use, a list of sentences that say what it lacks.
    """
    plan = plan_of(open_bag(path), read_topic_choice(path, topics))
    capture: Capture | None = None
    if not plan.lacks:
        try:
            capture = capture_from(plan)
        except InputError as error:
            plan.lacks["poses"] = str(error)
    held = [t for t in plan.bag.topics.values() if len(t)]
    first = min(int(t.times[0]) for t in held)
    last = max(int(t.times[-1]) for t in held)
    used = _used(plan)
    tree = plan.pose_reader.tree if plan.pose_reader else None
    return {
        "bag": str(path),
        "duration_s": round((last - first) * 1e-9, 3),
        "messages": sum(len(t) for t in held),
        "topics": [_topic(plan, topic, used) for topic in plan.bag.topics.values()],
        "transforms": [
            {"parent": parent, "child": child, "fixed": edge.fixed}
            for (parent, child), edge in (tree.edges.items() if tree else ())
        ],
        "chosen": {role: name for name, roles in used.items() for role in roles},
        "poses_in": plan.pose_reader.frame if plan.pose_reader else "",
        "frames": len(capture) if capture else 0,
        "left_out": dict(capture.left_out) if capture else {},
        "uses": {use: _lacks(plan, use) for use in USES},
        "notes": list(capture.notes if capture else plan.notes),
    }


def _used(plan: Plan) -> dict[str, list[str]]:
    """Return what topics are used for, by their names."""
    out: dict[str, list[str]] = {}

    def put(role: str, topic: Topic | None) -> None:
        if topic is not None:
            out.setdefault(topic.name, []).append(role)

    put("colour", plan.colour.topic if plan.colour else None)
    put("camera", plan.camera_topic)
    put("depth", plan.depth.topic if plan.depth else None)
    put("depth_camera", plan.depth_camera_topic)
    if plan.pose_reader:
        put("odometry", plan.pose_reader.odometry)
        put("imu", plan.pose_reader.imu)
        for topic in plan.pose_reader.moves:
            put("static_transforms" if topic.name.endswith("tf_static") else "transforms", topic)
    return out


def _topic(plan: Plan, topic: Topic, used: dict[str, list[str]]) -> dict[str, Any]:
    view = next((v for v in plan.views if v.topic is topic), None)
    seconds = float(topic.times[-1] - topic.times[0]) * 1e-9 if len(topic) else 0.0
    told: dict[str, Any] = {
        "topic": topic.name,
        "type": topic.short,
        "messages": len(topic),
        "rate_hz": round((len(topic) - 1) / seconds, 2) if seconds > 0 else None,
        "used": used.get(topic.name, []),
    }
    if view is not None:
        told |= {"encoding": view.encoding, "size": list(view.size), "frame": view.frame}
        told |= {"problem": view.problem} if view.problem else {}
    return told


def _lacks(plan: Plan, use: str) -> list[str]:
    """Return the sentences on what a use lacks; none: it can be done."""
    lacks = list(plan.lacks.values())
    path, pose_reader = plan.bag.path, plan.pose_reader
    if use == "build" and plan.colour is not None and plan.depth is None:
        lacks.append(
            f"{path} holds no depth, of which a map is fused; record the depth camera's image topic, "
            "16UC1 or 32FC1, with its CameraInfo."
        )
    if use == "track" and pose_reader is not None and pose_reader.frame in OF_OTHERS:
        lacks.append(
            f"{path}: poses are those of {pose_reader.frame}, which tracking itself should tell; record the "
            "transform odom -> base_link, or nav_msgs/Odometry."
        )
    return lacks
