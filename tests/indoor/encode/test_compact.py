"""The compact encoder: pictures and maps in, unit vectors out, on NumPy as on PyTorch."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.errors import InputError, MapError
from placegraph.formats.capture.frame import Frame
from placegraph.geometry import Camera
from placegraph.indoor.encode import Encoder, bound, encoder
from placegraph.indoor.encode.compact import CompactEncoder, picture
from placegraph.indoor.encode.compact.network import Network, Shape
from placegraph.indoor.encode.compact.things import FEATURES
from placegraph.indoor.encode.compact.weights import Weights, read_weights, write_weights
from placegraph_lab.train.compact import vary

SMALL = Shape(fine=8, coarse=12, fine_blocks=1, coarse_blocks=2, kernel=3, hidden=16, dimension=6)
WIDE = Camera(160, 90, 115.0, 115.0, 80.0, 45.0)
LEVEL = (0.0, 1.0, 0.0)


def random_arrays(shape, seed=0):
    rng = np.random.default_rng(seed)
    arrays = {n: 0.3 * rng.standard_normal(s) for n, s in shape.arrays().items()}
    arrays["spread"] = 1.0 + rng.random(FEATURES)
    return {n: a.astype(np.float16).astype(np.float32) for n, a in arrays.items()}


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A weights file of a small random network."""
    path = tmp_path_factory.mktemp("compact") / "small.weights"
    write_weights(path, Weights(SMALL, random_arrays(SMALL), 0.1, {"steps": 0}))
    return path


@pytest.fixture(scope="module")
def compact(weights):
    """Encoder with these weights."""
    return CompactEncoder(weights)


def noise(height, width, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)


def shot(rgb, camera=None, gravity=LEVEL):
    h, w = rgb.shape[:2]
    camera = camera or Camera(w, h, 0.7 * w, 0.7 * w, w / 2, h / 2)
    return Frame.from_arrays(rgb, camera, gravity=gravity)


@settings(max_examples=12, deadline=None)
@given(rows=st.integers(1, 5), columns=st.integers(1, 5), seed=st.integers(0, 99))
def test_numpy_is_torch(rows, columns, seed):
    torch = pytest.importorskip("torch", reason="PyTorch is not installed (extra learn)")
    from placegraph_lab.train.compact.torch_network import TorchNetwork

    arrays, rng = random_arrays(SMALL, seed), np.random.default_rng(seed)
    module = TorchNetwork(SMALL)
    module.load_state_dict({n: torch.from_numpy(a) for n, a in arrays.items()})
    cells = rng.standard_normal((2 * rows, 2 * columns, picture.INPUTS)).astype(np.float32)
    told = 3.0 * rng.standard_normal((7, FEATURES)).astype(np.float32)
    network = Network(SMALL, arrays)
    with torch.no_grad():
        seen = module.see(torch.from_numpy(cells)[None])[0].numpy()
        known = module.know(torch.from_numpy(told)).numpy()
    np.testing.assert_allclose(network.see(cells), seen, atol=1e-4)
    np.testing.assert_allclose(network.know(told), known, atol=1e-4)


def test_the_shipped_network_is_torchs_too():
    torch = pytest.importorskip("torch", reason="PyTorch is not installed (extra learn)")
    from placegraph_lab.train.compact.torch_network import TorchNetwork

    network = CompactEncoder().network
    arrays = dict(network.arrays)
    for name in arrays:  # from the layout of the kernels back to PyTorch's
        if name.endswith(".mix.weight"):
            arrays[name] = np.ascontiguousarray(arrays[name].transpose(2, 0, 1)[:, None])
    module = TorchNetwork(network.shape)
    module.load_state_dict({n: torch.from_numpy(a) for n, a in arrays.items()})
    cells = np.random.default_rng(1).standard_normal((18, 32, picture.INPUTS)).astype(np.float32)
    with torch.no_grad():
        seen = module.see(torch.from_numpy(cells)[None])[0].numpy()
    np.testing.assert_allclose(network.see(cells), seen, atol=1e-4)


def test_weights_have_the_names_and_shapes_of_torch():
    pytest.importorskip("torch", reason="PyTorch is not installed (extra learn)")
    from placegraph_lab.train.compact.torch_network import TorchNetwork

    state = TorchNetwork(SMALL).state_dict()
    assert {n: tuple(t.shape) for n, t in state.items()} == SMALL.arrays()


def test_it_is_an_encoder_of_unit_vectors(compact, room):
    assert isinstance(compact, Encoder)
    seen = compact.patches(shot(noise(90, 160), WIDE))
    known = compact.objects(room)
    assert seen.shape == (9, 16, 6)
    assert known.shape == (len(room), 6)
    assert seen.dtype == known.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(seen, axis=2), 1.0, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(known, axis=1), 1.0, atol=1e-5)


def test_it_is_bound_to_a_map(compact, room, walk):
    patches = bound(compact, room).encode(walk[0])
    assert patches.grid == (9, 16)
    assert patches.camera == walk[0].camera
    assert patches.table.shape[1] == len(room)
    assert patches.temperature == compact.temperature


@pytest.mark.parametrize("size", [(1, 1), (3, 500), (360, 540), (211, 37), (640, 480), (91, 163)])
def test_images_of_any_size(compact, size):
    rgb = noise(*size) if max(size) > 1 else np.zeros((*size, 3), np.uint8)
    seen = compact.patches(shot(rgb))
    assert np.isfinite(seen).all()
    assert min(seen.shape[:2]) >= 2
    if 0.5 < size[0] / size[1] < 2:
        assert abs(seen.shape[0] * seen.shape[1] - 144) < 20


def test_a_lid_says_nothing(compact):
    assert not compact.patches(shot(np.full((90, 160, 3), 17, np.uint8), WIDE)).any()


def test_a_broken_image_says_so(compact, tmp_path, walk):
    frame = walk[0]
    path = tmp_path / "walk"
    path.mkdir()
    for name in ("camera.json", "odometry.tum", "gravity.txt"):
        (path / name).write_bytes((walk.path / name).read_bytes())
    for kind in ("rgb", "depth", "instances"):
        (path / kind).mkdir()
        for image in (walk.path / kind).iterdir():
            (path / kind / image.name).write_bytes(image.read_bytes())
    from placegraph.formats.capture.capture import open_capture

    broken = path / f"rgb/{frame.index:06d}.jpg"
    broken.write_bytes(broken.read_bytes()[:200])
    with pytest.raises(InputError, match="000000"):
        compact.patches(open_capture(path)[0])


@settings(max_examples=20, deadline=None)
@given(
    gain=st.floats(0.6, 1.6), red=st.floats(0.8, 1.25), blue=st.floats(0.8, 1.25),
    seed=st.integers(0, 99),
)  # fmt: skip
def test_exposure_and_white_balance_are_all_but_taken_out(gain, red, blue, seed):
    light = np.random.default_rng(seed).uniform(0.3, 0.6, (90, 160, 3)).astype(np.float32)
    rise = np.zeros((18, 32), np.float32)
    one = picture.inputs(picture.log_light(light), rise, 0.0)
    factors = np.array([red, 1.0, blue], np.float32) * np.float32(gain)
    other = picture.inputs(picture.log_light(light * factors), rise, 0.0)
    colours = slice(None, -picture.FACTS)
    np.testing.assert_allclose(one[..., colours], other[..., colours], atol=0.05)


def test_inputs_keep_patches_apart():
    """A cell reads its own 5 x 5 pixels and no other."""
    log = np.zeros((90, 160, 3), np.float32)
    before = picture.inputs(log, np.zeros((18, 32), np.float32), 0.0)
    log[35:40, 50:55] += np.arange(75, dtype=np.float32).reshape(5, 5, 3)
    after = picture.inputs(log, np.zeros((18, 32), np.float32), 0.0)
    colours = slice(None, -picture.FACTS)
    change = (after - before)[..., colours]
    assert np.unique((change - change[0, 0])[7, 10]).size == 75
    change[7, 10] = change[0, 0]
    np.testing.assert_allclose(change - change[0, 0], 0.0, atol=1e-5)


@settings(max_examples=30, deadline=None)
@given(pitch=st.floats(-1.0, 1.0), roll=st.floats(-3.0, 3.0))
def test_rays_rise_as_gravity_says(pitch, roll):
    from placegraph_lab.train.compact.worlds import tilted

    level_from_camera = tilted(pitch, roll)
    gravity = -level_from_camera[2]  # level's -z, in camera axes
    grid = picture.grid_of(WIDE)
    rise = picture.rises(WIDE, gravity, grid)
    rows, columns = np.mgrid[:18, :32] + 0.5
    rays = WIDE.directions(np.stack([columns * 5, rows * 5], axis=-1))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    np.testing.assert_allclose(rise, (rays @ level_from_camera.T)[..., 2], atol=1e-5)
    middle = rise[8:10, 15:17].mean()
    assert middle == pytest.approx(np.sin(pitch), abs=0.01)


def test_a_wide_angle_is_told_from_a_narrow_one():
    wide, narrow = (
        Camera(160, 90, 60.0, 60.0, 80.0, 45.0),
        Camera(160, 90, 240.0, 240.0, 80.0, 45.0),
    )
    assert picture.span(wide, (9, 16)) - picture.span(narrow, (9, 16)) == pytest.approx(np.log(4))


def test_weights_come_back(weights):
    read = read_weights(weights)
    assert read.shape == SMALL
    assert read.temperature == 0.1
    for name, array in random_arrays(SMALL).items():
        np.testing.assert_array_equal(read.arrays[name], array)


def test_the_key_says_which_weights(weights, tmp_path, compact):
    assert CompactEncoder(weights).key == compact.key
    arrays = random_arrays(SMALL)
    arrays["head.bias"] = arrays["head.bias"] + np.float32(1.0)
    write_weights(tmp_path / "other", Weights(SMALL, arrays, 0.1, {}))
    assert CompactEncoder(tmp_path / "other").key != compact.key


def test_a_file_that_is_missing_or_foreign(tmp_path, room_world):
    with pytest.raises(InputError, match="compact train"):
        CompactEncoder(tmp_path / "none.weights")
    (tmp_path / "text").write_text("weights")
    with pytest.raises(MapError, match="compact train"):
        CompactEncoder(tmp_path / "text")
    with pytest.raises(MapError, match="scene"):
        CompactEncoder(room_world.folder / "flat.scene")


@settings(max_examples=20, deadline=None)
@given(share=st.floats(0.0, 0.999))
def test_a_file_cut_short(share, weights, tmp_path_factory):
    path = tmp_path_factory.mktemp("cut") / "cut.weights"
    content = weights.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises((MapError, InputError), match="compact train"):
        CompactEncoder(path)


def test_arrays_that_do_not_fit(tmp_path):
    arrays = random_arrays(SMALL)
    arrays["head.bias"] = np.zeros(7, np.float32)
    write_weights(tmp_path / "odd", Weights(SMALL, arrays, 0.1, {}))
    with pytest.raises(MapError, match=r"head\.bias"):
        read_weights(tmp_path / "odd")
    arrays["head.bias"] = np.full(6, np.nan, np.float32)
    write_weights(tmp_path / "odd", Weights(SMALL, arrays, 0.1, {}))
    with pytest.raises(MapError, match="finite"):
        read_weights(tmp_path / "odd")


def test_what_is_shipped():
    """Small enough, trained with much the same vectors of labels as now, and found by its name."""
    from placegraph.indoor.encode.compact.weights import shipped
    from placegraph.indoor.encode.words import vector

    assert shipped().stat().st_size <= 4_000_000
    for label, known in read_weights(shipped()).training["words"].items():
        assert vector(label) @ np.array(known) > 0.9, label
    made = encoder("compact")
    assert isinstance(made, CompactEncoder)
    assert made.dimension == 64


def test_the_shipped_network_finds_things(flat, flat_walk):
    """In a flat whose like it was trained on: far better than guessing among 110 objects."""
    patches = bound(CompactEncoder(), flat).encode(flat_walk[0])
    ids = flat_walk[0].labels()
    rows = {int(id_): row for row, id_ in enumerate(flat.graph.ids)}
    assert ids.shape == (45, 80)
    middle = [[rows.get(int(id_), -1) for id_ in line[2::5]] for line in ids[2::5]]
    true = np.array(middle).reshape(-1)
    logits = patches.table[patches.rows] / patches.temperature
    gains = logits[np.arange(144), true] - np.log(np.exp(logits).sum(axis=1)) + np.log(len(flat))
    assert gains[true >= 0].mean() > 1.0


def test_blurring_keeps_the_mean():
    light = np.random.default_rng(0).random((20, 30, 3)).astype(np.float32)
    assert vary._blurred(light).mean() == pytest.approx(light.mean(), rel=1e-5)
