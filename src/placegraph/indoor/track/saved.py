"""What a live tracker believes as a file of kilobytes: `docs/formats.md`. The map is never written to."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.core.mapfile import read_map, write_map
from placegraph.errors import InputError, MapError, OptionError
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.track.odometry import checked_covariance, checked_odometry, checked_pose

KIND = "track"
VERSION = 1


@dataclass(frozen=True, slots=True, eq=False)
class Saved:
    """A pose, and odometry at its time."""

    scene: str
    """Name of its map ..."""
    digest: str
    """... and what tells it from another map of that name (`digest_of`)."""
    stamp: float
    moved: bool
    """Whether odometry came by itself, and not with images."""
    odom_from_camera: Floats
    map_from_camera: Floats
    covariance: Floats
    """(6, 6)"""

    def write(self, path: str | PathLike[str]) -> None:
        """Write it (atomically); `MapError` where the file cannot be written."""
        meta = {"scene": self.scene, "digest": self.digest, "moved": self.moved}
        names = ("odom_from_camera", "map_from_camera", "covariance")
        arrays = {name: np.asarray(getattr(self, name), np.float64) for name in names}
        write_map(path, KIND, VERSION, meta, arrays | {"stamp": np.array([self.stamp], np.float64)})

    @classmethod
    def read(cls, path: str | PathLike[str]) -> Saved:
        """Read it; raises `InputError` and `MapError` where it is missing, or no sound file."""
        if not Path(path).exists():
            raise InputError(f"{path} does not exist; `LiveTracker.save` writes it.")
        file = read_map(path, KIND, VERSION)
        try:
            stamp, odometry, _ = checked_odometry(
                file.array("stamp", "<f8")[0], file.array("odom_from_camera", "<f8", 2), None
            )
            return cls(
                scene=_text(file.meta["scene"]),
                digest=_text(file.meta["digest"]),
                stamp=stamp,
                moved=bool(file.meta["moved"]),
                odom_from_camera=odometry,
                map_from_camera=checked_pose(
                    "map_from_camera", file.array("map_from_camera", "<f8", 2)
                ),
                covariance=checked_covariance("covariance", file.array("covariance", "<f8", 2)),
            )
        except (OptionError, KeyError, TypeError, IndexError) as error:
            raise MapError(
                f"{path}: its columns contradict each other ({error}). Save it again."
            ) from error


def digest_of(scene: Scene) -> str:
    """What tells a map from others: of its surfaces and the names of its objects."""
    sha = hashlib.sha256("\n".join(scene.graph.ids).encode())
    for column in (scene.mesh.vertices, scene.mesh.triangles):
        sha.update(np.ascontiguousarray(column).data)
    return sha.hexdigest()[:32]


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is no text")
    return value
