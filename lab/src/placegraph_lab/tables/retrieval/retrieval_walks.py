"""Walks of the retrieval benchmark: filmed in homes, kept on disk, decoded when asked for."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from placegraph.core.geometry import Camera
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.interior import Interior
from placegraph_lab.worlds.home.catalogue import SYNONYMS
from placegraph_lab.worlds.home.home import changed, record, visit

RENDERING = (
    "placegraph/geometry.py",
    "placegraph_lab/worlds/**/*.py",
    "placegraph_lab/tables/retrieval/retrieval_walks.py",
)
"""Code that decides what homes and walks are."""
LENGTH = 50
"""Frames of a walk through a home."""
RATE = 5.0
"""Frames a second."""
QUALITY = 92
"""Of the JPEG images, as in capture folders."""
_NOTHING = 255  # in label images


def filmed(flat: Flat, interior: Interior, seed: int, *, later: bool) -> Capture:
    """Walk through a home at any time of the day."""
    rng = np.random.default_rng([seed, 1 + later])
    state = changed(interior, rng) if later else interior
    walk = visit(flat, state, rng, frames=LENGTH, rate=RATE)
    daylight = float(rng.uniform())
    return record(state, walk, rng, daylight=daylight, words=said(state))


def said(interior: Interior) -> dict[str, str]:
    """What labels are called by who labels images: the plain word, where it is the only one.

    Maps of homes call things by synonyms: a network that says "sofa" sees what a map has as "couch".
    """
    plain: dict[str, set[str]] = {}
    for word, others in SYNONYMS.items():
        for other in others:
            plain.setdefault(other, set()).add(word)
    labels = {thing.label for thing in interior.things}
    return {label: min(plain[label]) for label in labels if len(plain.get(label, ())) == 1}


def kept(path: Path, made: Callable[[], Capture]) -> Capture:
    """Capture that a file holds; it is made and written first, if there is no file."""
    if not path.exists():
        write(path, made())
    return read(path)


def write(path: Path, capture: Capture) -> None:
    """Write colours and labels of a capture of up to 254 labels, odometry and gravity."""
    blobs = [_jpeg(frame.rgb()) for frame in capture]
    labels = [ids for frame in capture if (ids := frame.labels()) is not None]
    content = {
        "camera": capture.camera.to_dict(),
        "label_camera": capture.label_camera.to_dict() if capture.label_camera else None,
        "label_names": {str(k): v for k, v in capture.label_names.items()},
    }
    part = path.with_suffix(".part")
    path.parent.mkdir(parents=True, exist_ok=True)
    with part.open("wb") as file:
        np.savez_compressed(
            file,
            content=np.frombuffer(json.dumps(content).encode(), np.uint8),
            images=np.frombuffer(b"".join(blobs), np.uint8),
            ends=np.cumsum([len(blob) for blob in blobs]),
            labels=np.where((ids := np.array(labels)) < 0, _NOTHING, ids).astype(np.uint8),
            stamps=capture.stamps,
            odometry=capture.odometry,
            gravity=capture.gravity,
        )
    part.replace(path)


def read(path: Path) -> Capture:
    """Capture that `write` wrote."""
    with np.load(path) as file:
        held = {name: file[name] for name in file.files}
    content = json.loads(held["content"].tobytes())
    camera = Camera(**content["camera"])
    other = content["label_camera"]
    names = {int(k): v for k, v in content["label_names"].items()}
    starts = np.concatenate([[0], held["ends"][:-1]])
    frames = [
        Frame(
            index=i,
            stamp=float(held["stamps"][i]),
            odometry=held["odometry"][i],
            gravity=held["gravity"][i],
            camera=camera,
            depth_camera=None,
            label_camera=Camera(**other) if other else None,
            label_kind="labels" if other else None,
            label_names=names,
            images=_Kept(held["images"][start:end].tobytes(), held["labels"][i] if other else None),
        )
        for i, (start, end) in enumerate(zip(starts, held["ends"], strict=True))
    ]
    return Capture.from_frames(frames)


@dataclass(frozen=True, slots=True, eq=False)
class _Kept:
    """Images of one frame."""

    blob: bytes
    ids: NDArray[np.uint8] | None

    def rgb(self) -> NDArray[np.uint8]:
        """As `Frame.rgb`."""
        return np.asarray(Image.open(io.BytesIO(self.blob)))

    def depth(self) -> NDArray[np.float32] | None:
        """As `Frame.depth`."""
        return None

    def labels(self) -> NDArray[np.int32] | None:
        """As `Frame.labels`."""
        if self.ids is None:
            return None
        return np.where(self.ids == _NOTHING, -1, self.ids.astype(np.int32))


def _jpeg(colours: NDArray[np.uint8]) -> bytes:
    encoded = io.BytesIO()
    Image.fromarray(colours).save(encoded, "JPEG", quality=QUALITY)
    return encoded.getvalue()
