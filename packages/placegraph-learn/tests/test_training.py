import os

import numpy as np
import pytest
from PIL import Image, ImageColor

from placegraph.errors import InputError
from placegraph_learn.training import (
    COLORS,
    HEIGHT,
    PLAN,
    WIDTH,
    add_row,
    draw_curves,
    open_folder,
    rows_of,
)


def test_a_plan_that_cannot_be_written_is_not_there_by_half(tmp_path, monkeypatch):
    def full(_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(InputError, match="No space left"):
            open_folder(tmp_path, {"steps": 3})
    assert not (tmp_path / PLAN).exists()
    assert open_folder(tmp_path, {"steps": 3}) == {"steps": 3}


def test_rows_come_back_and_one_cut_short_is_passed_over(tmp_path):
    assert rows_of(tmp_path) == []
    add_row(tmp_path, {"epoch": 1, "match": 0.5})
    with (tmp_path / "curves.jsonl").open("a", encoding="utf-8") as file:
        file.write('{"epoch": 2, "ma')  # the disk was full
    assert rows_of(tmp_path) == [{"epoch": 1, "match": 0.5}]
    add_row(tmp_path, {"epoch": 2, "match": 0.25})
    assert [row["epoch"] for row in rows_of(tmp_path)] == [1, 2]
    assert [path.name for path in tmp_path.iterdir()] == ["curves.jsonl"]
    for epoch, loss in ((2, 2.5), (3, 1.0)):  # an epoch done again takes its own place
        add_row(tmp_path, {"epoch": epoch, "match": loss})
    assert [(r["epoch"], r["match"]) for r in rows_of(tmp_path)] == [(1, 0.5), (2, 2.5), (3, 1.0)]


ROWS = [
    {
        "epoch": i, "match": 3.0 / i, "similarity": 2.0 / i, "embedding": 4.0 / i, "relational": 0.4,
        "network": 0.2 + 0.02 * i, "dense": 0.25, "fused": 0.4 + 0.01 * i,
    }
    for i in range(1, 7)
]  # fmt: skip


def pixels_of(path, color):
    with Image.open(path) as picture:
        assert picture.size == (WIDTH, HEIGHT)
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    near = np.abs(pixels - ImageColor.getrgb(color)[:3]).max(axis=2) < 12
    return np.stack(np.nonzero(near), axis=1)  # rows, columns


def test_losses_stand_left_and_recall_right(tmp_path):
    path = draw_curves(ROWS, tmp_path / "curves.png")
    for name in ("match", "similarity", "embedding"):
        found = pixels_of(path, COLORS[name])
        left = found[found[:, 1] < 445]
        assert len(left) > 300
        # a falling loss runs from the upper left to the lower right
        assert np.corrcoef(left[:, 1], left[:, 0])[0, 1] > 0.6
    found = pixels_of(path, COLORS["fused"])
    right = found[(found[:, 1] > 650) & (found[:, 1] < 1020)]
    assert len(right) > 300
    assert np.corrcoef(right[:, 1], right[:, 0])[0, 1] < -0.6  # it rises


@pytest.mark.parametrize("rows", [[], ROWS[:1], [{"epoch": 1, "match": 0.0}], [{"epoch": 3}]])
def test_few_epochs_and_few_figures_are_drawn(rows, tmp_path):
    path = draw_curves(rows, tmp_path / "curves.png")
    with Image.open(path) as picture:
        assert len(picture.getcolors(1 << 20)) > 10
