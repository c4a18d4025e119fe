import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from placegraph.core.graph import SceneGraph
from placegraph.errors import OptionError
from placegraph.outdoor.network.label_graphs import LabelGraphs
from placegraph.outdoor.network.network import GraphTransformer
from placegraph.outdoor.network.weights import Shape
from placegraph_lab.datasets.kitti360pose import WORLD, Kitti360Pose, convert_kitti360pose
from placegraph_lab.tables.kitti.graphs import OSM, Names, description_of
from placegraph_lab.tables.kitti.kitti360pose import MATCHERS, TRANSFORMER, Split, evaluate
from placegraph_lab.tables.kitti.matchers import Relational
from placegraph_lab.tables.kitti.train import LOSSES, lessons_of, train_on_drives
from placegraph_lab.tables.named import outdoor_kitti360pose as table
from placegraph_lab.tables.runner import plain
from placegraph_lab.worlds.town.town import Town


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


@pytest.fixture(scope="module")
def network(data, tmp_path_factory):
    """The network that GOTLoc prints after a few steps on the training drive."""
    pytest.importorskip("torch", reason="PyTorch is not installed (extra learn)")
    folder = tmp_path_factory.mktemp("training")
    options = SMALL | {"epochs": 2, "steps": 6, "batch": 8}
    train_on_drives(data, folder / "a.weights", folder=folder, options=trained_by(**options))
    return GraphTransformer.open(folder / "a.weights")


SMALL = {"losses": LOSSES, "shape": Shape(width=16, dimension=16, layers=1, printed=True)}


def trained_by(**options):
    from placegraph_learn.city.train import TrainOptions

    return TrainOptions(**options)


def test_the_transformer_ranks_ten_candidates_by_the_cosine(data, network):
    """Eq. 9-16 by the network's own parts, on graphs made here from the data's columns."""
    split = Split.of(data, "test", "paper")
    matcher, names = split.matcher(TRANSFORMER, np.random.default_rng(0), network=network)
    graphs = []
    for cell in split.cells:
        span = data.cells.objects(int(cell))
        at = data.objects.centers[span, :2]
        labels = [OSM[data.labels[row]] for row in data.objects.labels[span]]
        pairs = [
            (a, b, "north" if d[1] > 0 else "south") if abs(d[0]) <= abs(d[1])
            else (a, b, "east" if d[0] > 0 else "west")
            for a in range(len(at)) for b in range(len(at))
            if 0 < np.hypot(*(d := at[a] - at[b])) <= 15.0
        ]  # fmt: skip
        graphs.append(
            SceneGraph(
                tuple(map(str, range(len(at)))), tuple(labels), at,
                np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs]),
                tuple(p[2] for p in pairs),
            )
        )  # fmt: skip
    cells = LabelGraphs.of_graphs(graphs)
    embedded = network.embed_places(cells)
    for pose in split.poses[:6]:
        description = description_of(data, int(pose), reading="paper", names=names)
        texts = LabelGraphs.of_texts([description])
        near = np.argsort(-(embedded @ network.embed_texts(texts)[0]), kind="stable")[:10]
        expected = network.match(texts, 0, cells, near).cosine
        found = matcher.scores(description)
        assert set(np.flatnonzero(np.isfinite(found))) == set(near)
        assert found[near] == pytest.approx(expected, abs=1e-5)


def test_training_takes_only_the_training_drives(data, network, tmp_path):
    lessons = lessons_of(Split.of(data, "train", "paper"))
    drive = {data.cells.ids[c][:4] for c in Split.of(data, "train").cells}
    assert drive == {"0000"}
    assert (len(lessons.cells), len(lessons.texts)) == (8, 16)
    best = [data.cells.ids[c] for c in data.poses.cells[Split.of(data, "train").poses]]
    assert [f"0000_{row:05d}" for row in lessons.truth] == best
    options = trained_by(**SMALL, epochs=2, steps=6, batch=8)
    train_on_drives(data, tmp_path / "a.weights", folder=tmp_path, options=options)
    again = GraphTransformer.open(tmp_path / "a.weights")
    assert again.digest == network.digest  # the same seed, the same weights
    plan = json.loads((tmp_path / "plan.json").read_text())
    assert (plan["readings"], plan["edge_distance"]) == (["paper"], 15.0)
    rows = [json.loads(line) for line in (tmp_path / "curves.jsonl").read_text().splitlines()]
    assert [row["epoch"] for row in rows] == [1, 2]
    assert {"eq17", "eq18", "network"} <= rows[0].keys()
    with pytest.raises(OptionError, match="other maps or options"):
        train_on_drives(data, tmp_path / "b", folder=tmp_path, options=replace(options, epochs=3))


def test_what_cannot_be_trained_or_used(data, kitti360pose_world, tmp_path):
    convert_kitti360pose(
        kitti360pose_world.write_set(tmp_path / "k", drives=("0003",)), tmp_path / "k.k360"
    )
    with pytest.raises(OptionError, match="none of the training drives 0000"):
        train_on_drives(Kitti360Pose.open(tmp_path / "k.k360"), tmp_path / "w", folder=tmp_path)
    with pytest.raises(OptionError, match="another network than the paper's"):
        Split.of(data, "test").matcher(
            TRANSFORMER, np.random.default_rng(0), network=GraphTransformer.default()
        )


def test_the_network_trained_is_as_deep_as_the_shipped_one():
    pytest.importorskip("torch", reason="PyTorch is not installed (extra learn)")
    assert table.train_options(1, 0).shape == GraphTransformer.default(printed=True).shape


def test_the_table_trains_both_halves(measure, folder, kitti360pose_world, tmp_path, monkeypatch):
    """One command: from the folder and an extract to Table II."""
    pytest.importorskip("torch", reason="PyTorch is not installed (extra learn)")
    town = Town.parse(kitti360pose_world.karlsruhe(WORLD)).write_osm(tmp_path / "karlsruhe.osm")
    options = partial(trained_by, **(SMALL | {"steps": 2, "batch": 4}))
    monkeypatch.setattr(
        table, "train_options", lambda epochs, seed: options(epochs=epochs, seed=seed)
    )
    command = (
        "outdoor_kitti360pose", folder, "--osm", town, "--train", "1", "--queries", "5",
        "--matchers", "transformer", "--cache", tmp_path, "--out", tmp_path / "a.json",
    )  # fmt: skip
    done = measure(*command)
    assert done.exit_code == 0, done.output
    made = sorted(tmp_path.glob("kitti360pose/*/network.weights"))
    assert len(made) == 2
    stamps = [path.stat().st_mtime_ns for path in made]
    for title in (
        "trained on its drives, the text",
        "trained on its drives on OSM, positions known",
    ):
        assert f"| GOTLoc as printed, {title} " in done.stdout
    told = json.loads((tmp_path / "a.json").read_text())["results"]
    assert {(r["split"], r["reading"], r["on_osm"]) for r in told} == {
        (split, reading, on_osm)
        for split in ("validation", "test") for reading in ("honest", "paper") for on_osm in (False, True)
    }  # fmt: skip
    assert measure(*command).exit_code == 0
    assert [path.stat().st_mtime_ns for path in made] == stamps  # trained once
    given = measure(*command[:2], "--weights", made[0], *command[6:])
    assert "GOTLoc as printed, trained on network.weights" not in given.stdout
    assert "GOTLoc as printed, network.weights" in given.stdout
