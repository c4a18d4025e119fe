from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.estimate import Status
from placegraph.errors import MapError, OptionError
from placegraph.indoor.library import make_library

pytestmark = pytest.mark.usefixtures("one_thread")


def test_a_lift(rooms, by_labels):
    live = by_labels.live(background=False)
    onto, stamp, scenes = np.eye(4), 0.0, []
    for name, seed in (("study", 21), ("bedroom", 5)):
        film, walk = rooms[name].film(seed, 8, depth=True), rooms[name].walk(seed, 8)
        onto = onto @ np.linalg.inv(film[0].odometry)
        seen = []
        for frame, true in zip(film, walk.map_from_camera, strict=True):
            pose = live.step(replace(frame, odometry=onto @ frame.odometry, stamp=stamp))
            stamp += 0.2
            near = False
            if pose.status is Status.OK and pose.scene == name:
                near = np.linalg.norm(pose.map_from_camera[:3, 3] - true[:3, 3]) < 0.3
            # of another map it is never OK, but for a frame or two that nothing contradicts yet
            seen.append((pose.status is Status.OK, near))
        onto = onto @ film[-1].odometry
        scenes.append(pose.scene)
        assert seen[-1] == (True, True)
        assert sum(ok and not near for ok, near in seen) <= 2
    assert scenes == ["study", "bedroom"]


def test_a_saved_pose_knows_its_map(rooms, by_labels, tmp_path):
    film = rooms["bedroom"].film(5, 8, depth=True)
    live = by_labels.live(background=False)
    for frame in film[:6]:
        pose = live.step(frame)
    live.save(tmp_path / "robot.track")
    again = type(live).load(tmp_path / "robot.track", by_labels, background=False)
    assert again.pose().scene == pose.scene == "bedroom"
    again.step(film[6])
    assert again.step(film[7]).status is Status.OK
    other = make_library({"study": rooms["study"].scene}, encoders="labels")
    with pytest.raises(MapError, match="bedroom"):
        type(live).load(tmp_path / "robot.track", other)
    with pytest.raises(OptionError, match=r"choose one of parlour, study, bedroom\."):
        by_labels.live(background=False).place(np.eye(4), np.eye(6))
