import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

import placegraph as pg
from placegraph.core.geometry import Camera
from placegraph.errors import MapError, OptionError
from placegraph.indoor.encode import Encoder, bind_encoder, encoder
from placegraph.io.capture.frame import Frame
from placegraph_learn.scenegraphloc import SceneGraphLocEncoder
from placegraph_learn.scenegraphloc.features import MODEL, ColourFeatures
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
    tied = bind_encoder(made, room, [survey])
    said = tied.encode(survey[3])
    assert said.table.shape[1] == len(room)
    assert said.grid == (9, 16)
    assert np.abs(said.table).max() <= 1.0 + 1e-5
    held = room.with_embeddings(made.objects(room, [survey]), encoder=made.key)
    again = bind_encoder(made, held).encode(survey[3])
    assert np.abs(again.table - said.table).max() < 0.05  # 8 bits a number


def test_without_images_of_the_map_it_says_so_or_does_without(made, tiny_weights, room, survey):
    with pytest.raises(OptionError, match="views=False"):
        made.objects(room)
    blind = SceneGraphLocEncoder(tiny_weights, views=False)
    vectors = blind.objects(room)
    assert vectors.shape == (len(room), 64)
    assert np.abs(made.objects(room, [survey]) - vectors).max() > 1e-3
    with pytest.raises(MapError, match="labels"):
        bind_encoder(made, room.with_embeddings(vectors, encoder="labels"))


@pytest.mark.parametrize("size", [(1, 1), (7, 3), (91, 157), (160, 90)])
def test_images_of_odd_size_have_patches(made, rng, size):
    height, width = size
    camera = Camera(width, height, 50.0, 50.0, width / 2, height / 2)
    frame = Frame.from_arrays(
        rng.integers(0, 256, (height, width, 3), np.uint8), camera, gravity=(0, 1, 0)
    )
    straight = made.patches(frame)
    assert straight.shape == ((9, 16, 64) if width >= height else (16, 9, 64))
    if size == (160, 90):  # the grid is in the image's own orientation
        other = Camera(160, 90, 50.0, 50.0, 80.0, 45.0)
        lying = Frame.from_arrays(np.rot90(frame.rgb()), other, gravity=(1, 0, 0))
        assert np.allclose(np.rot90(straight), made.patches(lying), atol=1e-6)


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
        ({"weights": None}, "none are given"),
        ({"features": Flat()}, "trained on"),
        ({"features": "sift"}, "one of"),
        ({"attributes": tmp_path / "words.txt"}, "has 2 words, but the network has 164"),
        ({"temperature": 0.0}, "temperature"),
        ({"device": "abacus"}, "device"),
        ({"colour": "red"}, "colour"),
    ):
        with pytest.raises(OptionError, match=message):
            encoder("scenegraphloc", **({"weights": tiny_weights} | options))
    weights = read_weights(tiny_weights)
    with pytest.raises(OptionError, match="3 numbers, but the network was trained on 17"):
        SceneGraphLocEncoder(replace(weights, notes={}), features=Flat())
    with pytest.raises(OptionError, match="mine-3"):
        SceneGraphLocEncoder(replace(weights, notes={"features": "mine-3"}))


def test_a_scene_without_relations_is_encoded(made, room, survey):
    n = np.zeros(0, np.int64)
    bare = replace(room, graph=replace(room.graph, sources=n, targets=n, relations=()))
    vectors = made.objects(bare, [survey])
    assert np.isfinite(vectors).all()
    assert np.abs(vectors - made.objects(room, [survey])).max() > 1e-4


WIDTH = 1536
NEEDED = 7e9
"""Bytes of disk that make a file of 4.5 GB."""


def draw_dino(timm):
    """State dict of DINOv2 ViT-g/14, spelled as dinov2_vitg14_pretrain.pth is."""
    with torch.device("meta"):
        model = timm.create_model(MODEL, num_classes=0)
    drawn, state = torch.Generator().manual_seed(0), {"mask_token": torch.zeros(1, WIDTH)}
    for name, known in model.state_dict().items():
        middle = 0.1 if "gamma" in name else float("norm" in name and name.endswith("weight"))
        spelled = name.replace("mlp.fc1", "mlp.w12").replace("mlp.fc2", "mlp.w3")
        state[spelled] = middle + 0.02 * torch.randn(known.shape, generator=drawn)
    return state


@pytest.fixture
def files(timm, shared, tmp_path):
    free = shutil.disk_usage(tmp_path).free
    if free < NEEDED:
        pytest.skip(f"needs {NEEDED / 1e9:.0f} GB of disk, and has {free / 1e9:.1f}")
    known = load_file(shared / "conformance/scenegraphloc/state_dict.safetensors")
    snapshot, dino = tmp_path / "snapshot.pth.tar", tmp_path / "dinov2_vitg14_pretrain.pth"
    torch.save({"epoch": 60, "iteration": 1, "model": known}, snapshot)
    torch.save(draw_dino(timm), dino)
    yield snapshot, dino
    dino.unlink()


@pytest.mark.all
def test_from_the_authors_files_to_a_pose(files, room, walk, survey, truth, tmp_path):

    snapshot, dino = files
    torch.set_num_threads(torch.get_num_interop_threads())
    made = encoder(f"scenegraphloc weights={snapshot} feature_weights={dino} rotate=False")
    assert (made.dimension, made.features.dimension) == (400, WIDTH)
    patches = made.patches(walk[0])
    assert patches.shape == (9, 16, 400)
    assert np.linalg.norm(patches, axis=2) == pytest.approx(1.0, abs=1e-5)
    assert np.ptp(patches.reshape(144, 400) @ patches[0, 0]) > 1e-3

    known = room.with_embeddings(made.objects(room, [survey[:1]]), encoder=made.key)
    known.save(tmp_path / "known.scene")
    opened = pg.open_map(tmp_path / "known.scene")
    found = opened.localize(walk, frames=slice(2), encoder=made, seed=0)
    off = found.best.map_from_camera[:3, 3] - truth(walk)[1, :3, 3]
    assert np.linalg.norm(off) < 0.5  # by its depth: the network knows nothing

    library = pg.SceneLibrary(made)
    library.add("room", tmp_path / "known.scene")
    assert library.search(walk[:1]).best.scene == "room"
