from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.indoor.encode.appearance import LEAST, around, towards
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.render import Renderer

CAMERA = Camera(64, 36, 46.0, 46.0, 32.0, 18.0)


@pytest.fixture(scope="module")
def table(room):
    return room.visibility(FilterOptions())


def test_glances_are_spread_over_free_places(table):
    poses = around(table)
    assert len(poses) >= LEAST
    assert np.linalg.det(poses[:, :3, :3]) == pytest.approx(1.0)
    at = poses[:, :3, 3]
    nearest = np.linalg.norm(at[:, None] - table.positions[None], axis=2).min(axis=1)
    assert nearest == pytest.approx(0.0)
    assert np.ptp(at[:, :2], axis=0) == pytest.approx(np.ptp(table.positions[:, :2], axis=0))
    assert (poses[:, 2, 1] < 0).all()  # upright: the image's down is down
    headings = np.arctan2(poses[:, 1, 2], poses[:, 0, 2])
    assert len(np.unique(np.floor(headings / (np.pi / 4)) % 8)) == 8


def test_an_object_asked_for_is_looked_at(room, table):
    renderer = Renderer(room)
    visible = np.unique(table.panoramas.objects)
    visible = visible[visible < len(room)]
    poses = towards(table, visible)
    assert len(poses) == len(visible)
    seen = [
        (renderer.render(pose, CAMERA, samples=1).objects == row).sum() >= 4
        for row, pose in zip(visible.tolist(), poses, strict=True)
    ]
    assert sum(seen) >= len(seen) - 1  # one may stand behind the edge of another


def test_what_cannot_be_seen_is_left_out(table, room):
    assert towards(table, np.array([len(room) + 7])).shape == (0, 4, 4)


def test_a_map_without_free_places(table):
    assert around(replace(table, positions=np.zeros((0, 3)))).shape == (0, 4, 4)
