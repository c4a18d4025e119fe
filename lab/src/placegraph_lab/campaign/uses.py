"""Uses of fuzzed files: opened, searched, localized in, drawn, exported and written again."""

from __future__ import annotations

import math
import threading
from contextlib import suppress
from functools import cache, cached_property
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from unittest.mock import patch

from numpy.random import Generator

from placegraph.core.files import check_regular
from placegraph.errors import GeoPoseError, InputError, OptionError, PlacegraphError
from placegraph.indoor.build import build_scene
from placegraph.indoor.library import SceneLibrary
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import open_capture
from placegraph.maps import open_map
from placegraph.outdoor.city import CityMap, build_city
from placegraph_lab.campaign.seeds import POSE, SMALL, SeedWorld


class _Handler(BaseHTTPRequestHandler):
    body = b""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(_Handler.body)))
        self.end_headers()
        self.wfile.write(_Handler.body)

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers["Content-Length"]))
        self.do_GET()

    def log_message(self, *_: object) -> None:
        """Say nothing."""


@cache
def _start_server() -> str:
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return f"http://127.0.0.1:{server.server_port}"


def serve_bytes(body: bytes) -> str:
    """Return the URL of a server that answers every request with these bytes."""
    _Handler.body = body
    return _start_server()


OUTSIDE = (
    "A bakery is north of me. The museum is east of me.", "I am on Lange Straße, a bench is left of me.",
    "Das Café Mole ist 30 m westlich von mir.", "A tree, and a fountain behind it.",
)  # fmt: skip
INSIDE = (
    "next to the desk",
    "a room with a chair and a bookcase",
    "two chairs in front of the wall",
)


class Bench(SeedWorld):
    """Sound maps that inputs are used with, and a folder to write to."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @cached_property
    def kleinstadt(self) -> CityMap:
        """Map of the town."""
        return self.city(self.folder)

    def file(self, name: str) -> Path:
        """Return the path of an output; delete what is there."""
        path = self.folder / name
        path.unlink(missing_ok=True)
        return path


def happens(rng: Generator, share: float) -> bool:
    """Draw whether a step is done: slow steps are done to a share of the inputs."""
    return bool(rng.random() < share)


def use_city(bench: Bench, city: CityMap, rng: Generator) -> None:
    """Locate, ask, draw, export and track."""
    found = city.locate(OUTSIDE[rng.integers(len(OUTSIDE))], top=3)
    found.to_dict()
    if happens(rng, 0.15):
        city.to_geojson("cells" if happens(rng, 0.5) else "objects")
        city.ask(found)
        repr(city)
    if happens(rng, 0.08):
        from placegraph.view.city.picture import write_picture

        write_picture(city, found, bench.file("city.png"), size=(320, 320))
    if happens(rng, 0.08):
        from placegraph.view.city.page import write_page

        write_page(city, found, bench.file("city.html"))
    if happens(rng, 0.1):
        tracker = city.track()
        tracker.tell(OUTSIDE[0])
        tracker.walk(20.0, math.pi)
    if happens(rng, 0.1):
        city.save(bench.file("again.city"))


def use_scene(bench: Bench, scene: SceneMap, rng: Generator) -> None:
    """Check, describe, localize, draw and export."""
    if happens(rng, 0.2):
        scene.check()
    if happens(rng, 0.2):
        from placegraph.indoor.language import rank_scenes

        rank_scenes(INSIDE[rng.integers(len(INSIDE))], [scene, bench.room])
    with suppress(GeoPoseError):
        scene.to_geojson()
    if happens(rng, 0.15):
        for ending in rng.choice([".glb", ".ply", ".json", ".osm"], 1):
            with suppress(OptionError, GeoPoseError):  # it stands nowhere on Earth
                scene.export(bench.file(f"room{ending}"), overwrite=True)
    if happens(rng, 0.1):
        scene.render(POSE, SMALL, samples=1)
    if happens(rng, 0.05):
        found = scene.localize(bench.frames, refine=False)
        found.to_dict()
        from placegraph.view.scene.plan import write_plan

        write_plan(scene, found, bench.file("plan.png"), width=480)
    if happens(rng, 0.05):
        scene.save(bench.file("again.scene"))


def osm(bench: Bench, path: Path, rng: Generator) -> None:
    """Build a city from an extract, and use it."""
    use_city(bench, build_city(path, bench.file("built.city")), rng)


def overture(bench: Bench, path: Path, rng: Generator) -> None:
    """Build a city from Overture's tables, of all or of a box."""
    from placegraph_io.overture import Box, Overture

    box = Box(9.9, 49.9, 10.1, 50.1) if happens(rng, 0.7) else None
    use_city(bench, build_city(Overture((str(path),), box), bench.file("built.city")), rng)


def rooms(bench: Bench, path: Path, rng: Generator) -> None:
    """Build a scene from rooms in an extract."""
    use_scene(bench, build_scene(path, None, reader={"level": int(rng.integers(2))}), rng)


def mesh(bench: Bench, path: Path, rng: Generator) -> None:
    """Build a scene from a mesh or a scene graph, and use it."""
    use_scene(bench, build_scene(path, bench.file("built.scene"), floor=0.0), rng)


def folder_mesh(bench: Bench, path: Path, rng: Generator) -> None:
    """Build a scene from the mesh file or the scan that a folder holds."""
    for ending in (".gltf", ".obj"):
        files = sorted(path.glob(f"*{ending}"))
        if files:
            mesh(bench, files[0], rng)
            return
    while below := [p for p in sorted(path.iterdir()) if p.is_dir() and p.name != "3DSSG"]:
        path = below[0]
    mesh(bench, path, rng)


def capture(bench: Bench, path: Path, rng: Generator) -> None:
    """Open a capture, read its frames, localize them, and build a map from them."""
    found = open_capture(path)
    for frame in (found[0], found[-1]):
        frame.rgb()
        frame.depth()
        frame.labels()
    if happens(rng, 0.1):
        with suppress(PlacegraphError):  # there is none
            open_capture(path, poses="trajectory")
    if happens(rng, 0.05):
        bench.room.localize(found, frames=slice(2), refine=False).to_dict()
    if happens(rng, 0.02):
        build_scene(path, None, floor=0.0)


def stream(_bench: Bench, path: Path, _rng: Generator) -> None:
    """Read an MCAP as a stream."""
    from placegraph_io.ros.stream import mcap_packets

    file = next(iter(sorted(path.glob("*.mcap"))), path)
    try:
        with check_regular(file).open("rb") as data:
            for _ in mcap_packets(data.read, "stdin"):
                pass
    except OSError as error:  # of opening it, which the shell does for a pipe
        raise InputError(str(error)) from error


def any_map(bench: Bench, path: Path, rng: Generator) -> None:
    """Open a map of any kind, and use it."""
    found = open_map(path)
    if isinstance(found, CityMap):
        use_city(bench, found, rng)
    elif isinstance(found, SceneMap):
        use_scene(bench, found, rng)
    else:
        found.search(INSIDE[rng.integers(len(INSIDE))])
        if happens(rng, 0.2):
            found.search(bench.frames)
        if happens(rng, 0.05):
            found.localize(bench.frames, refine=False)
        if happens(rng, 0.1) and isinstance(found, SceneLibrary):
            found.save(bench.file("again.library"))


def library(bench: Bench, path: Path, rng: Generator) -> None:
    """Open a library, or a folder of maps, and search it."""
    any_map(bench, path if happens(rng, 0.3) else path / "rooms.library", rng)


def shards(bench: Bench, path: Path, rng: Generator) -> None:
    """Open a library in shards, or the world that it is, and ask it."""
    if happens(rng, 0.3):
        world(bench, path, rng)
    else:
        any_map(bench, path / "rooms.shards", rng)


def world(bench: Bench, path: Path, rng: Generator) -> None:
    """Open a folder of maps as a world, and ask it."""
    from placegraph.world import open_world

    found = open_world(path)
    text = f"{OUTSIDE[rng.integers(len(OUTSIDE))]} I am {INSIDE[0]}."
    frames = bench.frames if happens(rng, 0.1) else None
    found.locate(text, frames, near=(8.0, 53.0) if happens(rng, 0.3) else None).to_dict()


def vectors(bench: Bench, path: Path, _rng: Generator) -> None:
    """Open a store of vectors, search it, and locate by it."""
    from placegraph.vectors import open_store

    with open_store(path) as store:
        store.search(bench.kleinstadt.embeddings[:2], 5)
        with suppress(PlacegraphError):  # of another map
            bench.kleinstadt.locate(OUTSIDE[0], store=store)


def weights(bench: Bench, path: Path, _rng: Generator) -> None:
    """Open a network, embed the town by it, and locate."""
    from placegraph.outdoor.network.network import EncodedCity, GraphTransformer

    encoded = EncodedCity(bench.kleinstadt, GraphTransformer.open(path))
    bench.kleinstadt.locate(OUTSIDE[0], encoded=encoded, matcher="fused")


def run(bench: Bench, path: Path, rng: Generator) -> None:
    """Open a recorded run, draw it and write it again."""
    from placegraph.indoor.pose.record import read_run, write_run

    found = read_run(path)
    found.to_dict()
    write_run(bench.file("again.run"), found)
    if happens(rng, 0.3):
        from placegraph.view.scene.plan import write_plan

        write_plan(bench.room, found, bench.file("plan.png"), width=480)


def track(bench: Bench, path: Path, _rng: Generator) -> None:
    """Load a tracker, and go on."""
    from placegraph.indoor.track.live import LiveTracker

    with LiveTracker.load(path, bench.room, background=False) as live:
        live.move(10.0, POSE)
        live.pose()


def changes(bench: Bench, path: Path, rng: Generator) -> None:
    """Read changes, and apply them."""
    from placegraph.indoor.mapping.change.changes import read_diff

    found = read_diff(path)
    found.to_dict()
    use_scene(bench, bench.room.updated(found), rng)


def nominatim(_bench: Bench, path: Path, _rng: Generator) -> None:
    """Find a place by an answer of Nominatim."""
    import osmnx as ox

    from placegraph.io.osm.overpass import find_area, rings

    with patch("osmnx._nominatim.time"):  # osmnx waits a second before each request
        ox.settings.nominatim_url = serve_bytes(path.read_bytes())
        _, outline = find_area(ox, "Mühlenend")
    rings(outline)


def overpass(bench: Bench, path: Path, _rng: Generator) -> None:
    """Download an answer of Overpass, and write it as PBF."""
    import osmnx as ox

    from placegraph.io.osm.overpass import copy_file, download

    answer = bench.file("answer.osm")
    url = serve_bytes(path.read_bytes())
    download(ox, f"{url}/interpreter", "", answer, lambda *_: None)
    copy_file(answer, bench.file("answer.osm.pbf"), lambda *_: None)
