"""Recordings of MultiScan's Scanner App, by ARKit on iOS and by ARCore on Android.

`X.mp4`; `X.jsonl`, a line a frame of it: `intrinsics` (9 by columns [px]), `transform` (16 by columns,
world_from_camera in ARKit's and ARCore's axes, of the image as it is stored), `timestamp` [ns];
`X.depth.zlib` and `X.confidence.zlib`, all frames in one raw deflate stream: float16 [m] or uint16 [mm],
and uint8; `X.json`, which says their sizes and the unit. (docs/read-the-docs/dataset/files/acquired.rst
and server/scripts/depth_decode.py of smartscenes/multiscan.)
"""

from __future__ import annotations

import json
import zlib
from collections import Counter
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import check_regular
from placegraph.core.geometry import Camera
from placegraph.errors import InputError
from placegraph.io.capture.frame import Capture, DepthUnit, LazyImages
from placegraph.io.capture.json_files import read_json
from placegraph.io.capture.posed import (
    ARKIT_FROM_OPENCV,
    MAP_FROM_Y_UP,
    StoredFrame,
    make_camera,
    make_capture,
    orthonormalize_pose,
    read_number,
    read_numbers,
    read_text,
    resize_camera,
)
from placegraph.io.capture.video import Video

_UNITS = {"m": ("<f2", 1.0), "mm": ("<u2", 1000.0)}
"""Numbers of the depth stream, and units in a metre."""
_MOST = 1 << 24  # pixels of a frame


def is_multiscan(path: Path) -> bool:
    """Return whether a folder has an `X.jsonl` and an `X.mp4`."""
    return path.is_dir() and _name(path) is not None


def read_multiscan(path: Path) -> Capture:
    """Read a recording; where it has no depth stream, its frames have no depth.

    Raises `InputError` where files are missing or broken, `MissingExtraError` where no decoder of
    videos is installed.
    """
    name = _name(path)
    if name is None:
        raise InputError(
            f"{path} holds no .jsonl with an .mp4 of its name; copy the whole recording."
        )
    video = Video(path / f"{name}.mp4")
    said = _StreamSizes.of(path / f"{name}.json")
    depth, sure = (
        _stream(path / f"{name}.{kind}.zlib", said, kind) for kind in ("depth", "confidence")
    )
    left_out: Counter[str] = Counter()
    shots: dict[float, StoredFrame] = {}
    for i, line in enumerate(read_text(path / f"{name}.jsonl").splitlines()):
        if not line.strip():
            continue
        where = path / f"{name}.jsonl, line {i + 1}"
        if i >= len(video):
            left_out["no colour image"] += 1
            continue
        shot = _shot(where, line, i, video, said)
        if shot.stamp in shots:
            left_out["its stamp twice"] += 1
            continue
        shots[shot.stamp] = shot if depth is None else _with_depth(shot, i, said, (depth, sure))
    return make_capture(path, shots.values(), left_out=left_out)


class _StreamSizes(NamedTuple):
    """What of `X.json` is used."""

    path: Path
    colour: tuple[int, int] | None
    """Width and height [px] that the intrinsics are of."""
    depth: tuple[int, int] | None
    unit: str

    @classmethod
    def of(cls, path: Path) -> _StreamSizes:
        content = read_json(path)
        streams = content.get("streams") if isinstance(content, dict) else None
        if not isinstance(streams, list) or not all(isinstance(s, dict) for s in streams):
            raise InputError(f"{path}: streams is not a list of objects; record again.")
        sizes = {str(s.get("file_extension")): _size(path, s) for s in streams}
        unit = content.get("depth_unit", "m")
        if not isinstance(unit, str) or unit not in _UNITS:
            raise InputError(f"{path}: depth_unit is {str(unit)[:40]!r}; it is 'm' or 'mm'.")
        return cls(path, sizes.get("mp4"), sizes.get("depth.zlib"), unit)


def _size(path: Path, stream: dict[str, Any]) -> tuple[int, int] | None:
    if "resolution" not in stream:
        return None
    height, width = read_numbers(path, stream, "resolution", 2)
    if not (0 < width < 1 << 16 and 0 < height < 1 << 16 and width * height <= _MOST):
        raise InputError(
            f"{path}: resolution is {height:g} x {width:g}; it is a height and a width."
        )
    return int(width), int(height)


def _name(path: Path) -> str | None:
    """Return the name that the files of a recording share."""
    held = (p.stem for p in path.glob("*.jsonl") if p.with_suffix(".mp4").is_file())
    return min(held, default=None)


def _stream(path: Path, said: _StreamSizes, kind: str) -> Deflated | None:
    if not path.is_file():
        return None
    if said.depth is None:
        raise InputError(f"{said.path}: no stream depth.zlib has a resolution; record again.")
    width, height = said.depth
    return Deflated(path, width * height * (2 if kind == "depth" else 1))


def _shot(where: Path, line: str, index: int, video: Video, said: _StreamSizes) -> StoredFrame:
    try:
        content = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where} is not JSON ({error}).") from error
    if not isinstance(content, dict):
        raise InputError(f"{where} must be a JSON object with intrinsics, transform and timestamp.")
    k = read_numbers(where, content, "intrinsics", 9)
    camera = make_camera(
        f"{where}: intrinsics", said.colour or video.size, (k[0], k[4], k[6], k[7])
    )
    camera = resize_camera(camera, video.size, video.path)
    turn = np.array(read_numbers(where, content, "transform", 16)).reshape(4, 4).T
    pose = MAP_FROM_Y_UP @ orthonormalize_pose(turn, f"{where}: transform") @ ARKIT_FROM_OPENCV
    images = LazyImages(partial(video.picture, index, camera))
    stamp = read_number(where, content, "timestamp") / 1e9
    return StoredFrame(f"{where}: transform", stamp, pose, camera, images)


def _with_depth(
    shot: StoredFrame, index: int, said: _StreamSizes, streams: tuple[Deflated, Deflated | None]
) -> StoredFrame:
    assert said.depth is not None  # noqa: S101  # else there is no stream
    camera = resize_camera(shot.camera, said.depth, streams[0].path)
    metres = partial(_metres, *streams, index, camera, said.unit)
    unit = DepthUnit(f"`depth_unit` in {said.path}", _UNITS[said.unit][1])
    images = LazyImages(shot.images.colours, metres, unit=unit)
    return StoredFrame(shot.name, shot.stamp, shot.pose, shot.camera, images, camera)


def _metres(
    depth: Deflated, sure: Deflated | None, index: int, camera: Camera, unit: str
) -> NDArray[np.float32]:
    kind, per_metre = _UNITS[unit]
    shape = camera.height, camera.width
    units = np.frombuffer(depth.read(index), kind).reshape(shape)
    with np.errstate(invalid="ignore"):  # of a damaged stream any bits may come
        metres = units.astype(np.float32) / np.float32(per_metre)
    metres[~(np.isfinite(metres) & (metres > 0))] = np.nan
    if sure is not None:
        metres[np.frombuffer(sure.read(index), np.uint8).reshape(shape) == 0] = np.nan
    return metres


_PART = 1 << 16  # bytes of the file at once
_MARKED = 100  # frames between places from which reading can go on, each some 50 kB of memory


class _Mark(NamedTuple):
    """Where a frame begins."""

    unpacker: Any
    """With what it was given and has not unpacked."""
    offset: int
    """Of the file, behind that."""


class Deflated:
    """Frames of `size` bytes each; in order is fastest. Opened again where it is sent to."""

    def __init__(self, path: Path, size: int) -> None:
        self.path, self.size = path, size
        self._lock = Lock()
        self._marks = {0: _Mark(zlib.decompressobj(-zlib.MAX_WBITS), 0)}
        self._at, self._number = self._marks[0], 0

    def __reduce__(self) -> tuple[type[Deflated], tuple[Path, int]]:
        return Deflated, (self.path, self.size)

    def read(self, number: int) -> bytes:
        """Return the bytes of a frame; `InputError` where the stream ends before it or is damaged."""
        with self._lock:
            nearest = max(n for n in self._marks if n <= number)
            if not nearest <= self._number <= number:
                self._at, self._number = self._marks[nearest], nearest
            try:
                with check_regular(self.path).open("rb") as file:
                    return self._forward(file, number)
            except (OSError, zlib.error) as error:
                raise InputError(f"{self.path} cannot be read ({error}); copy it again.") from error

    def _forward(self, file: Any, number: int) -> bytes:  # noqa: ANN401  # a file
        unpacker = self._at.unpacker.copy()
        file.seek(self._at.offset)
        frame = b""
        while self._number <= number:
            parts, missing = [], self.size
            while missing:
                packed = unpacker.unconsumed_tail or file.read(_PART)
                parts.append(unpacker.decompress(packed, missing))
                missing -= len(parts[-1])
                if unpacker.eof or not (packed or parts[-1]):
                    break
            if missing:
                raise InputError(f"{self.path} ends before frame {number}; copy it again.")
            frame = b"".join(parts)
            self._number += 1
            self._at = _Mark(unpacker.copy(), file.tell())
            if self._number % _MARKED == 0:
                self._marks[self._number] = self._at
        return frame
