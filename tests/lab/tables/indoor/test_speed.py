"""Costs of scoring: every ray is counted, maps of any size are the same map."""

import time

import numpy as np
import pytest

from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables.named import indoor_speed
from placegraph_lab.tables.named import indoor_speed as script
from placegraph_lab.tables.named.indoor_speed import (
    Cost,
    cost,
    median_time,
)


def bumpy(n, objects):
    """A sheet of bumps, n x n quads a side, cut into stripes, one an object."""
    x, y = np.meshgrid(*[np.linspace(-9.0, 9.0, n + 1)] * 2, indexing="ij")
    points = np.stack([x, y, 0.3 * np.sin(3 * x) * np.cos(2 * y)], axis=-1).reshape(-1, 3)
    a = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    corners = np.stack([a, a + n + 1, a + n + 2, a, a + n + 2, a + 1], axis=1).reshape(-1, 3)
    return Mesh.plain(points, corners, np.arange(len(corners)) * objects // len(corners))


@pytest.fixture(scope="module")
def scene():
    names = [str(i) for i in range(5)]
    return SceneMap.create(bumpy(40, 5), names, ["floor"] * 5, floor=0.0)


def test_costs_are_of_all_rays(scene, shared, monkeypatch):
    monkeypatch.setattr(indoor_speed, "median_time", lambda work: work() is not None and 0.5)
    background = scene.visibility(FilterOptions(spacing=2.0, heights=(1.6,))).background
    row = cost(scene, shared / "data/house/seq00", 20, 40.0, background)
    assert (row.particles, row.triangles) == (20, len(scene.mesh))
    assert row.rays >= 640 // 40 * 360 // 40
    assert row.rate == 20 * row.rays / 0.5
    assert row.share == 1.0


def test_times_are_medians():
    assert median_time(lambda: time.sleep(0.002), least=0.0, times=3) >= 0.002


def test_tables_name_the_paper_and_the_reason(monkeypatch, scene, tmp_path):
    monkeypatch.setattr(script, "costs", lambda *_: [Cost(20_000, 1000, 640, 0.04, 0.03)])
    text, rows = script.scoring(scene, tmp_path)
    assert "16.0" in text.splitlines()[2]  # million rays a second
    assert ".75" in text.splitlines()[2]
    assert rows[0]["rays_per_second"] == 16e6
    measured = {
        "frame_seconds": 0.2, "stage_seconds": {"filter": 0.03, "search": 0.1},
        "passes": 3, "particles": 90.0, "rays_a_frame": 2e5, "rays_per_second": 1e7,
        "scoring_share": 0.5, "peak_bytes": 4e8,
    }  # fmt: skip
    monkeypatch.setattr(script, "apart", lambda *_: measured)
    text, rows = script.methods({"house": tmp_path, "small": tmp_path}, [tmp_path], print)
    assert len(rows) == len(script.METHODS) + 2
    assert "10.0 ms" in text  # a frame and pass
    assert "2.90 s" in text
    assert "1.60 s" in text
