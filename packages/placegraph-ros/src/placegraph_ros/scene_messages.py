"""A scene map, its objects that agreed or disagreed, and camera images as messages for viewers."""

from __future__ import annotations

import io

import numpy as np

from placegraph.core.estimate import Evidence, PoseEstimate
from placegraph.core.geometry import Camera, Floats
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.export import encode_scene, paint_vertices
from placegraph.io.capture.frame import Frame
from placegraph_ros.message import (
    Fields,
    FrameIds,
    Message,
    colour,
    header,
    points,
    scale,
    time,
    xyz,
)

MARKERS = "visualization_msgs/msg/MarkerArray"
CUBE, LINES, TEXT, TRIANGLES = 1, 5, 9, 11  # Types of markers
CLEAR = 3  # Action that deletes all markers
COLOURS = {"for": (0.1, 0.75, 0.2), "against": (0.9, 0.1, 0.1)}
_ALPHA = 0.35
_TALL, _THICK = 0.12, 0.01  # of letters and lines [m]


def objects_message(
    estimate: PoseEstimate, stamp: float, frames: FrameIds | None = None
) -> list[Message]:
    """`MarkerArray` of the boxes of objects for and against the best mode, with lines to the camera.

    Empty where the estimate has no map.
    """
    frames = frames or FrameIds()
    scene = estimate.map
    if not isinstance(scene, Scene):
        return []
    head = header(stamp, frames.map)
    markers: list[Fields] = [{"header": head, "action": CLEAR}]
    rows = {name: row for row, name in enumerate(scene.graph.ids)}
    for verdict, rgb in COLOURS.items():
        evidenced = [
            (rows[ref.id], evidence)
            for evidence in estimate.evidence
            for ref in evidence.objects
            if evidence.verdict == verdict and ref.id in rows
        ]
        for row, evidence in evidenced:
            markers += _box(scene, row, evidence, head)
        if evidenced and estimate.best is not None:
            places = scene.graph.positions[[row for row, _ in evidenced]]
            ends = np.stack(
                [np.broadcast_to(estimate.best.map_from_camera[:3, 3], places.shape), places],
                axis=1,
            )
            markers.append({
                "header": head, "ns": f"{verdict}/lines", "type": LINES,
                "pose": {"orientation": {"w": 1.0}}, "scale": {"x": _THICK}, "color": colour(rgb),
                "points": points(ends.reshape(-1, 3)),
            })  # fmt: skip
    return [Message("localization/objects", MARKERS, stamp, {"markers": markers})]


def _box(scene: Scene, row: int, evidence: Evidence, head: Fields) -> list[Fields]:
    """Return the box and the name of an object."""
    graph = scene.graph
    center, size = graph.positions[row], np.maximum(extent(scene, row), _THICK)
    rgb = COLOURS[evidence.verdict]
    words = f"{graph.names[row] or graph.labels[row]} {evidence.weight:+.1f}"
    return [
        {
            "header": head, "ns": evidence.verdict, "id": row, "type": CUBE, "scale": xyz(size),
            "pose": {"position": xyz(center), "orientation": {"w": 1.0}},
            "color": colour(rgb, _ALPHA),
        },
        label(words, row, place_above(scene, row), head, rgb, ns=f"{evidence.verdict}/names"),
    ]  # fmt: skip


def extent(scene: Scene, row: int) -> Floats:
    """Return the size (3,) of the box around an object [m]."""
    extents = scene.graph.extents
    return np.zeros(3) if extents is None else extents[row]


def place_above(scene: Scene, row: int) -> Floats:
    """Return the position (3,) of an object's name, above it [m]."""
    up = np.array([0.0, 0.0, 0.5 * extent(scene, row)[2] + _TALL])
    return np.asarray(scene.graph.positions[row] + up)


def label(
    words: str,
    row: int,
    place: Floats,
    head: Fields,
    rgb: tuple[float, float, float],
    *,
    ns: str,
) -> Fields:
    """Return a text marker at a position (3,)."""
    return {
        "header": head, "ns": ns, "id": row, "type": TEXT, "scale": scale(_TALL),
        "pose": {"position": xyz(place), "orientation": {"w": 1.0}},
        "color": colour(rgb), "text": words,
    }  # fmt: skip


MAX_TRIANGLES = 200_000  # in markers, 120 bytes each


def map_messages(scene: Scene, stamp: float, frames: FrameIds | None = None) -> list[Message]:
    """Return the map as markers (RViz), its names, and as a `SceneUpdate` (Foxglove).

    - ``localization/map``: a `MarkerArray`, a list of triangles an object with colours by vertex; of
      more than `MAX_TRIANGLES` triangles the objects' boxes.
    - ``localization/names``: a `MarkerArray` of what the objects are called.
    - ``localization/scene``: a `foxglove_msgs/SceneUpdate` with the map as GLB and its textures.

    Raises `OptionError` where the stamp [s] is out of ROS's range.
    """
    frames = frames or FrameIds()
    head = header(stamp, frames.map)
    shown = (_meshes if len(scene.mesh) <= MAX_TRIANGLES else _boxes)(scene, head)
    names = [_name(scene, row, head) for row in range(len(scene))]
    model = {
        "pose": {"orientation": {"w": 1.0}}, "scale": scale(1.0),
        "media_type": "model/gltf-binary", "data": np.frombuffer(encode_scene(scene), np.uint8),
    }  # fmt: skip
    entity = {
        "timestamp": time(stamp), "frame_id": frames.map, "id": "map", "frame_locked": True,
        "metadata": [{"key": "source", "value": scene.source}], "models": [model],
    }  # fmt: skip
    return [
        Message("localization/map", MARKERS, stamp, {"markers": shown}, latched=True),
        Message("localization/names", MARKERS, stamp, {"markers": names}, latched=True),
        Message(
            "localization/scene", "foxglove_msgs/msg/SceneUpdate", stamp, {"entities": [entity]},
            latched=True,
        ),
    ]  # fmt: skip


def _boxes(scene: Scene, head: Fields) -> list[Fields]:
    graph = scene.graph
    return [
        {
            "header": head, "ns": graph.labels[row], "id": row, "type": CUBE, "frame_locked": True,
            "pose": {"position": xyz(graph.positions[row]), "orientation": {"w": 1.0}},
            "scale": xyz(extent(scene, row)), "color": colour((0.6, 0.6, 0.6), 0.3),
        }
        for row in range(len(scene))
    ]  # fmt: skip


def _meshes(scene: Scene, head: Fields) -> list[Fields]:
    model = paint_vertices(scene)
    order = np.argsort(model.object_of, kind="stable")
    ends = np.cumsum(np.bincount(model.object_of, minlength=len(scene)))[:-1]
    found = []
    for row, triangles in enumerate(np.split(model.triangles[order], ends)):
        corners = triangles.ravel()
        shades = model.colours[corners] / 255.0
        found.append({
            "header": head, "ns": scene.graph.labels[row], "id": row, "type": TRIANGLES,
            "pose": {"orientation": {"w": 1.0}}, "scale": scale(1.0), "frame_locked": True,
            "color": colour((1.0, 1.0, 1.0)),
            "points": points(model.vertices[corners]),
            "colors": [colour((r, g, b)) for r, g, b in shades.tolist()],
        })  # fmt: skip
    return found


def _name(scene: Scene, row: int, head: Fields) -> Fields:
    graph = scene.graph
    words = graph.names[row] or graph.labels[row]
    return label(words, row, place_above(scene, row), head, (1.0, 1.0, 1.0), ns=graph.labels[row])


QUALITY = 80  # of JPEG
MODELS = {0: "plumb_bob", 4: "plumb_bob", 5: "plumb_bob", 8: "rational_polynomial"}
"""ROS's distortion models by number of coefficients."""


def image_messages(frame: Frame, stamp: float, frames: FrameIds | None = None) -> list[Message]:
    """`CompressedImage` (JPEG) of a frame's colours, and its `CameraInfo`.

    Raises `InputError` where the image is broken, `OptionError` where the stamp [s] is out of ROS's range.
    """
    from PIL import Image

    frames = frames or FrameIds()
    head, file = header(stamp, frames.camera), io.BytesIO()
    Image.fromarray(frame.rgb()).save(file, "JPEG", quality=QUALITY)
    data = np.frombuffer(file.getvalue(), np.uint8)
    image = {"header": head, "format": "jpeg", "data": data}
    info = {"header": head} | info_fields(frame.camera)
    return [
        Message("localization/image", "sensor_msgs/msg/CompressedImage", stamp, image),
        Message("localization/camera_info", "sensor_msgs/msg/CameraInfo", stamp, info),
    ]


def info_fields(camera: Camera) -> Fields:
    """`sensor_msgs/CameraInfo` without its header; ROS's pixel centres are whole numbers."""
    k = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1.0]])
    fisheye = camera.model == "fisheye"
    return {
        "width": camera.width, "height": camera.height,
        "distortion_model": "equidistant" if fisheye else MODELS[len(camera.distortion)],
        "d": np.array(camera.distortion or [0.0] * 5),
        "k": k, "r": np.eye(3), "p": np.insert(k, 3, 0.0, axis=1),
    }  # fmt: skip
