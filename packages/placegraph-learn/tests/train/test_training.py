"""The file of a training's figures."""

import os

import pytest

from placegraph.errors import InputError
from placegraph_learn.train.training import PLAN, add_row, planned, rows_of


def test_a_plan_that_cannot_be_written_is_not_there_by_half(tmp_path, monkeypatch):
    def full(_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(InputError, match="No space left"):
            planned(tmp_path, {"steps": 3})
    assert not (tmp_path / PLAN).exists()
    assert planned(tmp_path, {"steps": 3}) == {"steps": 3}


def test_rows_come_back_and_one_cut_short_is_passed_over(tmp_path):
    assert rows_of(tmp_path) == []
    add_row(tmp_path, {"epoch": 1, "match": 0.5})
    with (tmp_path / "curves.jsonl").open("a", encoding="utf-8") as file:
        file.write('{"epoch": 2, "ma')  # the disk was full
    assert rows_of(tmp_path) == [{"epoch": 1, "match": 0.5}]
    add_row(tmp_path, {"epoch": 2, "match": 0.25})
    assert [row["epoch"] for row in rows_of(tmp_path)] == [1, 2]
    assert [path.name for path in tmp_path.iterdir()] == ["curves.jsonl"]


def test_an_epoch_done_again_takes_its_own_place(tmp_path):
    for epoch, loss in ((1, 3.0), (2, 2.0), (2, 2.5), (3, 1.0)):
        add_row(tmp_path, {"epoch": epoch, "match": loss})
    assert [(r["epoch"], r["match"]) for r in rows_of(tmp_path)] == [(1, 3.0), (2, 2.5), (3, 1.0)]
