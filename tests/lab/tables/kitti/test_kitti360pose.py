"""KITTI360Pose as graphs, its matchers, and the protocol, on a tiny world in the published layout."""

import json
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from placegraph.core.graph import SceneGraph
from placegraph.errors import OptionError
from placegraph.outdoor.language.description import (
    SPEAKER,
    Description,
    Mention,
    Relation,
    Sense,
    Statement,
)
from placegraph.outdoor.map.cells import compass
from placegraph_lab.datasets.kitti360pose import DIRECTIONS, Kitti360Pose, convert_kitti360pose
from placegraph_lab.tables.kitti.graphs import (
    OSM,
    Names,
    description_of,
    parsed,
    scene_graph,
    text_of,
)
from placegraph_lab.tables.kitti.kitti360pose import (
    MATCHERS,
    PAPER,
    Split,
    evaluate,
    localization_table,
    retrieval_table,
    size_table,
)
from placegraph_lab.tables.kitti.matchers import EditDistance, Transformer, TripleBag
from placegraph_lab.tables.kitti.relational import REACH, Relational


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


def test_names(data):
    row = int(np.flatnonzero(data.objects.labels == data.labels.index("road"))[0])
    assert Names(data).of(data.objects, row) == "road"
    assert Names(data, coloured=True).of(data.objects, row) == "gray road"
    assert Names(data, osm=True).of(data.objects, row) == OSM["road"] == "highway=residential"
    assert len(OSM) == 21


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


def test_honest_graphs_know_no_positions(data, rng):
    hints = replace(
        data.hints,
        offsets=rng.normal(size=data.hints.offsets.shape),
        closest=rng.normal(size=data.hints.closest.shape),
        objects=data.hints.objects * 0,
        instances=data.hints.instances * 0,
    )
    poses = replace(data.poses, positions=data.poses.positions * 0, cells=data.poses.cells * 0)
    blind = replace(data, hints=hints, poses=poses)
    for pose in range(80):
        assert description_of(blind, pose) == description_of(data, pose)
    changed = [
        description_of(blind, p, reading="paper") != description_of(data, p, reading="paper")
        for p in range(80)
    ]
    assert all(changed), "the paper's graphs do"


def test_statements_about_the_speaker(data):
    bearings = {"north": 0.0, "east": np.pi / 2, "south": np.pi, "west": 1.5 * np.pi}
    for pose in range(80):
        rows = range(*data.poses.hints(pose).indices(480))
        told = description_of(data, pose).statements
        for row, statement in zip(rows, told, strict=True):
            direction = DIRECTIONS[data.hints.directions[row]]
            assert statement.source == SPEAKER
            if direction == "on-top":
                assert (statement.relation, statement.bearing) == (Relation.SAME, None)
            else:
                assert statement.relation is Relation.DIRECTION
                assert statement.bearing == bearings[direction]


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


def toy(*labels, at):
    n = len(labels)
    return SceneGraph(
        tuple(map(str, range(n))), labels, np.array(at, float).reshape(n, 2),
        np.array([0]), np.array([1]), ("north",),
    )  # fmt: skip


def said(*statements, labels=("pole", "road")):
    mentions = [Mention(0, "I"), Mention(1, "you")]
    mentions += [Mention(i, f"a {x}", (Sense(x, 1.0),)) for i, x in enumerate(labels, 2)]
    return Description("", tuple(mentions), statements)


TOYS = [
    toy("pole", "road", at=[(0, 5), (0, -5)]),
    toy("pole", "wall", at=[(0, 5), (0, -5)]),
    toy("road", "pole", at=[(0, 5), (0, -5)]),
]
CENTERS = np.zeros((3, 2))


def test_a_bag_weighs_what_is_rare(rng):
    bag = TripleBag.of(TOYS, CENTERS, rng)
    north = said(Statement(Relation.DIRECTION, 2, 3, bearing=0.0))
    np.testing.assert_allclose(bag.scores(north), [np.log(3), 0, 0], atol=1e-6)
    speaker = said(Statement(Relation.DIRECTION, SPEAKER, 2, bearing=np.pi))  # south of a pole
    np.testing.assert_allclose(bag.scores(speaker), [np.log(1.5), np.log(1.5), 0], atol=1e-6)
    on_top = said(Statement(Relation.SAME, SPEAKER, 3))
    np.testing.assert_allclose(bag.scores(on_top), [np.log(1.5), 0, np.log(1.5)], atol=1e-6)
    nothing = said(Statement(Relation.SAME, SPEAKER, 2), labels=("zoo", "road"))
    assert 0.0 < np.ptp(bag.scores(nothing)) < 1e-8, "equals are ranked by chance"


def test_edit_distance_looks_at_candidates(rng):
    bag = TripleBag.of(TOYS, CENTERS, rng)
    query = said(Statement(Relation.DIRECTION, 2, 3, bearing=0.0))
    scores = EditDistance(TOYS, None, bag).scores(query)
    assert np.argmax(scores) == 0
    assert scores[0] == 0.0
    few = EditDistance(TOYS, None, bag, candidates=1).scores(query)
    assert few[0] == 0.0
    assert np.isneginf(few[1:]).all()


class Network:
    """Stands for the learned one: embeds by the number of things, likes the last place."""

    def word_vectors(self, words):
        self.words = words
        return np.zeros((len(words), 1))

    def embed_texts(self, texts):
        return np.ones((len(texts), 1), np.float32)

    def embed_places(self, places):
        return np.arange(len(places), dtype=np.float32)[:, None]

    def match(self, texts, text, places, rows, words, vectors):
        assert (len(texts), text, len(places)) == (1, 0, 3)
        assert len(vectors) == len(self.words)
        self.fits = words
        return SimpleNamespace(logit=np.asarray(rows, np.float32))


def test_the_network_is_given_candidates_and_words():
    network = Network()
    query = said(Statement(Relation.DIRECTION, 2, 3, bearing=0.0))
    scores = Transformer(TOYS, CENTERS, network).scores(query)
    np.testing.assert_array_equal(scores, [0, 1, 2])
    assert [network.words[t] for t in network.fits.tokens] == ["pole", "road"]
    np.testing.assert_array_equal(network.fits.starts, [0, 0, 1, 2])
    few = Transformer(TOYS, CENTERS, network, candidates=2).scores(query)
    np.testing.assert_array_equal(few, [-np.inf, 1, 2])


# --- relational ---


@pytest.fixture(scope="module")
def relational(data, fold):
    return Relational.of(data, fold.cells)


def test_viewpoints_belong_to_the_nearest_cell(data, fold, relational):
    centers = fold.centers
    scene = data.cells.scene[fold.cells]
    assert (np.diff(relational.owner) >= 0).all()
    for point, owner in zip(relational.points[::17], relational.owner[::17], strict=True):
        off = np.hypot(*(centers - point).T)
        assert off[owner] == off[scene == scene[owner]].min()
        assert np.abs(centers[owner] - point).max() <= 15.0


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


def test_poses_within_cells_beat_their_centres(data, fold, relational):
    off, centered = [], []
    for pose in fold.poses.tolist():
        cell = int(np.searchsorted(fold.cells, data.poses.cells[pose]))
        truth = data.poses.positions[pose, :2]
        (at,) = relational.poses(description_of(data, pose), np.array([cell]))
        off.append(np.hypot(*(at - truth)))
        centered.append(np.hypot(*(fold.centers[cell] - truth)))
    assert np.mean(off) < 0.75 * np.mean(centered)


def test_a_cell_in_the_dark(relational, fold):
    """Where nothing was understood, all cells are alike, and the pose is a centre."""
    empty = said()
    np.testing.assert_array_equal(relational.scores(empty), np.zeros(len(fold.cells)))
    cells = np.array([3, 1])
    np.testing.assert_array_equal(relational.poses(empty, cells), fold.centers[cells])
    unknown = said(Statement(Relation.SAME, SPEAKER, 2), labels=("zoo", "road"))
    assert np.isfinite(relational.scores(unknown)).any()


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


@pytest.mark.parametrize("reading", ["honest", "paper"])
@pytest.mark.parametrize(("name", "least"), [("triple bag", 0.6), ("relational", 0.7)])
def test_matchers_find_most(data, relational, name, least, reading):
    split = Split.of(data, "test", reading)
    matcher, names = split.matcher(name, np.random.default_rng(0))
    found = evaluate(split, name, matcher, names, within=relational)
    assert found.retrieval[1] >= least
    assert found.retrieval[5] >= 0.9


def test_edit_distance_within_the_protocol(data):
    split = Split.of(data, "validation")
    matcher, names = split.matcher("edit distance", np.random.default_rng(0), candidates=4)
    found = evaluate(split, "edit distance", matcher, names, poses=split.poses[:4].tolist())
    assert found.retrieval[3] >= 0.75
    assert found.queries == 4


def test_tables(data, fold, relational):
    names = Names(data)
    results = [evaluate(fold, "relational", Oracle(fold), names, within=relational)]
    table = retrieval_table(results)
    assert len(table.splitlines()) == 3 + len(PAPER)
    assert "| Text2Pos (published)" in table
    assert "GOTLoc, transformer (published)" in table
    last = table.splitlines()[-1]
    assert last.startswith("| relational, the text")
    assert last.count("1.00") == 3
    assert "1.00/1.00/1.00" in localization_table(results, "test")
    assert len(localization_table(results, "validation").splitlines()) == 2
    sizes = size_table(data, "0003").splitlines()
    assert sizes[0].count("cells") == 4
    assert "| ratio" in sizes[-1]


def test_sizes_stand_beside_the_papers(kitti360pose_world, tmp_path):
    folder = kitti360pose_world.write_set(tmp_path / "k360", drives=("0003",), n_cells=112)
    convert_kitti360pose(folder, tmp_path / "a.k360")
    found = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in size_table(Kitti360Pose.open(tmp_path / "a.k360")).splitlines()
    ]
    assert found[0] == ["MB of drive 0003", "110 cells"]
    assert found[3] == ["point cloud (published)", "1,310.67"]
    assert found[5] == ["scene graphs (published)", "0.13"]
    assert 0.0 < float(found[4][1]) < float(found[2][1])


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
