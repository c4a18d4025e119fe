from types import SimpleNamespace

import pytest

from placegraph_lab.campaign.row import Row, mark_fixed, merge_rows, total
from placegraph_lab.tables.named import reliability as module
from placegraph_lab.tables.runner import LAB, Run

FOUND = {"accepted": 3, "typed": 4, "hang": 1}


def test_rows_take_the_place_of_the_same_of_the_same_seed():
    old, again = (Row.from_counts("soak", "tracker", FOUND, 7, seconds) for seconds in (1.0, 2.0))
    other, first = (
        Row.from_counts("soak", "tracker", FOUND, 8, 1.0),
        Row.from_counts("fuzz", "GLB", {}, 7, 0.0),
    )
    assert merge_rows([other, old], [again, first]) == [first, other, again]


def test_what_is_mended_is_open_no_longer_until_it_is_found_again():
    row = Row.from_counts("fuzz", "GLB", FOUND, 7, 0.0)
    (mended,) = mark_fixed([row], ["fuzz/GLB/7"])
    assert (mended.faults, mended.mended, mended.open) == (1, 1, 0)
    assert Row.from_dict(mended.to_dict()) == mended
    assert (total([row, mended]).faults, total([row, mended]).open) == (2, 1)
    assert merge_rows([mended], [row]) == [row]
    with pytest.raises(KeyError, match="fuzz/GLB/8"):
        mark_fixed([row], ["fuzz/GLB/8"])


class Parts:
    def __init__(self, monkeypatch):
        self.cut = False
        monkeypatch.setattr(
            module, "import_module", lambda name: SimpleNamespace(rows=self.of(name))
        )

    def of(self, name):
        def rows(effort):
            for what in "ab":
                yield Row.from_counts(
                    name.rpartition(".")[2], what, FOUND, effort.seed, effort.seconds
                )
                if self.cut:
                    raise KeyboardInterrupt

        return rows


def test_what_is_cut_short_is_written_down_and_the_rest_stays(tmp_path, monkeypatch, capsys):
    parts, out = Parts(monkeypatch), tmp_path / "r.json"
    run = Run("reliability", tmp_path, tmp_path, out)

    def asked(**given):
        module.reliability.measure(run, **given)
        return [(r.part, r.what, r.seed, r.seconds) for r in module.read_rows(out)]

    assert asked(minutes=1.0, only="soak,fuzz") == [
        ("fuzz", "a", 0, 60.0), ("fuzz", "b", 0, 60.0), ("soak", "a", 0, 60.0), ("soak", "b", 0, 60.0),
    ]  # fmt: skip
    parts.cut = True
    with pytest.raises(KeyboardInterrupt):
        asked(minutes=2.0, only="fuzz")
    assert [row.seconds for row in module.read_rows(out)] == [60.0, 120.0, 60.0, 60.0]
    asked(minutes=0.0, mended="fuzz/a/0; soak/b/0")
    assert [r.what for r in module.read_rows(out) if r.faults and not r.open] == ["a", "b"]
    with pytest.raises(module.BadParameter, match="soak/c/0"):  # there is no such row
        asked(minutes=0.0, mended="soak/c/0")
    capsys.readouterr()
    asked(minutes=0.0, only="soak")
    assert "fuzz" not in capsys.readouterr().out
    parts.cut = False
    assert len(asked(minutes=1.0, only="soak", fresh=True)) == 4


def test_page_and_readme_are_those_of_the_rows(tmp_path):
    rows = module.read_rows(LAB / "results/reliability.json")
    for name in ("README.md", module.PAGE):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text((LAB.parent / name).read_text("utf-8"), "utf-8")
    module.publish(rows, tmp_path)
    for name, text in (
        ("README.md", module.summarize_rows(rows)),
        (module.PAGE, module.render_rows(rows)),
    ):
        assert text in (LAB.parent / name).read_text("utf-8"), (
            "table reliability --minutes 0 writes it"
        )
        assert (tmp_path / name).read_text("utf-8") == (LAB.parent / name).read_text("utf-8")
    module.publish([Row.from_counts("fuzz", "GLB", FOUND, 7, 0.0)], tmp_path)
    assert "8 trials, 1 faults found, 1 open" in (tmp_path / "README.md").read_text("utf-8")
    assert "| fuzz | all |" in (tmp_path / module.PAGE).read_text("utf-8")
