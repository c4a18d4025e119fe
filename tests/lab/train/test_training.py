"""The file of a training's figures."""

from placegraph_lab.train.training import add_row, rows_of


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
