import os
from dataclasses import replace

import pytest

from placegraph.errors import InputError
from placegraph_lab.campaign import faults, outages
from placegraph_lab.campaign.faults import TrialFolder
from placegraph_lab.campaign.row import Effort
from placegraph_lab.campaign.trial import OLD, WritingCommand, read_files

COMMAND = WritingCommand("city build", ("city", "build"), ("a.city", "a.png"), (".a.mcap.*",))


@pytest.fixture
def trial(tmp_path):
    trial = TrialFolder(COMMAND, tmp_path, tmp_path / "here", tmp_path / "room")
    trial.folder.mkdir()
    trial.new = {"a.city": b"new", "a.png": b"drawn"}
    return trial


@pytest.mark.all
def test_nothing_breaks(tmp_path):
    found = list(faults.rows(Effort(240.0, 20261123, tmp_path, tmp_path / "none", print)))
    assert [row for row in found if row.faults] == []
    assert sum(row.tried for row in found) > 100


def test_a_file_is_the_old_or_the_new_one(trial):
    old = COMMAND.before(trial.inputs, trial.folder)
    assert old == {"a.city": OLD, "a.png": OLD}
    assert trial.find_damage(old) == ""
    for name in (".a.city.tmp", ".a.png.lock", ".a.mcap.x1"):
        (trial.folder / name).touch()
    (trial.folder / "a.city").write_bytes(b"new")
    assert trial.find_damage(old) == ""
    (trial.folder / "a.city").write_bytes(b"ne")
    assert trial.find_damage(old) == "a.city is neither the old nor the new one"
    (trial.folder / "a.city").unlink()
    assert trial.find_damage(old) == "a.city is gone"
    COMMAND.before(trial.inputs, trial.folder)
    (trial.folder / "other").touch()
    assert trial.find_damage(old) == "other is left"


def test_old_files_are_inputs_bytes_or_none(trial):
    (trial.inputs / "homes.library").write_bytes(b"homes")
    kept = replace(COMMAND, old="homes.library")
    assert kept.before(trial.inputs, trial.folder)["a.city"] == b"homes"
    assert replace(COMMAND, old=None).before(trial.inputs, trial.folder) == {}
    assert read_files(trial.folder) == {}


def test_files_are_changed_while_they_are_used(tmp_path, rng):
    path = tmp_path / "a"
    for how in outages.CHANGES:
        path.write_bytes(b"0123456789" * 100)
        outages.change_file(path, how, rng)
        same = path.exists() and path.read_bytes() == b"0123456789" * 100
        assert same == (how == "older")
    assert path.stat().st_mtime == 0.0


@pytest.mark.parametrize(
    ("fails", "code"),
    [(None, 0), (InputError("gone"), outages.TYPED), (OSError("x"), outages.UNTYPED)],
)
def test_what_becomes_of_a_changed_file_is_an_exit_code(tmp_path, monkeypatch, fails, code):
    def use(_path):
        def ask():
            if fails:
                raise fails

        return ask

    (tmp_path / "a.map").write_bytes(b"0123456789")
    monkeypatch.setitem(outages.USES, "a map", ("*.map", use))
    codes = []
    monkeypatch.setattr(os, "_exit", codes.append)
    outages.use_changed_file("a map", "deleted", tmp_path, 1)
    assert codes == [code]
