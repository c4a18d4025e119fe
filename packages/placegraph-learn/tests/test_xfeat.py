import sys
import urllib.error

import numpy as np
import pytest
import torch
from tests.indoor.refine.matching.conftest import draw_texture, measure_errors, warp

from placegraph.errors import InputError, MissingExtraError, OptionError, ServiceError
from placegraph.indoor.refine.matching import matcher

feature = pytest.importorskip("kornia.feature", reason="needs kornia: 'placegraph[xfeat]'")

MODES = {"points": {}, "larger": {"scale": 2.0}}


@pytest.fixture(scope="module")
def weights(shared):
    return shared / "weights/xfeat.pt"


@pytest.fixture(scope="module", params=["points", pytest.param("larger", marks=pytest.mark.all)])
def xfeat(request, weights):
    return matcher("xfeat", weights=weights, **MODES[request.param])


@pytest.mark.parametrize(
    "homography",
    [[[1, 0, 3.5], [0, 1, 2.25], [0, 0, 1]], [[1.1, 0.05, -9], [-0.04, 0.95, 6], [2e-4, -1e-4, 1]]],
)
def test_a_homography_is_recovered(xfeat, picture, homography):
    h = np.array(homography, float)
    (found,) = xfeat.match(picture, [warp(picture, h)])
    off = measure_errors(found, h)
    assert len(found) > 150
    assert np.median(off) < 1.8
    assert np.mean(off < 4.0) > 0.8
    (again,) = xfeat.match(picture, [warp(picture, h)])
    assert np.array_equal(found.query, again.query)
    assert np.array_equal(found.rendered, again.rendered)


def test_points_are_counted_from_the_corner_of_the_first_pixel(xfeat, rng):
    # were a centre said to lie where its corner is, points of the larger picture would be off
    picture = draw_texture(rng, 256, 320)
    for scale in (0.8, 1.25):
        h = np.diag([scale, scale, 1.0])
        (found,) = xfeat.match(picture, [warp(picture, h)])
        off = found.rendered - scale * found.query
        off = off[np.linalg.norm(off, axis=1) < 4]
        assert len(off) > 100
        assert np.abs(off.mean(axis=0)).max() < 0.5


def test_sizes_that_the_network_cannot_take_are_resized_and_back(xfeat, rng):
    picture = draw_texture(rng, 241, 333)
    wide = picture[:, :301]  # other sizes, other steps
    (found,) = xfeat.match(picture, [wide])
    off = found.query - found.rendered
    assert len(found) > 100
    assert np.abs(np.median(off, axis=0)).max() < 0.35


def test_weights_of_another_network_are_named(tmp_path, weights):
    state, path = torch.load(weights, weights_only=True), tmp_path / "other.pt"
    name = next(n for n, t in state.items() if t.ndim == 4)
    for content, words in (
        ({"layer.weight": torch.zeros(3, 3)}, "contains weights of another network"),
        (state | {name: torch.zeros(2, 2, 2, 2)}, "contains weights of another network"),
        ([torch.zeros(3)], "contains no named tensors"),
    ):
        torch.save(content, path)
        with pytest.raises(InputError, match=rf"other\.pt {words}"):
            matcher("xfeat", weights=path)


def test_without_a_file_the_weights_come_from_the_hub(monkeypatch, weights, picture):
    asked = []

    def load(url, **_kwargs):
        asked.append(url)
        return torch.load(weights, weights_only=True)

    monkeypatch.setattr("kornia.feature.xfeat.load_state_dict_from_url", load)
    (found,) = matcher("xfeat").match(picture, [picture])
    assert len(asked) == 1
    assert len(found) > 100

    def unreachable(*_args, **_kwargs):
        raise urllib.error.URLError("Name or service not known")

    monkeypatch.setattr("kornia.feature.xfeat.load_state_dict_from_url", unreachable)
    with pytest.raises(ServiceError, match=r"xfeat\.pt cannot be reached.*weights="):
        matcher("xfeat")


def test_options_out_of_range_and_missing_libraries_are_named(weights, monkeypatch):
    for options, named in (
        ({"device": "tpu9"}, "tpu9"),
        ({"scale": 0}, "scale"),
        ({"least": 3}, "least"),
    ):
        with pytest.raises(OptionError, match=named):
            matcher("xfeat", weights=weights, **options)
    if not torch.cuda.is_available():
        with pytest.raises(OptionError, match="no GPU"):
            matcher("xfeat", weights=weights, device="cuda")
    assert matcher("xfeat", weights=weights, device="auto").name == "xfeat"
    monkeypatch.setitem(sys.modules, "kornia.feature", None)
    with pytest.raises(MissingExtraError, match=r"placegraph\[xfeat\]"):
        matcher("xfeat")
