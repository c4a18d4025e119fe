import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from placegraph.core.geometry import Camera
from placegraph.errors import InputError, MapError, MissingExtraError, OptionError, ServiceError
from placegraph.indoor.encode import Encoder, bind_encoder, encoder
from placegraph.io.capture.frame import Frame
from placegraph_learn.features import find_patch_objects

NETWORKS = {"test_vit": 16, "test_resnet": 32, "test_convnext": 32}
"""Small ones that timm has for tests, and the sides of their patches [px]."""


def made(model="test_vit", **options):
    return encoder("features", model=model, **{"pretrained": False, "device": "cpu"} | options)


def frame_of(shape, rng):
    camera = Camera(shape[1], shape[0], 100.0, 100.0, shape[1] / 2, shape[0] / 2)
    return Frame.from_arrays(rng.integers(0, 256, (*shape, 3), np.uint8), camera)


@pytest.fixture(scope="module")
def vit(timm):  # noqa: ARG001
    return made()


@pytest.fixture(scope="module")
def posed(walk, truth):
    frames = (replace(f, odometry=p) for f, p in zip(walk, truth(walk), strict=True))
    return replace(walk, frames=tuple(frames))


@pytest.fixture(scope="module")
def vectors(vit, room, posed):
    return vit.objects(room, [posed])


@pytest.mark.parametrize("model", NETWORKS)
def test_any_backbone_gives_a_grid(timm, model, rng):  # noqa: ARG001
    one = made(model)
    assert isinstance(one, Encoder)
    for shape, grid in (((90, 160), (9, 16)), ((160, 90), (16, 9)), ((61, 87), (11, 16))):
        patches = one.patches(frame_of(shape, rng))
        assert patches.shape == (*grid, one.dimension)
        assert np.linalg.norm(patches, axis=-1) == pytest.approx(1.0, abs=1e-4)
    assert one._backbone.cell == NETWORKS[model]


@pytest.mark.parametrize("shape", [(1, 1), (1, 700), (2000, 3001)])
def test_images_of_odd_sizes(vit, shape, rng):
    rows, columns, _ = vit.patches(frame_of(shape, rng)).shape
    assert columns == 16
    assert rows == max(1, round(16 * shape[0] / shape[1]))


def test_size_layer_and_weights_decide_the_key(timm, vit, tmp_path, rng):
    larger, earlier, again, image = made(size=400), made(layer=0), made(), frame_of((90, 160), rng)
    assert larger.patches(image).shape[:2] == (14, 25)
    assert len({vit.key, larger.key, earlier.key}) == 3
    assert vit.key.startswith("features test_vit ")
    assert again.key == vit.key
    assert again.patches(image) == pytest.approx(vit.patches(image), abs=1e-5)
    path = tmp_path / "larger.pt"  # weights of another image size
    torch.save(timm.create_model("test_vit", img_size=320, num_classes=0).state_dict(), path)
    assert made(weights=path).dimension == 64


@pytest.mark.parametrize("ending", ["pt", "safetensors"])
def test_weights_from_a_file(timm, vit, tmp_path, ending, rng):

    torch.manual_seed(5)
    state = timm.create_model("test_vit").state_dict()  # with a head, which nobody wants
    path = tmp_path / f"weights.{ending}"
    (torch.save if ending == "pt" else save_file)(state, path)
    one = made(weights=path, pretrained=True)
    assert one.key != vit.key
    image = frame_of((90, 160), rng)
    assert np.abs(one.patches(image) - vit.patches(image)).max() > 0.1
    assert one.key == made(weights=str(path)).key


@pytest.mark.parametrize("ending", ["pt", "safetensors"])
@pytest.mark.parametrize(
    ("model", "factor", "words"),
    [("test_resnet", 1.0, r"weights\."), ("test_vit", float("nan"), "not finite")],
)
def test_bad_weights(timm, tmp_path, model, factor, words, ending):
    state = {k: v * factor for k, v in timm.create_model(model).state_dict().items()}
    path = tmp_path / f"weights.{ending}"
    (torch.save if ending == "pt" else save_file)(state, path)
    with pytest.raises(InputError, match=words):
        made(weights=path)


def test_bad_options(timm, monkeypatch):
    for options, words in (
        ({"model": "vit_of_nobody"}, "has no model"),
        ({"layer": 77}, "layer 77"),
        ({"size": 8}, "size is 8"),
        ({"temperature": 0.0}, "temperature"),
        ({"device": "abacus"}, "device"),
        ({"colour": "red"}, "colour"),
    ):
        with pytest.raises(OptionError, match=words):
            made(**options)

    def offline(*_args, **_options):
        raise OSError("no route to host")

    monkeypatch.setattr(timm, "create_model", offline)
    with pytest.raises(ServiceError, match="give weights=FILE"):
        encoder("features")
    monkeypatch.setitem(sys.modules, "timm", None)
    with pytest.raises(MissingExtraError, match=r"placegraph\[learn\]"):
        made()


def test_patches_cover_what_label_images_say(room, posed):
    for frame in posed[:3]:
        patch, row, share = find_patch_objects(room, frame, (9, 16))
        assert np.bincount(patch, share, 144).max() <= 1.0
        ids = frame.labels()
        h, w = ids.shape
        most = share > 0.8
        agree = [
            str(ids[int((p // 16 + 0.5) * h / 9), int((p % 16 + 0.5) * w / 16)])
            == room.graph.ids[r]
            for p, r in zip(patch[most].tolist(), row[most].tolist(), strict=True)
        ]
        assert len(agree) > 40
        assert np.mean(agree) > 0.97


def test_what_stands_before_the_map_is_not_the_map(room, posed):
    frame = posed[0]
    near = np.full((90, 160), 0.2, np.float32)
    near[:, 80:] = np.nan
    hidden = Frame.from_arrays(frame.rgb(), frame.camera, depth=near, odometry=frame.odometry)
    patch, _, _ = find_patch_objects(room, hidden, (9, 16))
    assert patch.size
    assert (patch % 16 >= 8).all()


def test_objects_are_what_saw_them(room, posed, vectors, vit):
    seen = np.unique(np.concatenate([find_patch_objects(room, f, (9, 16))[1] for f in posed]))
    lengths = np.linalg.norm(vectors, axis=1)
    assert lengths[seen] == pytest.approx(1.0, abs=1e-4)
    assert not np.delete(lengths, seen).any()
    ranks = []
    for frame in posed:
        patch, row, share = find_patch_objects(room, frame, (9, 16))
        cosines = vit.patches(frame).reshape(144, -1) @ vectors[seen].T
        for p, r in zip(patch[share > 0.8], row[share > 0.8], strict=True):
            ranks.append((cosines[p] < cosines[p, seen == r]).mean())
    assert np.mean(ranks) > 0.6  # even weights of no meaning know the same from the other


def test_objects_need_images(vit, room, posed, vectors):
    with pytest.raises(OptionError, match="captures"):
        vit.objects(room)
    with pytest.raises(MapError, match="use the same encoder for both"):
        bind_encoder(vit, room.with_embeddings(np.eye(len(room)), encoder="labels"))
    kept = bind_encoder(vit, room.with_embeddings(vectors, encoder=vit.key)).encode(posed[0])
    made_now = bind_encoder(vit, room, [posed]).encode(posed[0])
    assert kept.grid == made_now.grid == (9, 16)
    assert kept.table == pytest.approx(made_now.table, abs=0.05)
