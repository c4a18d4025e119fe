"""Recordings without a reader of their own: images, poses and intrinsics in common layouts.

Files are found by their names. Poses are a file for each image, or a file of rows or blocks: 4 x 4 or
3 x 4 numbers (7-Scenes, SUN3D, KITTI, Redwood's `.log`), or positions and quaternions (TUM). Conventions
that are not given are those under which depth of frames agrees best with that of other frames.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from shutil import copyfile
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import write_output
from placegraph.core.geometry import Camera, Floats, rotation_from_quaternion
from placegraph.core.options import check_options, option
from placegraph.errors import InputError
from placegraph.io.capture.frame import Capture, ColourFile, LazyImages, colour_file
from placegraph.io.capture.images import ENDINGS, image_size, open_image
from placegraph.io.capture.json_files import read_json
from placegraph.io.capture.posed import (
    StoredFrame,
    make_camera,
    make_capture,
    match_stamps,
    orthonormalize_poses,
    read_text,
    resize_camera,
)
from placegraph.io.capture.tum import write_tum
from placegraph.io.capture.up import MEAN_UP, estimated_up, surface_normals, upright, vote_for_up

_COLOUR, _DEPTH = (".jpg", ".jpeg", ".png", ".ppm"), (".png", ".pgm", ".depth")
_TABLES = (".txt", ".log", ".freiburg", ".tum", ".sim", ".csv")
_OTHER = re.compile(r"label|conf|mask|semantic|instance|normal", re.IGNORECASE)
_POSES = re.compile(r"pose|traj|\bgt\b|truth|extrinsic|odom|scene_\d", re.IGNORECASE)
_INTRINSICS = re.compile(r"^k\.txt|intrinsic|calib|camera", re.IGNORECASE)
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_DATA_SETS = {
    r"^frame-\d+\.color\.png": (585.0, 585.0, 320.0, 240.0),  # 7-Scenes
    r"\.gt\.(freiburg|sim)$|\.depth$": (481.2, -480.0, 320.0, 240.0),  # ICL-NUIM
}
"""fx, fy, cx, cy of 640 x 480 pixels of data sets without a file of intrinsics, by names of files."""
_AXES = {
    "opencv": np.eye(4),
    "opengl": np.diag([1.0, -1.0, -1.0, 1.0]),
    "mirrored": np.diag([1.0, -1.0, 1.0, 1.0]),
}
_UNITS = (1000.0, 5000.0, 10000.0, 256.0, 100.0, 1.0)
_PAIRS, _POINTS = 24, 1500  # whose depth is compared
_TURN, _MOVE = 0.2, 0.3  # between frames of a pair, about [rad, m]
_REACH = 0.2, 20.0  # median depth of a plausible camera [m]
_FAR, _UNLIKELY = 6.0, 0.9  # median depth from which a unit is doubted [m], and its factor
_OVERLAP = 0.1  # share of points that other frames show, at least
_AGREES = 0.03  # relative difference of depth of one surface
_FITS, _CLEARLY = 0.45, 0.1  # share of points that agree, and lead over other conventions
_SNAP = np.radians(5.0)  # from an axis of the world to estimated up


@dataclass(frozen=True, slots=True)
class RawOptions:
    """Files and conventions of a recording; those that are not given are found."""

    images: str | None = option(None, "Colour images: 'rgb/*.png'.", flag="--images")
    depth: str | None = option(None, "Depth images: 'depth/*.png'.", flag="--depth")
    poses: str | None = option(None, "File of poses, or 'pose/*.txt'.", flag="--poses")
    intrinsics: str | None = option(
        None, "FX,FY,CX,CY of the colour images, or a file of them or of a matrix.",
        flag="--intrinsics",
    )  # fmt: skip
    axes: Literal["opencv", "opengl", "mirrored"] | None = option(
        None, "Camera axes: opencv (y down, z forward), opengl (y up, z backward) or mirrored "
        "(y up, z forward, as by a negative fy).", flag="--axes",
    )  # fmt: skip
    pose: Literal["camera-to-world", "world-to-camera"] | None = option(
        None, "Direction of poses: camera-to-world or world-to-camera.", flag="--pose"
    )
    quaternion: Literal["xyzw", "wxyz"] | None = option(
        None, "Order of quaternions: xyzw or wxyz.", flag="--quaternion"
    )
    depth_unit: float | None = option(
        None, "Depth units in a metre, such as 1000.", above=0, flag="--depth-unit"
    )
    depth_kind: Literal["z", "range"] | None = option(
        None, "Depth: z, along the optical axis, or range, along the ray.", flag="--depth-kind"
    )
    pose_unit: float = option(1.0, "Units of positions in a metre.", above=0, flag="--pose-unit")
    up: str | None = option(None, "X,Y,Z: up in the frame of the poses.", flag="--up")

    def __post_init__(self) -> None:
        check_options(self)

    def __str__(self) -> str:
        named = {name: getattr(self, name) for name in _CONVENTIONS}
        return " ".join(
            f"--{name.replace('_', '-')} {value:g}" if isinstance(value, float)
            else f"--{name.replace('_', '-')} {value}" for name, value in named.items() if value
        )  # fmt: skip


_CONVENTIONS = ("axes", "pose", "quaternion", "depth_unit", "depth_kind")


@dataclass(frozen=True, eq=False)
class Recording:
    """Files of frames that belong together, and their poses as stored."""

    path: Path
    colours: list[Path]
    depths: list[Path | None]
    rows: list[Floats]
    """(T,) of (4, 4), or (7,) position and quaternion."""
    camera: Camera
    is_mirrored: bool
    """Whether fy is negative."""

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """Rows of frames near each other, both with depth, from all over the recording."""
        known = [i for i, depth in enumerate(self.depths) if depth]
        if len(known) < 2:
            return []
        poses = self.poses(RawOptions())[known]
        steps = np.linalg.inv(poses[:-1]) @ poses[1:]
        turns = np.arccos(np.clip((np.trace(steps, axis1=1, axis2=2) - 2.0) / 2.0, -1.0, 1.0))
        motion = turns / _TURN + np.linalg.norm(steps[:, :3, 3], axis=1) / _MOVE
        gap = int(np.clip(1.0 / np.maximum(np.median(motion), 1e-3), 1, max(len(known) // 3, 1)))
        near = [p for k in (gap, 2 * gap) for p in zip(known, known[k:], strict=False)]
        return sorted(near)[:: len(near) // _PAIRS + 1]

    @cached_property
    def depth_samples(self) -> dict[int, Floats]:
        """Depth (h, w), as stored, of the frames of `pairs` by their row."""
        rows = sorted(set(itertools.chain(*self.pairs)))
        return {i: read_depth(file) for i in rows if (file := self.depths[i])}

    @cached_property
    def depth_camera(self) -> Camera:
        """Camera of the depth images: that of the colour images in their size."""
        height, width = next(read_depth(depth) for depth in self.depths if depth).shape
        return resize_camera(self.camera, (width, height), f"depth in {self.path}")

    @cached_property
    def rays(self) -> Floats:
        """Rays (h, w, 3) of the depth images, z = 1."""
        v, u = np.mgrid[: self.depth_camera.height, : self.depth_camera.width] + 0.5
        return self.depth_camera.directions(np.stack([u, v], axis=-1))

    def poses(self, how: RawOptions) -> Floats:
        """Return world_from_camera (T, 4, 4) [m] in OpenCV's axes."""
        poses: Floats = np.tile(np.eye(4), (len(self.rows), 1, 1))
        for pose, row in zip(poses, self.rows, strict=True):
            if row.shape == (4, 4):
                pose[:] = row
            else:
                order = [4, 5, 6, 3] if how.quaternion == "wxyz" else [3, 4, 5, 6]
                pose[:3, :3], pose[:3, 3] = rotation_from_quaternion(row[order]), row[:3]
        if how.pose == "world-to-camera":
            poses[:] = np.linalg.inv(poses)
        poses[:, :3, 3] /= how.pose_unit
        flip = _AXES[how.axes or "opencv"]
        return (flip if how.axes == "mirrored" else np.eye(4)) @ poses @ flip

    @cached_property
    def lengths(self) -> Floats:
        """Lengths (h, w) of `rays`."""
        return np.linalg.norm(self.rays, axis=-1)

    def units_in_metre(self, how: RawOptions) -> Floats:
        """Return stored units (h, w) in a metre along the optical axis."""
        kind = self.lengths if how.depth_kind == "range" else np.ones_like(self.lengths)
        return kind * (how.depth_unit or 1.0)


def find_recording(path: Path, given: RawOptions) -> Recording:
    """Find images, poses and intrinsics; `InputError` names everything that is missing at once."""
    files = sorted(p for pattern in ("*", "*/*") for p in path.glob(pattern) if p.is_file())
    files = [p for p in files if not _OTHER.search(p.relative_to(path).as_posix())]
    is_depth = {
        p: "depth" in p.relative_to(path).as_posix().lower() or p.suffix == ".pgm" for p in files
    }
    colours = _largest(
        path, given.images, [p for p in files if p.suffix.lower() in _COLOUR and not is_depth[p]]
    )
    depths = _largest(
        path, given.depth, [p for p in files if p.suffix.lower() in _DEPTH and is_depth[p]]
    )
    keys = _numbers(colours)
    poses = _find_poses(path, files, given.poses, keys)
    size = image_size(colours[0]) if colours else (640, 480)
    intrinsics = _find_intrinsics(path, files, given.intrinsics, size)
    lacking = [
        option
        for option, found in (("colour images: --images 'rgb/*.png'", colours),
                              ("poses of these images: --poses FILE, or 'pose/*.txt'", poses),
                              ("intrinsics: --intrinsics FX,FY,CX,CY, or FILE", intrinsics)) if not found
    ]  # fmt: skip
    if lacking:
        raise InputError(f"{path} contains no {'; no '.join(lacking)}.")
    fx, fy, cx, cy = intrinsics
    camera = make_camera(f"{path}, intrinsics", size, (fx, abs(fy), cx, cy))
    near = match_stamps(_numbers(depths), keys, _tolerance(keys)).tolist()
    rows = sorted(poses)
    return Recording(
        path, [colours[i] for i in rows], [depths[near[i]] if near[i] >= 0 else None for i in rows],
        [poses[i] for i in rows], camera, fy < 0,
    )  # fmt: skip


def _largest(path: Path, given: str | None, files: list[Path]) -> list[Path]:
    """Return the files of the pattern given, else the largest set that differs in numbers only."""
    if given:
        return sorted(path.glob(given))
    sets: dict[tuple[Path, str], list[Path]] = {}
    for p in files:
        sets.setdefault((p.parent, re.sub(r"\d+", "", p.name)), []).append(p)
    return max(sets.values(), key=len, default=[])


def _numbers(files: Sequence[Path]) -> Floats:
    """Return the last number in each name that differs between all of them (n,); else their places."""
    found = [[float(n) for n in re.findall(r"\d+(?:\.\d+)?", p.name)] for p in files]
    columns = [c for c in zip(*found, strict=False) if len(set(c)) == len(found)]
    return np.array(columns[-1] if columns else range(len(found)), np.float64)


def _tolerance(keys: Floats) -> float:
    """Return the largest difference between numbers of one moment, less than a step."""
    return 0.6 * float(np.median(np.diff(np.sort(keys)))) if len(keys) > 1 else 0.0


def _find_poses(
    path: Path, files: list[Path], given: str | None, keys: Floats
) -> dict[int, Floats]:
    """Return poses as stored by the row of their image."""
    tables = [
        p for p in files if p.suffix in _TABLES and _POSES.search(p.relative_to(path).as_posix())
    ]
    tables = sorted(path.glob(given)) if given else tables
    each = _largest(path, None, tables)
    if len(each) > max(1, len(keys) // 2):
        rows = match_stamps(_numbers(each), keys, 0.0).tolist()
        found = {i: read_poses(each[row])[1] for i, row in enumerate(rows) if row >= 0}
        return {i: poses[0] for i, poses in found.items() if len(poses) == 1}
    for file in reversed(tables):  # SUN3D's newest come first
        stamps, poses = read_poses(file)
        if poses and len(poses) == len(keys):
            return dict(enumerate(poses))
        rows = match_stamps(stamps, keys, _tolerance(keys)).tolist()
        if max(rows, default=-1) >= 0:
            return {i: poses[row] for i, row in enumerate(rows) if row >= 0}
    return {}


def read_poses(path: Path) -> tuple[Floats, list[Floats]]:
    """Read stamps (n,), if any, and poses as stored, each (4, 4) or position and quaternion (7,)."""
    text = read_text(path)
    if povray := dict(re.findall(r"(cam_\w+)\s*=\s*\[(.*?)\]", text)):
        axes, z = np.eye(4), _parse_row(povray["cam_dir"])
        x = np.cross(_parse_row(povray["cam_up"]), z)
        for i, axis in enumerate((x, np.cross(z, x), z)):
            axes[:3, i] = axis / np.linalg.norm(axis)
        axes[:3, 3] = _parse_row(povray["cam_pos"])
        return np.zeros(0), [axes]
    rows = [row for line in text.splitlines() if len(row := _parse_row(line.partition("#")[0]))]
    width = max(map(len, rows), default=0)
    rows = [row for row in rows if len(row) == width]  # others are headers
    if width == 4:
        tall = 4 if len(rows) > 3 and np.array_equal(rows[3], (0, 0, 0, 1)) else 3
        rows = list(np.array(rows[: len(rows) // tall * tall]).reshape(-1, 4 * tall))
    elif width not in {7, 8, 12, 13, 16, 17}:
        return np.zeros(0), []
    stamped = width in {8, 13, 17}
    return np.array([row[0] for row in rows if stamped]), [
        _parse_pose(row[stamped:]) for row in rows
    ]


def _parse_row(line: str) -> Floats:
    words = line.replace(",", " ").split()
    return np.array(words, float) if all(re.fullmatch(_NUMBER, w) for w in words) else np.zeros(0)


def _parse_pose(values: Floats) -> Floats:
    """Return (7,) numbers as they are, and 12 or 16 as (4, 4); by columns where the last says so."""
    if len(values) == 7:
        return values
    pose = np.eye(4)
    pose.flat[: len(values)] = values
    return pose.T if pose[3, :3].any() and not pose[:3, 3].any() else pose


def _find_intrinsics(
    path: Path, files: list[Path], given: str | None, size: tuple[int, int]
) -> list[float]:
    """Return fx, fy, cx, cy; nothing where they are unknown."""
    if given and len(numbers := _parse_row(given)) == 4:
        return numbers.tolist()
    for file in [path / given] if given else [p for p in files if _INTRINSICS.search(p.name)]:
        if file.suffix == ".json":
            content = read_json(file)
            content = content if isinstance(content, dict) else {}
            values = content.get("intrinsic_matrix") or content.get("K") or [
                content[n] for n in ("fx", "fy", "cx", "cy") if n in content
            ]  # fmt: skip
            numbers = np.array(values, float).ravel()
        elif file.suffix in _TABLES:
            numbers = np.array(re.findall(_NUMBER, read_text(file)), float)
        if len(numbers) in {9, 16}:
            k = numbers.reshape(int(len(numbers) ** 0.5), -1)
            numbers = (k.T if k[2, 0] else k)[[0, 1, 0, 1], [0, 1, 2, 2]]
        if len(numbers) == 4:
            return numbers.tolist()
    known = (k for name, k in _DATA_SETS.items() if any(re.search(name, p.name) for p in files))
    return list(next(known, ())) if size == (640, 480) else []


def read_depth(file: Path) -> Floats:
    """Read depth (h, w) as stored, NaN: no reading; `InputError` where it is not one channel."""
    if file.suffix == ".depth":  # ICL-NUIM's text, 4 : 3
        values = np.array(read_text(file).split(), float)
        units = values.reshape(round((values.size * 0.75) ** 0.5), -1)
    else:
        with open_image(file, file) as image:
            units = np.asarray(image).astype(np.int64)
        if units.ndim != 2:
            raise InputError(f"{file} has several channels; depth has one.")
        if (units[units > 0] & 7 == 0).sum() > 0.9 * (
            units > 0
        ).sum():  # SUN3D stores bits rotated by three
            units = units >> 3 | units << 13 & 0xFFFF
    return np.where((units > 0) & (units < 65535), units, np.nan)


def measure_agreement(recording: Recording, how: RawOptions) -> float:
    """Return the share of points of some frames that lie where the depth of later ones has a surface."""
    poses, camera, stored = recording.poses(how), recording.depth_camera, recording.depth_samples
    metre = recording.units_in_metre(how)
    depths, near, known = [np.zeros(0)], 0, 0
    for i, j in recording.pairs:
        seen = np.flatnonzero(np.isfinite(stored[i]))
        seen = seen[:: len(seen) // _POINTS + 1]
        depth = stored[i].ravel()[seen] / metre.ravel()[seen]
        move = np.linalg.inv(poses[j]) @ poses[i]
        points = recording.rays.reshape(-1, 3)[seen] * depth[:, None] @ move[:3, :3].T + move[:3, 3]
        x, y = np.nan_to_num(np.floor(camera.project(points)), nan=-1.0).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
        x, y, z = x[inside], y[inside], points[inside, 2]
        read = stored[j][y, x] / metre[y, x]
        known += np.isfinite(read).sum()
        near += (np.abs(z - read) < _AGREES * z).sum()
        depths.append(depth)
    every = np.concatenate(depths)
    if not len(every) or not _REACH[0] < (median := np.median(every)) < _REACH[1]:
        return 0.0
    share = float(near / max(known, _OVERLAP * len(every)))
    return share if median < _FAR else _UNLIKELY * share


def find_conventions(recording: Recording, given: RawOptions) -> tuple[RawOptions, str]:
    """Return the conventions under which depth agrees, and a sentence about them.

    Raises `InputError` where those given disagree and others do not, or where none agrees.
    """
    quaternions = ("xyzw", "wxyz") if recording.rows[0].shape == (7,) else (None,)
    axes = sorted(_AXES, key=lambda name: (name == "mirrored") != recording.is_mirrored)
    units = dict.fromkeys((given.depth_unit or _UNITS[0], *_UNITS))
    directions, kinds = ("camera-to-world", "world-to-camera"), ("z", "range")
    tried = [
        replace(given, **dict(zip(_CONVENTIONS, choice, strict=True)))
        for choice in itertools.product(axes, directions, quaternions, units, kinds)
    ]
    told = [name for name in _CONVENTIONS if getattr(given, name) is not None]
    asked = [h for h in tried if all(getattr(h, name) == getattr(given, name) for name in told)]
    if not recording.pairs:
        return asked[0], f"Fewer than two frames have depth, so nothing confirms {asked[0]}."
    scores = {how: measure_agreement(recording, how) for how in tried}
    best = max(tried, key=lambda how: scores[how])
    most = max(scores[how] for how in asked)
    chosen = next(how for how in asked if scores[how] > most - 0.02)
    words = (
        f"depth of frames agrees with that of other frames for {scores[chosen]:.0%} of its pixels"
    )
    if scores[best] > max(_FITS, scores[chosen] + _CLEARLY):
        raise InputError(
            f"{recording.path}: {words} by {given}, but for {scores[best]:.0%} by {best}; give these."
        )
    if scores[chosen] < _FITS:
        raise InputError(
            f"{recording.path}: {words} at best, by {chosen}; check that the poses are of these images, "
            "and the intrinsics."
        )
    return chosen, f"{words.capitalize()} by {chosen}."


def read_raw(path: Path, given: RawOptions) -> Capture:
    """Read a recording, z up; raises `InputError` where files are missing or no convention fits."""
    recording = find_recording(path, given)
    how, note = find_conventions(recording, given)
    poses = orthonormalize_poses(recording.poses(how), [f"{p}, pose" for p in recording.colours])
    normals = [
        surface_normals(_read_metres(recording, file, how), recording.depth_camera)
        @ poses[i, :3, :3].T
        for i in recording.depth_samples
        if (file := recording.depths[i])
    ]
    if given.up:
        up, way = _parse_row(given.up), "as given"
    else:
        votes = np.concatenate([np.zeros((0, 3)), *normals])
        up, way = estimated_up(poses[:, :3, :3], votes)
        axis = np.eye(3)[np.abs(up).argmax()] * np.sign(up[np.abs(up).argmax()])
        voted = vote_for_up(votes, axis)
        if voted is not None and voted @ axis > np.cos(_SNAP):
            up, way = axis, "horizontal and vertical surfaces agree with this axis"
        elif way == MEAN_UP:
            up, way = axis, "the axis next to the mean up direction of the images"
    level = np.eye(4)
    level[:3, :3] = upright(up / np.linalg.norm(up), np.eye(3)[0])
    notes = (note, f"Up is {' '.join(f'{v:.3g}' for v in up)} there: {way}; --up gives another.")

    def stored_frame(i: int, colour: Path, depth: Path | None) -> StoredFrame:
        read = partial(_read_metres, recording, depth, how) if depth else None
        images = LazyImages(colour_file(colour, recording.camera), read)
        view = recording.depth_camera if depth else None
        return StoredFrame(str(colour), float(i), level @ poses[i], recording.camera, images, view)

    frames = map(stored_frame, range(len(poses)), recording.colours, recording.depths)
    return make_capture(path, frames, notes=notes)


def _read_metres(recording: Recording, depth: Path, how: RawOptions) -> NDArray[np.float32]:
    return (read_depth(depth) / recording.units_in_metre(how)).astype(np.float32)


def write_capture(capture: Capture, out: Path) -> None:
    """Write a capture folder, depth in 1/1000 m; raises `InputError` where files are in it already."""
    from PIL import Image

    if out.exists() and any(out.iterdir()):
        raise InputError(f"{out} is not empty; choose another --out.")
    (out / "rgb").mkdir(parents=True, exist_ok=True)
    entry = capture.camera.to_dict()
    if capture.depth_camera is not None:
        (out / "depth").mkdir()
        entry["depth"] = capture.depth_camera.to_dict() | {"scale": 1000}
    for i, frame in enumerate(capture):
        images, target = frame.images, out / "rgb" / f"{i:06d}.png"
        stored = images.colours if isinstance(images, LazyImages) and not images.turns else None
        if isinstance(stored, ColourFile) and stored.path.suffix.lower() in ENDINGS:
            copyfile(stored.path, target.with_suffix(stored.path.suffix))
        else:
            Image.fromarray(frame.rgb()).save(target)
        if (metres := frame.depth()) is not None:
            units = np.nan_to_num(np.rint(metres * 1000).clip(0, 65535)).astype(np.uint16)
            Image.fromarray(units).save(out / "depth" / target.name)
    write_output(out / "camera.json", json.dumps(entry, indent=1).encode())
    note = " ".join(capture.notes)
    write_tum(out / "odometry.tum", capture.stamps, capture.odometry, comment=note)
