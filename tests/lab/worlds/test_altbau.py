import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.indoor.build import build_scene
from placegraph.io.capture.capture import open_capture
from placegraph_lab.make.shipped import FLAT, WAY
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.walks import stroll, write_walk

SMALL = Camera(160, 90, 115.0, 115.0, 80.0, 45.0)


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("altbau"), np.random.default_rng(0)
    drawing = Flat.load(FLAT)
    interior = drawing.furnish(rng)
    scene = build_scene(interior.write_glb(folder / "flat.glb"), None)
    now = interior.move_object("armchair", (0.5, -0.2), 0.6).without("chair 1")
    walk = stroll(drawing, rng, frames=14, through=WAY, speed=1.5)
    write_walk(now, walk, folder / "walk", rng, camera=SMALL)
    return scene, open_capture(folder / "walk"), walk.map_from_camera


def test_the_film_passes_three_rooms(film):
    drawing = Flat.load(FLAT)
    _, _, truth = film
    rooms = {int(drawing.room_of[drawing.cell(*pose[:2, 3])]) for pose in truth} - {-2}
    assert {drawing.rooms[room].name for room in rooms} == {"bedroom", "hall", "living room"}


def test_the_film_is_localized(film):
    scene, capture, truth = film
    estimate = scene.localize(capture, seed=0)
    off = estimate.best.map_from_camera[:3, 3] - truth[-1, :3, 3]
    assert np.linalg.norm(off) < 0.1
    way = estimate.trajectory[:, :3, 3] - truth[:, :3, 3]
    assert np.linalg.norm(way, axis=1).max() < 0.2
