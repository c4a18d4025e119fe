"""A tiny network, and captures of the drawn room whose poses are in its map."""

import numpy as np
import pytest
import torch

from placegraph_learn.scenegraphloc.features import ColourFeatures
from placegraph_learn.scenegraphloc.lessons import place_capture
from placegraph_learn.scenegraphloc.network import SceneGraphLoc, Widths
from placegraph_learn.scenegraphloc.weights import write_weights


@pytest.fixture(scope="session")
def survey(walk, truth):
    """The walk through the room as one of the map: its odometry is map_from_camera."""
    return place_capture(walk, truth(walk))


@pytest.fixture(scope="session")
def tiny_weights(tmp_path_factory):
    """Random weights of a small network on features of colour, as a file."""
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(11)
        network = SceneGraphLoc(Widths.small(ColourFeatures.dimension))
    write_weights(path, network, {"features": ColourFeatures.key, "temperature": "0.07"})
    return path


@pytest.fixture
def picture(rng):
    """Random image (90, 160, 3) whose left half is red and whose right half is blue."""
    image = rng.integers(0, 40, (90, 160, 3), np.uint8)
    image[:, :80, 0] += 200
    image[:, 80:, 2] += 200
    return image
