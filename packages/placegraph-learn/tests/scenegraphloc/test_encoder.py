"""The encoder: vectors of patches and objects, what is in its key, and what goes wrong."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.errors import InputError, MapError, MissingExtraError, OptionError
from placegraph.indoor.encode import Encoder, bound, encoder
from placegraph.io.capture.frame import Frame
from placegraph_learn.scenegraphloc import SceneGraphLocEncoder
from placegraph_learn.scenegraphloc.features import ColourFeatures
from placegraph_learn.scenegraphloc.weights import read_weights


@pytest.fixture(scope="module")
def made(tiny_weights):
    return SceneGraphLocEncoder(tiny_weights)


def test_it_is_an_encoder_of_the_registry(tiny_weights):
    found = encoder("scenegraphloc", weights=tiny_weights)
    assert isinstance(found, Encoder)
    assert isinstance(found, SceneGraphLocEncoder)
    assert (found.name, found.dimension, found.temperature) == ("scenegraphloc", 64, 0.07)
    assert read_weights(tiny_weights).digest in found.key
    assert ColourFeatures.key in found.key


def test_patches_and_objects_are_unit_vectors(made, room, survey):
    vectors = made.objects(room, [survey])
    assert vectors.shape == (len(room), 64)
    assert vectors.dtype == np.float32
    assert np.allclose(np.linalg.norm(vectors, axis=1), 1.0, atol=1e-5)
    patches = made.patches(survey[0])
    assert patches.shape == (9, 16, 64)
    assert np.allclose(np.linalg.norm(patches, axis=2), 1.0, atol=1e-5)
    assert made.camera(survey[0]) == survey.camera
    assert np.array_equal(made.objects(room, [survey]), vectors)  # the same seed, the same points


def test_bound_to_a_map_it_compares_patches_with_objects(made, room, survey):
    tied = bound(made, room, [survey])
    said = tied.encode(survey[3])
    assert said.table.shape[1] == len(room)
    assert said.grid == (9, 16)
    assert np.abs(said.table).max() <= 1.0 + 1e-5
    held = room.with_embeddings(made.objects(room, [survey]), encoder=made.key)
    again = bound(made, held).encode(survey[3])
    assert np.abs(again.table - said.table).max() < 0.05  # 8 bits a number


def test_a_map_of_another_encoder_is_refused(made, room):
    other = room.with_embeddings(np.ones((len(room), 3)), encoder="labels")
    with pytest.raises(MapError, match="labels"):
        bound(made, other)


def test_without_images_of_the_map_it_says_so_or_does_without(made, tiny_weights, room):
    with pytest.raises(OptionError, match="views=False"):
        made.objects(room)
    blind = SceneGraphLocEncoder(tiny_weights, views=False)
    assert blind.objects(room).shape == (len(room), 64)
    assert blind.key != made.key


def test_images_of_the_map_matter(made, tiny_weights, room, survey):
    blind = SceneGraphLocEncoder(tiny_weights, views=False)
    assert np.abs(made.objects(room, [survey]) - blind.objects(room)).max() > 1e-3


@pytest.mark.parametrize("size", [(1, 1), (7, 3), (91, 157), (200, 40)])
def test_images_of_odd_size_have_patches(made, rng, size):
    height, width = size
    camera = Camera(width, height, 50.0, 50.0, width / 2, height / 2)
    frame = Frame.from_arrays(
        rng.integers(0, 256, (height, width, 3), np.uint8), camera, gravity=(0, 1, 0)
    )
    assert made.patches(frame).shape == ((9, 16, 64) if width >= height else (16, 9, 64))


def test_the_grid_is_in_the_images_own_orientation(made, rng):
    camera = Camera(90, 160, 80.0, 80.0, 45.0, 80.0)
    image = rng.integers(0, 256, (160, 90, 3), np.uint8)
    upright = Frame.from_arrays(image, camera, gravity=(0, 1, 0))
    lying = Frame.from_arrays(
        np.rot90(image), Camera(160, 90, 80.0, 80.0, 80.0, 45.0), gravity=(1, 0, 0)
    )
    straight, turned = made.patches(upright), made.patches(lying)
    assert straight.shape == (16, 9, 64)
    assert turned.shape == (9, 16, 64)
    assert np.allclose(np.rot90(straight), turned, atol=1e-6)


def test_settings_that_change_vectors_are_in_the_key(tiny_weights, tmp_path):
    (tmp_path / "words.txt").write_text("\n".join(f"w{i}" for i in range(164)), encoding="utf-8")
    keys = {
        SceneGraphLocEncoder(tiny_weights, **options).key
        for options in (
            {}, {"points": "vertices"}, {"views": False}, {"seed": 2},
            {"attributes": tmp_path / "words.txt"},
        )
    }  # fmt: skip
    assert len(keys) == 5
    assert SceneGraphLocEncoder(tiny_weights, temperature=0.5).key in keys


class Flat(ColourFeatures):
    key, dimension = "flat", 3


def test_options_that_do_not_fit_the_network_are_refused(tiny_weights, tmp_path):
    (tmp_path / "words.txt").write_text("red\nblue\n", encoding="utf-8")
    for options, message in (
        ({"weights": None}, "none given"),
        ({"features": Flat()}, "trained on"),
        ({"features": "sift"}, "one of"),
        ({"attributes": tmp_path / "words.txt"}, "2 words, the network counts 164"),
        ({"temperature": 0.0}, "temperature"),
        ({"device": "abacus"}, "device"),
        ({"colour": "red"}, "colour"),
    ):
        with pytest.raises(OptionError, match=message):
            encoder("scenegraphloc", **({"weights": tiny_weights} | options))


def test_features_of_another_width_are_refused(tiny_weights):
    weights = replace(read_weights(tiny_weights), notes={})
    with pytest.raises(OptionError, match="3 numbers, the network was trained on 17"):
        SceneGraphLocEncoder(weights, features=Flat())


def test_unknown_features_of_a_file_must_be_passed(tiny_weights):
    weights = replace(read_weights(tiny_weights), notes={"features": "mine-3"})
    with pytest.raises(OptionError, match="mine-3"):
        SceneGraphLocEncoder(weights)


def test_a_file_cut_short_is_refused(tiny_weights, tmp_path):
    path = tmp_path / "cut.safetensors"
    path.write_bytes(tiny_weights.read_bytes()[:5000])
    with pytest.raises(InputError, match="cut short"):
        encoder("scenegraphloc", weights=path)


@pytest.mark.parametrize("module", ["torch", "safetensors.torch"])
def test_without_pytorch_one_is_told_what_to_install(tiny_weights, monkeypatch, module):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=r"placegraph\[learn\]"):
        SceneGraphLocEncoder(tiny_weights)


def test_a_scene_without_relations_is_encoded(made, room, survey):
    n = np.zeros(0, np.int64)
    bare = replace(room, graph=replace(room.graph, sources=n, targets=n, relations=()))
    vectors = made.objects(bare, [survey])
    assert np.isfinite(vectors).all()
    assert np.abs(vectors - made.objects(room, [survey])).max() > 1e-4
