import asyncio
import re
import shutil
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress

import httpx
import numpy as np
import pytest
from starlette.testclient import TestClient

from placegraph.core.geo import Anchor
from placegraph.demo.town import FLAT, TOWN
from placegraph.maps import open_map
from placegraph.outdoor.city import build_city
from placegraph_lab.worlds.town.town import Town
from placegraph_serve.app import create_app
from placegraph_serve.options import ServeOptions
from placegraph_serve.places import Dispatcher, Places
from placegraph_serve.workers import answer

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
SENTENCE = "A bakery is north of me. The church is east of the bakery."


@pytest.fixture(scope="session")
def maps(demo_world, tmp_path_factory):
    folder = tmp_path_factory.mktemp("served")
    for name in (f"{TOWN}.city", "home1.scene", "home2.scene"):
        shutil.copy(demo_world / name, folder)
    return folder


@pytest.fixture(scope="session")
def walk(demo_world):
    return demo_world / "walk"


@pytest.fixture(scope="session")
def flat(demo_world, tmp_path_factory):
    anchor = Anchor(8.0, 53.0, 40.0, np.pi / 2, np.diag([1.0, 1.0, 1.0, 1e-4]), "Haus", level="2")
    file = tmp_path_factory.mktemp("flat") / f"{FLAT}.scene"
    open_map(demo_world / file.name).anchored(anchor).save(file)
    return file


@pytest.fixture(scope="session")
def town(maps):
    return maps / f"{TOWN}.city"


def ready(asked, status=200):
    end = time.monotonic() + 120
    while time.monotonic() < end:
        with suppress(httpx.RemoteProtocolError):  # a busy machine is too slow for tiny limits
            if (answer := asked()).status_code == status:
                return answer
        threading.Event().wait(0.05)
    pytest.fail(f"no answer {status} in two minutes")


class LocalQueue:
    ready, waiting, running, answered, replaced = True, 0, 0, 0, 0

    def __init__(self, name, pool, dispatcher):
        self.name, self.pool, self.dispatcher = name, pool, dispatcher

    def start(self):
        pass

    async def end(self):
        self.pool.shutdown()

    async def ask(self, verb, asked):
        loop = asyncio.get_running_loop()
        asked = asked() if callable(asked) else asked
        return await loop.run_in_executor(self.pool, answer, self.dispatcher, verb, asked)


@contextmanager
def serving(*paths, processes=(), **options):
    """Client of an application; a thread works in place of kinds of processes that are not named."""
    # Starlette calls itself testserver
    options = ServeOptions(**{"names": ("testserver",), "sentence_workers": 1} | options)
    app = create_app(places := Places(paths), options)
    server, pool = app.state.server, ThreadPoolExecutor(1)
    dispatcher = Dispatcher(places, options)
    for name in {"sentences", "captures", "steps"}.difference(processes):
        setattr(server, name, LocalQueue(name, pool, dispatcher))
    server.sessions._queue = server.steps
    with TestClient(app) as client:
        ready(lambda: client.get("/healthz"))
        yield client


@pytest.fixture(scope="session")
def client(town):
    with serving(town) as client:
        yield client


class Running:
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
def running(maps, demo_world, tmp_path_factory):
    """A server: a town with a flat in its hotel, a hostile one with a home, a home of no town."""
    folder = tmp_path_factory.mktemp("running")
    build_city(Town.parse(HOSTILE).write_osm(folder / "hostile.osm"), folder / "hostile.city")
    shutil.copy(maps / f"{TOWN}.city", folder)
    hotel = (9.99884, 53.55015, 6.4, 0.3, np.diag([1.0, 1, 1, 1e-4]), "Hotel Hansa")
    flat = open_map(demo_world / f"{FLAT}.scene").anchored(Anchor(*hotel, level="2"))
    flat.save(folder / f"{FLAT}.scene")
    shutil.copy(maps / "home1.scene", folder)
    there = Anchor(7.42, 43.73, 0.0, 0.4, building=HOUSE, level="<i>0")
    open_map(maps / "home2.scene").anchored(there).save(folder / f"{HOUSE}.scene")
    server = Running(folder, "--port", "0")
    server.folder = folder
    yield server
    code, said = server.end()
    assert (code, said) == (0, "")


@pytest.fixture(scope="session")
def url(running):
    return f"{running.url}/"


@pytest.fixture(scope="session")
def web(url):
    with httpx.Client(base_url=url) as client:
        yield client
