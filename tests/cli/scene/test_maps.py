"""Every command refuses what is no map, and what is no capture."""

import pytest
from tests.cli.failing import fails

POSE = ("--pose", "1,2,1.5,0")
COMMANDS = {"localize": (), "refine": POSE, "render": (*POSE, "-o", "out", "--capture")}
"""What stands between the map and the capture."""


@pytest.mark.parametrize("command", COMMANDS)
def test_what_is_no_map_or_no_capture(run, room, tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    damaged = tmp_path / "damaged.scene"
    damaged.write_bytes(room.map.read_bytes()[:-50])
    for map_, walk, code, word, lines in (
        (tmp_path / "no.scene", room.walk, 3, "no.scene", 1),
        (room.walk / "odometry.tum", room.walk, 4, "odometry.tum", 1),
        (damaged, room.walk, 4, "damaged.scene", 1),
        (room.map, tmp_path / "nowhere", 3, "nowhere", 1),
        (room.map, tmp_path, 3, tmp_path.name, 3),
    ):
        fails(run("scene", command, map_, *COMMANDS[command], walk), code, word, lines=lines)
