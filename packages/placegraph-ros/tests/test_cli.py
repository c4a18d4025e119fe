import json
import os
import signal
import sys
import termios
from pathlib import Path
from types import SimpleNamespace

import pytest

import placegraph as pg
from placegraph.errors import InputError
from placegraph_io.ros.containers import open_bag
from placegraph_lab.worlds.bags import BagWriter, Layout, write_capture
from placegraph_ros.cli import listen_to_keys, live, stop_on_interrupt
from placegraph_ros.sources import PlaybackClock, WaitPolicy
from ros_world import FRAMES, START


def test_a_bag_of_poses(run, room, tmp_path):
    out = tmp_path / "out.mcap"
    words = ("bag", "localize", room.bag, room.map, "-o", out)
    result = run(*words, "--json")
    assert result.code == 0, result.err
    assert result.json["frames"] == FRAMES
    assert result.json["share_ok"] > 0.7
    topics = open_bag(out).topics
    assert len(topics["/localization/pose"]) >= 0.7 * FRAMES
    assert len(topics["/localization/image"]) == FRAMES
    assert abs(topics["/localization/pose"].times[0] * 1e-9 - START) < 10.0
    again = run(*words)
    assert again.code == 7
    assert "already exists" in again.err
    folder = run("bag", "localize", room.bag, room.map, "-o", tmp_path / "other")
    assert f"{FRAMES} frames: " in folder.out
    assert "OK (" in folder.out
    assert (tmp_path / "other" / "metadata.yaml").is_file()
    # what it tells of is a capture again: its own images, placed by its own transforms
    assert pg.open_capture(out, topics={"frame": "map"}).frames[-1].rgb().shape == (90, 160, 3)


def test_a_recording_of_rerun_beside_it(run, room, tmp_path):
    pytest.importorskip("rerun", reason="needs rerun-sdk: pip install 'placegraph[rerun]'")
    out, rerun = tmp_path / "out.mcap", tmp_path / "out.rrd"
    result = run("bag", "localize", room.bag, room.map, "-o", out, "--rerun", rerun)
    assert result.code == 0, result.err
    assert rerun.stat().st_size > 10_000


def test_an_unknown_device_is_refused(run, room):
    result = run("live", room.map, room.walk, "--device", "gpu")
    assert result.code == 7
    assert "device is 'gpu'; it must be" in result.err


def test_follow_a_folder_and_a_pipe(run, room, tmp_path, monkeypatch, capsys):
    result = run("live", room.map, room.walk, "--speed", "inf", "--wait", 0, "--json")
    assert result.code == 0, result.err
    *poses, summary = map(json.loads, result.out.splitlines())
    assert summary["frames"] == FRAMES
    assert sum(summary["told"].values()) + summary["dropped"] == FRAMES
    assert {"map_from_camera", "status", "reason"} < poses[-1].keys()
    with room.bag.open("rb") as pipe:
        monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=pipe, isatty=lambda: False))
        live(room.map, Path("-"), out=tmp_path / "live.mcap", speed=float("inf"))
    said = capsys.readouterr().out
    assert f"{FRAMES} frames: " in said
    assert f"out: {tmp_path / 'live.mcap'}" in said
    assert "/localization/odometry" in open_bag(tmp_path / "live.mcap").topics


def test_a_bag_in_foxglove(run, room):
    result = run("live", room.map, room.bag, "--foxglove", "ws://127.0.0.1:0", "--speed", "inf")
    assert result.code == 0, result.err
    assert "Foxglove: open a connection to ws://127.0.0.1:" in result.err
    assert result.out.splitlines()[0].split()[1] in set(pg.Status)


def test_a_bag_that_is_cut_off_is_localized_as_far_as_it_goes(run, room, tmp_path):
    data = room.bag.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: int(0.7 * len(data))])
    words = (tmp_path / "cut.mcap", room.map, "-o", tmp_path / "out.mcap")
    result = run("bag", "localize", *words)
    assert result.code == 0, result.err
    assert "only the part before the damage is read" in result.out
    told = run("live", room.map, tmp_path / "cut.mcap", "--wait", 0, "--speed", "inf")
    assert told.code == 0, told.err
    assert "has no end" in told.out


@pytest.mark.parametrize("piped", [False, True])
def test_what_lacks_is_named_with_the_mend(piped, run, room, tmp_path, monkeypatch):
    with BagWriter(tmp_path / "walk") as writer:
        write_capture(writer, room.clip, Layout(infos=False))
    if piped:
        with next((tmp_path / "walk").glob("*.mcap")).open("rb") as pipe:
            monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=pipe, isatty=lambda: False))
            with pytest.raises(InputError, match="stdin contains no CameraInfo"):
                live(room.map, Path("-"), out=tmp_path / "out.mcap", speed=float("inf"))
    else:
        result = run("bag", "localize", tmp_path / "walk", room.map, "-o", tmp_path / "out.mcap")
        assert result.code == 3
        assert "contains no CameraInfo of /camera/color/image_raw" in result.err
    assert not (tmp_path / "out.mcap").exists()


def test_keys_of_a_terminal(monkeypatch):
    master, slave = os.openpty()
    stdin = SimpleNamespace(isatty=lambda: True, fileno=lambda: slave)
    monkeypatch.setattr(sys, "stdin", stdin)
    pace, policy, before = PlaybackClock(), WaitPolicy(0.0), termios.tcgetattr(slave)
    with listen_to_keys(pace, policy):
        for key, done in (
            (b" ", lambda: pace.paused), (b"+", lambda: pace.speed == 2.0),
            (b"q", lambda: pace.stopped),
        ):  # fmt: skip
            os.write(master, key)
            with pace._changed:
                assert pace._changed.wait_for(done, 20)
    assert termios.tcgetattr(slave) == before
    os.close(master)
    os.close(slave)


def test_ctrl_c_ends_it_between_two_messages():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    pace, policy = PlaybackClock(), WaitPolicy(0.0)
    try:
        with stop_on_interrupt(pace, policy):
            signal.raise_signal(signal.SIGINT)
            assert policy.over.wait(20)
            with pace._changed:
                assert pace._changed.wait_for(lambda: pace.stopped, 20)
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        assert list(pace.play(iter("abc"), lambda _: None)) == []
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        with stop_on_interrupt(pace, policy):
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN, "a shell may have it ignored"
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("live", "{map}", "nowhere.mcap"), 3, "nowhere.mcap does not exist"),
        (("live", "{map}", "{bag}", "--mode", "twice"), 7, "mode is 'twice'"),
        (("live", "{map}", "{bag}", "--speed", "0"), 7, "speed is 0"),
        (("live", "{map}", "{bag}", "--wait", "-1"), 7, "wait is -1"),
        (("live", "{map}", "{bag}", "--foxglove", "8765"), 7, "is not a valid address"),
        (("live", "{map}", "{map}"), 3, "room.scene"),
        (("bag", "localize", "{walk}", "{map}", "-o", "out.mcap"), 3, "is not a bag"),
        (("bag", "localize", "{bag}", "{bag}", "-o", "{walk}/out.mcap"), 4, "bag.mcap"),
    ],
)
def test_what_is_mistaken(words, code, said, run, room):
    result = run(*[word.format(map=room.map, bag=room.bag, walk=room.walk) for word in words])
    assert result.code == code, result.err
    assert said in result.err
