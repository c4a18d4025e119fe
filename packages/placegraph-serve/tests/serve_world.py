import re
import shutil
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import httpx
import numpy as np
import pytest
import uvicorn
from starlette.testclient import TestClient

from placegraph.core.geo import Anchor
from placegraph.demo.world import FLAT, TOWN, unpack
from placegraph.indoor.build import build_scene
from placegraph.maps import open_map
from placegraph.outdoor.city import build_city
from placegraph_lab.worlds.town.town import Town
from placegraph_serve.app import create_app
from placegraph_serve.options import ServeOptions
from placegraph_serve.places import Places

HOSTILE = """
[town]
name = Hostile
center = 7.42 43.73

[drawing]
 ####   |  \"\"\"\"\"\"   ####
 #K##   |  \"\"\"F\"\"\"   #  #
 ####   |  \"\"\"\"\"\"   ####
-----1--+------------------
        |   R   b    L

[legend]
K: shop=bakery name=<script>window.hacked=1</script>
F: amenity=fountain name="><img/src=x/onerror=window.hacked=1>
R: amenity=cafe name=\u202eمقهى البحر\u202c ${window.hacked=1}
b: amenity=bench name='"`\\
L: tourism=museum name=Museum LONG
1 road: highway=primary name=</textarea><svg/onload=window.hacked=1>
""".replace("LONG", "of everything that is very long " * 12)
HOUSE = "<img src=x onerror=window.hacked=1>"


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


def ready(asked, status=200):
    """Ask until the answer has a status, and return that answer."""
    end = time.monotonic() + 120
    while (answer := asked()).status_code != status:
        assert time.monotonic() < end, answer.text
        threading.Event().wait(0.05)
    return answer


@contextmanager
def serving(*paths, **options):
    """Client of an application whose processes have started."""
    options = ServeOptions(names=("testserver",), **options)  # as Starlette calls it
    with TestClient(create_app(Places(paths), options)) as client:
        ready(lambda: client.get("/healthz"))
        yield client


@pytest.fixture(scope="session")
def client(town):
    """One server of the town alone, for all tests that do not change it."""
    with serving(town, sentence_workers=1) as client:
        yield client


class Running:
    """A server as `placegraph serve` starts it, in a process of its own."""

    def __init__(self, *words, program=None, cwd=None):
        start = ["-m", "placegraph", "serve"] if program is None else [program]
        self.process = subprocess.Popen(  # noqa: S603  # our own interpreter
            [sys.executable, *start, *map(str, words)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=cwd,
        )  # fmt: skip
        said = self.process.stdout.readline()
        assert "http://" in said, self.process.communicate(timeout=30)[1]
        self.url = re.search(r"http://[^\s;]+", said)[0]
        self.port = int(self.url.rpartition(":")[2])
        ready(lambda: httpx.get(f"{self.url}/healthz"))

    def end(self):
        """Exit code, and what it said at the error output, after SIGTERM."""
        self.process.terminate()
        said = self.process.communicate(timeout=60)[1]
        return self.process.returncode, said


@pytest.fixture(scope="session")
def hotel(maps, flat, tmp_path_factory):
    """Folder with the town, and the flat as a floor of the town's hotel."""
    folder = tmp_path_factory.mktemp("town")
    shutil.copy(maps / f"{TOWN}.city", folder)
    anchor = Anchor(
        9.99884, 53.55015, 6.4, 0.3, np.diag([1.0, 1, 1, 1e-4]), "Hotel Hansa", level="2"
    )
    open_map(flat).anchored(anchor).save(folder / f"{FLAT}.scene")
    return folder


@pytest.fixture(scope="session")
def running(hotel):
    """A server of the town and the flat, which stands in the town's hotel."""
    server = Running(hotel, "--port", "0")
    server.folder = hotel
    yield server
    code, said = server.end()
    assert (code, said) == (0, "")


@contextmanager
def threaded(folder):
    """Address of a server of a folder, in a thread."""
    app = create_app(Places([folder]), ServeOptions(sentence_workers=1))
    server = uvicorn.Server(uvicorn.Config(app, port=0, log_level="error", ws="websockets-sansio"))
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        while not (server.started and app.state.server.sentences.ready):
            assert thread.is_alive()
            threading.Event().wait(0.05)
        [socket] = server.servers[0].sockets
        yield f"http://127.0.0.1:{socket.getsockname()[1]}/"
    finally:
        server.should_exit = True
        thread.join()


@pytest.fixture(scope="session")
def url(maps, hotel, tmp_path_factory):
    """Address of a page: a town with a flat in its hotel, a hostile one with a home, a home of no town."""
    folder = tmp_path_factory.mktemp("page")
    build_city(Town.parse(HOSTILE).write_osm(folder / "hostile.osm"), folder / "hostile.city")
    for file in hotel.iterdir():
        shutil.copy(file, folder)
    shutil.copy(maps / "home1.scene", folder)
    there = Anchor(7.42, 43.73, 0.0, 0.4, building=HOUSE, level="<i>0")
    open_map(maps / "home2.scene").anchored(there).save(folder / f"{HOUSE}.scene")
    with threaded(folder) as url:
        yield url


@pytest.fixture(scope="session")
def web(url):
    """Client of the server of the page."""
    with httpx.Client(base_url=url) as client:
        yield client
