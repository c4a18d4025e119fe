from dataclasses import replace

import numpy as np
import pytest

from placegraph.errors import OptionError
from placegraph.indoor.encode import encoder
from placegraph.indoor.library.signature import (
    BANDS,
    TURNS,
    compute_signature,
    load_decoys,
)

LABELS = encoder("labels")


def test_a_signature_tells_what_is_seen_where(maps):
    scene = maps["study"]
    signature = compute_signature(scene, [LABELS])
    assert signature.panoramas.shape == (len(signature.places), BANDS, TURNS)
    assert signature.share.sum() == pytest.approx(1.0, abs=1e-5)
    labels = np.array([*scene.graph.labels, ""])
    seen = set(labels[signature.panoramas.ravel()])
    assert {"wall", "floor", "desk", "bookcase"} <= seen
    # from the most central place the bookcase, in the east, is seen in the east
    row = scene.graph.labels.index("bookcase")
    here = signature.places[0]
    away = scene.graph.positions[row, :2] - here
    turn = round(np.arctan2(away[1], away[0]) / (2 * np.pi / TURNS)) % TURNS
    assert row in signature.panoramas[0, :, turn]
    assert signature.rooms == () or all(signature.rooms)


def test_scenes_that_say_nothing_are_refused(maps):

    scene = maps["study"]
    nameless = replace(scene, graph=replace(scene.graph, labels=("object",) * len(scene)))
    with pytest.raises(OptionError, match=r"labels can use none of its \d+ objects"):
        compute_signature(nameless, [LABELS])


@pytest.mark.parametrize("name", ["labels", "appearance"])
def test_homes_have_vectors_of_the_encoders_as_they_are(name):
    made = encoder(name)
    homes = load_decoys([made])
    assert len(homes) >= 24
    vectors = np.concatenate([h.vectors[made.key] for h in homes])
    assert vectors.shape[1] == made.dimension
    assert vectors.any(axis=1).mean() > 0.8


def test_homes_say_nothing_to_encoders_they_do_not_know():
    class Other:
        name, key, dimension, temperature = "other", "other 1", 5, 0.1

    homes = load_decoys([encoder("labels"), Other()])
    assert all(h.vectors["other 1"].shape == (len(h), 5) for h in homes)
    assert not any(h.vectors["other 1"].any() for h in homes)
