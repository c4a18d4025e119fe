"""Fixtures of readers: a small capture folder, written by hand."""

import json
import struct

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


class Glb:
    """A glTF binary written piece by piece; every `add` returns the row of what it added."""

    def __init__(self, path):
        self.path = path
        self.json = {"asset": {"version": "2.0"}, "buffers": [{}]}
        self.bytes = bytearray()

    def add(self, kind, entry):
        self.json.setdefault(kind, []).append(entry)
        return len(self.json[kind]) - 1

    def view(self, data, **entry):
        self.bytes += b"\0" * (-len(self.bytes) % 4)
        entry |= {"buffer": 0, "byteOffset": len(self.bytes), "byteLength": len(data)}
        self.bytes += data
        return self.add("bufferViews", entry)

    def accessor(self, values, dtype="<f4", **entry):
        array = np.asarray(values, dtype)
        codes = {"<f4": 5126, "<u1": 5121, "<u2": 5123, "<u4": 5125, "<i1": 5120, "<i2": 5122}
        width = 1 if array.ndim == 1 else array.shape[1]
        return self.add("accessors", {
            "bufferView": self.view(array.tobytes()), "componentType": codes[dtype],
            "count": len(array), "type": ["SCALAR", "VEC2", "VEC3", "VEC4"][width - 1], **entry,
        })  # fmt: skip

    def primitive(self, points, indices=None, dtype="<u2", **entry):
        """Primitive of points (V, 3); indices are one row of numbers."""
        primitive = {"attributes": {"POSITION": self.accessor(points)}, **entry}
        if indices is not None:
            primitive["indices"] = self.accessor(indices, dtype)
        return primitive

    def node(self, *primitives, **entry):
        if primitives:
            entry["mesh"] = self.add("meshes", {"primitives": list(primitives)})
        return self.add("nodes", entry)

    def texture(self, data, sampler=None):
        texture = {"source": self.add("images", {"bufferView": self.view(data)})}
        if sampler:
            texture["sampler"] = self.add("samplers", sampler)
        return self.add("textures", texture)

    def material(self, factor=None, texture=None, **info):
        base = {"baseColorFactor": factor} if factor else {}
        if texture is not None:
            base["baseColorTexture"] = {"index": texture, **info}
        return self.add("materials", {"pbrMetallicRoughness": base})

    def write(self):
        if self.json["buffers"] == [{}]:
            self.json["buffers"] = [{"byteLength": len(self.bytes)}]
        text = json.dumps(self.json).encode()
        text += b" " * (-len(text) % 4)
        data = bytes(self.bytes) + b"\0" * (-len(self.bytes) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
        chunks += struct.pack("<II", len(data), 0x004E4942) + data
        self.path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return self.path


@pytest.fixture
def glb(tmp_path):
    return Glb(tmp_path / "a.glb")


@pytest.fixture
def new_glb(tmp_path_factory):
    """Makes further writers."""
    return lambda: Glb(tmp_path_factory.mktemp("glb") / "a.glb")
