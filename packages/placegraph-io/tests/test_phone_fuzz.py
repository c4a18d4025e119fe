"""Flipped, cut and repeated bytes of telephones' recordings end in frames or in one kind of error."""

import contextlib
import importlib

import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.errors import PlacegraphError
from placegraph.io.capture.capture import open_capture
from placegraph.io.capture.tum import write_tum

pytest.importorskip("tests.io.video", reason="needs OpenCV")
LARGE = Camera(192, 144, 160.0, 161.0, 97.5, 71.0)
FLIPS = 40


def video_folder(path, world):
    writer = importlib.import_module("tests.io.capture.test_video")
    writer.write(path, world, start=0.5, body_from_camera=np.eye(4).tolist())
    write_tum(path / "odometry.tum", world.stamps, world.poses)


def multiscan(path, world):
    importlib.import_module("dataset.test_multiscan").write(path, world)


def ios_logger(path, world):
    importlib.import_module("test_phone").write_ios_logger(path, world)


def mutated(data, rng):
    bad = bytearray(data)
    for _ in range(int(rng.integers(1, 6))):
        if bad:
            at = int(rng.integers(len(bad)))
            kind = int(rng.integers(4))
            if kind == 0:
                bad[at] ^= 1 << int(rng.integers(8))
            elif kind == 1:
                del bad[at : at + int(rng.integers(1, 40))]
            elif kind == 2:
                bad[at:at] = bad[: int(rng.integers(1, 40))]
            else:
                bad[at:at] = rng.choice([b"nan", b"1e999", b"-", b"[", b"null", b",", b"9" * 400])
    return bytes(bad)


@pytest.mark.parametrize(
    "write",
    [multiscan, ios_logger, video_folder],
)
def test_nothing_else_is_raised(write, recorded, tmp_path):
    write(tmp_path, recorded(camera=LARGE, shrink=4))
    rng = np.random.default_rng(0)
    files = [p for p in sorted(tmp_path.iterdir()) if p.suffix not in {".mp4", ".mov", ".m4v"}]
    for _ in range(FLIPS):
        file = files[int(rng.integers(len(files)))]
        good = file.read_bytes()
        file.write_bytes(mutated(good, rng))
        with contextlib.suppress(PlacegraphError):
            frame = open_capture(tmp_path)[-1]
            frame.rgb(), frame.depth()
        file.write_bytes(good)
