import os
import pickle

import numpy as np
import pytest

from placegraph.errors import InputError
from placegraph_lab.datasets.pickles import file_of, read_graphs

CELLS = "scene_graphs/osm_cell_graphs_*.pkl"


@pytest.mark.parametrize("lists", [False, True])
def test_graphs_are_read_as_they_were_written(gotpr_world, tmp_path, lists):
    gotpr_world.write_graphs(tmp_path, cells=3, lists=lists)
    found = read_graphs(file_of(tmp_path, CELLS))
    assert list(found.graphs) == [f"{d}_{k:05d}" for d in ("0010", "0003") for k in range(3)]
    assert len(found.vectors) <= 12, "each word once"
    assert found.vectors.dtype == np.float32
    known, rng = gotpr_world.vectors(), np.random.default_rng(3)
    for graph in found.graphs.values():
        nodes, edges = gotpr_world.drawn(rng, 6)
        assert graph.labels == tuple(nodes.values())
        row = {i: n for n, i in enumerate(nodes)}
        assert graph.ends.T.tolist() == [[row[a], row[b]] for a, _, b in edges]
        for rows, words in ((graph.nodes, nodes.values()), (graph.edges, [w for _, w, _ in edges])):
            assert np.array_equal(found.vectors[rows], [known[w] for w in words])


def first(graph):
    return next(iter(graph.nodes.values()))


SPOILT = {
    "no nodes": (lambda g: g.__dict__.pop("nodes"), "has no nodes"),
    "nodes in a list": (lambda g: g.__dict__.update(nodes=[]), "nodes is not of type dict"),
    "no node at all": (lambda g: g.__dict__.update(nodes={}), "nodes are missing"),
    "a node that is none": (lambda g: g.nodes.update({99: type(g)()}), "is not of type Node"),
    "the same node twice": (lambda g: g.nodes.update({99: first(g)}), "there twice"),
    "an edge to nowhere": (lambda g: g.edge_idx[0].__setitem__(0, 77), "node that is not there"),
    "an end too many": (lambda g: g.edge_idx[1].append(3), "two ends"),
    "a short vector": (lambda g: first(g).__dict__.update(features=[1.0]), "numbers"),
    "a word for a vector": (lambda g: first(g).__dict__.update(features="bench"), "is not a vector"),
    "not a number": (lambda g: first(g).__dict__.update(features=[np.nan] * 6), "not a number"),
    "no index": (lambda g: first(g).__dict__.update(idx="0"), "idx is not of type int"),
}  # fmt: skip


@pytest.mark.parametrize("name", SPOILT)
def test_what_is_wrong_is_said_with_its_id(gotpr_world, tmp_path, name):
    what, says = SPOILT[name]
    gotpr_world.write_graphs(tmp_path, cells=2, edit=lambda found: what(next(iter(found.values()))))
    with pytest.raises(InputError, match=rf"osm_cell_graphs_4\.pkl, 0010_00000.*{says}"):
        read_graphs(file_of(tmp_path, CELLS))


def test_nothing_of_a_file_is_run(tmp_path):
    class Run:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "mark"),)

    path = tmp_path / "osm_cell_graphs_1.pkl"
    for value, says in (({"0003_00000": Run()}, r"asks for .*mkdir"), ([], "no graphs by id")):
        path.write_bytes(pickle.dumps(value))
        with pytest.raises(InputError, match=says):
            read_graphs(path)
    assert not (tmp_path / "mark").exists()
