import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic

from placegraph.errors import OptionError
from placegraph_io.ros.decode import decode, typestore
from placegraph_ros.message import Message, cdr, definition, header, time

NUMBERS = st.floats(allow_nan=False)


def both(message):
    data = cdr(message)
    other = generate_dynamic(message.type, definition(message.type))[message.type](data)
    return decode(data, "", message.type, "cdr"), other


@given(st.lists(NUMBERS, min_size=36, max_size=36), st.lists(NUMBERS, min_size=7, max_size=7))
def test_a_pose_is_read_back_field_by_field(covariance, pose):
    position = dict(zip("xyz", pose[:3], strict=True))
    orientation = dict(zip("xyzw", pose[3:], strict=True))
    fields = {
        "header": header(12.25, "map"),
        "pose": {
            "pose": {"position": position, "orientation": orientation},
            "covariance": np.reshape(covariance, (6, 6)),
        },
    }
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    for read in both(Message("pose", kind, 12.25, fields)):
        assert read.header.frame_id == "map"
        assert (read.header.stamp.sec, read.header.stamp.nanosec) == (12, 250_000_000)
        assert list(read.pose.covariance) == covariance
        at, turned = read.pose.pose.position, read.pose.pose.orientation
        assert [at.x, at.y, at.z, turned.x, turned.y, turned.z, turned.w] == pose


def test_types_that_ros_does_not_bring_are_defined_by_the_file():
    model = {"media_type": "model/gltf-binary", "data": np.arange(5, dtype=np.uint8)}
    fields = {"entities": [{"id": "map", "frame_id": "map", "models": [model]}]}
    for read in both(Message("scene", "foxglove_msgs/msg/SceneUpdate", 0.0, fields)):
        (entity,) = read.entities
        assert bytes(entity.models[0].data) == bytes(range(5))
        assert not entity.models[0].override_color
        assert not entity.cubes
    cloud = {"header": header(1.0, "map"), "particles": [{"weight": 0.25}, {"weight": 0.75}]}
    for read in both(Message("cloud", "nav2_msgs/msg/ParticleCloud", 1.0, cloud)):
        assert [p.weight for p in read.particles] == [0.25, 0.75]
        assert read.particles[0].pose.position.x == 0.0


def test_foxglove_knows_the_same_fields():
    messages = pytest.importorskip("foxglove.messages")
    protobuf = pytest.importorskip("google.protobuf.descriptor_pb2")
    files = protobuf.FileDescriptorSet.FromString(messages.SceneUpdate.get_schema().data)
    kinds = [kind for file in files.file for kind in file.message_type]
    ours = typestore("cdr").fielddefs
    known = {k.name: k for k in kinds if f"foxglove_msgs/msg/{k.name}" in ours}
    assert len(known) == 13
    for name, kind in known.items():
        told = [field for field, _ in ours[f"foxglove_msgs/msg/{name}"][1]]
        assert told == [field.name for field in kind.field]


@pytest.mark.parametrize(
    ("kind", "fields", "said"),
    [
        ("geometry_msgs/msg/Poze", {}, "Poze"),
        ("geometry_msgs/msg/Point", {"x": 1.0, "w": 1.0}, "has no w"),
        (
            "geometry_msgs/msg/Point",
            {"x": "east"},
            "does not fit the definition of geometry_msgs/msg/Point",
        ),
    ],
)
def test_what_a_definition_does_not_know_is_named(kind, fields, said):
    with pytest.raises(OptionError, match=said):
        cdr(Message("here", kind, 0.0, fields))


@pytest.mark.parametrize("stamp", [float("nan"), 1e10, -float("inf")])
def test_stamps_that_ros_cannot_say_are_refused(stamp):
    with pytest.raises(OptionError, match="stamp"):
        time(stamp)


@given(st.integers(0, 2**31 - 2), st.integers(0, 10**6 - 1))
def test_stamps_are_kept_to_a_microsecond(seconds, micros):
    told = time(seconds + micros * 1e-6)
    assert abs(told["sec"] * 10**9 + told["nanosec"] - seconds * 10**9 - micros * 1000) < 1000
    assert 0 <= told["nanosec"] < 10**9
