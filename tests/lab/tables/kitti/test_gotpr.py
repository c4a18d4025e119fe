import json

import numpy as np
import pytest

from placegraph.errors import InputError
from placegraph_lab.datasets.pickles import file_of, read_graphs
from placegraph_lab.tables.named.outdoor_gotpr import BigGNN, recalls


@pytest.fixture(scope="module")
def folder(gotpr_world, tmp_path_factory):
    return gotpr_world.write_graphs(tmp_path_factory.mktemp("gotpr"))


@pytest.fixture(scope="module")
def cells(folder):
    return read_graphs(file_of(folder, "scene_graphs/osm_cell_graphs_*.pkl"))


@pytest.fixture(scope="module")
def texts(folder):
    return read_graphs(file_of(folder, "scene_graphs/osm_test_text_graphs_*.pkl"))


def transformer_conv(state, name, x, ends, features, heads):
    """`TransformerConv` as its documentation prints it, for one node and one head at a time."""

    def linear(part, v):
        w = state[f"{name}.TConv.lin_{part}.weight"].astype(float) @ v
        return w + state.get(f"{name}.TConv.lin_{part}.bias", 0.0)

    c = x.shape[1]
    out = []
    for i in range(len(x)):
        total = np.zeros(c)
        for h in range(heads):
            part = slice(h * c, (h + 1) * c)
            come = [(j, linear("edge", f)[part]) for (j, to), f in zip(ends, features, strict=True)
                    if to == i]  # fmt: skip
            logits = [
                linear("query", x[i])[part] @ (linear("key", x[j])[part] + e) for j, e in come
            ]
            weights = np.exp(np.array(logits) / np.sqrt(c))
            for (j, e), a in zip(come, weights, strict=True):
                total += a / weights.sum() * (linear("value", x[j])[part] + e) / heads
        found = total + linear("skip", x[i])
        out.append(np.where(found > 0, found, 0.01 * found))
    return np.array(out)


def big_gnn(state, layers, heads, one, two):
    """`BigGNN.forward`: both pooled embeddings and the matching probability."""
    (x1, ends1, e1), (x2, ends2, e2) = one, two
    for i in range(layers):
        x1 = transformer_conv(state, f"TSALayers.{i}", x1, ends1, e1, heads)
        x2 = transformer_conv(state, f"GSALayers.{i}", x2, ends2, e2, heads)
        n, m, nothing = len(x1), len(x2), np.zeros(x1.shape[1])
        across1 = [(a, n + b) for a in range(n) for b in range(m)]
        across2 = [(b, m + a) for b in range(m) for a in range(n)]
        both1, both2 = np.vstack([x1, x2]), np.vstack([x2, x1])
        zeros = [nothing] * (n * m)
        x1 = transformer_conv(state, f"TCALayers.{i}", both1, across1, zeros, heads)[:n]
        x2 = transformer_conv(state, f"GCALayers.{i}", both2, across2, zeros, heads)[:m]
    p1, p2 = x1.mean(axis=0), x2.mean(axis=0)
    hidden = np.concatenate([p1, p2])
    for k in (0, 2, 4):
        hidden = state[f"SceneText_MLP.{k}.weight"] @ hidden + state[f"SceneText_MLP.{k}.bias"]
        if k < 4:
            hidden = np.where(hidden > 0, hidden, 0.01 * hidden)
    return p1, p2, float(1 / (1 + np.exp(-hidden[0])))


def plain(graphs, name):
    graph = graphs.graphs[name]
    return graphs.vectors[graph.nodes], graph.ends.T.tolist(), graphs.vectors[graph.edges]


@pytest.mark.parametrize(("layers", "heads"), [(1, 2), (2, 1)])
def test_the_forward_pass_is_the_published_one(gotpr_world, texts, cells, layers, heads):
    state = gotpr_world.state(layers, heads)
    network = BigGNN.of(state, "x")
    assert (network.layers, network.heads, network.width) == (layers, heads, 6)
    said, there = network.texts(texts), network.places(cells)
    names, places = list(texts.graphs), list(cells.graphs)
    for t, k in ((0, 12), (5, 3), (11, 23)):
        one, two = plain(texts, names[t]), plain(cells, places[k])
        p1, p2, probability = big_gnn(state, layers, heads, one, two)
        assert said[t] == pytest.approx(p1, rel=1e-4, abs=1e-5)
        assert there[k] == pytest.approx(p2, rel=1e-4, abs=1e-5)
        found = network.probability(said[t : t + 1], there[k : k + 1])
        assert found[0] == pytest.approx(probability, abs=1e-5)
    first = transformer_conv(state, "TSALayers.0", *plain(cells, places[4]), heads).mean(axis=0)
    assert network.first(cells)[4] == pytest.approx(first, rel=1e-4, abs=1e-5)


def test_the_table_runs_a_release(gotpr_world, folder, tmp_path, capsys):
    torch = pytest.importorskip("torch", reason="PyTorch is not installed (extra learn)")
    from placegraph_lab.tables.named.outdoor_gotpr import outdoor_gotpr
    from placegraph_lab.tables.runner import Run

    weights = folder / "model_checkpoints" / "model_osm.pt"
    weights.parent.mkdir(exist_ok=True)
    torch.save({k: torch.from_numpy(v) for k, v in gotpr_world.state().items()}, weights)
    run = Run("outdoor_gotpr", tmp_path, tmp_path, tmp_path / "a.json")
    outdoor_gotpr.measure(run, folder)
    said = capsys.readouterr().out
    assert "| published " in said
    assert ".22 |" in said
    told = json.loads((tmp_path / "a.json").read_text())
    assert (told["cells"], told["texts"]) == (24, {"val": 24, "test": 24})
    network = BigGNN.open(weights)
    for split, found in zip(("val", "test"), told["rows"]["all cells"], strict=True):
        graphs = read_graphs(file_of(folder, f"scene_graphs/osm_{split}_text_graphs_*.pkl"))
        cells = read_graphs(file_of(folder, "scene_graphs/osm_cell_graphs_*.pkl"))
        expected = recalls(network, graphs, cells, candidates=None)
        assert found == pytest.approx({str(k): v for k, v in expected.items()}, rel=1e-5)
    outdoor_gotpr.measure(run, folder, quick=True)
    assert "test k" not in capsys.readouterr().out
    weights.write_bytes(b"no weights")
    with pytest.raises(InputError, match="weights of 'GOTPR'"):
        BigGNN.open(weights)
