"""Training of the compact encoder: pictures, what is done to them, and that it learns and goes on."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.errors import InputError, OptionError
from placegraph.geometry import Camera
from placegraph.indoor.encode.compact import picture
from placegraph.indoor.encode.compact.network import Shape
from placegraph.indoor.encode.compact.weights import read_weights
from placegraph_lab.train.compact import vary, worlds
from placegraph_lab.train.compact.worlds import World
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.home.home import scene_of

DRAWING = """
[flat]
name = Cell
metres = 0.5 0.5
height = 2.5
[drawing]
########
#SS   B#
#SS   B#
#      #
#  TT  #
#1     #
########
[legend]
1 room: walls=plain khaki floor=plain sienna
S sofa: look=plain darkred trim=plain firebrick
B shelf: look=plain teal
T table: look=plain navy
"""
PICTURES = 4
SMALL = Shape(fine=8, coarse=16, fine_blocks=1, coarse_blocks=1, kernel=3, hidden=16, dimension=8)


def _world(seed):
    rng = np.random.default_rng(seed)
    interior = Flat.parse(DRAWING).furnish(rng)
    return worlds.of_home(interior, scene_of(interior), PICTURES, (9, 16), rng)


@pytest.fixture(scope="module")
def world():
    """Pictures of a room of 3 x 2.5 m."""
    return _world(0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, world):
    """Sixteen worlds, one of which is held out."""
    path = tmp_path_factory.mktemp("worlds")
    for number in range(16):
        world.save(path / f"home_{number:04d}.npz")
    return path


def test_pictures_know_what_they_show(world):
    assert world.light.shape == (PICTURES, 90, 160, 3)
    assert world.objects.shape == (PICTURES, 90, 160)
    assert np.isfinite(world.light).all()
    assert (world.light >= 0).all()
    for image, patches in zip(world.objects, world.patches, strict=True):
        cells = image.reshape(9, 10, 16, 10).swapaxes(1, 2).reshape(144, 100)
        for cell, object_ in zip(cells, patches, strict=True):
            shares = np.bincount(cell[cell >= 0], minlength=1)
            assert object_ == (shares.argmax() if shares.sum() >= 50 else -1)
    assert {"sofa", "table", "floor"} <= set(world.labels[np.unique(world.objects)])


def test_colours_of_pictures_are_those_of_the_map(world):
    """A red sofa is red in both: hues of what is seen follow those of the map's points."""
    row = int(np.flatnonzero(world.labels == "sofa")[0])
    seen = world.light.astype(np.float32)[world.objects == row]
    assert len(seen) > 100
    for light in (seen, world.samples[row]):
        red, green, blue = light.mean(axis=0)
        assert red > 3 * max(green, blue)


def test_the_floor_lies_below(world):
    """Rays to the floor fall, rays to the ceiling rise."""
    rise = world.rises.reshape(PICTURES, 9, 2, 16, 2).mean(axis=(2, 4)).reshape(PICTURES, -1)
    floor, ceiling = (int(np.flatnonzero(world.labels == name)[0]) for name in ("floor", "ceiling"))
    assert (rise[world.patches == floor] < 0).all()
    assert (rise[world.patches == ceiling] > 0).all()


def test_a_map_is_lit_too(room):
    rng = np.random.default_rng(0)
    made = worlds.of_map(room, 2, (10, 15), rng)
    assert made.light.shape == (2, 100, 150, 3)
    assert made.grid == (10, 15)
    assert made.light.std() > 0.01
    assert tuple(made.labels) == room.graph.labels


def test_worlds_come_back(world, tmp_path):
    world.save(tmp_path / "w.npz")
    again = World.open(tmp_path / "w.npz")
    np.testing.assert_array_equal(again.light, world.light)
    assert tuple(again.labels) == tuple(world.labels)
    (tmp_path / "cut.npz").write_bytes((tmp_path / "w.npz").read_bytes()[:1000])
    with pytest.raises(InputError, match=r"cut\.npz"):
        World.open(tmp_path / "cut.npz")


def test_the_same_seed_makes_the_same_world(world):
    np.testing.assert_array_equal(_world(0).light, world.light)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 9999))
def test_cameras_and_maps_stay_finite(world, seed):
    rng = np.random.default_rng(seed)
    factors = vary.paint(len(world.area), rng)
    log = vary.photographed(world.light[0].astype(np.float32) * 10 ** rng.uniform(-3, 2), rng)
    assert log.shape == (90, 160, 3)
    assert np.isfinite(log).all()
    assert log.min() >= np.log(picture.FAINT) - 1e-4
    assert log.max() <= 0.05
    made = vary.mapped(world.things, factors, rng)
    assert made.light.shape == world.samples.shape
    assert np.isfinite(made.light).all()
    assert (made.light >= 0).all()
    assert made.form.shape == world.form.shape


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 9999))
def test_what_stands_before_is_not_the_object(seed):
    """Patches still said to show their object are those of which no pixel was changed."""
    rng = np.random.default_rng(seed)
    log = rng.uniform(-3, 0, (90, 160, 3)).astype(np.float32)
    before = log.copy()
    left = vary.strewn(log, np.zeros((9, 16), np.int16), 10, rng)
    changed = (log != before).any(axis=2).reshape(9, 10, 16, 10).any(axis=(1, 3))
    assert (left[changed] == -1).all()


def test_repainting_keeps_some():
    rng = np.random.default_rng(0)
    drawn = np.concatenate([vary.paint(50, rng) for _ in range(40)])
    kept = (drawn == 1).all(axis=1).mean()
    assert 0.5 < kept < 0.8
    assert drawn.min() > 0


def torch_training():
    pytest.importorskip("torch", reason="PyTorch is not installed (extra learn)")
    from placegraph_lab.train.compact import train

    return train


def test_weights_of_patches():
    train = torch_training()
    true = np.array([[4, 4, 4, 4, 7, -1]])
    got = train.weights_of(true, 0.5)
    np.testing.assert_allclose(got, [[0.5, 0.5, 0.5, 0.5, 1.0, 0.0]])


def test_nats_of_knowing_and_of_guessing():
    train = torch_training()
    true = np.array([0, 2, 3])
    shares = np.array([0.5, 0.125, 0.25, 0.125], np.float32)
    guess = np.zeros((3, 4), np.float32)
    assert train.told([(guess, true, shares)], 0.1) == pytest.approx(0.0, abs=1e-6)
    sure = guess.copy()
    sure[np.arange(3), true] = 1.0
    wanted = np.log([2, 4, 8]).mean()  # what is seen everywhere says little
    assert train.told([(sure, true, shares)], 0.01) == pytest.approx(wanted, abs=1e-4)


def test_it_learns(folder, tmp_path):
    train = torch_training()
    known, _ = train.split(folder)
    state = train.State.begun(
        tmp_path / "t", train.Plan(steps=99, batch=2, rate=0.05), known, SMALL
    )
    losses = [state.learn(known[0]) for _ in range(40)]
    assert np.mean(losses[-8:]) < np.mean(losses[:8]) - 0.1


def test_it_goes_on_where_it_was(folder, tmp_path):
    train = torch_training()
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    rows = []
    try:
        plan = train.Plan(steps=10, batch=2, check=5)
        train.train_on(
            folder, tmp_path / "one", tmp_path / "one.weights", plan, SMALL, tell=rows.append
        )
        whole = read_weights(tmp_path / "one.weights")
        known, _ = train.split(folder)
        half = train.State.begun(tmp_path / "two", plan, known, SMALL)
        for _ in range(5):
            half.learn(known[half.step % len(known)])
        half.write()
        train.train_on(folder, tmp_path / "two", tmp_path / "two.weights", plan, SMALL)
        again = read_weights(tmp_path / "two.weights")
    finally:
        torch.set_num_threads(before)
    for name, array in whole.arrays.items():
        np.testing.assert_allclose(again.arrays[name], array, atol=1e-3, err_msg=name)
    assert whole.training["step"] in {5, 10}
    assert "nats" in rows[-1]
    with pytest.raises(OptionError, match="another folder"):
        train.State.begun(tmp_path / "one", train.Plan(steps=13), known, SMALL)


def test_no_worlds_is_an_error(tmp_path):
    train = torch_training()
    with pytest.raises(InputError, match="0 worlds"):
        train.split(tmp_path)


def test_cameras_of_pictures_are_those_of_phones():
    rng = np.random.default_rng(0)
    for _ in range(20):
        camera = worlds._camera((160, 90), rng)
        assert isinstance(camera, Camera)
        wide = 2 * np.degrees(np.arctan(80 / camera.fx))
        assert 48 <= wide <= 85
