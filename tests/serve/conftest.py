import threading
import time
from contextlib import contextmanager

import pytest
from starlette.testclient import TestClient

from placegraph.demo.world import TOWN, unpack
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
