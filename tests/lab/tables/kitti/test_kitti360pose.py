import json

import numpy as np
import pytest

from placegraph.errors import OptionError
from placegraph_lab.datasets.kitti360pose import Kitti360Pose, convert_kitti360pose
from placegraph_lab.tables.kitti.graphs import Names
from placegraph_lab.tables.kitti.kitti360pose import MATCHERS, Split, evaluate
from placegraph_lab.tables.kitti.matchers import Relational
from placegraph_lab.tables.runner import plain


@pytest.fixture(scope="module")
def folder(kitti360pose_world, tmp_path_factory):
    return kitti360pose_world.write_set(tmp_path_factory.mktemp("k360") / "k360_tiny")


@pytest.fixture(scope="module")
def data(folder):
    convert_kitti360pose(folder, folder / "tiny.k360")
    return Kitti360Pose.open(folder / "tiny.k360")


@pytest.fixture(scope="module")
def fold(data):
    return Split.of(data, "test")


@pytest.fixture(scope="module")
def relational(data, fold):
    return Relational.of(data, fold.cells)


class Oracle:
    """Knows the best cell by the text alone: to test what is counted."""

    def __init__(self, split, rank=0):
        told, rows = split.pairs(Names(split.data))
        self.best = {t: int(r) for t, r in zip(told, rows, strict=True)}
        self.cells, self.rank = len(split.cells), rank

    def scores(self, description):
        total = -np.arange(self.cells, dtype=float)
        best = self.best[description]
        order = [k for k in range(self.cells) if k != best]
        order.insert(self.rank, best)
        total[order] = -np.arange(self.cells)
        return total


def test_recall_counts_the_exact_cell(fold, relational):
    names = Names(fold.data)
    for rank, expected in ((0, [1, 1, 1]), (1, [0, 1, 1]), (4, [0, 0, 1]), (5, [0, 0, 0])):
        found = evaluate(fold, "oracle", Oracle(fold, rank), names, within=relational)
        assert list(found.retrieval.values()) == expected
        assert (found.queries, found.cells) == (48, 24)


def test_another_drive_is_infinitely_far(data, fold, relational):
    """Cells of another drive, and answers that are none, are no hits at any distance."""
    scenes = data.cells.scene[fold.cells]

    class Elsewhere:
        def scores(self, description):
            del description
            return np.where(scenes == scenes[-1], 1.0, -np.inf)

    found = evaluate(fold, "x", Elsewhere(), Names(data), within=relational)
    assert found.centered[10][15.0] == pytest.approx(1 / 3)
    assert found.off["centered"] == np.inf
    assert plain(found)["off"]["centered"] is None

    class Nowhere:
        def scores(self, description):
            del description
            return np.full(len(scenes), -np.inf)

    found = evaluate(fold, "x", Nowhere(), Names(data), within=relational)
    assert found.retrieval[5] == found.refined[10][15.0] == 0.0


def test_one_split_sees_only_its_own(data):
    split = Split.of(data, "validation")
    assert {data.cells.ids[c][:4] for c in split.cells} == {"0010"}
    with pytest.raises(OptionError, match="no matcher 'magic'"):
        split.matcher("magic", np.random.default_rng(0))
    with pytest.raises(OptionError, match="no poses"):
        evaluate(split, "x", Oracle(split), Names(data), poses=[])


def test_the_whole_benchmark(measure, folder, tmp_path):
    done = measure(
        "outdoor_kitti360pose", folder, "--out", tmp_path / "a.json", "--cache", tmp_path,
        "--slow", "3", "--queries", "10", "--readings", "honest",
        "--matchers", "triple bag,edit distance,relational",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    assert done.stdout.count("###") == 4
    told = json.loads((tmp_path / "a.json").read_text())
    assert told["data"] == "k360_tiny"
    found = {(r["split"], r["matcher"]): r for r in told["results"]}
    assert len(found) == 6
    assert {m for _, m in found} < set(MATCHERS)
    assert found["test", "relational"]["queries"] == 10
    assert found["test", "edit distance"]["queries"] == 3
    assert found["test", "relational"]["refined"]["10"]["15.0"] == 1.0
    assert (tmp_path / "k360_tiny.k360").exists()
