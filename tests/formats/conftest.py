"""Fixtures of readers: a small capture folder, written by hand."""

import json

import numpy as np
import pytest
from PIL import Image

POSE = "{} {} 0 1.6 0.5 -0.5 0.5 -0.5\n"  # upright, looking along x of a level odometry


CAMERA = {
    "width": 8, "height": 6, "fx": 10.0, "fy": 11.0, "cx": 4.0, "cy": 3.0,
    "depth": {"width": 4, "height": 3, "fx": 5.0, "fy": 5.5, "cx": 2.0, "cy": 1.5, "scale": 1000},
    "instances_offset": 1,
}  # fmt: skip


class CaptureFolder:
    """Three frames of 8 x 6 with depth and instances of 4 x 3; tests spoil what they like."""

    def __init__(self, path, frames=3):
        self.path = path
        self.camera = CAMERA
        self.frames = frames
        rng = np.random.default_rng(0)
        self.rgb = rng.integers(0, 256, (frames, 6, 8, 3)).astype(np.uint8)
        self.depth = rng.integers(0, 5000, (frames, 3, 4)).astype(np.uint16)
        self.depth[:, 0, 0] = 0
        self.instances = rng.integers(0, 5, (frames, 3, 4)).astype(np.uint8)
        self.instances[:, 0, 0] = 0
        self.json("camera.json", self.camera)
        for i in range(frames):
            self.image(f"rgb/{i:06d}.png", self.rgb[i])
            self.image(f"depth/{i:06d}.png", self.depth[i])
            self.image(f"instances/{i:06d}.png", self.instances[i])
        self.text("odometry.tum", "".join(POSE.format(i * 0.2, i * 0.1) for i in range(frames)))

    def image(self, name, array, **options):
        path = self.path / name
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(array).save(path, **options)
        return path

    def json(self, name, content):
        return self.text(name, json.dumps(content))

    def text(self, name, text):
        path = self.path / name
        path.write_text(text, encoding="utf-8")
        return path

    def remove(self, name):
        path = self.path / name
        if path.is_dir():
            for file in path.iterdir():
                file.unlink()
            path.rmdir()
        else:
            path.unlink()


@pytest.fixture
def folder(tmp_path):
    return CaptureFolder(tmp_path)


@pytest.fixture
def new_folder(tmp_path_factory):
    """Makes further capture folders."""
    return lambda **options: CaptureFolder(tmp_path_factory.mktemp("capture"), **options)
