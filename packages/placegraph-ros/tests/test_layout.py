import json

import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph_lab.worlds.bags import BagWriter
from placegraph_ros.foxglove import layout

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
    from placegraph_ros.pose_messages import estimate_messages
    from placegraph_ros.scene_messages import map_messages

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
