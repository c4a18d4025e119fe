"""Sound captures, scans and bags of every layout that is read, small: what is mutated.

They are drawn by the writers of the repository's tests, so that no layout is written twice.
"""

from __future__ import annotations

import importlib
import shutil
import sys
import zipfile
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image

from placegraph.core.geo import Anchor
from placegraph.core.geometry import Camera
from placegraph.indoor.build import scene_of_model
from placegraph.indoor.library import make_library
from placegraph.indoor.library.library import SceneLibrary
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.frame import Capture, Frame
from placegraph.io.capture.tum import write_tum
from placegraph.io.osm.indoor_osm import encode_rooms
from placegraph.outdoor.city import CityMap, build_city
from placegraph_lab.worlds.bags import BagWriter, Layout, write_capture
from placegraph_lab.worlds.town.town import Town

Draw = Callable[[Path, "Drawn"], None]


ROOT = Path(__file__).parents[4]  # of the repository: tests stand beside the lab
LARGE = Camera(192, 144, 160.0, 161.0, 97.5, 71.0)  # A video's blocks blur small images


def writer(name: str) -> Any:  # noqa: ANN401  # a module
    """Module of the repository's tests."""
    for folder in (ROOT / "packages" / "placegraph-io" / "tests", ROOT):
        if str(folder) not in sys.path:
            sys.path.insert(0, str(folder))
    top = name.partition(".")[0] in {"conftest", "dataset", "graphs", "test_overture", "test_phone"}
    return importlib.import_module(name if top else f"tests.{name}")


def save(path: Path, array: ArrayLike, **options: Any) -> None:  # noqa: ANN401
    """Write an image, with its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(array)).save(path, **options)


class Drawn:
    """What seeds are made of, drawn once: films of a room as telephones hold them."""

    @cached_property
    def world(self) -> Any:  # noqa: ANN401  # of the tests
        """Three frames of 96 x 72 with depth."""
        return self._recorded(frames=3)

    @cached_property
    def large(self) -> Any:  # noqa: ANN401
        """The same for videos."""
        return self._recorded(frames=3, camera=LARGE, shrink=4)

    def _recorded(self, **options: Any) -> Any:  # noqa: ANN401
        from placegraph_lab.worlds.flat.flat import Flat

        study = Flat.load("study")
        return writer("io.conftest").Recorded(study, **options)

    @cached_property
    def clip(self) -> Capture:
        """The film as a capture in memory."""
        world = self.world
        return Capture.from_frames(
            Frame.from_arrays(
                world.rgb[i], world.cameras[i], depth=np.where(world.sure[i], world.metres[i], 0),
                depth_camera=world.depth_cameras[i], odometry=world.poses[i],
                stamp=world.stamps[i],
            )
            for i in range(len(world))
        )  # fmt: skip


def _phone(name: str, *, large: bool = False, saves: bool = True, **options: Any) -> Draw:  # noqa: ANN401
    def draw(folder: Path, drawn: Drawn) -> None:
        folder.mkdir()
        given = (save,) if saves else ()
        phones = name not in {"arkit_scenes", "multiscan"}
        module = writer("test_phone" if phones else f"dataset.test_{name}")
        write = getattr(module, f"write_{name}" if phones else "write")
        write(folder, drawn.large if large else drawn.world, *given, **options)

    return draw


def _record3d(folder: Path, drawn: Drawn) -> None:
    module = writer("test_phone")
    folder.mkdir()
    module.unpacked(folder, drawn.world, save)


def _r3d(path: Path, drawn: Drawn) -> None:
    folder = path.with_name("to pack")
    _record3d(folder, drawn)
    writer("test_phone").packed(path, folder)
    shutil.rmtree(folder)


def _video(folder: Path, drawn: Drawn) -> None:
    folder.mkdir()
    module = writer("io.capture.test_video")
    module.write(folder, drawn.large, start=0.5, body_from_camera=np.eye(4).tolist())
    write_tum(folder / "odometry.tum", drawn.large.stamps, drawn.large.poses)


def _folder(path: Path, _drawn: Drawn) -> None:
    path.mkdir()
    made = writer("io.conftest").CaptureFolder(path)
    made.text("gravity.txt", "".join(f"{0.2 * i} 0 1 0\n" for i in range(3)))
    made.text("fixes.txt", "".join(f"{0.2 * i} 8.0 53.0 40.0 5.0\n" for i in range(3)))
    (path / "labels").mkdir()
    for file in (path / "instances").iterdir():
        shutil.copy(file, path / "labels" / file.name)
    made.json("labels.json", {str(i): f"thing {i}" for i in range(6)})


def _tum(folder: Path, drawn: Drawn) -> None:
    writer("dataset.test_tum_rgbd").write(folder, drawn.world, save)


def _transforms(kind: str) -> Draw:
    def draw(folder: Path, drawn: Drawn) -> None:
        folder.mkdir()
        writer("dataset.test_transforms").write(folder, drawn.world, save, kind)

    return draw


def _colmap(form: str, *, own: bool = False) -> Draw:
    def draw(folder: Path, drawn: Drawn) -> None:
        module = writer("dataset.test_colmap")
        model = module.Model(drawn.world)
        getattr(model, form)(folder / "sparse/0")
        module.images(folder, drawn.world, model, save, depth="" if own else "depth/{}.png")
        if own:
            module.own_depth(folder, drawn.world, model)

    return draw


def _rtabmap(**options: Any) -> Draw:  # noqa: ANN401
    def draw(path: Path, drawn: Drawn) -> None:
        writer("dataset.test_rtabmap").write(path, drawn.world, **options)

    return draw


def _sens(colour: int, depth: int) -> Draw:
    def draw(path: Path, _drawn: Drawn) -> None:
        writer("scannet_world").Recording().write_sens(path, colour=colour, depth=depth)

    return draw


def _exported(folder: Path, _drawn: Drawn) -> None:
    writer("scannet_world").Recording().export(folder)


def _sequence(path: Path, _drawn: Drawn) -> None:
    recording = writer("dataset.test_scan3r_sequence").Recording()
    recording.folder(path)


def _sequence_zip(path: Path, drawn: Drawn) -> None:
    _sequence(path / "unzipped", drawn)
    with zipfile.ZipFile(path / "sequence.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted((path / "unzipped/sequence").iterdir()):
            archive.write(file, file.name)
    shutil.rmtree(path / "unzipped")


def _bag(container: str, *, packed: bool = False, layout: Layout | None = None) -> Draw:
    def draw(path: Path, drawn: Drawn) -> None:
        with BagWriter(path, container, packed=packed) as bag:  # type: ignore[arg-type]
            write_capture(bag, drawn.clip, layout or Layout())

    return draw


PACKED = Layout(images="packed", poses="odometry")
CAPTURES: dict[str, dict[str, Draw]] = {
    "capture folder": {"folder": _folder},
    "video with a trajectory": {"video": _video},
    "Stray Scanner": {"stray": _phone("stray", large=True),
                      "all": _phone("stray", large=True, intrinsics=True)},
    "Polycam": {"polycam": _phone("polycam")},
    "Record3D": {"unpacked": _record3d, "walk.r3d": _r3d},
    "MultiScan": {"multiscan": _phone("multiscan", large=True, saves=False)},
    "ios_logger": {"ios": _phone("ios_logger", large=True, saves=False)},
    "3D Scanner App": {"app": _phone("arkit_app")},
    "ARKitScenes": {"scenes": _phone("arkit_scenes")},
    "TUM RGB-D": {"tum": _tum},
    "transforms.json": {k: _transforms(k) for k in ("nerfcapture", "polycam", "spectacular", "record3d")},
    "COLMAP": {"binary": _colmap("binary"), "text": _colmap("text"), "own": _colmap("binary", own=True)},
    "RTAB-Map": {"new.db": _rtabmap(), "old.db": _rtabmap(version="0.11.3", depth="png"),
                 "float.db": _rtabmap(depth="float", optimized=False)},
    "ScanNet .sens": {"png.sens": _sens(1, 1), "raw.sens": _sens(0, 0), "jpeg.sens": _sens(2, 1)},
    "ScanNet export": {"exported": _exported},
    "3RScan sequence": {"folder": _sequence, "zip": _sequence_zip},
    "bags MCAP": {"plain": _bag("mcap"), "packed": _bag("mcap", packed=True),
                  "compressed": _bag("mcap", layout=PACKED)},
    "bags db3": {"rosbag2": _bag("sqlite3"), "compressed": _bag("sqlite3", layout=PACKED)},
    "bags rosbag1": {"walk.bag": _bag("rosbag1"), "packed.bag": _bag("rosbag1", packed=True)},
}  # fmt: skip
"""Of each layout its seeds: a name of a file or folder, and what draws it there."""


DrawMap = Callable[[Path, "DrawnPlaces"], None]


TOWN = """
[town]
name = Kleinstadt
center = 8.0 53.0

[drawing]
 ####   |  ~~~~   ####
 #K##   |  ~~~~   #H##
-----1--+-------------
        |   R   b
  T     2   F     L

[legend]
K: shop=bakery name=Bäckerei Kern
H: tourism=hotel name=Hotel Hansa
T: natural=tree
F: amenity=fountain
R: amenity=cafe name=Café Mole
b: amenity=bench
L: tourism=museum name=Museum
~: natural=water
1 road: highway=residential name=Lange Straße
2 road: highway=residential name=Hafenweg
"""
BOXES = {
    "floor": ((0, 0, -0.1), (5, 4, 0)), "wall": ((0, 4, 0), (5, 4.1, 2.5)),
    "desk": ((1, 1, 0), (2.2, 1.7, 0.75)), "chair": ((1.5, 2, 0), (2, 2.5, 0.9)),
    "bookcase": ((4.5, 0.5, 0), (4.9, 2, 2.1)),
}  # fmt: skip
SMALL = Camera(48, 36, 35.0, 35.0, 24.0, 18.0)
POSE = np.array([[1, 0, 0, 2.5], [0, 0, -1, 0.2], [0, 1, 0, 1.5], [0, 0, 0, 1.0]])
POSE[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]


class DrawnPlaces(Drawn):
    """A town and a room, what is seen there, and all that can be asked of them."""

    @cached_property
    def town(self) -> Town:
        """As it was drawn."""
        return Town.parse(TOWN)

    def city(self, folder: Path) -> CityMap:
        """Its map, built in a folder."""
        self.town.write_osm(folder / "town.osm")
        return build_city(folder / "town.osm", folder / "town.city")

    @cached_property
    def room(self) -> SceneMap:
        """Five boxes, on Earth."""
        scene = scene_of_model(writer("indoor.conftest")._model(BOXES))  # noqa: SLF001
        there = np.diag([1.0, 1.0, 1.0, 1e-4])
        anchor = Anchor(8.0, 53.0, 40.0, 0.3, there, "Hotel Hansa", level="0")
        return scene.anchored(anchor)

    @cached_property
    def frames(self) -> list[Frame]:
        """Two looks into the room, with depth."""
        seen = []
        for i in range(2):
            pose = POSE.copy()
            pose[0, 3] += 0.1 * i
            shown = self.room.render(pose, SMALL, samples=1)
            seen.append(
                Frame.from_arrays(
                    shown.colour, SMALL, depth=np.nan_to_num(shown.depth), labels=shown.objects + 1,
                    label_camera=SMALL, label_names=dict(enumerate(BOXES, 1)),
                    odometry=pose, stamp=float(i), index=i,
                )
            )  # fmt: skip
        return seen


def _osm(path: Path, places: DrawnPlaces) -> None:
    plain = places.town.write_osm(path.with_name("plain.source"))
    text = plain.read_text("utf-8")
    plain.unlink()
    writer("io.osm.test_osm").write(path, text)
    path.with_name(path.name.split(".", maxsplit=1)[0] + ".source.osm").unlink()


def _areas(path: Path, _places: DrawnPlaces) -> None:
    """Multipolygons, which osmium assembles."""
    module = writer("io.osm.test_osm")
    module.write(path, module.WORLD)
    path.with_name(path.name.split(".", maxsplit=1)[0] + ".source.osm").unlink()


def _indoor(*, osmag: bool) -> DrawMap:
    def draw(path: Path, _places: DrawnPlaces) -> None:
        hall = writer("indoor.mapping.test_osm").HALL
        path.write_bytes(encode_rooms(hall, osmag=osmag, generator="campaign"))

    return draw


def _recorded(name: str) -> DrawMap:
    """What a service answered, as the tests have it."""

    def draw(path: Path, _places: DrawnPlaces) -> None:
        data = writer("io.osm.test_overpass").DATA
        shutil.copy(data / name, path)

    return draw


def _exported_map(path: Path, places: DrawnPlaces) -> None:
    places.room.export(path)


def _gltf(folder: Path, _places: DrawnPlaces) -> None:
    module = writer("io.mesh.test_gltf")
    folder.mkdir()
    glb = writer("io.conftest").Glb(folder / "a.glb")
    module.filled(glb)
    module.as_text(glb, "a.bin")
    shutil.rmtree(folder / "parts")
    (folder / "a.bin").write_bytes(glb.bytes)
    (folder / "a.glb").unlink()


def _textured(path: Path, _places: DrawnPlaces) -> None:
    writer("io.mesh.test_gltf").filled(writer("io.conftest").Glb(path))


def _obj(folder: Path, _places: DrawnPlaces) -> None:
    module = writer("io.mesh.test_obj")
    (folder / "textures").mkdir(parents=True)
    (folder / "textures/wood grain.png").write_bytes(module.png())
    (folder / "room.mtl").write_text(module.MATERIALS)
    (folder / "room.obj").write_text(module.ROOM)


def _ply(form: str) -> DrawMap:
    def draw(path: Path, _places: DrawnPlaces) -> None:
        module = writer("io.mesh.test_ply")
        points = [(x, y, 0.1 * (x + y)) for x in range(4) for y in range(4)]
        rows = [[4 * x + y, 4 * x + 4 + y, 4 * x + 5 + y] for x in range(3) for y in range(3)]
        colour = {c: ("uchar", [90] * 16) for c in ("red", "green", "blue")}
        ids = {"objectId": ("short", [7] * 8 + [9] * 8)}
        path.write_bytes(
            module.ply(form, module.vertices(points, **colour, **ids), module.faces(*rows))
        )

    return draw


def _conceptgraphs(folder: Path, _places: DrawnPlaces) -> None:
    writer("graphs.test_conceptgraphs").write(folder, mesh=False)


def _scan3r(folder: Path, _places: DrawnPlaces) -> None:
    module = writer("dataset.test_scan3r")
    module.ScanFolder(folder).write()


def _scannet(folder: Path, _places: DrawnPlaces) -> None:
    world = writer("scannet_world")
    world.Scan(folder / world.NAME)


def _fusion(folder: Path, _places: DrawnPlaces) -> None:
    writer("dataset.test_scenegraphfusion").Output(folder, every=7)


def _city(path: Path, places: DrawnPlaces) -> None:
    places.city(path.parent)
    (path.parent / "town.osm").unlink()


def _scene(path: Path, places: DrawnPlaces) -> None:
    places.room.save(path)


def _weights(path: Path, _places: DrawnPlaces) -> None:
    from placegraph.outdoor.network.network import Weights, write_weights

    module = writer("cities")
    arrays = module.adding(module.random_arrays(module.SMALL), 0.3)
    write_weights(path, Weights(module.SMALL, arrays, {"plan": {}, "curves": []}))


def _run(path: Path, places: DrawnPlaces) -> None:
    from placegraph.indoor.pose.record import write_run

    options = FilterOptions(record=True, colour=True)
    write_run(path, places.room.localize(places.frames, options=options, refine=False))


def _track(path: Path, places: DrawnPlaces) -> None:
    with places.room.live(SMALL, background=False) as live:
        for frame in places.frames:
            live.move(frame.stamp, frame.odometry)
        live.place(POSE, np.eye(6) * 0.01)
        live.save(path)


def _changes(path: Path, places: DrawnPlaces) -> None:
    later = {**BOXES, "lamp": ((3, 3, 0), (3.2, 3.2, 1.4)), "chair": ((3, 1, 0), (3.5, 1.5, 0.9))}
    del later["bookcase"]
    places.room.diff(scene_of_model(writer("indoor.conftest")._model(later))).save(path)  # noqa: SLF001


MAPS: dict[str, dict[str, DrawMap]] = {
    "OSM .osm": {"town.osm": _osm, "areas.osm": _areas},
    "OSM .osm.pbf": {"town.osm.pbf": _osm, "areas.osm.pbf": _areas},
    "OSM .osm.gz, .osm.bz2": {"town.osm.gz": _osm, "areas.osm.bz2": _areas},
    "OSM of Overpass": {"overpass.osm": _recorded("overpass_muehlenend.osm")},
    "Overpass answers": {"answer.xml": _recorded("overpass_muehlenend.osm")},
    "Nominatim answers": {"answer.json": _recorded("nominatim_muehlenend.json")},
    "OSM rooms": {"rooms.osm": _indoor(osmag=False), "rooms.osmag": _indoor(osmag=True)},
    "GLB": {"room.glb": _exported_map, "textured.glb": _textured},
    "glTF": {"gltf": _gltf},
    "OBJ and MTL": {"obj": _obj},
    "PLY": {
        "room.ply": _exported_map,
        "text.ply": _ply("ascii"),
        "big.ply": _ply("binary_big_endian"),
    },
    "Spark-DSG": {"dsg.json": _exported_map},
    "ConceptGraphs": {"run": _conceptgraphs},
    "3RScan scan": {"scans": _scan3r},
    "ScanNet scan": {"scans": _scannet},
    "SceneGraphFusion": {"out": _fusion},
    ".city": {"town.city": _city},
    ".scene": {"room.scene": _scene},
    ".weights": {"small.weights": _weights},
    ".run": {"walk.run": _run},
    ".track": {"robot.track": _track},
    "changes": {"changes.json": _changes},
}
"""Of each format its seeds: a name of a file or folder, and what draws it there."""


def _rooms(folder: Path, places: DrawnPlaces) -> SceneLibrary:
    folder.mkdir()
    places.room.save(folder / "room.scene")
    library = make_library({}, encoders="labels")
    library.add("room", folder / "room.scene")
    return library


def _library(folder: Path, places: DrawnPlaces) -> None:
    _rooms(folder, places).save(folder / "rooms.library")


def _shards(folder: Path, places: DrawnPlaces) -> None:
    """One map under four names, two a shard; the folder is a world as well."""
    from placegraph_scale.library.write import NamedEntry, write_shards

    entry = _rooms(folder, places).entry("room")
    listed = [NamedEntry(f"room {i}", entry, "../room.scene") for i in range(4)]
    write_shards(folder / "rooms.shards", listed, encoders=("labels",), size=2)


def _world(folder: Path, places: DrawnPlaces) -> None:
    _library(folder, places)
    _city(folder / "town.city", places)


def _planet(folder: Path, places: DrawnPlaces) -> None:
    """A world of shards, and its table of words."""
    from placegraph_lab.worlds.shards import write_shards

    write_shards(_town(folder, places), folder, 16)


def _indexed(path: Path, places: DrawnPlaces) -> None:
    """A town's map with the index of its viewpoints, which only large ones have by themselves."""
    from placegraph.outdoor.map.city import City

    City.save(_town(path, places), path, index=True)


def _town(path: Path, places: DrawnPlaces) -> Any:  # noqa: ANN401  # a CityMap
    city = places.city(path.parent)
    for name in ("town.osm", "town.city"):
        (path.parent / name).unlink()
    return city


def _vectors(bits: int) -> DrawMap:
    def draw(path: Path, places: DrawnPlaces) -> None:
        _town(path, places).encoded.keep(path, name="town", bits=bits)

    return draw


def _overture(folder: Path, _places: DrawnPlaces) -> None:
    """DrawnPlaces, buildings and streets, a file each."""
    module = writer("test_overture")
    square = "POLYGON ((10 50, 10.001 50, 10.001 50.001, 10 50.001, 10 50))"
    rows = {
        "place": [module.place(10 + i * 1e-3, 50.0, i, kind, name=f"Haus {i}")
                  for i, kind in enumerate(("coffee_shop", "bakery", "hotel", "pharmacy"))],
        "building": [module.row(square, 11, subtype="religious", **{"class": "church"}, name="Sankt Anna")],
        "segment": [module.row("LINESTRING (10 50, 10.002 50.001)", 21, subtype="road",
                               **{"class": "primary"}, subclass="link", name="Lange Straße")],
        "infrastructure": [module.row("POINT (10.0005 50.0005)", 31, source_tags=[("amenity", "bench")])],
    }  # fmt: skip
    for kind, held in rows.items():
        module.write(folder / f"type={kind}/part-0.parquet", kind, held)


STORES: dict[str, dict[str, DrawMap]] = {
    "Overture": {"release": _overture},
    ".city with an index": {"town.city": _indexed},
    ".library": {"library": _library},
    "libraries in shards": {"shards": _shards},
    "worlds": {"world": _world},
    "worlds in shards": {"planet": _planet},
    ".vectors": {"8.vectors": _vectors(8), "16.vectors": _vectors(16), "32.vectors": _vectors(32)},
}
"""Of each format its seeds: a name of a file or folder, and what draws it there."""
