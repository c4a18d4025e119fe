"""Cities drawn node by node, and networks of random weights that read texts and places."""

from contextlib import contextmanager
from xml.sax.saxutils import quoteattr

import numpy as np
import pytest

from placegraph.core.geometry import LocalPlane
from placegraph.outdoor.city import build_city
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.map.objects import of_name
from placegraph.outdoor.network.graphs import PlaceGraphs
from placegraph.outdoor.network.network import EncodedCity, GraphTransformer
from placegraph.outdoor.network.network_kernels import MAX_OBJECTS
from placegraph.outdoor.network.weights import Shape
from placegraph.outdoor.network.weights import list_weight_shapes as sizes_of
from placegraph_learn.city.descriptions import Speaker

PLANE = LocalPlane(10.0, 50.0)
SMALL = Shape(width=16, dimension=12, heads=2, layers=2, crossings=2, evidence=8)


def _xml(kind, i, attributes, inner, tags):
    tag = "".join(f"<tag k={quoteattr(k)} v={quoteattr(v)}/>" for k, v in tags.items())
    return f'<{kind} id="{i}" version="1"{attributes}>{inner}{tag}</{kind}>'


def _write_world(path, nodes, ways=(), relations=()):
    """Nodes (east, north, tags), ways (rows of nodes, tags), relations (rows and roles, tags)."""
    lines = ['<osm version="0.6">']
    for i, (east, north, tags) in enumerate(nodes, 1):
        lon, lat = PLANE.to_lonlat((east, north))
        lines.append(_xml("node", i, f' lon="{lon:.7f}" lat="{lat:.7f}"', "", tags))
    for i, (rows, tags) in enumerate(ways, 1):
        inner = "".join(f'<nd ref="{row + 1}"/>' for row in rows)
        lines.append(_xml("way", i, "", inner, tags))
    for i, (members, tags) in enumerate(relations, 1):
        inner = "".join(
            f'<member type="way" ref="{row + 1}" role="{role}"/>' for row, role in members
        )
        lines.append(_xml("relation", i, "", inner, {"type": "multipolygon"} | tags))
    path.write_text("\n".join([*lines, "</osm>"]), encoding="utf-8")
    return path


@pytest.fixture
def write_world(tmp_path):
    """Write nodes (east, north, tags), ways and multipolygons around 10 E, 50 N as OSM XML."""
    return lambda *things, name="world.osm": _write_world(tmp_path / name, *things)


@pytest.fixture
def build_world(write_world, tmp_path):
    """City of nodes (east, north, tags), ways and multipolygons around 10 E, 50 N."""

    def build(*things, **options):
        with osmium_in_process():
            return build_city(write_world(*things), tmp_path / "world.city", **options)

    return build


@contextmanager
def osmium_in_process():
    """Read sound files of OpenStreetMap in this process: starting another takes longer than all else."""

    def refuse(*_, **__):
        raise OSError

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("subprocess.Popen", refuse)
        yield


def random_arrays(shape, seed=0, known=None):
    rng = np.random.default_rng(seed)
    return {
        name: rng.normal(scale=0.3, size=size).astype(np.float32)
        for name, size in sizes_of(shape, known).items()
    }


def adding(arrays, weight):
    """Arrays of a network that adds `weight` times as much to relational matching."""
    loud = {name: array.copy() for name, array in arrays.items()}
    for name, array in loud.items():
        if name.endswith("verdict.weight"):
            array[1] *= weight
    if "prior" in arrays:
        loud["prior"] = np.ones(3, np.float32)
    return loud


@pytest.fixture(scope="session")
def network():
    return GraphTransformer(SMALL, adding(random_arrays(SMALL), 0.3), "random")


@pytest.fixture(scope="module")
def one_thread():
    """PyTorch on one thread: so small are the networks of tests."""
    torch = pytest.importorskip("torch", reason="PyTorch is not installed (extra learn)")
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def make_network():
    """Network of random weights: a seed, fields of the shape that differ, how much it adds."""

    def make(seed=0, fusion=0.3, known=None, **sizes):
        shape = Shape(**{**SMALL.to_dict(), **sizes})
        arrays = adding(random_arrays(shape, seed, known), fusion)
        return GraphTransformer(shape, arrays, f"random {seed}", known)

    return make


@pytest.fixture(scope="session")
def encoded(harbour, network):
    """The shipped town as the random network reads it."""
    return EncodedCity(harbour, network)


@pytest.fixture(scope="session")
def vocabulary():
    return Vocabulary.default()


@pytest.fixture(scope="session")
def speakers(harbour, vocabulary):
    """In the tiles of training, and in those held out."""
    return Speaker(harbour, vocabulary), Speaker(harbour, vocabulary, held_out=True)


@pytest.fixture(scope="session")
def pool(speakers):
    """Examples from the shipped town."""
    from placegraph_learn.city.descriptions import make_pool

    return make_pool(speakers[0], 24, np.random.default_rng(5))


@pytest.fixture(scope="session")
def texts(pool):
    return pool.texts


@pytest.fixture(scope="session")
def places(harbour):
    from placegraph.outdoor.network.graphs import PlaceGraphs

    return PlaceGraphs.of_cells(harbour)


def places_of_graphs(graphs, centers):
    """Graphs of any scene graphs with positions in a plane, around `centers` (K, 2) [m]."""
    rows, offsets, words, starts = {}, [], [], [0]
    for graph, center in zip(graphs, centers, strict=True):
        off = graph.positions[:, :2] - center
        nearest = np.argsort(np.hypot(*off.T), kind="stable")[:MAX_OBJECTS]
        offsets.append(off[nearest])
        for i in nearest:
            called = [graph.labels[i]]
            called += [of_name(graph.names[i])] if graph.names[i] else []
            words.append([rows.setdefault(word, len(rows)) for word in called])
        starts.append(len(words))
    flat = [word for thing in words for word in thing]
    return PlaceGraphs(
        np.array(starts, np.int64),
        np.concatenate([np.zeros((0, 2)), *offsets]).astype(np.float32),
        np.zeros(len(words), np.uint8),
        np.concatenate(([0], np.cumsum([len(thing) for thing in words]))).astype(np.int64),
        np.array(flat, np.int32),
        np.ones(len(flat), np.float32),
        tuple(rows),
    )
