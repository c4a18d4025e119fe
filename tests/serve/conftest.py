import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
from starlette.testclient import TestClient

from placegraph.demo.world import FLAT, TOWN, unpack
from placegraph.earth import Anchor
from placegraph.indoor.build import build_scene
from placegraph.outdoor.city import build_city
from placegraph.serve.app import create_app
from placegraph.serve.options import ServeOptions
from placegraph.serve.places import Places


@pytest.fixture(scope="session")
def maps(tmp_path_factory):
    """Folder with the demo's town and two of its homes."""
    folder = tmp_path_factory.mktemp("served")
    world = unpack(folder / "raw")
    (folder / "maps").mkdir()
    build_city(world / f"{TOWN}.osm", folder / "maps" / f"{TOWN}.city")
    for name in ("home1", "home2"):
        (world / f"{name}.scene").rename(folder / "maps" / f"{name}.scene")
    return folder / "maps"


@pytest.fixture(scope="session")
def walk(maps):
    """A film in the demo's flat, which is not among the maps."""
    return maps.parent / "raw" / "walk"


@pytest.fixture(scope="session")
def flat(maps):
    """The demo's flat, which stands on Earth: its y axis points to the east."""
    scene = build_scene(maps.parent / "raw" / f"{FLAT}.glb", maps.parent / "raw" / f"{FLAT}.scene")
    anchor = Anchor(8.0, 53.0, 40.0, np.pi / 2, np.diag([1.0, 1.0, 1.0, 1e-4]), "Haus", level="2")
    file = maps.parent / f"{FLAT}.scene"
    scene.anchored(anchor).save(file)
    return file


@pytest.fixture(scope="session")
def town(maps):
    return maps / f"{TOWN}.city"


@contextmanager
def serving(*paths, **options):
    """Client of an application whose processes have started."""
    with TestClient(create_app(Places(paths), ServeOptions(**options))) as client:
        end = time.monotonic() + 120
        while client.get("/healthz").status_code != 200:
            assert time.monotonic() < end
            threading.Event().wait(0.05)
        yield client


@pytest.fixture(scope="session")
def client(town):
    """One server of the town alone, for all tests that do not change it."""
    with serving(town, sentence_workers=1) as client:
        yield client
