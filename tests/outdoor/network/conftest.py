"""Networks of random weights, texts and places to read."""

import numpy as np
import pytest

from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.network.encoded import EncodedCity
from placegraph.outdoor.network.network import GraphTransformer
from placegraph.outdoor.network.shape import Shape
from placegraph_lab.train.city.sample import Speaker

SMALL = Shape(width=16, dimension=12, heads=2, layers=2, crossings=2, evidence=8)


def random_arrays(shape, seed=0):
    rng = np.random.default_rng(seed)
    return {
        name: rng.normal(scale=0.3, size=size).astype(np.float32)
        for name, size in shape.arrays().items()
    }


def adding(arrays, weight):
    """Arrays of a network that adds `weight` times as much to relational matching."""
    loud = {name: array.copy() for name, array in arrays.items()}
    for name, array in loud.items():
        if name.endswith("verdict.weight"):
            array[1] *= weight
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

    def make(seed=0, fusion=0.3, **sizes):
        shape = Shape(**{**SMALL.to_dict(), **sizes})
        arrays = adding(random_arrays(shape, seed), fusion)
        return GraphTransformer(shape, arrays, f"random {seed}")

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
    return Speaker(harbour, vocabulary), Speaker(harbour, vocabulary, held=True)


@pytest.fixture(scope="session")
def pool(speakers):
    """Examples from the shipped town."""
    from placegraph_lab.train.city.pool import fill

    return fill(speakers[0], 24, np.random.default_rng(5))


@pytest.fixture(scope="session")
def texts(pool):
    return pool.texts


@pytest.fixture(scope="session")
def places(harbour):
    from placegraph.outdoor.network.graphs import PlaceGraphs

    return PlaceGraphs.of_cells(harbour)
