import sys

import numpy as np
import pytest
import torch
from PIL import Image

from placegraph.errors import InputError, MissingExtraError, OptionError
from placegraph_learn.scenegraphloc.features import ColourFeatures, DinoFeatures, features_named


@pytest.mark.parametrize("kind", ["colour", "dino"])
@pytest.mark.parametrize("size", [(90, 160), (91, 157), (1, 1), (3, 500), (700, 2)])
def test_images_of_any_size_have_a_grid_of_unit_features(request, rng, size, kind):
    features = ColourFeatures() if kind == "colour" else request.getfixturevalue("dino")
    width = 17 if kind == "colour" else 24
    image = rng.integers(0, 256, (*size, 3), np.uint8)
    grid, crop = features.grid(image), features.crop(image)
    assert grid.shape == ((9, 16, width) if size[1] >= size[0] else (16, 9, width))
    assert grid.dtype == np.float32
    assert np.allclose(np.linalg.norm(grid, axis=2), 1.0, atol=1e-5)
    assert crop.shape == (width,)
    assert abs(float(np.linalg.norm(crop)) - 1.0) < 1e-5


def test_colours_are_told_apart_and_each_knows_itself(picture):
    grid = ColourFeatures().grid(picture)
    red, blue = grid[:, :8].reshape(-1, 17), grid[:, 8:].reshape(-1, 17)
    assert (red @ red.T).min() > (red @ blue.T).max()
    crop = ColourFeatures().crop(picture[:, :80])
    assert (red @ crop).min() > (blue @ crop).max()


BLOCK = 2


@pytest.fixture(scope="module")
def transformer(timm):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(2)
        model = timm.models.vision_transformer.VisionTransformer(
            img_size=70, patch_size=14, embed_dim=24, depth=4, num_heads=3, num_classes=0,
            init_values=0.5, dynamic_img_size=True,
        )  # fmt: skip
        for parameter in model.parameters():
            parameter.data += 0.2 * torch.randn_like(parameter)
    return model.eval()


@pytest.fixture(scope="module")
def dino(transformer):
    return DinoFeatures(transformer, name="tiny", block=BLOCK)


def _by_hook(model, image, stretched):
    """Values of the block as the model itself computes them, on an image already resized."""

    found = []
    hook = model.blocks[BLOCK].attn.qkv.register_forward_hook(
        lambda _module, _inputs, output: found.append(output)
    )
    mean, deviation = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    pixels = ((image / 255.0 - mean) / deviation).transpose(2, 0, 1)[None]
    table = model.pos_embed.data
    model.pos_embed.data = stretched  # what timm would stretch otherwise than DINOv2 does
    model.dynamic_img_size = stretched.shape == table.shape
    with torch.inference_mode():
        model(torch.from_numpy(pixels).float())
    hook.remove()
    model.pos_embed.data, model.dynamic_img_size = table, True
    values = found[0][0, :, -24:].numpy()
    return values / np.linalg.norm(values, axis=1, keepdims=True)


def test_features_are_values_of_the_block(dino, transformer, rng, monkeypatch):

    image = rng.integers(0, 256, (126, 224, 3), np.uint8)
    transformer.patch_embed.strict_img_size = False
    monkeypatch.setattr(transformer.patch_embed, "dynamic_img_pad", False)
    table = transformer.pos_embed
    square = table[:, 1:].reshape(1, 5, 5, 24).permute(0, 3, 1, 2)
    grid = torch.nn.functional.interpolate(square, scale_factor=(9.1 / 5, 16.1 / 5), mode="bicubic")
    stretched = torch.cat([table[:, :1], grid.flatten(2).transpose(1, 2)], dim=1).detach()
    transformer.patch_embed.flatten = True  # as without dynamic sizes
    transformer.patch_embed.output_fmt = None
    expected = _by_hook(transformer, image, stretched)
    assert np.abs(dino.grid(image).reshape(144, 24) - expected[1:]).max() < 1e-5


def test_a_turned_image_is_resized_as_it_was_taken(dino, rng):
    image = rng.integers(0, 256, (270, 480, 3), np.uint8)
    small = np.asarray(Image.fromarray(image).resize((224, 126), Image.Resampling.BICUBIC))
    once = dino._values(np.rot90(small, -1))[1:].reshape(16, 9, 24)
    assert np.array_equal(dino.grid(np.rot90(image, -1)), once)


def test_positions_matter_and_the_class_token_is_that_of_crops(dino, rng):
    flat = np.full((126, 224, 3), 90, np.uint8)
    grid = dino.grid(flat)  # the same pixels everywhere: only positions differ
    assert np.abs(grid - grid[0, 0]).max() > 1e-3
    square = rng.integers(0, 256, (224, 224, 3), np.uint8)
    assert np.array_equal(dino.crop(square), dino._values(square)[0])


def test_positions_are_stretched_as_dinov2_does_it(dino, transformer):
    """`interpolate_pos_encoding` of facebookresearch/dinov2, offset 0.1, by cubic convolution."""
    table = transformer.pos_embed[0, 1:].detach().numpy().reshape(5, 5, 24).astype(np.float64)

    def stretched(rows):
        """(rows, 5): weights of Keys' kernel, a = -0.75, at (i + 1/2) / scale - 1/2."""
        out = np.zeros((rows, 5))
        for i in range(rows):
            at = (i + 0.5) * 5 / (rows + 0.1) - 0.5
            for k in range(int(np.floor(at)) - 1, int(np.floor(at)) + 3):
                d, a = abs(at - k), -0.75
                near = (a + 2) * d**3 - (a + 3) * d**2 + 1
                far = a * (d**3 - 5 * d**2 + 8 * d - 4)
                out[i, min(max(k, 0), 4)] += near if d <= 1 else far
        return out

    wanted = np.einsum("ri,cj,ijf->rcf", stretched(9), stretched(16), table)
    got = dino._positions(9, 16)[0].detach().numpy()
    assert np.abs(got[1:].reshape(9, 16, 24) - wanted).max() < 1e-5
    assert np.array_equal(got[0], transformer.pos_embed[0, 0].detach().numpy())
    assert dino._positions(5, 5) is transformer.pos_embed


def test_what_is_wrong_is_named(timm, transformer, tmp_path, monkeypatch):
    name = "vit_tiny_patch16_224"
    (tmp_path / "cut.pth").write_bytes(b"PK\x03\x04 and no more")
    torch.save({"norm.weight": torch.ones(3)}, tmp_path / "other.pth")
    small = timm.create_model("test_vit", num_classes=0)
    torch.save(small.state_dict(), tmp_path / "small.pth")
    for file, options, error, words in (
        ("a.pth", {"model": "vit_none"}, OptionError, "has no model"),
        ("none.pth", {"model": name}, InputError, r"none\.pth"),
        ("cut.pth", {"model": name}, InputError, "is truncated"),
        ("other.pth", {"model": name}, InputError, "not the weights of"),
        ("small.pth", {"model": "test_vit", "block": 1}, OptionError, "do not fill"),
    ):
        with pytest.raises(error, match=words):
            DinoFeatures.load(tmp_path / file, **options)
    for block in (4, -1):
        with pytest.raises(OptionError, match="block"):
            DinoFeatures(transformer, name="tiny", block=block)
    for features, options, words in (
        ("sift", {}, "one of dinov2, colour"),
        ("colour", {"weights": "a.pth"}, "remove it"),
    ):
        with pytest.raises(OptionError, match=words):
            features_named(features, **options)
    assert features_named("colour").dimension == 17
    with pytest.raises(OptionError, match="at least one pixel"):
        ColourFeatures().grid(np.zeros((0, 5, 3), np.uint8))
    monkeypatch.setitem(sys.modules, "timm", None)
    with pytest.raises(MissingExtraError, match=r"placegraph\[learn\]"):
        DinoFeatures.load()
