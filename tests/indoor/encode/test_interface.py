from importlib.metadata import EntryPoint
from string import Formatter

import numpy as np
import pytest

from placegraph.core import plugins
from placegraph.errors import MapError, MissingExtraError, OptionError
from placegraph.indoor.encode import (
    Encoder,
    MapEncoder,
    bind_encoder,
    encode_objects,
    encode_patches,
    encoder,
    make_map_encoder,
    parse_encoder,
)
from placegraph.indoor.refine.matching import matcher


@pytest.mark.parametrize("name", ["labels", "appearance"])
def test_encoders_by_name_read_a_map(name, room):
    made = encoder(name)
    assert isinstance(made, Encoder)
    assert made.name == name
    assert made.key.startswith(name)
    reader = make_map_encoder(name, room)
    assert isinstance(reader, MapEncoder)
    assert make_map_encoder(reader, room) is reader
    vectors = encode_objects(made, room)
    assert vectors.shape == (len(room), made.dimension)
    lengths = np.linalg.norm(vectors, axis=1)
    np.testing.assert_allclose(lengths[lengths > 0], 1.0, atol=1e-5)


def test_options_are_said_with_the_name():
    said = "labels weights='my file.pth' rotate=True temperature=0.5 name=a=b"
    options = {"weights": "my file.pth", "rotate": True, "temperature": 0.5, "name": "a=b"}
    assert parse_encoder(said) == ("labels", options)
    assert encoder("appearance").key == encoder("  appearance ").key
    for wrong in ("labels colour=1", "labels colour", "labels 'colour", ""):
        with pytest.raises(OptionError):
            encoder(wrong)
    with pytest.raises(OptionError, match="one of labels, appearance"):
        encoder("votes")
    with pytest.raises(OptionError, match="'labels'"):
        encoder("labels", colour=1)


class Fixed:
    name, key, dimension, temperature = "fixed", "fixed 1", 3, 0.1

    def __init__(self, image=None, vectors=None):
        self.image, self.vectors = image, vectors

    def patches(self, _image):
        return self.image

    def camera(self, image):
        return image.camera

    def objects(self, _scene, _captures=()):
        if self.vectors is None:
            raise OptionError("captures: there is none.")
        return self.vectors


def test_a_bound_encoder_compares_all_patches_with_all_objects(room, walk):
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(len(room), 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    image = np.zeros((2, 3, 3), np.float32)
    image[0, 0], image[1, 2] = vectors[0], vectors[1]
    said = bind_encoder(Fixed(image, vectors), room).encode(walk[0])
    assert said.grid == (2, 3)
    assert said.rows[[1, 2, 3, 4]].tolist() == [-1] * 4
    assert said.temperature == 0.1
    np.testing.assert_allclose(said.table[said.rows[0]], vectors @ vectors[0], atol=1e-5)
    np.testing.assert_allclose(said.table[said.rows[5]], vectors @ vectors[1], atol=1e-5)
    assert bind_encoder(Fixed(None, vectors), room).encode(walk[0]) is None


@pytest.mark.parametrize(
    "image", [np.full((2, 2, 3), np.nan), np.zeros((2, 2, 4)), np.zeros((4, 3))]
)
def test_patches_that_are_none(image, walk):
    with pytest.raises(OptionError, match=r"patches are .* in frame 0, expected"):
        encode_patches(Fixed(image.astype(np.float32)), walk[0])


def test_vectors_of_the_map_come_first_and_those_of_others_are_refused(room):
    own = np.eye(len(room), 3)
    held = room.with_embeddings(own, encoder="fixed 1")
    np.testing.assert_allclose(encode_objects(Fixed(), held), own, atol=0.01)
    other = room.with_embeddings(own, encoder="fixed 2")
    with pytest.raises(MapError, match=r"fixed 2.*fixed 1"):
        encode_objects(Fixed(), other)
    with pytest.raises(OptionError, match="captures"):
        encode_objects(Fixed(), room)
    with pytest.raises(
        OptionError, match=r"vectors are \(17, 3\) in flat\.glb, expected \(17, 3\)"
    ):
        encode_objects(Fixed(vectors=np.full((len(room), 3), np.inf)), room)


@pytest.mark.parametrize(
    ("make", "group", "name"),
    [(encoder, plugins.ENCODERS, "features"), (matcher, plugins.MATCHERS, "roma")],
)
def test_others_join_by_entry_points(monkeypatch, make, group, name):
    found = {}
    monkeypatch.setattr(plugins, "plugins", lambda asked: found if asked == group else {})
    with pytest.raises(MissingExtraError, match=r"pip install 'placegraph\[learn\]'"):
        make(name)
    with pytest.raises(OptionError, match="'mine'"):
        make("mine")
    found["mine"] = EntryPoint("mine", "string:Formatter", group)
    assert isinstance(make("mine"), Formatter)
