"""KITTI360Pose as graphs, its matchers, and the protocol, on a tiny world in the published layout."""

import json
import subprocess
import sys

import numpy as np
import pytest

from placegraph.errors import OptionError
from placegraph.outdoor.language.description import SPEAKER
from placegraph.outdoor.map.cells import compass
from placegraph_lab.datasets.kitti360pose import DIRECTIONS, Kitti360Pose, convert_kitti360pose
from placegraph_lab.tables.kitti.graphs import Names, description_of, parsed, scene_graph, text_of
from placegraph_lab.tables.kitti.kitti360pose import MATCHERS, Split, evaluate
from placegraph_lab.tables.kitti.matchers import REACH, Relational


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


# --- graphs ---


def test_scene_graphs_are_of_equation_6(data):
    for cell in range(0, 40, 7):
        graph = scene_graph(data, cell, edge_distance=12.0)
        span = data.cells.objects(cell)
        np.testing.assert_array_equal(graph.positions, data.objects.centers[span, :2])
        assert graph.labels == tuple(data.labels[i] for i in data.objects.labels[span])
        at = graph.positions
        expected = {
            (a, b, compass(at[a] - at[b]))
            for a in range(len(at))
            for b in range(len(at))
            if 0.0 < np.hypot(*(at[a] - at[b])) <= 12.0
        }
        found = set(
            zip(graph.sources.tolist(), graph.targets.tolist(), graph.relations, strict=True)
        )
        assert found == expected
        assert expected


def test_the_text_is_the_published_one(data):
    text = text_of(data, 0)
    h, span = data.hints, data.poses.hints(0)
    first = f"The pose is {DIRECTIONS[h.directions[0]]} of a "
    assert text.startswith(first + f"{data.colours[h.colours[0]]} {data.labels[h.labels[0]]}. ")
    assert text.count("The pose is") == span.stop - span.start == 6
    assert "on-top" in " ".join(text_of(data, p) for p in range(80))


@pytest.mark.parametrize("options", [{}, {"coloured": True}, {"osm": True}])
def test_our_parser_reads_the_same_graph(data, options):
    names = Names(data, **options)
    for pose in range(80):
        direct, read = description_of(data, pose, names=names), parsed(data, pose, names=names)
        assert read.mentions == direct.mentions
        assert read.statements == direct.statements
        assert read.ignored == ()


def test_papers_relations_are_those_of_where_things_stand(data):
    """Compared with the cell's own objects, where a thing lies in the best cell as a whole."""
    compared = 0
    for pose in range(80):
        cell = int(data.poses.cells[pose])
        span = data.cells.objects(cell)
        rows = range(*data.poses.hints(pose).indices(480))
        at = {}
        for node, row in enumerate(rows, 2):
            if data.hints.objects[row] >= 0:
                at[node] = data.objects.centers[span.start + data.hints.objects[row], :2]
                true = data.poses.positions[pose, :2] - data.hints.offsets[row]
                if np.hypot(*(true - at[node])) > 0.2:  # cut otherwise in the best cell
                    del at[node]
        told = description_of(data, pose, reading="paper")
        assert all(SPEAKER not in (s.source, s.target) for s in told.statements)
        for s in told.statements:
            if s.source in at and s.target in at:
                delta = at[s.source] - at[s.target]
                if abs(abs(delta[0]) - abs(delta[1])) > 0.5:
                    assert f"on the {compass(delta)} of" in s.text
                    compared += 1
    assert compared > 200


# --- matchers ---


# --- relational ---


@pytest.fixture(scope="module")
def relational(data, fold):
    return Relational.of(data, fold.cells)


def test_what_is_in_sight(data, relational):
    for v in range(0, len(relational.points), 97):
        owner = relational.owner[v]
        objects = range(relational.object_starts[owner], relational.object_starts[owner + 1])
        expected = {}
        for i in objects:
            off = data.objects.footprint(int(relational.objects[i])) - relational.points[v]
            nearest = off[np.argmin(np.hypot(*off.T))]
            if np.hypot(*nearest) <= REACH:
                expected[i] = nearest
        seen = slice(relational.starts[v], relational.starts[v + 1])
        assert relational.seen[seen].tolist() == list(expected)
        np.testing.assert_allclose(
            relational.offsets[seen], np.reshape(list(expected.values()), (-1, 2)), atol=1e-4
        )


# --- the protocol ---


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


def test_distances_are_those_of_the_best_of_k(data, fold, relational):
    found = evaluate(fold, "oracle", Oracle(fold), Names(data), within=relational)
    truth = data.poses.positions[fold.poses, :2]
    cells = data.poses.cells[fold.poses]
    off = np.hypot(*(data.cells.centers[cells] - truth).T)
    for r, share in found.centered[1].items():
        assert share == pytest.approx((off <= r).mean())
    assert found.off["centered"] == pytest.approx(np.median(off))
    assert found.off["placed"] < found.off["centered"]
    assert found.centered[10][15.0] == 1.0
    assert json.loads(json.dumps(found.to_dict(), allow_nan=False)) == found.to_dict()


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
    assert found.to_dict()["median_m"]["centered"] is None

    class Nowhere:
        def scores(self, description):
            del description
            return np.full(len(scenes), -np.inf)

    found = evaluate(fold, "x", Nowhere(), Names(data), within=relational)
    assert found.retrieval[5] == found.placed[10][15.0] == 0.0


def test_one_split_sees_only_its_own(data):
    split = Split.of(data, "validation")
    assert {data.cells.ids[c][:4] for c in split.cells} == {"0010"}
    with pytest.raises(OptionError, match="no matcher 'magic'"):
        split.matcher("magic", np.random.default_rng(0))
    with pytest.raises(OptionError, match="no poses"):
        evaluate(split, "x", Oracle(split), Names(data), poses=[])


def test_the_whole_benchmark(folder, tmp_path):
    command = [
        sys.executable,
        "-m",
        "placegraph_lab",
        "table",
        "outdoor_kitti360pose",
        folder,
        "--out",
        tmp_path / "a.json",
        "--slow",
        "3",
    ]
    command += ["--cache", tmp_path, "--queries", "10", "--readings", "honest"]
    command += ["--matchers", "triple bag,edit distance,relational"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("###") == 4
    told = json.loads((tmp_path / "a.json").read_text())
    assert told["data"] == "k360_tiny"
    found = {(r["split"], r["matcher"]): r for r in told["results"]}
    assert len(found) == 6
    assert {m for _, m in found} < set(MATCHERS)
    assert found["test", "relational"]["queries"] == 10
    assert found["test", "edit distance"]["queries"] == 3
    assert found["test", "relational"]["placed"]["10"]["15 m"] == 1.0
    assert (tmp_path / "k360_tiny.k360").exists()
