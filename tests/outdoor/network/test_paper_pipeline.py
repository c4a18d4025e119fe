"""GOTLoc as printed against `paper_pipeline`, an independent implementation: by steps, and whole."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.outdoor.network import paper_pipeline as theirs

from placegraph.core.graph import SceneGraph
from placegraph.errors import OptionError
from placegraph.outdoor.language import describe
from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.map.directions_kernels import WINDS, relate_pairs
from placegraph.outdoor.network import network
from placegraph.outdoor.network.label_graphs import LabelGraphs, name_label
from placegraph.outdoor.network.network import EncodedCity
from placegraph.outdoor.search.cells import retrieve
from placegraph.outdoor.search.request import Matching, parse

TEXTS = (
    "The bench is on the north of the tree. The tree is on the west of the bakery.",
    "The bakery is on the south of the fountain. The fountain is on the south of the bench.",
    "The tree is on the east of the bench. The bench is on the west of the tree.",
    "The fountain is on the north of the church. The residential is on the south of the church.",
)


@pytest.fixture(scope="module")
def printed(make_network):
    return make_network(printed=True, layers=2, crossings=2)


@pytest.fixture(scope="module")
def encoded(harbour, printed):
    return EncodedCity(harbour, printed)


@pytest.fixture(scope="module")
def paper(printed):
    def vector(label):
        return printed.word_vectors((label,))[0]

    shape = printed.shape
    return theirs.JointNetwork(
        printed.arrays, vector, layers=shape.layers, crossings=shape.crossings, heads=shape.heads
    )


def edges_of(graphs, k):
    rows = slice(*graphs.edge_starts[k : k + 2])
    ends, winds = graphs.ends[rows].tolist(), graphs.winds[rows]
    return {(i, WINDS[wind], j) for (i, j), wind in zip(ends, winds, strict=True)}


def labels_of(graphs, k):
    return [graphs.vocabulary[row] for row in graphs.labels[slice(*graphs.starts[k : k + 2])]]


@pytest.fixture(scope="module")
def places(harbour):
    """Graphs of the paper, of the points where the objects of each cell are."""
    found = []
    for cell in harbour.cells:
        graph = harbour.graph(cell)
        labels = [name_label(label) for label in graph.labels]
        found.append(theirs.map_graph(labels, graph.positions, harbour.cells.edge_distance))
    return found


def test_graphs_of_cells(harbour, places):
    graphs = LabelGraphs.of_cells(harbour)
    assert len(graphs) == len(places) == len(harbour.cells)
    for k, (labels, edges) in enumerate(places):
        assert labels_of(graphs, k) == labels
        assert edges_of(graphs, k) == edges
    assert sum(len(edges) for _, edges in places) == len(graphs.ends) > 100


COORDINATES = st.integers(-40, 40).map(float)  # whole numbers: diagonals and equal points occur


@given(points=st.lists(st.tuples(COORDINATES, COORDINATES), min_size=1, max_size=6))
def test_relations_of_points(points):
    labels = [f"thing={'abcdef'[i]}" for i in range(len(points))]
    named = [name_label(label) for label in labels]
    _, edges = theirs.map_graph(named, points, 30.0)
    sources, relations, targets = zip(*edges, strict=True) if edges else ((), (), ())
    graph = SceneGraph(
        tuple(named), tuple(labels), np.array(points), np.array(sources, np.int64),
        np.array(targets, np.int64), relations,
    )  # fmt: skip
    assert edges_of(LabelGraphs.of_graphs([graph]), 0) == edges
    starts, ends, winds = relate_pairs(np.array([0, len(points)]), np.array(points), 30.0)
    found = {(int(i), WINDS[w], int(j)) for (i, j), w in zip(ends, winds, strict=True)}
    assert starts.tolist() == [0, len(edges)]
    assert found == edges


@pytest.mark.parametrize("text", TEXTS)
def test_graphs_of_texts(text):
    graphs = LabelGraphs.of_texts([describe(text)])
    labels, edges = theirs.text_graph(text)
    assert labels_of(graphs, 0) == labels
    assert edges_of(graphs, 0) == edges


@pytest.mark.parametrize(
    ("text", "labels", "edges"),
    [
        ("The bench is north of me. A tree is near the bench.", ["bench", "tree"], 0),
        ("There is no bench. The tree is east of the church.", ["tree", "church"], 2),
        ("Die Bäckerei ist nordöstlich der Bushaltestelle.", ["bakery", "bus stop"], 2),
        ("There is no bench.", [""], 0),
    ],
)
def test_what_the_paper_has_not_is_left_out(text, labels, edges):
    graphs = LabelGraphs.of_texts([describe(text)])
    assert labels_of(graphs, 0) == labels
    assert len(graphs.ends) == edges


def test_a_diagonal_is_north_or_south_from_both_ends():
    graphs = LabelGraphs.of_texts([describe("The cafe is northwest of the bench.")])
    assert edges_of(graphs, 0) == {(0, "north", 1), (1, "south", 0)}


def test_embeddings(printed, encoded, paper, places):
    for k in range(0, len(places), 9):
        whole = paper.embed(places[k])
        assert encoded.embeddings[k] == pytest.approx(whole / np.linalg.norm(whole), abs=1e-5)
    for text in TEXTS:
        whole = paper.embed(theirs.text_graph(text))
        (found,) = printed.embed_texts(LabelGraphs.of_texts([describe(text)]))
        assert found == pytest.approx(whole / np.linalg.norm(whole), abs=1e-5)


def test_joint_embeddings_cosine_and_probability(printed, encoded, paper, places):
    rows = np.arange(0, len(places), 15)
    for text in TEXTS:
        found = printed.match(LabelGraphs.of_texts([describe(text)]), 0, encoded.cells, rows)
        joint = [paper.join(theirs.text_graph(text), places[k]) for k in rows]
        assert found.cosine == pytest.approx([theirs.cosine(*pair) for pair in joint], abs=1e-4)
        logits = [paper.perceptron(*pair) for pair in joint]
        assert found.logit == pytest.approx(logits, rel=1e-3, abs=1e-3)


def test_the_preset_is_the_pipeline_of_the_paper(harbour, encoded, paper, places):
    for text in TEXTS:
        matching = replace(Matching.preset("paper"), encoded=encoded)
        found = retrieve(harbour, parse(harbour, text), matching, top=3)
        _, scores = theirs.retrieve(paper, theirs.text_graph(text), places, 3)
        assert found.scores == pytest.approx(scores, abs=1e-4)
        # random weights: cosines of several cells are equal but for rounding
        own = [theirs.cosine(*paper.join(theirs.text_graph(text), places[k])) for k in found.rows]
        assert own == pytest.approx(scores, abs=1e-4)


@pytest.fixture(scope="module")
def learned(encoded, printed):
    """Texts about three cells in one batch, and what PyTorch makes of them."""
    torch = pytest.importorskip("torch", reason="PyTorch is not installed (extra learn)")
    from placegraph_learn.city.batches import forward
    from placegraph_learn.city.cell_lessons import CellLessons
    from placegraph_learn.city.network import Network

    texts = LabelGraphs.of_texts(list(map(describe, TEXTS)))
    lessons = CellLessons(texts, encoded.cells, np.array([3, 20, 11, 3]))
    network = Network(printed.shape)
    network.load_state_dict({n: torch.from_numpy(a) for n, a in printed.arrays.items()})
    batch = lessons.batch(np.arange(4))
    with torch.no_grad():
        return lessons, batch, forward(network.eval(), lessons, batch, "cpu")


def test_numpy_is_torch(encoded, printed, learned):
    lessons, batch, scores = learned
    cells = np.array([3, 11, 20])
    assert batch.right.reshape(4, 3).tolist() == [[1, 0, 0], [0, 0, 1], [0, 1, 0], [1, 0, 0]]
    for q in range(4):
        found = printed.match(lessons.texts, q, encoded.cells, cells)
        mine = batch.pairs.text == q
        assert found.logit == pytest.approx(scores.logit[mine].numpy(), rel=1e-4, abs=1e-4)
        assert found.cosine == pytest.approx(scores.cosine[mine].numpy(), abs=1e-5)
        assert found.embedding == pytest.approx(scores.embedding[q].numpy(), abs=1e-5)


def test_losses(learned, paper, places):
    from placegraph_learn.city.train import Temperatures, losses

    _, batch, scores = learned
    none = Temperatures(*(scores.logit[:1],) * 3)
    found = losses(scores, batch.truth("cpu"), none, ("eq17", "eq18"))
    right = {(0, 0), (1, 2), (2, 1), (3, 0)}
    texts = [theirs.text_graph(text) for text in TEXTS]
    match, similarity = theirs.losses(paper, texts, [places[c] for c in (3, 11, 20)], right)
    assert found["eq17"].item() == pytest.approx(match, rel=1e-4)
    assert found["eq18"].item() == pytest.approx(similarity, abs=1e-4)


def test_many_cells_are_matched_some_at_a_time(harbour, encoded, monkeypatch):
    text = encoded.text(compile_query(parse(harbour, TEXTS[0]), harbour))
    rows = np.arange(len(harbour.cells))
    whole = encoded.match(text, encoded.cells, rows)
    monkeypatch.setattr(network, "BATCH_SIZE", len(rows) // 3)
    for one, other in zip(whole, encoded.match(text, encoded.cells, rows), strict=True):
        assert one.shape == rows.shape
        assert other == pytest.approx(one, abs=1e-4)


def test_a_network_of_cells_does_not_rank_viewpoints(harbour, encoded):
    with pytest.raises(OptionError, match="fused matching ranks viewpoints"):
        Matching("fused", encoded=encoded).check(harbour)
    with pytest.raises(OptionError, match="fused matching ranks viewpoints"):
        Matching("fused", printed=True).check(harbour)
