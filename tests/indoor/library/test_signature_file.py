"""The homes beside every library."""

import numpy as np
import pytest

from placegraph.indoor.encode import encoder
from placegraph.indoor.library.signature import decoys


@pytest.mark.parametrize("name", ["labels", "appearance"])
def test_homes_have_vectors_of_the_encoders_as_they_are(name):
    """Where this fails, an encoder has changed: run `placegraph-lab decoys` again."""
    made = encoder(name)
    homes = decoys([made])
    assert len(homes) >= 24
    vectors = np.concatenate([h.vectors[made.key] for h in homes])
    assert vectors.shape[1] == made.dimension
    assert vectors.any(axis=1).mean() > 0.8


def test_homes_say_nothing_to_encoders_they_do_not_know():
    class Other:
        name, key, dimension, temperature = "other", "other 1", 5, 0.1

    homes = decoys([encoder("labels"), Other()])
    assert all(h.vectors["other 1"].shape == (len(h), 5) for h in homes)
    assert not any(h.vectors["other 1"].any() for h in homes)
