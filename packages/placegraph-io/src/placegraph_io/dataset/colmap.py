"""COLMAP models with depth: poses of structure from motion, brought to metres and z up.

Beside the model (`sparse/0`, or the folder itself) lie `images/` and depth: `depth/` with a PNG of
16 bits [mm] an image, or COLMAP's own `stereo/depth_maps/*.geometric.bin`. Model units become
metres by the median ratio of measured depth to that of the sparse points; COLMAP's own depth has
the model's unit, whose metres must be given. Up is found from cameras and level surfaces.
"""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.frame_files import (
    DepthUnit,
    LazyImages,
    check_shape,
    colour_file,
    depth_file,
)
from placegraph.io.capture.frames import Capture
from placegraph.io.capture.images import image_size, natural
from placegraph.io.capture.level import estimated_up, surface_normals, upright
from placegraph.io.capture.posed import Shot, capture_of, smaller_view
from placegraph_io.dataset.colmap_files import (
    ColmapModel,
    Picture,
    model_folder,
    read_depth_map,
)
from placegraph_io.dataset.colmap_files import read_model as read_colmap_model

_UNIT = 1000.0
_FEWEST = 30  # readings at sparse points that a scale needs
_LOOKED_AT = 40  # images whose depth is compared with sparse points


class _View(NamedTuple):
    """An image of the model whose files are there."""

    picture: Picture
    colour: Path
    depth: Path
    camera: Camera
    depth_camera: Camera


def is_colmap(path: Path) -> bool:
    """Whether a folder has a model in `sparse/0`, in `sparse` or in itself."""
    return model_folder(path) is not None


def read_colmap(path: Path, *, scale: float | None = None, up: ArrayLike | None = None) -> Capture:
    """Read a model and its depth; `notes` of the capture say which scale and direction were found.

    Parameters
    ----------
    path
        Folder with the model, `images/` and depth.
    scale
        Metres in a unit of the model; estimated if not given.
    up
        (3,) direction of up in the model; estimated if not given.

    Raises
    ------
    InputError
        There is no depth, or too little at sparse points; a file is missing, truncated or broken;
        a camera's model is none that `Camera` can express.
    OptionError
        `scale` is not greater than 0, or `up` no direction.

    """
    if scale is not None and not (np.isfinite(scale) and scale > 0):
        raise OptionError(f"scale is {scale}; it must be greater than 0.")
    folder = model_folder(path) or path
    model = read_colmap_model(folder)
    left_out: Counter[str] = Counter()
    views = _views(path, model, left_out)
    own = views[0].depth.suffix == ".bin"
    metres, said = _scale(model, views, scale, own=own)
    map_from_model, direction = _upright(views, up, own=own)
    map_from_model[:3, :3] *= metres
    unit = DepthUnit(str(views[0].depth.parent), 1.0 / metres if own else _UNIT)
    shots = []
    for i, view in enumerate(views):
        pose = map_from_model @ np.linalg.inv(view.picture.camera_from_model)
        pose[:3, :3] /= metres
        depth = partial(_own_depth, view.depth, view.depth_camera, metres) if own else None
        images = LazyImages(
            colour_file(view.colour, view.camera),
            depth or depth_file(view.depth, view.depth_camera, _UNIT),
            unit=unit,
        )
        name = f"{folder / 'images'}, {view.picture.name!r}"
        shots.append(Shot(name, float(i), pose, view.camera, images, view.depth_camera))
    return capture_of(path, shots, left_out=left_out, notes=(said, direction))


def _views(path: Path, model: ColmapModel, left_out: Counter[str]) -> list[_View]:
    """Images with colour and depth, in natural order of their names."""
    own = path / "stereo" / "depth_maps"
    if not (path / "depth").is_dir() and not own.is_dir():
        raise InputError(
            f"{path} has no depth: neither depth/ (PNG of 16 bits [mm], named as the images) nor "
            "stereo/depth_maps/ (of COLMAP's patch_match_stereo); a map needs depth."
        )
    sizes: dict[int, tuple[int, int]] = {}
    views = []
    for picture in sorted(model.pictures, key=lambda p: natural(p.name)):
        name = PurePosixPath(picture.name)
        if name.is_absolute() or ".." in name.parts:
            raise InputError(f"{path}: the image name {picture.name!r} leads out of the folder.")
        colour = next((p for p in (path / "images" / name, path / name) if p.is_file()), None)
        below = path / "depth" / name.parent
        files = (below / f"{name.stem}.png", below / f"{name.name}.png",
                 own / f"{picture.name}.geometric.bin")  # fmt: skip
        depth = next((p for p in files if p.is_file()), None)
        if colour is None or depth is None:
            left_out[f"no {'colour image' if colour is None else 'depth'}"] += 1
            continue
        if picture.camera not in sizes:
            sizes[picture.camera] = _depth_size(depth)
        camera = model.cameras[picture.camera]
        depth_camera = smaller_view(camera, sizes[picture.camera], depth)
        views.append(_View(picture, colour, depth, camera, depth_camera))
    if len({view.depth.suffix for view in views}) > 1:
        raise InputError(
            f"{path} has depth of two kinds, depth/ and stereo/; move one of them away."
        )
    if not views:
        raise InputError(
            f"{path} has no image with both colour and depth; {len(model.pictures)} are in the model, "
            "whose names belong to images/ and to depth/."
        )
    return views


def _depth_size(path: Path) -> tuple[int, int]:
    if path.suffix == ".png":
        return image_size(path)
    height, width = read_depth_map(path).shape
    return width, height


def _own_depth(path: Path, camera: Camera, metres: float) -> NDArray[np.float32]:
    """Depth (h, w) [m] of COLMAP's own, whose unit is the model's."""
    depth = read_depth_map(path)
    check_shape(depth, camera, path)
    return np.asarray(depth * np.float32(metres))


# ---------------------------------------------------------------------------------------- scale


def _scale(
    model: ColmapModel, views: list[_View], given: float | None, *, own: bool
) -> tuple[float, str]:
    """Metres in a unit of the model, and a sentence that says whence."""
    if given is not None:
        return given, f"A unit of the COLMAP model is {given:g} m, as was given."
    if own:
        return 1.0, (
            "A unit of the COLMAP model is taken for a metre: its own depth cannot tell; give scale "
            "where it is another."
        )
    step = max(1, len(views) // _LOOKED_AT)
    ratios = np.concatenate([_ratios(model, view) for view in views[::step]])
    if len(ratios) < _FEWEST:
        raise InputError(
            f"{views[0].depth.parent} has depth at {len(ratios)} sparse points of the model, which is "
            f"too little for a scale ({_FEWEST} are needed); give the metres in a unit as scale."
        )
    metres = float(np.median(ratios))
    spread = float(np.median(np.abs(ratios / metres - 1.0)))
    return metres, (
        f"A unit of the COLMAP model is {metres:.4g} m, by depth at {len(ratios)} sparse points "
        f"(median deviation {100 * spread:.1f} %)."
    )


def _ratios(model: ColmapModel, view: _View) -> NDArray[np.float64]:
    """Measured depth over that of sparse points (n,) [m a unit of the model] in an image."""
    seen = [(uv, model.points[int(i)]) for uv, i in
            zip(view.picture.uv, view.picture.points, strict=True) if int(i) in model.points]  # fmt: skip
    if not seen:
        return np.zeros(0)
    uv, points = (np.array(column, np.float64) for column in zip(*seen, strict=True))
    pose = view.picture.camera_from_model
    z = points @ pose[2, :3] + pose[2, 3]
    depth = depth_file(view.depth, view.depth_camera, _UNIT)()
    h, w = depth.shape
    with np.errstate(invalid="ignore"):
        column, row = np.floor(uv * (w / view.camera.width, h / view.camera.height)).T
    inside = (z > 0) & (column >= 0) & (column < w) & (row >= 0) & (row < h)
    measured = depth[row[inside].astype(int), column[inside].astype(int)]
    ratios: NDArray[np.float64] = measured.astype(np.float64) / z[inside]
    return ratios[np.isfinite(ratios)]


# ------------------------------------------------------------------------------------------- up


def _upright(
    views: list[_View], given: ArrayLike | None, *, own: bool
) -> tuple[NDArray[np.float64], str]:
    """Rotation (4, 4), map_from_model, that stands the model upright, and a sentence on it."""
    turns = np.stack([v.picture.camera_from_model[:3, :3].T for v in views])
    if given is None:
        step = max(1, len(views) // _LOOKED_AT)
        read = read_depth_map if own else None
        normals = [
            surface_normals(
                read(v.depth) if read else depth_file(v.depth, v.depth_camera, _UNIT)(),
                v.depth_camera,
            )
            @ turn.T
            for v, turn in zip(views[::step], turns[::step], strict=True)
        ]
        up, how = estimated_up(turns, np.concatenate(normals))
    else:
        up, how = np.asarray(given, np.float64), "was given"
    if up.shape != (3,) or not (np.isfinite(up).all() and np.linalg.norm(up) > 0):
        raise OptionError(f"up is {given!r}; it is a direction of three numbers, in the model.")
    z = up / np.linalg.norm(up)
    turn = np.eye(4)
    turn[:3, :3] = upright(z, turns[0][:, 2])
    return turn, f"Up is ({z[0]:.3f}, {z[1]:.3f}, {z[2]:.3f}) in the COLMAP model, as {how}."
