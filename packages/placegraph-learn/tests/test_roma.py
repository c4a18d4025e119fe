import os
import subprocess
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from placegraph.errors import InputError, MissingExtraError, OptionError, ServiceError
from placegraph.indoor.refine.matching import Matcher, matcher
from placegraph.indoor.refine.matching.matches import to_normalised, to_pixels

pytest.importorskip("kornia", reason="needs kornia: pip install 'placegraph[roma]'")

SHIFT = np.array([14.0, -9.0])
"""How far the view is shifted [px of the query's size]."""


def grid(height, width):
    y, x = ((2.0 * np.arange(n) + 1.0) / n - 1.0 for n in (height, width))
    return np.stack(np.meshgrid(x, y), axis=-1)


def moved(own, sizes, by):
    """Where pixels of one image lie in the other; normalised, cut as RoMa does it."""
    return np.clip(to_normalised(to_pixels(own, sizes[0]) + by, sizes[1]), -1, 1)


class Network(torch.nn.Module):
    symmetric = True

    def __init__(self, shape=(48, 64)):
        super().__init__()
        self.shape, self.asked = shape, []

    def match(self, first, second, *args):
        assert not args
        sizes = [(image.height, image.width) for image in (first, second)]
        self.asked.append(sizes)
        own = grid(*self.shape)
        forth = np.concatenate([own, moved(own, sizes, SHIFT)], axis=-1)
        back = np.concatenate([moved(own, sizes[::-1], -SHIFT), own], axis=-1)
        warp = torch.from_numpy(np.concatenate([forth, back], axis=1)[None]).float()
        certainty = 1.0 - 0.1 * (warp.abs() >= 1).any(dim=-1).float() * 10
        return warp, certainty


class Tiny(Network):
    symmetric = False

    def match(self, first, second):
        warp, certainty = super().match(first, second)
        width = self.shape[1]
        return warp[0, :, :width], certainty[0, :, :width]  # no batch for PIL images


class NetworkV2(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.state = torch.hub.load_state_dict_from_url("https://hub/romav2.pt", map_location="cpu")
        self.both = False
        self.weight = torch.nn.Parameter(torch.zeros(3))
        self.load_state_dict(self.state)

    def apply_setting(self, setting):
        self.both = setting == "precise"

    def match(self, first, second):
        assert first.dtype == np.uint8
        sizes = first.shape[:2], second.shape[:2]
        own = grid(40, 40)
        tensors = [
            torch.from_numpy(moved(own, s, by)[None]).float()
            for s, by in ((sizes, SHIFT), (sizes[::-1], -SHIFT))
        ]
        sure = [1.0 - (t.abs() >= 1).any(dim=-1, keepdim=True).float() for t in tensors]
        answer = {"warp_AB": tensors[0], "overlap_AB": sure[0], "warp_BA": None, "overlap_BA": None}
        return answer | ({"warp_BA": tensors[1], "overlap_BA": sure[1]} if self.both else {})


@pytest.fixture
def library(monkeypatch, tmp_path):
    calls = []

    def make(kind):
        def made(
            device, *, weights, dinov2_weights, coarse_res, upsample_res, use_custom_corr,
            upsample_preds,
        ):  # fmt: skip
            calls.append(
                SimpleNamespace(
                    kind=kind, device=device, weights=weights, under=dinov2_weights,
                    sizes=(coarse_res, upsample_res), fine=upsample_preds, custom=use_custom_corr,
                )
            )  # fmt: skip
            if "wrong" in weights:
                raise RuntimeError("Error(s) in loading:\n\tUnexpected key: wrong")
            return Network()

        return made

    def tiny(weights=None, freeze_xfeat=False, exact_softmax=False, xfeat=None):
        assert not freeze_xfeat
        assert not exact_softmax
        calls.append(SimpleNamespace(kind="tiny", weights=weights, xfeat=xfeat))
        return Tiny()

    zoo = ModuleType("romatch.models.model_zoo")
    zoo.weight_urls = {
        "romatch": {"indoor": "https://hub/indoor.pth", "outdoor": "https://hub/outdoor.pth"},
        "tiny_roma_v1": {"outdoor": "https://hub/tiny.pth"},
        "dinov2": "https://hub/dinov2.pth",
    }
    zoo.roma_indoor, zoo.roma_outdoor = make("indoor"), make("outdoor")
    zoo.tiny_roma_v1_model = tiny
    for name in ("romatch", "romatch.models"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setitem(sys.modules, zoo.__name__, zoo)
    files = {}
    for name in ("roma", "dino", "wrong"):
        files[name] = tmp_path / f"{name}.pth"
        torch.save({name: torch.zeros(2)}, files[name])
    return SimpleNamespace(calls=calls, **files)


@pytest.fixture
def library_v2(monkeypatch, tmp_path):
    package, where = ModuleType("romav2"), ModuleType("romav2.device")
    package.RoMaV2, where.device = NetworkV2, torch.device("cpu")
    monkeypatch.setitem(sys.modules, "romav2", package)
    monkeypatch.setitem(sys.modules, "romav2.device", where)
    path = tmp_path / "v2.pt"
    torch.save({"weight": torch.ones(3)}, path)
    return SimpleNamespace(weights=path, where=where)


def check_shift(found):
    assert len(found) > 300
    assert np.allclose(found.rendered - found.query, SHIFT, atol=1e-3)


@pytest.mark.parametrize("kind", ["indoor", "outdoor"])
def test_roma_is_asked_and_answers_in_pixels(library, picture, kind):
    made = matcher(
        "roma", weights=library.roma, backbone=library.dino, kind=kind, size=112, fine=160
    )
    (call,) = library.calls
    assert (call.kind, str(call.device), call.sizes, call.fine) == (kind, "cpu", (112, 160), True)
    assert "roma" in call.weights
    assert "dino" in call.under
    assert not call.custom
    assert isinstance(made, Matcher)
    wide = picture[:200, :300]
    for found in made.match(picture, [picture, wide]):
        check_shift(found)
        assert len(found) <= 2000
    assert made._network.asked == [[(240, 320), (240, 320)], [(240, 320), (200, 300)]]
    matcher("roma", weights=library.roma, backbone=library.dino, size=112, fine=0)
    assert library.calls[1].fine is False  # without a second look


def test_tiny_roma_sees_images_that_are_not_too_large(library, picture):
    made = matcher("roma", weights=library.roma, kind="tiny", size=154)
    assert library.calls[0].kind == "tiny"
    assert type(library.calls[0].xfeat).__name__ == "XFeatModel"
    (found,) = made.match(picture, [picture])
    assert made._network.asked[0][0][1] == 154
    scale = 320 / 154  # the network speaks of pixels of the smaller image
    assert np.allclose(found.rendered - found.query, SHIFT * scale, atol=0.2)


@pytest.mark.parametrize("setting", ["turbo", "precise"])
def test_roma_v2_answers_in_pixels(library_v2, picture, setting):
    made = matcher("romav2", weights=library_v2.weights, setting=setting)
    assert made._network.state["weight"].sum() == 3
    for found in made.match(picture, [picture, picture[:200, :300]]):
        check_shift(found)
    assert made._network.both == (setting == "precise")


@pytest.fixture(params=["roma", "tiny", "romav2"])
def adapter(request, library, library_v2):
    if request.param == "romav2":
        return matcher("romav2", weights=library_v2.weights)
    kind = "tiny" if request.param == "tiny" else "indoor"
    return matcher("roma", weights=library.roma, backbone=library.dino, kind=kind)


def test_masks_blank_and_tiny_images(adapter, picture, rng):
    mask = np.zeros(picture.shape[:2], bool)
    mask[60:180, 100:260] = True
    (found,) = adapter.match(picture, [picture], masks=[mask])
    x, y = found.rendered.T
    assert len(found) > 100
    assert ((x >= 104) & (x < 256) & (y >= 64) & (y < 176)).all()
    burnt = np.full_like(picture, 255)
    speck = rng.integers(0, 256, (9, 11, 3), dtype=np.uint8)
    for query, view in ((burnt, picture), (picture, burnt), (speck, picture), (picture, speck)):
        assert len(adapter.match(query, [view])[0]) == 0
    assert len(adapter.match(picture[:, :, 0], [picture[:, :, 0]])[0]) > 100
    a, b = (adapter.match(picture, [picture])[0] for _ in range(2))
    assert np.array_equal(a.query, b.query)
    assert np.array_equal(a.rendered, b.rendered)


def test_wrong_weights_are_named(library, library_v2, tmp_path):
    with pytest.raises(InputError, match=r"wrong\.pth contains weights of another network"):
        matcher("roma", weights=library.wrong, backbone=library.dino)
    with pytest.raises(InputError, match=r"wrong\.pth contains weights of another network"):
        matcher("romav2", weights=library.wrong)
    (tmp_path / "junk.pth").write_bytes(b"junk")
    with pytest.raises(InputError, match=r"junk\.pth cannot be read as weights"):
        matcher("roma", weights=library.roma, backbone=tmp_path / "junk.pth")
    assert library_v2.weights.exists()


@pytest.mark.parametrize(
    ("name", "options", "urls"),
    [
        ("roma", {}, ["https://hub/indoor.pth", "https://hub/dinov2.pth"]),
        ("roma", {"kind": "outdoor"}, ["https://hub/outdoor.pth", "https://hub/dinov2.pth"]),
        ("roma", {"kind": "tiny"}, ["https://hub/tiny.pth"]),
        ("romav2", {}, ["https://hub/romav2.pt"]),
    ],
)
def test_without_files_the_hub_is_asked_and_nothing_is_unpickled(
    monkeypatch, library, library_v2, name, options, urls
):
    assert library.calls == []
    asked = []

    def fetch(url, *, map_location, weights_only):
        assert weights_only
        assert map_location == "cpu"
        asked.append(url)
        return torch.load(library_v2.weights, weights_only=True)

    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", fetch)
    matcher(name, **options)
    assert asked == urls
    assert torch.hub.load_state_dict_from_url is fetch  # as it was

    def unreachable(*_args, **_kwargs):
        raise OSError("no route")

    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", unreachable)
    with pytest.raises(ServiceError, match="cannot be reached"):
        matcher(name, **options)


def test_options_out_of_range_are_refused(library, library_v2):
    for name, options, named in (
        ("roma", {"kind": "underwater"}, "underwater"),
        ("roma", {"size": 555}, "555"),
        ("roma", {"least": 2}, "least"),
        ("romav2", {"setting": "warp"}, "warp"),
        ("romav2", {"count": 0}, "count"),
        ("roma", {"device": "abacus"}, "abacus"),
    ):
        with pytest.raises(OptionError, match=named):
            matcher(name, weights=library.roma, **options)
    library_v2.where.device = torch.device("cuda")
    with pytest.raises(OptionError, match="device is 'cpu', but romav2 always runs on 'cuda'"):
        matcher("romav2", weights=library_v2.weights, device="cpu")


@pytest.mark.parametrize(("name", "missing"), [("roma", "romatch"), ("romav2", "romav2")])
def test_without_the_library_it_says_what_to_install(monkeypatch, name, missing):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(MissingExtraError, match=r"placegraph\[roma\]"):
        matcher(name)


PACKAGES = "romatch==0.1.2", "loguru", "einops"
"""What its networks import and we do not: pip would bring another PyTorch, and much besides."""
DRAWN = """
import sys
from pathlib import Path
from unittest.mock import patch
import numpy as np, torch
try:
    import torchvision
except RuntimeError:  # another PyTorch's: it declares no operators, and none is used
    library = torch.library.Library("torchvision", "DEF")
    for name in ("nms", "qnms"):
        library.define(name + "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
from kornia.feature import XFeat
from romatch.models.model_zoo import roma_indoor
from romatch.models.tiny import TinyRoMa
from placegraph.indoor.refine.matching import matcher

torch.manual_seed(0)
folder = Path(sys.argv[1])
with patch.object(torch.nn.Module, "load_state_dict", lambda *_: None):
    drawn = roma_indoor("cpu", weights={}, dinov2_weights={}, use_custom_corr=False)
torch.save(drawn.state_dict(), folder / "indoor.pth")
torch.save(drawn.encoder.dinov2_vitl14[0].state_dict(), folder / "dino.pth")
torch.save(TinyRoMa(xfeat=XFeat().net, freeze_xfeat=False).state_dict(), folder / "tiny.pth")
del drawn
query, view = np.random.default_rng(0).integers(0, 256, (2, 120, 160, 3), dtype=np.uint8)
for kind, more in (("indoor", {"backbone": folder / "dino.pth", "fine": 160}), ("tiny", {})):
    made = matcher(
        "roma", kind=kind, weights=folder / f"{kind}.pth", size=112, least=0.0, device="cpu", **more
    )
    (found,) = made.match(query, [view[:100]])
    assert len(found) > 100, len(found)
    assert found.query.shape == found.rendered.shape
    assert (found.query >= 0).all() and (found.query <= (160, 120)).all()
    assert (found.rendered >= 0).all() and (found.rendered <= (160, 100)).all()
"""


@pytest.mark.all
def test_the_library_itself_on_numbers_drawn_by_chance(tmp_path):
    """RoMa as published (`romatch`), ViT-L/14 and all, and the tiny one: 1.7 GB of weights."""
    site = tmp_path / "site"
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", site, *PACKAGES]
    installed = subprocess.run(pip, capture_output=True, text=True, check=False)  # noqa: S603
    if installed.returncode:
        pytest.skip(f"romatch cannot be installed here: {installed.stderr[-200:]}")
    path = os.pathsep.join([str(site), *filter(None, sys.path)])
    asked = subprocess.run(  # noqa: S603
        [sys.executable, "-c", DRAWN, tmp_path], env=os.environ | {"PYTHONPATH": path},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    for file in tmp_path.glob("*.pth"):
        file.unlink()
    assert not asked.returncode, asked.stderr
