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

_UNITS = {
    "m": ("<f2", 1.0),
    "mm": ("<u2", 1000.0),
}  # Numbers of the depth stream, and units in a metre
_MOST_PIXELS = 1 << 24  # pixels of a frame


def is_multiscan(path: Path) -> bool:
    """Return whether a folder has an `X.jsonl` and an `X.mp4`."""
    return path.is_dir() and _find_name(path) is not None


def read_multiscan(path: Path) -> Capture:
    """Read a recording; frames have no depth without a depth stream.

    Raises `InputError` where files are missing or broken, `MissingExtraError` without a video decoder.
    """
    name = _find_name(path)
    if name is None:
        raise InputError(
            f"{path} contains no .jsonl with an .mp4 of the same name; copy the whole recording."
        )
    video = Video(path / f"{name}.mp4")
    sizes = _StreamSizes.read(path / f"{name}.json")
    depth, confidence = (
        _stream(path / f"{name}.{kind}.zlib", sizes, kind) for kind in ("depth", "confidence")
    )
    left_out: Counter[str] = Counter()
    frames: dict[float, StoredFrame] = {}
    for i, line in enumerate(read_text(path / f"{name}.jsonl").splitlines()):
        if not line.strip():
            continue
        where = path / f"{name}.jsonl, line {i + 1}"
        if i >= len(video):
            left_out["no colour image"] += 1
            continue
        frame = _read_frame(where, line, i, video, sizes)
        if frame.stamp in frames:
            left_out["a repeated stamp"] += 1
            continue
        frames[frame.stamp] = (
            frame if depth is None else _with_depth(frame, i, sizes, (depth, confidence))
        )
    return make_capture(path, frames.values(), left_out=left_out)


class _StreamSizes(NamedTuple):
    """Sizes and unit of the streams, of `X.json`."""

    path: Path
    colour: tuple[int, int] | None  # Width and height of the images of the intrinsics [px]
    depth: tuple[int, int] | None
    unit: str

    @classmethod
    def read(cls, path: Path) -> _StreamSizes:
        content = read_json(path)
        streams = content.get("streams") if isinstance(content, dict) else None
        if not isinstance(streams, list) or not all(isinstance(s, dict) for s in streams):
            raise InputError(f"{path}: streams is not a list of objects; record again.")
        by_stream = {str(s.get("file_extension")): _size(path, s) for s in streams}
        unit = content.get("depth_unit", "m")
        if not isinstance(unit, str) or unit not in _UNITS:
            raise InputError(f"{path}: depth_unit is {str(unit)[:40]!r}; it must be 'm' or 'mm'.")
        return cls(path, by_stream.get("mp4"), by_stream.get("depth.zlib"), unit)


def _size(path: Path, stream: dict[str, Any]) -> tuple[int, int] | None:
    if "resolution" not in stream:
        return None
    height, width = read_numbers(path, stream, "resolution", 2)
    if not (0 < width < 1 << 16 and 0 < height < 1 << 16 and width * height <= _MOST_PIXELS):
        raise InputError(
            f"{path}: resolution is {height:g} x {width:g}; it must be a height and a width."
        )
    return int(width), int(height)


def _find_name(path: Path) -> str | None:
    """Return the common name of the files of a recording."""
    held = (p.stem for p in path.glob("*.jsonl") if p.with_suffix(".mp4").is_file())
    return min(held, default=None)


def _stream(path: Path, sizes: _StreamSizes, kind: str) -> DeflateStream | None:
    if not path.is_file():
        return None
    if sizes.depth is None:
        raise InputError(f"{sizes.path}: the stream depth.zlib has no resolution; record again.")
    width, height = sizes.depth
    return DeflateStream(path, width * height * (2 if kind == "depth" else 1))


def _read_frame(
    where: Path, line: str, index: int, video: Video, sizes: _StreamSizes
) -> StoredFrame:
    try:
        content = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where} is not JSON ({error}).") from error
    if not isinstance(content, dict):
        raise InputError(f"{where} must be a JSON object with intrinsics, transform and timestamp.")
    k = read_numbers(where, content, "intrinsics", 9)
    camera = make_camera(
        f"{where}: intrinsics", sizes.colour or video.size, (k[0], k[4], k[6], k[7])
    )
    camera = resize_camera(camera, video.size, video.path)
    turn = np.array(read_numbers(where, content, "transform", 16)).reshape(4, 4).T
    pose = MAP_FROM_Y_UP @ orthonormalize_pose(turn, f"{where}: transform") @ ARKIT_FROM_OPENCV
    images = LazyImages(partial(video.picture, index, camera))
    stamp = read_number(where, content, "timestamp") / 1e9
    return StoredFrame(f"{where}: transform", stamp, pose, camera, images)


def _with_depth(
    frame: StoredFrame,
    index: int,
    sizes: _StreamSizes,
    streams: tuple[DeflateStream, DeflateStream | None],
) -> StoredFrame:
    assert sizes.depth is not None  # noqa: S101  # else there is no stream
    camera = resize_camera(frame.camera, sizes.depth, streams[0].path)
    metres = partial(_read_depth, *streams, index, camera, sizes.unit)
    unit = DepthUnit(f"`depth_unit` in {sizes.path}", _UNITS[sizes.unit][1])
    images = LazyImages(frame.images.colours, metres, unit=unit)
    return StoredFrame(frame.name, frame.stamp, frame.pose, frame.camera, images, camera)


def _read_depth(
    depth: DeflateStream, confidence: DeflateStream | None, index: int, camera: Camera, unit: str
) -> NDArray[np.float32]:
    kind, per_metre = _UNITS[unit]
    shape = camera.height, camera.width
    units = np.frombuffer(depth.read(index), kind).reshape(shape)
    with np.errstate(invalid="ignore"):  # a damaged stream holds any bits
        metres = units.astype(np.float32) / np.float32(per_metre)
    metres[~(np.isfinite(metres) & (metres > 0))] = np.nan
    if confidence is not None:
        metres[np.frombuffer(confidence.read(index), np.uint8).reshape(shape) == 0] = np.nan
    return metres


_READ_SIZE = 1 << 16  # bytes
_CHECKPOINT_INTERVAL = 100  # frames; each checkpoint takes some 50 kB


class _Checkpoint(NamedTuple):
    """State of the decompressor at the beginning of a frame."""

    unpacker: Any  # Decompressor with its unread input
    offset: int  # Offset of the following input in the file


class DeflateStream:
    """Deflate stream of frames of `size` bytes, fastest in order; pickled by its path."""

    def __init__(self, path: Path, size: int) -> None:
        self.path, self.size = path, size
        self._lock = Lock()
        self._checkpoints = {0: _Checkpoint(zlib.decompressobj(-zlib.MAX_WBITS), 0)}
        self._at, self._number = self._checkpoints[0], 0

    def __reduce__(self) -> tuple[type[DeflateStream], tuple[Path, int]]:
        return DeflateStream, (self.path, self.size)

    def read(self, number: int) -> bytes:
        """Return the bytes of a frame; `InputError` where the stream ends before it or is damaged."""
        with self._lock:
            nearest = max(n for n in self._checkpoints if n <= number)
            if not nearest <= self._number <= number:
                self._at, self._number = self._checkpoints[nearest], nearest
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
                packed = unpacker.unconsumed_tail or file.read(_READ_SIZE)
                parts.append(unpacker.decompress(packed, missing))
                missing -= len(parts[-1])
                if unpacker.eof or not (packed or parts[-1]):
                    break
            if missing:
                raise InputError(f"{self.path} ends before frame {number}; copy it again.")
            frame = b"".join(parts)
            self._number += 1
            self._at = _Checkpoint(unpacker.copy(), file.tell())
            if self._number % _CHECKPOINT_INTERVAL == 0:
                self._checkpoints[self._number] = self._at
        return frame
