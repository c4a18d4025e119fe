"""Databases of RTAB-Map (`.db`), of its telephone apps and of its ROS nodes.

SQLite: `Node` (id, map_id, stamp, pose), `Data` (image, depth, calibration, since 0.23
depth_confidence) and `Admin` (version, and the poses as they were optimized last). Poses are 3 x 4
float32 by rows, of the base in a world with z up; a calibration's local transform leads from the
base to the camera's optical frame, whose axes are OpenCV's. (DatabaseSchema.sql of introlab/rtabmap.)
"""

from __future__ import annotations

import io
import math
import sqlite3
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import InputError
from placegraph.io.capture.frame_files import DepthUnit, LazyImages, check_shape
from placegraph.io.capture.frames import Capture
from placegraph.io.capture.images import opened, read_rgb
from placegraph.io.capture.posed import Shot, capture_of, smaller_view
from placegraph_io.database import Database
from placegraph_io.dataset.rtabmap_file import calibration, depth_image, matrix

_COLUMNS = "n.id, n.map_id, n.stamp, n.pose, length(d.image), length(d.depth), d.calibration"


def is_rtabmap(path: Path) -> bool:
    """Whether a path is a `.db` file."""
    return path.suffix.lower() == ".db" and path.is_file()


def read_rtabmap(path: Path) -> Capture:
    """Read a database; its images are read when they are asked for.

    Poses are the optimized ones, where RTAB-Map has saved any when it closed the database; else the
    odometry's of the longest session. Raises `InputError` where the file is no such database, is
    older than 0.10, is of a stereo camera, or holds no node with an image, a pose and a calibration.
    """
    base = Database(path)
    try:
        version = _version(base)
        base.select("id", "Data")
        known = base.columns("Data")
        if not {"image", "depth", "calibration"} <= known:
            raise InputError(
                f"{path} is a database of RTAB-Map {'.'.join(map(str, version))}, which is not read; "
                "`rtabmap-reprocess old.db new.db` makes a new one."
            )
        sure = "depth_confidence" in known
        columns = _COLUMNS + (", length(d.depth_confidence)" if sure else ", NULL")
        rows = base.select(columns, "Node", "n JOIN Data d ON n.id = d.id ORDER BY n.id").fetchall()
        poses, notes = _optimized(base)
    except (sqlite3.Error, ValueError, OverflowError) as error:
        raise InputError(f"{path} is no database of RTAB-Map ({error}); copy it again.") from error
    return _capture(base, version, [_Node(*row) for row in rows], poses, notes)


class _Node(NamedTuple):
    """A row, as SQLite hands it out: of any type."""

    id: Any
    session: Any
    stamp: Any
    pose: Any
    image: Any
    """Bytes of the image."""
    depth: Any
    calibration: Any
    sure: Any

    @property
    def stamped(self) -> bool:
        return (
            isinstance(self.id, int) and isinstance(self.stamp, float) and math.isfinite(self.stamp)
        )


def _version(base: Database) -> tuple[int, ...]:
    row = base.select("version", "Admin", "WHERE version IS NOT NULL").fetchone()
    numbers = str(row[0]).split(".") if row else []
    if not numbers or not all(n.isascii() and n.isdigit() and len(n) < 6 for n in numbers):
        raise ValueError("its table Admin names no version")
    return tuple(int(n) for n in numbers)


def _optimized(base: Database) -> tuple[dict[int, NDArray[np.float64]], tuple[str, ...]]:
    """world_from_base (3, 4) by node, as optimized last; empty where they were not saved."""
    if not {"opt_ids", "opt_poses"} <= base.columns("Admin"):
        return {}, ()
    row = base.select("opt_ids, opt_poses", "Admin", "WHERE length(opt_poses) > 0").fetchone()
    if row is None or not all(isinstance(value, bytes) for value in row):
        return {}, ()
    ids, poses = (
        matrix(v, f"{base.path}, Admin.{n}")
        for v, n in zip(row, ("opt_ids", "opt_poses"), strict=True)
    )
    if ids.dtype.kind != "i" or poses.dtype.kind != "f" or poses.size != 12 * ids.size:
        raise InputError(
            f"{base.path}: Admin.opt_poses does not hold twelve numbers for each of opt_ids."
        )
    held = dict(zip(ids.ravel().tolist(), poses.reshape(-1, 3, 4).astype(np.float64), strict=True))
    return held, ("Poses are those that RTAB-Map optimized when it closed the database.",)


def _odometry(nodes: list[_Node]) -> tuple[dict[int, NDArray[np.float64]], tuple[str, ...]]:
    """world_from_base (3, 4) by node of the session that has most; sessions have worlds of their own."""
    held = [n for n in nodes if isinstance(n.pose, bytes) and len(n.pose) == 48]
    sessions = Counter(n.session for n in held)
    session = sessions.most_common(1)[0][0] if sessions else None
    poses = {
        n.id: np.frombuffer(n.pose, "<f4").reshape(3, 4).astype(np.float64)
        for n in held
        if n.session == session
    }
    notes = ["Poses are the odometry's: the database was not closed with optimized ones."]
    if len(sessions) > 1:
        notes.append(
            f"Of {len(sessions)} sessions the longest is used; each has a world of its own."
        )
    return poses, tuple(notes)


def _capture(
    base: Database,
    version: tuple[int, ...],
    nodes: list[_Node],
    poses: dict[int, NDArray[np.float64]],
    notes: tuple[str, ...],
) -> Capture:
    whole = [n for n in nodes if n.stamped]
    if not poses:
        poses, notes = _odometry(whole)
    left_out = Counter({"no stamp": len(nodes) - len(whole)})
    shots: dict[float, Shot] = {}
    sizes = _Sizes(base)
    for node in whole:
        pose = poses.get(node.id)
        if not node.image or not isinstance(node.calibration, bytes) or not node.calibration:
            left_out["no colour image" if not node.image else "no calibration"] += 1
        elif pose is None or not pose.any():
            left_out["no pose"] += 1
        elif node.stamp in shots:
            left_out["its stamp twice"] += 1
        else:
            shots[node.stamp] = _shot(base, version, node, pose, sizes)
    return capture_of(base.path, shots.values(), left_out=+left_out, notes=notes)


class _Sizes:
    """Width and height [px] of a database's images by their kind, of the first that is asked for."""

    def __init__(self, base: Database) -> None:
        self.base = base
        self.known: dict[str, tuple[int, int]] = {}

    def of(self, kind: str, node: int) -> tuple[int, int]:
        """Of "image" or "depth"; `InputError` where that of the node cannot be read."""
        if kind not in self.known:
            data, name = _blob(self.base, kind, node)
            if kind == "depth":
                height, width = depth_image(data, name).shape
            else:
                with opened(io.BytesIO(data), name) as image:
                    width, height = image.size
            self.known[kind] = width, height
        return self.known[kind]


def _shot(
    base: Database,
    version: tuple[int, ...],
    node: _Node,
    world_from_base: NDArray[np.float64],
    sizes: _Sizes,
) -> Shot:
    name = f"{base.path}, node {node.id}"
    model = calibration(node.calibration, version, f"{name}, calibration")
    wide, height = sizes.of("image", node.id)
    camera = model.camera((wide // model.cameras, height), f"{name}, calibration")
    depth_camera = metres = None
    if node.depth:
        wide, height = sizes.of("depth", node.id)
        depth_camera = smaller_view(camera, (wide // model.cameras, height), f"{name}, depth")
        metres = partial(_metres, base, node.id, depth_camera, model.cameras, bool(node.sure))
    pose = np.vstack([world_from_base, (0.0, 0.0, 0.0, 1.0)]) @ model.base_from_camera
    images = LazyImages(
        partial(_colours, base, node.id, camera, model.cameras),
        metres,
        unit=DepthUnit(f"the depth images of {base.path}", 1000.0),
    )
    return Shot(f"{name}, pose", node.stamp, pose, camera, images, depth_camera)


def _blob(base: Database, column: str, node: int) -> tuple[bytes, str]:
    name = f"{base.path}, {column} of node {node}"
    return base.blob(("Data", column, node), name), name


def _colours(base: Database, node: int, camera: Camera, cameras: int) -> NDArray[np.uint8]:
    data, name = _blob(base, "image", node)
    image = read_rgb(Path(name), (camera.width * cameras, camera.height), io.BytesIO(data))
    return image[:, : camera.width]


def _metres(
    base: Database, node: int, camera: Camera, cameras: int, sure: bool
) -> NDArray[np.float32]:
    data, name = _blob(base, "depth", node)
    image = depth_image(data, name)
    if sure:
        packed, said = _blob(base, "depth_confidence", node)
        trust = matrix(packed, said)
        if trust.shape != image.shape:
            raise InputError(
                f"{said} has {trust.shape[1]} x {trust.shape[0]} numbers, but depth "
                f"{image.shape[1]} x {image.shape[0]}; record again."
            )
        image[trust == 0] = np.nan
    image = image[:, : image.shape[1] // cameras]
    check_shape(image, camera, name)
    return image
