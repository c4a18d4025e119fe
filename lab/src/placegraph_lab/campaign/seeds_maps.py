"""Sound towns, meshes, scene graphs, maps and stores, small: what is mutated."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import numpy as np

from placegraph.core.geo import Anchor
from placegraph.core.geometry import Camera
from placegraph.indoor.build import scene_of_model
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.frame import Frame
from placegraph.io.osm.indoor_osm import encode_rooms
from placegraph.outdoor.city import CityMap, build_city
from placegraph_lab.campaign.seeds import Drawn, writer
from placegraph_lab.worlds.town.town import Town

Draw = Callable[[Path, "Places"], None]


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


class Places(Drawn):
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


def _osm(path: Path, places: Places) -> None:
    plain = places.town.write_osm(path.with_name("plain.source"))
    text = plain.read_text("utf-8")
    plain.unlink()
    writer("formats.place.test_osm").write(path, text)
    path.with_name(path.name.split(".", maxsplit=1)[0] + ".source.osm").unlink()


def _areas(path: Path, _places: Places) -> None:
    """Multipolygons, which osmium assembles."""
    module = writer("formats.place.test_osm")
    module.write(path, module.WORLD)
    path.with_name(path.name.split(".", maxsplit=1)[0] + ".source.osm").unlink()


def _indoor(*, osmag: bool) -> Draw:
    def draw(path: Path, _places: Places) -> None:
        hall = writer("indoor.mapping.test_osm").HALL
        path.write_bytes(encode_rooms(hall, osmag=osmag, generator="campaign"))

    return draw


def _recorded(name: str) -> Draw:
    """What a service answered, as the tests have it."""

    def draw(path: Path, _places: Places) -> None:
        data = writer("formats.place.test_overpass").DATA
        shutil.copy(data / name, path)

    return draw


def _exported(path: Path, places: Places) -> None:
    places.room.export(path)


def _gltf(folder: Path, _places: Places) -> None:
    module = writer("formats.mesh.test_gltf")
    folder.mkdir()
    glb = writer("formats.conftest").Glb(folder / "a.glb")
    module.filled(glb)
    module.as_text(glb, "a.bin")
    shutil.rmtree(folder / "parts")
    (folder / "a.bin").write_bytes(glb.bytes)
    (folder / "a.glb").unlink()


def _textured(path: Path, _places: Places) -> None:
    writer("formats.mesh.test_gltf").filled(writer("formats.conftest").Glb(path))


def _obj(folder: Path, _places: Places) -> None:
    module = writer("formats.mesh.test_obj")
    (folder / "textures").mkdir(parents=True)
    (folder / "textures/wood grain.png").write_bytes(module.png())
    (folder / "room.mtl").write_text(module.MATERIALS)
    (folder / "room.obj").write_text(module.ROOM)


def _ply(form: str) -> Draw:
    def draw(path: Path, _places: Places) -> None:
        module = writer("formats.mesh.test_ply")
        points = [(x, y, 0.1 * (x + y)) for x in range(4) for y in range(4)]
        rows = [[4 * x + y, 4 * x + 4 + y, 4 * x + 5 + y] for x in range(3) for y in range(3)]
        colour = {c: ("uchar", [90] * 16) for c in ("red", "green", "blue")}
        ids = {"objectId": ("short", [7] * 8 + [9] * 8)}
        path.write_bytes(
            module.ply(form, module.vertices(points, **colour, **ids), module.faces(*rows))
        )

    return draw


def _conceptgraphs(folder: Path, _places: Places) -> None:
    writer("formats.mesh.test_conceptgraphs").write(folder, mesh=False)


def _scan3r(folder: Path, _places: Places) -> None:
    module = writer("formats.dataset.test_scan3r")
    module.ScanFolder(folder).write()


def _scannet(folder: Path, _places: Places) -> None:
    world = writer("scannet_world")
    world.Scan(folder / world.NAME)


def _fusion(folder: Path, _places: Places) -> None:
    writer("formats.dataset.test_scenegraphfusion").Output(folder, every=7)


def _city(path: Path, places: Places) -> None:
    places.city(path.parent)
    (path.parent / "town.osm").unlink()


def _scene(path: Path, places: Places) -> None:
    places.room.save(path)


def _weights(path: Path, _places: Places) -> None:
    from placegraph.outdoor.network.weights import Weights, write_weights

    module = writer("cities")
    arrays = module.adding(module.random_arrays(module.SMALL), 0.3)
    write_weights(path, Weights(module.SMALL, arrays, {"plan": {}, "curves": []}))


def _run(path: Path, places: Places) -> None:
    from placegraph.indoor.pose.record import write_run

    options = FilterOptions(record=True, colour=True)
    write_run(path, places.room.localize(places.frames, options=options, refine=False))


def _track(path: Path, places: Places) -> None:
    with places.room.live(SMALL, background=False) as live:
        for frame in places.frames:
            live.move(frame.stamp, frame.odometry)
        live.place(POSE, np.eye(6) * 0.01)
        live.save(path)


def _changes(path: Path, places: Places) -> None:
    later = {**BOXES, "lamp": ((3, 3, 0), (3.2, 3.2, 1.4)), "chair": ((3, 1, 0), (3.5, 1.5, 0.9))}
    del later["bookcase"]
    places.room.diff(scene_of_model(writer("indoor.conftest")._model(later))).save(path)  # noqa: SLF001


MAPS: dict[str, dict[str, Draw]] = {
    "OSM .osm": {"town.osm": _osm, "areas.osm": _areas},
    "OSM .osm.pbf": {"town.osm.pbf": _osm, "areas.osm.pbf": _areas},
    "OSM .osm.gz, .osm.bz2": {"town.osm.gz": _osm, "areas.osm.bz2": _areas},
    "OSM of Overpass": {"overpass.osm": _recorded("overpass_muehlenend.osm")},
    "Overpass answers": {"answer.xml": _recorded("overpass_muehlenend.osm")},
    "Nominatim answers": {"answer.json": _recorded("nominatim_muehlenend.json")},
    "OSM rooms": {"rooms.osm": _indoor(osmag=False), "rooms.osmag": _indoor(osmag=True)},
    "GLB": {"room.glb": _exported, "textured.glb": _textured},
    "glTF": {"gltf": _gltf},
    "OBJ and MTL": {"obj": _obj},
    "PLY": {"room.ply": _exported, "text.ply": _ply("ascii"), "big.ply": _ply("binary_big_endian")},
    "Spark-DSG": {"dsg.json": _exported},
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
