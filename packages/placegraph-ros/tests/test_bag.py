import sqlite3

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from placegraph.core.geometry import Camera
from placegraph.errors import MapError, MapLockedError, OptionError
from placegraph.io.capture.frame import Frame
from placegraph.io.mesh.gltf import read_glb
from placegraph_io.ros.containers import open_bag
from placegraph_ros.bag import BagWriter
from placegraph_ros.message import Message
from placegraph_ros.pose_messages import estimate_messages, rig_message
from placegraph_ros.scene_messages import image_messages, map_messages

HEAD = {"header": {"stamp": {"sec": 3}, "frame_id": "here"}}
EMPTY = Message("empty", "std_msgs/msg/Header", 3.0, HEAD["header"])


@pytest.fixture
def everything(estimate, scene):
    camera = Camera(8, 6, 8.0, 8.0, 4.0, 3.0, (0.1, 0.0, 0.0, 0.0))
    frame = Frame.from_arrays(np.full((6, 8, 3), 90, np.uint8), camera, stamp=0.0)
    said = estimate_messages(estimate(), 2.5, map_from_odom=np.eye(4))
    maps = [*map_messages(scene, 2.0), rig_message(None, 2.0)]
    return [*maps, *image_messages(frame, 2.25), *said]


def agrees(read, fields):
    for name in read.__slots__ if hasattr(read, "__slots__") else vars(read):
        if name.startswith("_") or name.isupper():  # a constant
            continue
        value, said = getattr(read, name), fields.get(name)
        array = isinstance(value, (list, tuple, np.ndarray))
        if array and len(value) and not np.isscalar(value[0]):
            assert len(value) == len(said)
            for one, other in zip(value, said, strict=True):
                agrees(one, other)
        elif isinstance(value, (list, tuple, bytes, np.ndarray)):
            flat = np.asarray(list(value), float).ravel()
            wanted = np.zeros(len(flat)) if said is None else np.asarray(said, float).ravel()
            np.testing.assert_array_equal(flat, wanted, name)
        elif isinstance(value, (bool, int, float, str, np.generic)):
            if isinstance(said, float) and said != value:
                said = float(np.float32(said))  # of colours
            assert value == (said if said is not None else type(value)()), name
        else:
            agrees(value, said or {})
    return True


def by_rosbags(path):
    with AnyReader([path]) as reader:
        for connection, at, raw in reader.messages():
            yield connection.topic, at, reader.deserialize(raw, connection.msgtype)


def by_mcap(path):
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, read in reader.iter_decoded_messages(log_time_order=False):
            yield channel.topic, message.log_time, read


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    ("name", "readers"),
    [
        ("out.mcap", (by_rosbags, by_mcap)), ("out", (by_rosbags,)), ("out.bag", (by_rosbags,)),
        ("sqlite3", (by_rosbags,)),
    ],
)  # fmt: skip
def test_what_is_written_is_read_back_field_by_field(tmp_path, everything, name, readers, packed):
    path = tmp_path / name
    with BagWriter(path, "sqlite3" if name == "sqlite3" else None, packed=packed) as bag:
        for message in everything:
            bag.write(message)
    assert [p.name for p in tmp_path.iterdir()] == [name]
    for reader in readers:
        found = list(reader(path))
        assert len(found) == len(everything)
        assert {topic for topic, *_ in found} == {f"/{m.topic}" for m in everything}
        for message in everything:
            ((at, read),) = [rest for topic, *rest in found if topic == f"/{message.topic}"]
            assert at == round(message.stamp * 1e9)
            assert agrees(read, message.fields)


def test_a_database_is_a_bag_too_and_what_is_cached_for_later_says_so(tmp_path, everything):
    for name in ("out.db3", "out.mcap"):
        with BagWriter(tmp_path / name) as bag:
            for message in everything:
                bag.write(message)
    assert set(open_bag(tmp_path / "out.db3").topics) == {f"/{m.topic}" for m in everything}
    with AnyReader([tmp_path / "out.mcap"]) as reader:
        kept = {
            c.topic
            for c in reader.connections
            if any(q.durability.name == "TRANSIENT_LOCAL" for q in c.ext.offered_qos_profiles)
        }
    assert kept == {f"/{m.topic}" for m in everything if m.latched}
    assert "/localization/map" in kept


def test_the_model_in_the_bag_is_the_map(tmp_path, everything, scene):
    (message,) = [m for m in everything if m.topic == "localization/scene"]
    (tmp_path / "map.glb").write_bytes(message.fields["entities"][0]["models"][0]["data"].tobytes())
    model = read_glb(tmp_path / "map.glb")
    assert [thing.label for thing in model.objects] == ["table", "lamp"]
    (markers,) = [m.fields["markers"] for m in everything if m.topic == "localization/map"]
    for row, marker in enumerate(markers):
        drawn = np.array([[*point.values()] for point in marker["points"]])
        for corners in (model.vertices[model.triangles[model.object_of == row]], drawn):
            box = [corners.reshape(-1, 3).min(axis=0), corners.reshape(-1, 3).max(axis=0)]
            np.testing.assert_allclose(box, scene.mesh.object_bounds(2)[row], atol=1e-6)


def test_a_map_of_many_triangles_is_shown_by_boxes(scene, monkeypatch):
    monkeypatch.setattr("placegraph_ros.scene_messages.MAX_TRIANGLES", 1)
    markers = map_messages(scene, 1.0)[0].fields["markers"]
    boxes = scene.mesh.object_bounds(2)
    for marker, (low, high) in zip(markers, boxes, strict=True):
        center, size = marker["pose"]["position"].values(), marker["scale"].values()
        np.testing.assert_allclose([*center], (low + high) / 2, atol=1e-6)
        np.testing.assert_allclose([*size], high - low, atol=1e-6)


def test_a_half_written_bag_never_has_its_name(tmp_path):
    with pytest.raises(KeyboardInterrupt), BagWriter(tmp_path / "out.mcap") as bag:  # noqa: PT012
        bag.write(EMPTY)
        assert not (tmp_path / "out.mcap").exists()
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "error", [OSError(28, "no space"), sqlite3.OperationalError("disk is full")]
)
def test_a_full_disk(tmp_path, monkeypatch, error):
    def full(*_):
        raise error

    with pytest.raises(MapError, match=r"out cannot be written: .*(space|full)"):  # noqa: PT012, SIM117
        with BagWriter(tmp_path / "out") as bag:
            monkeypatch.setattr("rosbags.rosbag2.Writer.write", full)
            bag.write(EMPTY)
    assert list(tmp_path.iterdir()) == []


def test_what_is_there_is_never_written_over(tmp_path):
    (tmp_path / "walk.mcap").write_text("mine")
    with pytest.raises(OptionError, match=r"walk\.mcap already exists"):
        BagWriter(tmp_path / "walk.mcap")
    with pytest.raises(OptionError, match="already exists"), BagWriter(tmp_path / "b.mcap") as bag:  # noqa: PT012
        bag.write(EMPTY)
        (tmp_path / "b.mcap").write_text("another's")  # made while this one was written
    assert (tmp_path / "b.mcap").read_text() == "another's"
    with BagWriter(tmp_path / "c.mcap") as bag:  # a second writer is refused at once
        with pytest.raises(MapLockedError, match="by another process"), BagWriter(bag.path):
            pass
        bag.write(EMPTY)
    assert {p.name for p in tmp_path.iterdir()} == {"walk.mcap", "b.mcap", "c.mcap"}


def test_where_nothing_can_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(MapError, match="cannot be written"), BagWriter(tmp_path / "file/out.mcap"):
        pass
    with pytest.raises(OptionError, match="not open"):
        BagWriter(tmp_path / "out.mcap").write(EMPTY)
