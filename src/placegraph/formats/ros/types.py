"""Types of messages: those that `rosbags` ships, and the few beside them that are read or written.

Of packages that ROS does not bring, the definitions are what nav2_msgs and foxglove_msgs say; a bag
carries them along, so that who reads it needs neither package.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

TRANSFORMS = "tf2_msgs/msg/TFMessage"
_SOLID = "geometry_msgs/Pose pose\ngeometry_msgs/Vector3 size\n{}foxglove_msgs/Color color"
_POINTS = (
    "geometry_msgs/Point[] points\nfoxglove_msgs/Color color\nfoxglove_msgs/Color[] colors\n"
    "uint32[] indices"
)
_DEFINITIONS = {
    "nav2_msgs/msg/Particle": "geometry_msgs/Pose pose\nfloat64 weight",
    "nav2_msgs/msg/ParticleCloud": "std_msgs/Header header\nnav2_msgs/Particle[] particles",
    "foxglove_msgs/msg/Color": "float64 r\nfloat64 g\nfloat64 b\nfloat64 a",
    "foxglove_msgs/msg/KeyValuePair": "string key\nstring value",
    "foxglove_msgs/msg/ArrowPrimitive": (
        "geometry_msgs/Pose pose\nfloat64 shaft_length\nfloat64 shaft_diameter\n"
        "float64 head_length\nfloat64 head_diameter\nfoxglove_msgs/Color color"
    ),
    "foxglove_msgs/msg/CubePrimitive": _SOLID.format(""),
    "foxglove_msgs/msg/SpherePrimitive": _SOLID.format(""),
    "foxglove_msgs/msg/CylinderPrimitive": _SOLID.format(
        "float64 bottom_scale\nfloat64 top_scale\n"
    ),
    "foxglove_msgs/msg/LinePrimitive": (
        "uint8 LINE_STRIP=0\nuint8 LINE_LOOP=1\nuint8 LINE_LIST=2\nuint8 type\n"
        f"geometry_msgs/Pose pose\nfloat64 thickness\nbool scale_invariant\n{_POINTS}"
    ),
    "foxglove_msgs/msg/TriangleListPrimitive": f"geometry_msgs/Pose pose\n{_POINTS}",
    "foxglove_msgs/msg/TextPrimitive": (
        "geometry_msgs/Pose pose\nbool billboard\nfloat64 font_size\nbool scale_invariant\n"
        "foxglove_msgs/Color color\nstring text"
    ),
    "foxglove_msgs/msg/ModelPrimitive": (
        "geometry_msgs/Pose pose\ngeometry_msgs/Vector3 scale\nfoxglove_msgs/Color color\n"
        "bool override_color\nstring url\nstring media_type\nuint8[] data"
    ),
    "foxglove_msgs/msg/SceneEntityDeletion": (
        "builtin_interfaces/Time timestamp\nuint8 MATCHING_ID=0\nuint8 ALL=1\nuint8 type\nstring id"
    ),
    "foxglove_msgs/msg/SceneEntity": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nstring id\n"
        "builtin_interfaces/Duration lifetime\nbool frame_locked\n"
        "foxglove_msgs/KeyValuePair[] metadata\nfoxglove_msgs/ArrowPrimitive[] arrows\n"
        "foxglove_msgs/CubePrimitive[] cubes\nfoxglove_msgs/SpherePrimitive[] spheres\n"
        "foxglove_msgs/CylinderPrimitive[] cylinders\nfoxglove_msgs/LinePrimitive[] lines\n"
        "foxglove_msgs/TriangleListPrimitive[] triangles\nfoxglove_msgs/TextPrimitive[] texts\n"
        "foxglove_msgs/ModelPrimitive[] models"
    ),
    "foxglove_msgs/msg/SceneUpdate": (
        "foxglove_msgs/SceneEntityDeletion[] deletions\nfoxglove_msgs/SceneEntity[] entities"
    ),
}


@lru_cache(maxsize=2)
def typestore(encoding: str) -> Typestore:
    """Types of ROS 2, or of ROS 1 where the encoding is `ros1`."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    lacking = dict(_DEFINITIONS)
    if encoding == "ros1":
        lacking[TRANSFORMS] = "geometry_msgs/TransformStamped[] transforms"
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    for name, text in lacking.items():
        store.register(get_types_from_msg(text, name))
    return store
