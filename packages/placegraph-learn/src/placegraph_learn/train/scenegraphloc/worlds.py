"""Where lessons come from: folders of scene maps with captures, and procedural homes."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.capture import Capture, open_capture
from placegraph_learn.train.scenegraphloc.lessons import Material, Surveyed, World

SUFFIX = ".scene"


def placed(capture: Capture, map_from_camera: NDArray[np.float64]) -> Capture:
    """Capture whose odometry (T, 4, 4) is map_from_camera: one of the map itself."""
    frames = zip(capture.frames, map_from_camera, strict=True)
    return replace(capture, frames=tuple(replace(f, odometry=pose) for f, pose in frames))


def homes(
    count: int,
    *,
    seed: int = 0,
    frames: int = 16,
    changes: bool = True,
    camera: Camera | None = None,
) -> list[World]:
    """Procedural homes (`placegraph_lab.worlds.home.home`), each drawn from its own seed.

    Parameters
    ----------
    count
        Number of homes.
    seed
        The same seed, the same homes.
    frames
        Images of each of the walks: one to know the objects by, one whose patches are learned.
    changes
        Whether a home is known as it was months before, too, when things stood elsewhere.
    camera
        Of the images; that of `homes.record` if not given.

    """
    if count < 1 or frames < 1:
        raise OptionError(f"homes: {count}, frames: {frames}; choose at least one of each.")
    return [
        World(f"home-{seed}-{i:04d}", partial(_home, seed, i, frames, camera, changes=changes))
        for i in range(count)
    ]


def _home(seed: int, index: int, frames: int, camera: Camera | None, *, changes: bool) -> Material:
    from placegraph_lab.worlds.home.home import CAMERA, changed, home, record, scene_of, visit

    rng = np.random.default_rng([seed, index])
    flat = home(rng)
    then = flat.furnish(rng)
    now = changed(then, rng) if changes else then

    def walk(interior: object) -> Capture:
        way = visit(flat, interior, rng, frames=frames)  # type: ignore[arg-type]
        lit = float(rng.random())
        taken = record(
            interior, way, rng, camera=camera or CAMERA, daylight=lit, labels=None  # type: ignore[arg-type]
        )  # fmt: skip
        return placed(taken, way.map_from_camera)

    earlier = Surveyed(scene_of(then), (walk(then),)) if changes else None
    return Material(Surveyed(scene_of(now), (walk(now),)), (walk(now),), earlier)


def folder(path: str | PathLike[str]) -> list[World]:
    """Scene maps of a folder, each `NAME.scene` with its captures in the folder `NAME`.

    `NAME` is one capture or holds several, by whatever recorder; poses are those of
    `trajectory.tum` where there is one, else the recorder's own, and must be in the map. Of several
    captures the first shows what objects look like and the others are learned; of a single one,
    every other image.

    Raises
    ------
    OptionError
        The folder holds no map with captures.

    """
    root = Path(path)
    found = sorted(root.glob(f"*{SUFFIX}")) if root.is_dir() else []
    known = [file for file in found if file.with_suffix("").is_dir()]
    if not known:
        raise OptionError(
            f"{path}: no NAME{SUFFIX} with captures in a folder NAME beside it; build maps with "
            "`placegraph scene build`."
        )
    return [World(file.stem, partial(_opened, file)) for file in known]


def _opened(file: Path) -> Material:
    from placegraph.indoor.scene_map import SceneMap

    at = file.with_suffix("")
    inner = [] if _is_capture(at) else sorted(p for p in at.iterdir() if _is_capture(p))
    captures = [_with_poses(p) for p in inner or [at]]
    if len(captures) == 1:
        captures = [captures[0][::2], captures[0][1::2]]
    if not len(captures[1]):
        raise OptionError(f"{at}: a single image; two are the least, one to know objects by.")
    scene = SceneMap.open(file)
    return Material(Surveyed(scene, (captures[0],)), tuple(captures[1:]))


def _is_capture(path: Path) -> bool:
    from placegraph.io.capture.capture import format_of

    try:
        format_of(path)
    except InputError:
        return False
    return True


def _with_poses(path: Path) -> Capture:
    truth = (path / "trajectory.tum").is_file()
    return open_capture(path, labels=None, poses="trajectory") if truth else open_capture(path)
