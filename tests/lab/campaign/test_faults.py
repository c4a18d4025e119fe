"""Faults of machines are made, and what became of them is judged."""

import os
from dataclasses import replace

import pytest

from placegraph.errors import InputError
from placegraph_lab.campaign import faults
from placegraph_lab.campaign import outages as changed
from placegraph_lab.campaign.faults import Ground
from placegraph_lab.campaign.outages import CHANGES, change, judged
from placegraph_lab.campaign.row import Effort
from placegraph_lab.campaign.trial import OLD, Writing, files_in

WRITING = Writing("city build", ("city", "build"), ("a.city", "a.png"), (".a.mcap.*",))


@pytest.fixture
def ground(tmp_path):
    made = Ground(WRITING, tmp_path, tmp_path / "here", tmp_path / "room")
    made.folder.mkdir()
    made.new = {"a.city": b"new", "a.png": b"drawn"}
    return made


@pytest.mark.all
def test_nothing_breaks(tmp_path):
    found = list(faults.rows(Effort(240.0, 20261123, tmp_path, tmp_path / "none", print)))
    assert [row for row in found if row.faults] == []
    assert sum(row.tried for row in found) > 100


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
