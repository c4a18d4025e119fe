"""A drawn town and a drawn room that the commands are asked about."""

from types import SimpleNamespace

import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.indoor.build import build_scene
from placegraph_lab.worlds.flat.walks import stroll, write_walk


@pytest.fixture(scope="session")
def osm(hafenstadt, tmp_path_factory):
    return hafenstadt.write_osm(tmp_path_factory.mktemp("cli") / "town.osm")


@pytest.fixture(scope="session")
def city(osm, harbour):
    harbour.save(osm.with_name("town.city"))
    return osm.with_name("town.city")


@pytest.fixture(scope="session")
def room(tmp_path_factory, study):
    """Map, mesh and true poses of a walk of six frames; `wide` is the walk with a wider camera."""
    folder, rng = tmp_path_factory.mktemp("room"), np.random.default_rng(3)
    interior = study.furnish(rng)
    build_scene(interior.write_glb(folder / "room.glb"), folder / "room.scene")
    walk = stroll(study, rng, frames=6, through="123")
    for name, camera in (
        ("walk", Camera(160, 90, 115.0, 115.0, 80.0, 45.0)),
        ("wide", Camera(160, 120, 90.0, 90.0, 80.0, 60.0)),
    ):
        write_walk(interior, walk, folder / name, rng, camera=camera)
    return SimpleNamespace(
        map=folder / "room.scene", walk=folder / "walk", wide=folder / "wide",
        truth=walk.map_from_camera,
    )  # fmt: skip
