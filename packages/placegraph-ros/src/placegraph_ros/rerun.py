"""Writer of messages as a recording of Rerun (.rrd)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import groupby
from os import PathLike
from pathlib import Path
from typing import Any, Self

import numpy as np

from placegraph.core.geometry import Floats, rotation_from_quaternion
from placegraph.errors import MissingExtraError, OptionError
from placegraph_ros.bag import UnfinishedFile, check_free, report_disk_errors
from placegraph_ros.message import Fields, Message
from placegraph_ros.scene_messages import CLEAR, CUBE, LINES, TEXT, TRIANGLES

_LEVELS = ("INFO", "WARN", "ERROR")
_GAP = 1.0  # Longest gap in the drawn path [s]
_CAMERA, _BASE = "map/base/camera", "map/base"


class RerunWriter:
    """Writer of a recording, a context manager; the file appears when the context ends without an error.

    Entities: ``map/map``, ``map/names`` and ``map/objects`` (markers), ``map/base`` and its
    ``camera`` (the pose, where it is known), ``map/path``, ``map/particle_cloud``, ``map/modes``,
    ``camera/image``, ``status`` and ``evidence``. Other types are ignored.

    `path`: a file NAME.rrd, which must not exist.

    Raises `OptionError`: `path` exists; `MapError`: nothing can be written there; `MissingExtraError`:
    `rerun-sdk` is not installed.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        try:
            import rerun
        except ImportError as error:
            raise MissingExtraError(
                'Rerun recordings need the extra `rerun`: pip install "placegraph[rerun]".'
            ) from error
        self.path = Path(path)
        check_free(self.path)
        self._rr: Any = rerun
        self._place: UnfinishedFile | None = None
        self._to: Any = None
        self._path: list[tuple[float, list[float]]] = []
        self._kinds: dict[str, Callable[[Message], None]] = {
            "geometry_msgs/msg/PoseWithCovarianceStamped": self._pose,
            "geometry_msgs/msg/PoseArray": self._modes,
            "nav2_msgs/msg/ParticleCloud": self._particles,
            "visualization_msgs/msg/MarkerArray": self._markers,
            "diagnostic_msgs/msg/DiagnosticArray": self._status,
            "sensor_msgs/msg/CompressedImage": self._image,
            "sensor_msgs/msg/CameraInfo": self._camera,
            "tf2_msgs/msg/TFMessage": self._transforms,
        }

    def __enter__(self) -> Self:
        self._place = UnfinishedFile(self.path)
        self._to = self._rr.RecordingStream("placegraph", send_properties=False)
        self._to.save(self._place.folder / "made", default_blueprint=_blueprint())
        self._to.log("map", self._rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        return self

    def __exit__(self, kind: object, *error: object) -> None:
        assert self._place is not None  # noqa: S101  entered
        try:
            with report_disk_errors(self.path):
                self._log("map/path", self._rr.LineStrips3D(_split_path(self._path)), static=True)
                self._to.flush()
                self._to.disconnect()
            if kind is None:
                self._place.finish(self._place.folder / "made")
        finally:
            self._place.drop()
            self._place = self._to = None

    def write(self, message: Message) -> None:
        """Write a message at its stamp, if its type is shown."""
        if self._to is None:
            raise OptionError(
                "The file is not open; write inside `with RerunWriter(path) as file`."
            )
        show = self._kinds.get(message.type)
        if show is not None:
            self._to.set_time("time", timestamp=message.stamp)
            show(message)

    def _log(self, entity: str, *what: Any, static: bool = False) -> None:  # noqa: ANN401
        self._to.log(entity, *what, static=static)

    def _pose(self, message: Message) -> None:
        told = message.fields["pose"]
        place, turn = _xyz(told["pose"]["position"]), [*told["pose"]["orientation"].values()]
        covariance = np.reshape(told["covariance"], (6, 6))[:3, :3]
        values, axes = np.linalg.eigh(covariance)
        axes[:, 0] *= np.linalg.det(axes)  # a rotation
        shown = self._rr.Transform3D(translation=place, quaternion=turn)
        self._log(_BASE, shown, self._rr.TransformAxes3D(axis_length=0.3))
        ball = self._rr.Ellipsoids3D(
            half_sizes=[2.0 * np.sqrt(np.maximum(values, 0.0))], colors=[(255, 176, 0, 90)]
        )
        self._log("map/deviation", self._rr.Transform3D(translation=place, mat3x3=axes), ball)
        self._path.append((message.stamp, place))

    def _modes(self, message: Message) -> None:
        poses = message.fields["poses"]
        turns = np.array([[*pose["orientation"].values()] for pose in poses]).reshape(-1, 4)
        origins = [_xyz(pose["position"]) for pose in poses]
        ahead = rotation_from_quaternion(turns)[:, :, 0]
        self._log("map/modes", self._rr.Arrows3D(vectors=0.4 * ahead, origins=origins))

    def _particles(self, message: Message) -> None:
        cloud = message.fields["particles"]
        weights = np.array([part["weight"] for part in cloud])
        shares = weights / max(float(weights.max(initial=0.0)), 1e-300)
        colours = np.column_stack([255 * shares, np.full(len(cloud), 90), 255 * (1 - shares)])
        places = np.array([_xyz(part["pose"]["position"]) for part in cloud]).reshape(-1, 3)
        shown = self._rr.Points3D(places, colors=colours.astype(np.uint8), radii=0.01)
        self._log("map/particle_cloud", shown)

    def _status(self, message: Message) -> None:
        (status,) = message.fields["status"]
        level = _LEVELS[status["level"]]
        if status["level"]:  # no certain pose
            self._log(_BASE, self._rr.Clear(recursive=True))
            self._log("map/deviation", self._rr.Clear(recursive=False))
        self._log("status", self._rr.TextLog(status["message"], level=level))
        lines = [f"- **{pair['key']}**: {pair['value']}" for pair in status["values"]]
        text = "\n".join([f"# {status['message']}", "", *lines])
        self._log("evidence", self._rr.TextDocument(text, media_type="text/markdown"))

    def _image(self, message: Message) -> None:
        data = np.asarray(message.fields["data"], np.uint8).tobytes()
        kind = f"image/{message.fields['format']}"
        self._log("camera/image", self._rr.EncodedImage(contents=data, media_type=kind))

    def _camera(self, message: Message) -> None:
        info = message.fields
        pinhole = self._rr.Pinhole(
            image_from_camera=np.reshape(info["k"], (3, 3)), width=info["width"],
            height=info["height"], image_plane_distance=0.3,
        )  # fmt: skip
        self._log(_CAMERA, pinhole)

    def _transforms(self, message: Message) -> None:
        """Show the camera's mount."""
        for link in message.fields["transforms"] if message.latched else ():
            moved = link["transform"]
            turn = [*moved["rotation"].values()]
            shown = self._rr.Transform3D(translation=_xyz(moved["translation"]), quaternion=turn)
            self._log(_CAMERA, shown, static=True)

    def _markers(self, message: Message) -> None:
        entity = f"map/{message.topic.rpartition('/')[2]}"
        markers = message.fields["markers"]
        if any(marker.get("action") == CLEAR for marker in markers):
            self._log(entity, self._rr.Clear(recursive=True))
        shown = [marker for marker in markers if "type" in marker]
        keys = sorted(shown, key=_group)
        for (kind, ns), group in groupby(keys, key=_group):
            for name, what in self._draw_markers(kind, ns, list(group)):
                self._log(f"{entity}/{name}", what, static=message.latched)

    def _draw_markers(self, kind: int, ns: str, markers: Sequence[Fields]) -> list[tuple[str, Any]]:
        """Return names and archetypes of markers of one type and namespace."""
        rr, colours = self._rr, [_rgba([marker["color"]])[0] for marker in markers]
        if kind == TRIANGLES:
            return [(f"{ns}/{m['id']}", self._mesh(m)) for m in markers]
        if kind == LINES:
            pairs = [np.reshape(_places(m["points"]), (-1, 2, 3)) for m in markers]
            return [(ns, rr.LineStrips3D([*np.concatenate(pairs)], colors=colours[0]))]
        places = [_xyz(marker["pose"]["position"]) for marker in markers]
        if kind == TEXT:
            words = [marker["text"] for marker in markers]
            return [(ns, rr.Points3D(places, labels=words, colors=colours, radii=0.01))]
        if kind == CUBE:
            sizes = [_xyz(marker["scale"]) for marker in markers]
            return [(ns, rr.Boxes3D(centers=places, sizes=sizes, colors=colours))]
        return []

    def _mesh(self, marker: Fields) -> Any:  # noqa: ANN401  # of rerun
        corners = _places(marker["points"])
        return self._rr.Mesh3D(
            vertex_positions=corners,
            triangle_indices=np.arange(len(corners), dtype=np.uint32).reshape(-1, 3),
            vertex_colors=_rgba(marker["colors"]),
        )


def _blueprint() -> Any:  # noqa: ANN401  # of rerun
    import rerun.blueprint as rrb

    return rrb.Horizontal(
        rrb.Spatial3DView(origin="map", name="map"),
        rrb.Vertical(
            rrb.Spatial2DView(origin="camera", name="camera"),
            rrb.TextDocumentView(origin="evidence", name="evidence"),
            rrb.TextLogView(origin="status", name="status"),
        ),
        column_shares=[2, 1],
    )


def _split_path(way: Sequence[tuple[float, list[float]]]) -> list[Floats]:
    """Split the path (N, 3) at its gaps."""
    if not way:
        return []
    stamps, places = np.array([stamp for stamp, _ in way]), np.array([place for _, place in way])
    return np.split(places, np.flatnonzero(np.diff(stamps) > _GAP) + 1)


def _group(marker: Fields) -> tuple[int, str]:
    return marker["type"], marker["ns"]


def _xyz(fields: Fields) -> list[float]:
    return [fields["x"], fields["y"], fields["z"]]


def _places(points: Sequence[Fields]) -> Floats:
    """Return (N, 3) of points."""
    return np.array([(point["x"], point["y"], point["z"]) for point in points])


def _rgba(colours: Sequence[Fields]) -> Any:  # noqa: ANN401  # of rerun
    """Return (N, 4) uint8 of colours."""
    found = np.array([(c["r"], c["g"], c["b"], c["a"]) for c in colours])
    return np.rint(255.0 * found).astype(np.uint8)
