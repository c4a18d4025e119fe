import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph_lab.worlds.flat.flat import read_material
from placegraph_lab.worlds.flat.furniture import MODELS, Body
from placegraph_lab.worlds.flat.render import GeometryImage, simulate_depth
from placegraph_lab.worlds.flat.textures import PAINTERS, Material, paint


@pytest.mark.parametrize("kind", PAINTERS)
def test_a_look_has_its_size_its_colour_and_some_pattern(kind):
    image = paint(Material(kind, (150, 110, 70)), (1.5, 1.0), np.random.default_rng(0))
    assert image.shape == (96, 144, 3)
    assert image.dtype == np.uint8
    assert image.std(axis=(0, 1)).max() > 1.0  # nothing is quite plain
    if kind not in {"books", "picture", "window", "rug"}:
        mean = image.mean(axis=(0, 1))
        assert mean[0] > mean[1] > mean[2]


@pytest.mark.parametrize("name", MODELS)
@settings(max_examples=10)
@given(st.floats(0.1, 3.0), st.floats(0.1, 3.0), st.floats(0.2, 2.0))
def test_furniture_keeps_to_its_body(name, width, depth, stretch):
    model = MODELS[name]
    looks = (read_material(look, "") for look in (model.material, model.trim))
    body = Body(width, depth, model.height * stretch, *looks)
    parts = model.make_parts(body)
    points = np.concatenate([part.vertices for part in parts])
    low, high = points.min(axis=0), points.max(axis=0)
    assert (low >= 0.0).all()
    assert (high <= (width, depth + 0.03, body.height + model.above)).all()
    assert high[2] >= 0.9 * body.height
    for part in parts:
        assert part.triangles.max() < len(part.vertices) == len(part.uv)
        assert np.isfinite(part.uv).all()


def flat_wall(distance, shape=(90, 160)):
    full = np.full(shape, 1.0, np.float32)
    return GeometryImage(distance * full, np.zeros(shape, np.int32), full)


@pytest.mark.parametrize("distance", [0.8, 2.0, 5.0])
def test_depth_errors_grow_with_the_square_of_the_distance(distance, rng):
    depth = simulate_depth(flat_wall(distance), rng)
    read = depth[depth > 0] / 1000.0
    sigma = 0.0012 + 0.0019 * (distance - 0.4) ** 2
    assert 0.8 < len(read) / depth.size < 0.985
    assert np.std(read - distance) == pytest.approx(sigma, rel=0.35)
    assert np.mean(read) == pytest.approx(distance, abs=sigma)
