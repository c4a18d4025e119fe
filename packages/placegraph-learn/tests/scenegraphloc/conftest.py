import numpy as np
import pytest
import torch

from placegraph_learn.scenegraphloc.features import ColourFeatures
from placegraph_learn.scenegraphloc.lessons import place_capture
from placegraph_learn.scenegraphloc.network import SceneGraphLoc, Widths
from placegraph_learn.scenegraphloc.weights import write_weights


@pytest.fixture(scope="session")
def survey(walk, truth):
    return place_capture(walk, truth(walk))


@pytest.fixture(scope="session")
def tiny_weights(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(11)
        network = SceneGraphLoc(Widths.small(ColourFeatures.dimension))
    write_weights(path, network, {"features": ColourFeatures.key, "temperature": "0.07"})
    return path


@pytest.fixture
def picture(rng):
    image = rng.integers(0, 40, (90, 160, 3), np.uint8)
    image[:, :80, 0] += 200
    image[:, 80:, 2] += 200
    return image
