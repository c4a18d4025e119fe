"""Fixtures of readers: a small capture folder, written by hand."""

import functools
import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from placegraph.core.geometry import Camera
from placegraph.io.capture.frame import quarter_turn
from placegraph_lab.worlds.flat.render import Stage
from placegraph_lab.worlds.flat.walks import stroll

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


WIDE = Camera(96, 72, 80.0, 81.0, 49.5, 35.0)


class Recorded:
    """Frames of a walk through a drawn room, as a telephone stores them, to write in any layout.

    Colours say where a pixel's surface is, depth is true to a millimetre. A corner of the depth
    has no reading, another has wrong readings of confidence 0.
    """

    def __init__(self, flat, *, frames=4, turns=0, camera=WIDE, shrink=2, refocus=0.0, seed=3):
        interior = flat.furnish(np.random.default_rng(1))
        walk = stroll(flat, np.random.default_rng(seed), frames=frames, through="123", rate=2.0)
        stage = Stage(interior, np.random.default_rng(0))
        self.caster, self.turns = stage.caster, turns
        low, high = stage.mesh.vertices.min(axis=0), stage.mesh.vertices.max(axis=0)
        self.colour_of = lambda points: np.clip((points - low) / (high - low) * 255, 0, 255)
        upright_from_stored = np.eye(4)
        upright_from_stored[:3, :3] = quarter_turn(turns)
        self.stamps = 100.0 + walk.stamps
        self.poses = walk.map_from_camera @ upright_from_stored
        self.cameras = [
            replace(camera, fx=camera.fx * (1 + refocus * i), fy=camera.fy * (1 + refocus * i))
            for i in range(frames)
        ]
        self.depth_cameras = [
            c.resize(camera.width // shrink, camera.height // shrink) for c in self.cameras
        ]
        self.rgb = [
            self._colours(stage, *view) for view in zip(self.cameras, self.poses, strict=True)
        ]
        views = zip(self.depth_cameras, self.poses, strict=True)
        metres = np.stack([stage.geometry(*view).depth for view in views])
        self.sure = np.full(metres.shape, 2, np.uint8)
        self.sure[:, -9:, -9:] = 0
        metres[:, :6, :6] = 0.0
        metres[:, -9:, -9:] = 7.7
        self.metres = np.nan_to_num(metres)

    def _colours(self, stage, camera, pose):
        depth = stage.geometry(camera, pose).depth
        points = unproject(depth, camera) @ pose[:3, :3].T + pose[:3, 3]
        return np.rint(np.nan_to_num(self.colour_of(points))).astype(np.uint8)

    def __len__(self):
        return len(self.rgb)

    def units(self, i, per_metre=1000):
        return np.rint(self.metres[i] * per_metre).astype(np.uint16)

    def arkit(self, i):
        """Pose of frame i as ARKit has it: y up, the camera's y up and z backward."""
        y_up_from_map = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
        return y_up_from_map @ self.poses[i] @ np.diag([1.0, -1, -1, 1])

    def _align(self, capture, rows, map_from_world):
        """Yield each upright frame with its row of the walk and its pose in the map."""
        rows = range(len(self)) if rows is None else rows
        assert len(capture) == len(rows)
        for frame, row in zip(capture, rows, strict=True):
            assert frame.gravity[1] > 0.8, "upright"
            pose = frame.odometry if map_from_world is None else map_from_world @ frame.odometry
            yield frame, row, pose

    def check(self, capture, rows=None, *, map_from_world=None, sure=True, near=0.006):
        """Check that points of a capture lie on the surface, and colours where they say."""
        for frame, row, pose in self._align(capture, rows, map_from_world):
            np.testing.assert_allclose(frame.gravity, -frame.odometry[2, :3], atol=1e-9)
            depth = frame.depth()
            assert depth.dtype == np.float32
            assert depth.shape == (frame.depth_camera.height, frame.depth_camera.width)
            lost = (self.metres[row] == 0) | (self.sure[row] == 0 if sure else False)
            np.testing.assert_array_equal(np.isnan(depth), np.rot90(lost, self.turns))
            if not sure:
                depth = np.where(np.rot90(self.sure[row] == 0, self.turns), np.nan, depth)
            points = unproject(depth, frame.depth_camera) @ pose[:3, :3].T + pose[:3, 3]
            points = points[np.isfinite(depth)]
            centre = self.poses[row, :3, 3]
            rays = points - centre
            reach = np.linalg.norm(rays, axis=1)
            hits = self.caster.cast(
                np.broadcast_to(centre, rays.shape).astype("f4"),
                (rays / reach[:, None]).astype("f4"),
            )
            off = np.abs(hits.distance - reach)
            assert np.percentile(off, 98) < near, np.percentile(off, [50, 90, 98])
            self._check_colours(frame, points, np.linalg.inv(pose))

    def check_views(self, capture, rows=None, *, map_from_world=None):
        """Check colours of a capture without depth where its poses say that their surfaces are."""
        for frame, row, pose in self._align(capture, rows, map_from_world):
            metres = np.where(self.sure[row] == 0, np.nan, self.metres[row])
            seen = unproject(np.where(metres == 0, np.nan, metres), self.depth_cameras[row])
            points = seen @ self.poses[row, :3, :3].T + self.poses[row, :3, 3]
            points = points[np.isfinite(points).all(axis=2)]
            self._check_colours(frame, points, np.linalg.inv(pose))

    def _check_colours(self, frame, points, camera_from_map):
        image = frame.rgb()
        assert image.shape == (frame.camera.height, frame.camera.width, 3)
        seen = points @ camera_from_map[:3, :3].T + camera_from_map[:3, 3]
        column, row = np.floor(frame.camera.project(seen)).astype(int).T
        inside = (column >= 0) & (column < frame.camera.width)
        inside &= (row >= 0) & (row < frame.camera.height)
        assert inside.mean() > 0.95
        found = image[row[inside], column[inside]].astype(float)
        off = np.abs(found - self.colour_of(points[inside])).max(axis=1)
        assert np.median(off) < 6
        assert np.percentile(off, 80) < 20


def unproject(depth, camera):
    """Points (h, w, 3) [m] in the camera of depth (h, w)."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return camera.directions(np.stack([u + 0.5, v + 0.5], axis=-1)) * np.asarray(depth)[..., None]


@pytest.fixture(scope="session")
def recorded(study):
    """Records a walk: `recorded(turns=1, frames=4, camera=..., shrink=2, refocus=0.0)`; kept."""
    return functools.cache(lambda **options: Recorded(study, **options))


@pytest.fixture
def save():
    """Writes an array as an image, with its folder."""

    def write(path, array, **options):
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(array).save(path, **options)

    return write
