"""Scenes to be lost in: drawn in ASCII, furnished, written as GLB and built as any other."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import strategies as st
from tests.indoor.mapping.parts import cuboid

from placegraph.core.geometry import Camera
from placegraph.core.threads import limit_threads
from placegraph.indoor.build import build_scene
from placegraph.indoor.likelihood.observe import observe_frame, views
from placegraph.indoor.likelihood.score import model_of
from placegraph.io.capture.capture import Capture, open_capture
from placegraph.io.capture.frame import Frame
from placegraph.io.capture.tum import read_tum
from placegraph.io.mesh.model import Model, ModelObject, Texture
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.walks import stroll, write_walk

ROOM = """
[flat]
name = Room
height = 2.6
[drawing]
########====########
#SSS         pp  BB#
#SSS             BB#
#SSS  tt      1  BB#
#SSS  tt         BB#
#SSS             BB#
#                  #
#LL  3             #
#LL       hhTTT  2 +
#         hhTTT    +
#           TTT    +
#CCCCCC            #
#CCCCCC    pp      #
####################
[legend]
1 room: label=study walls=wallpaper palegoldenrod floor=parquet sienna
2 spot:
3 spot:
S sofa: look=fabric darkred trim=fabric firebrick
B shelf: label=bookcase height=2.1
t roundtable: label=side table height=0.45
T table: label=desk look=wood burlywood
h chair: faces=T look=plain teal trim=plain darkslategrey
C cabinet: label=sideboard height=0.8 look=wood peru
L lamp:
p picture:
"""
SMALL = Camera(160, 90, 115.0, 115.0, 80.0, 45.0)


def view_frames(scene, frames, options, encoder=None, stride=10.0):
    """Views of frames, against what is seen of the scene on average."""
    background = scene.visibility(options).background
    observed = [observe_frame(frame, encoder, options) for frame in frames]
    return views(observed, stride, model_of(options.likelihood), background)


def rebuild_frame(frame, **change):
    """The frame in memory, with other values of some fields."""
    fields = {
        "rgb": frame.rgb(), "camera": frame.camera, "depth": frame.depth(), "labels": frame.labels(),
        "depth_camera": frame.depth_camera, "label_camera": frame.label_camera,
        "label_kind": frame.label_kind or "labels", "gravity": frame.gravity,
        "odometry": frame.odometry, "stamp": frame.stamp, "index": frame.index,
    }  # fmt: skip
    return Frame.from_arrays(**fields | change)


def rebuild(capture, **change):
    """The capture in memory; `change` maps fields to functions of a frame."""
    return Capture.from_frames(
        [rebuild_frame(f, **{k: make(f) for k, make in change.items()}) for f in capture]
    )


def measure_error(pose, truth):
    """Distance [m] and turn [deg] between two poses (4, 4)."""
    delta = np.linalg.inv(truth) @ pose
    turn = np.arccos(np.clip((np.trace(delta[:3, :3]) - 1) / 2, -1, 1))
    return float(np.linalg.norm(delta[:3, 3])), float(np.degrees(turn))


def damage(data, whole):
    """Bytes with up to three of them changed, perhaps cut, as Hypothesis draws it."""
    damaged = bytearray(whole)
    for _ in range(data.draw(st.integers(0, 3))):
        damaged[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    return bytes(damaged[: data.draw(st.integers(0, len(whole)) | st.just(len(whole)))])


def _world(folder, drawing, seed):
    interior = drawing.furnish(np.random.default_rng(seed))
    interior.write_glb(folder / "flat.glb")
    # as it was drawn: these tests are of localizing, not of what a smaller map loses
    scene = build_scene(folder / "flat.glb", folder / "flat.scene", detail="full")
    return SimpleNamespace(drawing=drawing, interior=interior, scene=scene, folder=folder)


def _render(
    world, name, seed, *, through="", frames=10, height=1.6, interior=None, camera=SMALL, **options
):
    rng = np.random.default_rng(seed)
    walk = stroll(world.drawing, rng, frames=frames, through=through, height=height)
    folder = world.folder / name
    write_walk(interior or world.interior, walk, folder, rng, camera=camera, **options)
    return open_capture(folder)


@pytest.fixture(scope="session")
def room_world(tmp_path_factory):
    return _world(tmp_path_factory.mktemp("room"), Flat.parse(ROOM), 1)


@pytest.fixture(scope="session")
def flat_world(tmp_path_factory):
    return _world(tmp_path_factory.mktemp("flat"), Flat.load("altbau"), 1)


@pytest.fixture(scope="session")
def room(room_world):
    return room_world.scene


@pytest.fixture(scope="session")
def flat(flat_world):
    return flat_world.scene


@pytest.fixture(scope="session")
def render():
    return _render


@pytest.fixture(scope="session")
def walk(room_world):
    return _render(room_world, "walk", 2, through="123")


@pytest.fixture(scope="session")
def flat_walk(flat_world):
    return _render(flat_world, "walk", 2, through="12")


@pytest.fixture(scope="session")
def house(shared, tmp_path_factory):
    """The shared house as a scene map, its file, and what it was built of."""
    source = shared / "data/house/map/house.glb"
    path = tmp_path_factory.mktemp("house") / "house.scene"
    return SimpleNamespace(scene=build_scene(source, path), path=path, source=source)


@pytest.fixture(scope="module")
def one_thread():
    with limit_threads(1):
        yield


@pytest.fixture(scope="session")
def truth():
    def read(capture):
        poses = read_tum(capture.path / "trajectory.tum").poses
        return poses[[frame.index for frame in capture]]

    return read


def _model(boxes, **columns):
    parts = [cuboid(*box) for box in boxes.values()]
    things = tuple(ModelObject(str(i), label, f"{label}_{i}") for i, label in enumerate(boxes))
    model = Model(
        path=Path("drawn.glb"),
        objects=things,
        vertices=np.concatenate([np.zeros((0, 3)), *(v for v, _ in parts)]),
        triangles=np.concatenate(
            [np.zeros((0, 3), int), *(t + 8 * i for i, (_, t) in enumerate(parts))]
        ),
        object_of=np.repeat(np.arange(len(parts)), 12),
        colours=np.full((8 * len(parts), 3), 255, np.uint8),
        uv=np.zeros((8 * len(parts), 2)),
        picture_of=np.zeros(12 * len(parts), int),
        pictures=(Texture(None, (0.2140411, 1.0, 0.0)),),
    )
    return replace(model, **columns)


@pytest.fixture(scope="session")
def boxes():
    return _model
