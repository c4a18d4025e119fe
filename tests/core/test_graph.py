"""The scene graph: columns that fit together, and the way to NetworkX and back."""

import sys
from dataclasses import FrozenInstanceError

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as stnp

from placegraph import SceneGraph
from placegraph.errors import MissingExtraError, OptionError

finite = {"allow_nan": False, "allow_infinity": False}


@st.composite
def graphs(draw):
    n = draw(st.integers(0, 6))
    m = draw(st.integers(0, 10)) if n else 0
    d = draw(st.sampled_from([2, 3]))
    rows = stnp.arrays(np.int64, m, elements=st.integers(0, max(n - 1, 0)))
    texts = lambda count: st.lists(st.text(), min_size=count, max_size=count)  # noqa: E731
    coordinates = stnp.arrays(np.float64, (n, d), elements=st.floats(**finite))
    lengths = stnp.arrays(np.float64, (n, d), elements=st.floats(0, **finite))
    e = draw(st.integers(0, 4))
    vectors = stnp.arrays(np.float32, (n, e), elements=st.floats(width=32, **finite))
    weights = stnp.arrays(np.float64, m, elements=st.floats(**finite))
    return SceneGraph(
        ids=draw(st.lists(st.text(), min_size=n, max_size=n, unique=True)),
        labels=draw(texts(n)),
        names=draw(texts(n)),
        positions=draw(coordinates),
        extents=draw(st.none() | lengths),
        embeddings=draw(st.none() | vectors),
        sources=draw(rows),
        targets=draw(rows),
        relations=draw(texts(m)),
        weights=draw(st.none() | weights),
    )


def columns(**changes):
    """Columns of a small graph: a bakery north of a church, which stands near a bench."""
    base = {
        "ids": ("node/1", "way/2", "node/3"),
        "labels": ("shop=bakery", "building=church", "amenity=bench"),
        "names": ("", "St. Mary", ""),
        "positions": [[0.0, 30.0], [0.0, 0.0], [3.0, 4.0]],
        "sources": [0, 1],
        "targets": [1, 2],
        "relations": ("north", "near"),
    }
    return base | changes


@given(graphs())
def test_to_networkx_and_back_is_exact(graph):
    back = SceneGraph.from_networkx(graph.to_networkx())
    assert back == graph
    for name in ("positions", "sources", "targets", "extents", "embeddings", "weights"):
        a, b = getattr(back, name), getattr(graph, name)
        assert (a is None) == (b is None)
        assert a is None or (a.dtype == b.dtype and a.tobytes() == b.tobytes()), name


def test_networkx_speaks_of_ids_and_attributes():
    graph = SceneGraph(**columns(extents=np.ones((3, 2)), weights=[0.5, 2.0])).to_networkx()
    assert isinstance(graph, nx.MultiDiGraph)
    assert graph.nodes["way/2"] == {
        "label": "building=church",
        "name": "St. Mary",
        "position": (0.0, 0.0),
        "extent": (1.0, 1.0),
    }
    assert list(graph.edges(data=True)) == [
        ("node/1", "way/2", {"relation": "north", "weight": 0.5}),
        ("way/2", "node/3", {"relation": "near", "weight": 2.0}),
    ]


def test_graphs_made_with_networkx_are_read():
    graph = nx.DiGraph()
    graph.add_node(7, label="a", position=[0, 0, 1])
    graph.add_node(8, label="b", position=np.array([1.0, 2.0, 3.0]), name="B")
    graph.add_edge(8, 7, relation="on")
    found = SceneGraph.from_networkx(graph)
    assert found.ids == ("7", "8")
    assert found.names == ("", "B")
    assert found.positions.tolist() == [[0, 0, 1], [1, 2, 3]]
    assert found.triples() == [("b", "on", "a")]
    assert found.weights is None
    with pytest.raises(OptionError, match="undirected"):
        SceneGraph.from_networkx(nx.Graph())


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda g: g.nodes["way/2"].pop("label"), "node 'way/2' has no attribute 'label'"),
        (lambda g: g.nodes["way/2"].pop("position"), "node 'way/2' has no attribute 'position'"),
        (lambda g: g.nodes["way/2"].update(extent=(1, 1)), "node 'node/1' has no .* 'extent'"),
        (lambda g: g.edges["node/1", "way/2", 0].clear(), "edge 'node/1' -> 'way/2' .*'relation'"),
        (lambda g: g.nodes["way/2"].update(position=(1, 1, 1)), "positions: not an array"),
        (lambda g: g.nodes["way/2"].update(label=3), "labels: 3 is not a string"),
    ],
)
def test_what_networkx_lacks_is_named(spoil, sentence):
    graph = SceneGraph(**columns()).to_networkx()
    spoil(graph)
    with pytest.raises(OptionError, match=sentence):
        SceneGraph.from_networkx(graph)


def test_without_networkx_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "networkx", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'placegraph\[networkx\]'"):
        SceneGraph(**columns()).to_networkx()


@given(graphs(), st.data())
def test_a_subgraph_keeps_what_lies_inside(graph, data):
    rows = data.draw(st.permutations(range(len(graph))).map(lambda p: p[: len(p) // 2 + 1]))
    part = graph.subgraph(rows)
    assert part.ids == tuple(graph.ids[i] for i in rows)
    assert np.array_equal(part.positions, graph.positions[rows])

    def edges(g):
        ends = zip(g.sources, g.relations, g.targets, strict=True)
        return [(g.ids[s], relation, g.ids[t]) for s, relation, t in ends]

    kept = set(part.ids)
    assert edges(part) == [e for e in edges(graph) if e[0] in kept and e[2] in kept]


@given(graphs())
def test_the_whole_is_a_subgraph_of_itself(graph):
    assert graph.subgraph(range(len(graph))) == graph
    assert graph.subgraph(np.ones(len(graph), bool)) == graph
    assert len(graph.subgraph(np.zeros(len(graph), bool))) == 0


@pytest.mark.parametrize("rows", [[0, 0], [3], [-1], [0.5], [[0]], [True]])
def test_rows_that_are_not_there(rows):
    with pytest.raises(OptionError, match=r"^rows: "):
        SceneGraph(**columns()).subgraph(rows)


def test_triples_are_labels_and_relations():
    graph = SceneGraph(**columns(names=()))
    assert graph.names == ("", "", "")
    assert graph.triples() == [
        ("shop=bakery", "north", "building=church"),
        ("building=church", "near", "amenity=bench"),
    ]


def test_nothing_in_it_can_change():
    positions = np.zeros((3, 2))
    graph = SceneGraph(**columns(positions=positions))
    positions[:] = 7
    assert np.all(graph.positions == 0), "the graph has its own copy"
    with pytest.raises(FrozenInstanceError):
        graph.ids = ()
    for name in ("positions", "sources", "targets"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(graph, name)[0] = 1


def test_graphs_compare_by_content():
    graph = SceneGraph(**columns())
    assert graph == SceneGraph(**columns())
    assert graph != SceneGraph(**columns(weights=[1, 1]))
    assert graph != SceneGraph(**columns(relations=("north", "south")))
    assert graph != "graph"
    with pytest.raises(TypeError, match="unhashable"):
        hash(graph)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"labels": ("a",)}, "labels: 1 entries are given, expected 3"),
        ({"names": ("a",)}, "names: 1 entries are given, expected 3"),
        ({"labels": ("a", None, "c")}, "labels: None is not a string"),
        ({"ids": ("a", "b", "a")}, "ids: 'a' is used by several nodes"),
        ({"positions": np.zeros((2, 2))}, r"positions: shape is \(2, 2\), expected \(3, any\)"),
        ({"positions": np.zeros((3, 4))}, "positions: they have 4 dimensions"),
        ({"positions": [[0, 0], [0, 0], [0]]}, "positions: not an array of numbers"),
        ({"positions": [[0, 0], [0, float("nan")], [0, 0]]}, "positions: .*not finite"),
        ({"extents": -np.ones((3, 2))}, "extents: a length is negative"),
        ({"extents": np.ones((3, 3))}, r"extents: shape is \(3, 3\), expected \(3, 2\)"),
        ({"embeddings": np.full((3, 2), 1e300)}, "embeddings: .*too large for float32"),
        ({"embeddings": np.zeros(3)}, r"embeddings: shape is \(3,\)"),
        ({"weights": [1.0]}, r"weights: shape is \(1,\), expected \(2\)"),
        ({"sources": [0]}, r"sources: shape is \(1,\), but there are 2 relations"),
        ({"targets": [0, 3]}, "targets: a row index is outside 0 to 2"),
        ({"targets": [0, -1]}, "targets: a row index is outside 0 to 2"),
        ({"targets": [0.0, 1.0]}, "targets: float64"),
    ],
)
def test_columns_that_do_not_fit(changes, sentence):
    with pytest.raises(OptionError, match=sentence):
        SceneGraph(**columns(**changes))
