import json
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from websockets.sync.client import connect

from placegraph.core.geometry import Camera
from placegraph.errors import OptionError, ServiceError
from placegraph_io.ros.decode import typestore
from placegraph_lab.worlds.bags import BagWriter
from placegraph_ros.foxglove import FoxgloveServer, _ViewerListener, layout
from placegraph_ros.message import Message, cdr
from placegraph_ros.pose_messages import estimate_messages
from placegraph_ros.scene_messages import map_messages
from placegraph_ros.sources import PlaybackClock

foxglove = pytest.importorskip("foxglove")
KIND = "std_msgs/msg/String"


def receive_messages(client, wanted):
    channels, out = {}, []
    while len(out) < wanted:
        said = client.recv(timeout=20)
        if isinstance(said, bytes):
            (number,) = struct.unpack_from("<I", said, 1)
            out.append((channels[number], said[13:]))
            continue
        content = json.loads(said)
        for channel in content.get("channels", ()) if content["op"] == "advertise" else ():
            assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
            channels[channel["id"]] = channel["topic"]
            subscriptions = [{"id": channel["id"], "channelId": channel["id"]}]
            client.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
    return out


def test_what_is_latched_is_told_to_whoever_comes_and_the_rest_as_it_comes():
    with FoxgloveServer("ws://127.0.0.1:0") as server:
        kept = Message("localization/status", KIND, 5.0, {"data": "kept"}, latched=True)
        server.write(kept)
        server.write(Message("localization/other", KIND, 5.0, {"data": "gone"}))
        for _ in range(2):
            with connect(server.address, subprotocols=["foxglove.sdk.v1"]) as client:
                ((topic, data),) = receive_messages(client, 1)
        assert (topic, data) == ("/localization/status", cdr(kept))
        assert typestore("cdr").deserialize_cdr(data, KIND).data == "kept"


def test_its_buttons_pause_and_change_the_speed():
    from foxglove.websocket import PlaybackCommand, PlaybackStatus

    pace = PlaybackClock()
    pace.now = 12.0
    listener = _ViewerListener(SimpleNamespace(), (pace, (10.0, 20.0)))
    asked = SimpleNamespace(
        playback_command=PlaybackCommand.Pause, playback_speed=3.0, seek_time=None, request_id="7"
    )
    state = listener.on_playback_control_request(asked)
    assert (pace.paused, pace.speed) == (True, 3.0)
    assert state.status == PlaybackStatus.Paused
    assert (state.current_time, state.request_id) == (12_000_000_000, "7")
    asked.playback_command, asked.playback_speed = PlaybackCommand.Play, 0.0
    assert listener.on_playback_control_request(asked).playback_speed == 3.0
    assert not pace.paused
    with FoxgloveServer("ws://127.0.0.1:0", pace, (10.0, 20.0)) as server:
        with connect(server.address, subprotocols=["foxglove.sdk.v1"]) as client:
            info = json.loads(client.recv(timeout=20))
        assert "playbackControl" in info["capabilities"]
        with pytest.raises(ServiceError, match="cannot listen at"):
            FoxgloveServer(server.address)


@pytest.mark.parametrize("address", ["8765", "http://localhost", "ws://host:99999", "ws://a:b"])
def test_addresses_that_are_none(address):
    with pytest.raises(OptionError, match="is not a valid address"):
        FoxgloveServer(address)


PANELS = {  # in a layout's file, and in Foxglove's SDK
    "3D": "ThreeDeeConfig", "Image": "ImageConfig", "Indicator": "IndicatorConfig",
    "DiagnosticStatusPanel": "DiagnosticsDetailConfig", "Plot": "PlotConfig",
    "StateTransitions": "StateTransitionsConfig",
}  # fmt: skip


def leaves(tree):
    return leaves(tree["first"]) + leaves(tree["second"]) if isinstance(tree, dict) else [tree]


def test_every_setting_is_one_that_foxglove_knows():
    layouts = pytest.importorskip("foxglove.layouts")
    given = layout()
    assert sorted(leaves(given["layout"])) == sorted(given["configById"])
    for name, settings in given["configById"].items():
        kind = getattr(layouts, PANELS[name.partition("!")[0]])
        assert settings.keys() <= kind()._to_dict().keys()
    panel = given["configById"]["3D!placegraph"]
    assert panel["cameraState"].keys() <= layouts.ThreeDeeCameraState()._to_dict().keys()


def test_every_topic_is_one_that_is_written(estimate, scene):

    written = [*map_messages(scene, 1.0), *estimate_messages(estimate(), 1.0)]
    topics = {f"/{message.topic}" for message in written}
    configs = layout()["configById"]
    assert configs["3D!placegraph"]["topics"].keys() <= topics
    for panel in ("Plot!placegraph", "StateTransitions!placegraph"):
        for path in configs[panel]["paths"]:
            assert path["value"].partition(".")[0] in topics


def test_beside_the_bag_with_its_own_images(tmp_path, run):
    with BagWriter(tmp_path / "walk.mcap") as writer:
        writer.image("/cam/image_raw", 1.0, np.zeros((4, 6, 3), np.uint8), "rgb8")
        writer.info("/cam/camera_info", 1.0, Camera(6, 4, 6.0, 6.0, 3.0, 2.0))
    result = run("bag", "layout", tmp_path / "walk.mcap")
    assert result.out == f"wrote {tmp_path / 'walk.mcap.layout.json'}\n"
    written = json.loads((tmp_path / "walk.mcap.layout.json").read_text())
    shown = written["configById"]["Image!placegraph"]["imageMode"]
    assert shown == {"imageTopic": "/cam/image_raw", "calibrationTopic": "/cam/camera_info"}
