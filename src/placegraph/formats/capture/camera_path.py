"""The way of a camera, from whichever file holds one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import InputError
from placegraph.formats.capture.camera import read_json
from placegraph.formats.capture.tum import read_tum

if TYPE_CHECKING:
    from os import PathLike

    from numpy.typing import NDArray


def read_camera_path(path: str | PathLike[str]) -> NDArray[np.float64]:
    """Poses (T, 4, 4) map_from_camera of a TUM file, or of what `scene localize --json` printed.

    Raises
    ------
    InputError
        The file is missing or neither, or holds no pose.

    """
    path = Path(path)
    if path.suffix.lower() != ".json":
        return read_tum(path).poses
    content = read_json(path)
    try:
        poses = np.array(content["trajectory"], np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} holds no trajectory; save what `placegraph scene localize --json` prints."
        ) from error
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not len(poses):
        raise InputError(f"{path}: its trajectory has shape {poses.shape}; (T, 4, 4) belongs.")
    if not np.isfinite(poses).all():
        raise InputError(f"{path}: a pose of its trajectory is not finite; localize again.")
    return poses
