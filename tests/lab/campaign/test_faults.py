"""Faults of machines are made, and what became of them is judged."""

import os
import signal
from dataclasses import replace

import pytest

from placegraph.errors import InputError
from placegraph_lab.campaign import faults
from placegraph_lab.campaign import outages as changed
from placegraph_lab.campaign.faults import Ground, worse
from placegraph_lab.campaign.outages import CHANGES, Load, change, judged
from placegraph_lab.campaign.row import Effort
from placegraph_lab.campaign.trial import OLD, Ended, Writing, files_in

WRITING = Writing("city build", ("city", "build"), ("a.city", "a.png"), (".a.mcap.*",))


@pytest.fixture
def ground(tmp_path):
    made = Ground(WRITING, tmp_path, tmp_path / "here", tmp_path / "room")
    made.folder.mkdir()
    made.new = {"a.city": b"new", "a.png": b"drawn"}
    return made


def ended(code=0, said="", *, killed=False):
    return Ended(code, said, 1.0, killed)


@pytest.mark.all
def test_nothing_breaks(tmp_path):
    found = list(faults.rows(Effort(240.0, 20261123, tmp_path, tmp_path / "none", print)))
    assert [row for row in found if row.faults] == []
    assert sum(row.tried for row in found) > 100


@pytest.mark.parametrize(
    ("how", "outcome"),
    [
        (ended(), "accepted"),
        (ended(3, "placegraph: a.city is no map."), "typed"),
        (ended(4, "Traceback (most recent call last):"), "untyped"),
        (ended(1, "ValueError"), "untyped"),
        (ended(-signal.SIGSEGV), "crash"),
        (ended(None), "hang"),
    ],
)
def test_how_a_command_ended(how, outcome):
    assert how.outcome == outcome
    assert worse("accepted") == worse("typed") == "untyped"
    assert worse("crash") == "crash"


def test_a_file_is_the_old_or_the_new_one(ground):
    old = WRITING.before(ground.inputs, ground.folder)
    assert old == {"a.city": OLD, "a.png": OLD}
    assert ground.whole(old) == ""
    for name in (".a.city.tmp", ".a.png.lock", ".a.mcap.x1"):
        (ground.folder / name).touch()
    (ground.folder / "a.city").write_bytes(b"new")
    assert ground.whole(old) == ""
    (ground.folder / "a.city").write_bytes(b"ne")
    assert ground.whole(old) == "a.city is neither the old nor the new one"
    (ground.folder / "a.city").unlink()
    assert ground.whole(old) == "a.city is gone"
    WRITING.before(ground.inputs, ground.folder)
    (ground.folder / "other").touch()
    assert ground.whole(old) == "other is left"


def test_old_files_are_inputs_bytes_or_none(ground):
    (ground.inputs / "homes.library").write_bytes(b"homes")
    kept = replace(WRITING, old="homes.library")
    assert kept.before(ground.inputs, ground.folder)["a.city"] == b"homes"
    assert replace(WRITING, old=None).before(ground.inputs, ground.folder) == {}
    assert files_in(ground.folder) == {}


def test_files_are_changed_while_they_are_used(tmp_path, rng):
    path = tmp_path / "a"
    for how in CHANGES:
        path.write_bytes(b"0123456789" * 100)
        change(path, how, rng)
        same = path.exists() and path.read_bytes() == b"0123456789" * 100
        assert same == (how == "older")
    assert path.stat().st_mtime == 0.0


@pytest.mark.parametrize(
    ("fails", "code"),
    [(None, 0), (InputError("gone"), changed.TYPED), (OSError("x"), changed.UNTYPED)],
)
def test_what_becomes_of_a_changed_file_is_an_exit_code(tmp_path, monkeypatch, fails, code):
    def use(_path):
        def ask():
            if fails:
                raise fails

        return ask

    (tmp_path / "a.map").write_bytes(b"0123456789")
    monkeypatch.setitem(changed.USES, "a map", ("*.map", use))
    codes = []
    monkeypatch.setattr(os, "_exit", codes.append)
    changed.used("a map", "deleted", tmp_path, 1)
    assert codes == [code]


def test_clients_tell_what_they_saw_of_a_server():
    answers = [(200, {}), (500, {"code": "worker_died"}), (500, {"code": "internal"}), (-1, None)]

    class Server:
        def ask(self, *_):
            status, told = answers.pop(0)
            if not answers:
                load.over.set()
            return status, told

    load = Load(Server())
    load.ask(lambda _: None)
    assert dict(load.counts) == {"accepted": 1, "typed": 1, "untyped": 1, "hang": 1}


def test_what_a_service_says_is_judged(tmp_path):
    told = []
    effort = Effort(1.0, 7, tmp_path, tmp_path, told.append)

    def gone():
        raise InputError("gone")

    def broken():
        raise KeyError("workers")

    assert [judged(lambda: 3, wanted, effort) for wanted in (3, 4, None)] == [
        "accepted", "untyped", "untyped",
    ]  # fmt: skip
    assert [judged(gone, wanted, effort) for wanted in (None, 3)] == ["typed", "untyped"]
    assert judged(broken, None, effort) == "untyped"
    assert told == ["a service: another answer"] * 2 + [
        "a service: gone",
        "a service: KeyError: 'workers'",
    ]


def test_a_folder_is_unfinished_until_its_last_file_is_there(ground):
    made = Writing("world build", (), ("w",), ("w/.*",), ends="w/world.json")
    ground = replace(ground, writing=made, new={"w/a.city": b"new", "w/world.json": b"told"})
    (ground.folder / "w/.build").mkdir(parents=True)
    (ground.folder / "w/.build/journal").touch()
    (ground.folder / "w/a.city").write_bytes(b"new")
    assert made.before(ground.inputs, ground.folder) == {}
    assert ground.whole({}) == ""
    (ground.folder / "w/a.city").unlink()
    (ground.folder / "w/world.json").write_bytes(b"told")
    assert ground.whole({}) == "w/a.city is gone"
    (ground.folder / "w/a.city").write_bytes(b"ne")
    assert ground.whole({}) == "w/a.city is neither the old nor the new one"
    made.before(ground.inputs, ground.folder)
    assert not (ground.folder / "w").exists()
