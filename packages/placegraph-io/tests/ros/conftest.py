import numpy as np
import pytest

from placegraph.io.capture.frame import Capture, Frame
from placegraph_lab.worlds.bags import BagWriter, Layout, write_capture


@pytest.fixture
def clip(recorded):
    world = recorded()
    return Capture.from_frames(
        Frame.from_arrays(
            world.rgb[i], world.cameras[i], depth=np.where(world.sure[i], world.metres[i], 0),
            depth_camera=world.depth_cameras[i], odometry=world.poses[i], stamp=world.stamps[i],
        )
        for i in range(len(world))
    )  # fmt: skip


@pytest.fixture
def bag(tmp_path, clip):
    def write(container="mcap", layout=None, *, packed=False, before=None, more=None, name="walk"):
        path = tmp_path / (f"{name}.bag" if container == "rosbag1" else name)
        with BagWriter(path, container, packed=packed) as writer:
            if before:
                before(writer)
            write_capture(writer, clip, layout or Layout())
            if more:
                more(writer)
        return path

    return write
