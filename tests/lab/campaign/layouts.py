"""Seeds of the formats that the tests' own writers know, for `placegraph_lab.campaign`."""

import importlib
import re
import shutil
import sys
import zipfile
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image

from placegraph.core.geometry import Camera
from placegraph.io.capture.tum import write_tum
from placegraph.io.osm.indoor_osm import encode_rooms
from placegraph_lab.worlds.flat.flat import Flat

ROOT = Path(__file__).parents[3]
LARGE = Camera(192, 144, 160.0, 161.0, 97.5, 71.0)  # a video's blocks blur small images
EXPECTED = re.compile(r" => .*| @\d+.*")  # what the tests expect of a sentence stands behind it


def writer(name):
    for folder in (ROOT / "packages/placegraph-io/tests", ROOT):
        if str(folder) not in sys.path:
            sys.path.insert(0, str(folder))
    top = name.partition(".")[0] in {"dataset", "graphs", "test_overture", "test_phone"}
    return importlib.import_module(name if top else f"tests.{name}")


def save(path, array, **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(array)).save(path, **options)


@cache
def film(*, large=False):
    options = {"camera": LARGE, "shrink": 4} if large else {}
    return writer("io.conftest").Recorded(Flat.load("study"), frames=3, **options)


def read_sentences():
    found = []
    for path in sorted((ROOT / "tests/outdoor/language/hand").glob("*.txt")):
        lines = path.read_text("utf-8").splitlines()
        found += [EXPECTED.sub("", line) for line in lines if line.strip() and line[0] != "#"]
    for name in ("sentences", "human", "turns"):
        lines = (ROOT / f"tests/outdoor/language/{name}.txt").read_text("utf-8").splitlines()
        found += [line.partition(" | ")[0] for line in lines if line and line[0] not in " #"]
    return found


def phone(name, *, large=False, saves=True, module="test_phone", write="write_{}", **options):
    def draw(folder, _):
        folder.mkdir()
        given = (save,) if saves else ()
        getattr(writer(module), write.format(name))(folder, film(large=large), *given, **options)

    return draw


def record3d(folder, _):
    folder.mkdir()
    writer("test_phone").unpacked(folder, film(), save)


def r3d(path, _):
    folder = path.with_name("to pack")
    record3d(folder, _)
    writer("test_phone").packed(path, folder)
    shutil.rmtree(folder)


def video(folder, _):
    folder.mkdir()
    module, held = writer("io.capture.test_video"), film(large=True)
    module.write(folder, held, start=0.5, body_from_camera=np.eye(4).tolist())
    write_tum(folder / "odometry.tum", held.stamps, held.poses)


def capture_folder(path, _):
    path.mkdir()
    made = writer("io.conftest").CaptureFolder(path)
    made.text("gravity.txt", "".join(f"{0.2 * i} 0 1 0\n" for i in range(3)))
    made.text("fixes.txt", "".join(f"{0.2 * i} 8.0 53.0 40.0 5.0\n" for i in range(3)))
    shutil.copytree(path / "instances", path / "labels")
    made.json("labels.json", {str(i): f"thing {i}" for i in range(6)})


def tum(folder, _):
    writer("dataset.test_tum_rgbd").write(folder, film(), save)


def transforms(kind):
    def draw(folder, _):
        folder.mkdir()
        writer("dataset.test_transforms").write(folder, film(), save, kind)

    return draw


def colmap(form, *, own=False):
    def draw(folder, _):
        module = writer("dataset.test_colmap")
        model = module.Model(film())
        getattr(model, form)(folder / "sparse/0")
        module.images(folder, film(), model, save, depth="" if own else "depth/{}.png")
        if own:
            module.own_depth(folder, film(), model)

    return draw


def rtabmap(**options):
    return lambda path, _: writer("dataset.test_rtabmap").write(path, film(), **options)


def sens(colour, depth):
    def draw(path, _):
        writer("scannet_world").Recording().write_sens(path, colour=colour, depth=depth)

    return draw


def sequence(path, _):
    writer("dataset.test_scan3r_sequence").Recording().folder(path)


def sequence_zip(path, _):
    sequence(path / "unzipped", _)
    with zipfile.ZipFile(path / "sequence.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted((path / "unzipped/sequence").iterdir()):
            archive.write(file, file.name)
    shutil.rmtree(path / "unzipped")


CAPTURES = {
    "capture folder": {"labelled": capture_folder},
    "video with a trajectory": {"video": video},
    "Stray Scanner": {"stray": phone("stray", large=True),
                      "all": phone("stray", large=True, intrinsics=True)},
    "Polycam": {"polycam": phone("polycam")},
    "Record3D": {"unpacked": record3d, "walk.r3d": r3d},
    "MultiScan": {"multiscan": phone("", large=True, saves=False, module="dataset.test_multiscan",
                                     write="write")},
    "ios_logger": {"ios": phone("ios_logger", large=True, saves=False)},
    "3D Scanner App": {"app": phone("arkit_app")},
    "ARKitScenes": {"scenes": phone("", module="dataset.test_arkit_scenes", write="write")},
    "TUM RGB-D": {"tum": tum},
    "transforms.json": {k: transforms(k) for k in ("nerfcapture", "polycam", "spectacular", "record3d")},
    "COLMAP": {"binary": colmap("binary"), "text": colmap("text"), "own": colmap("binary", own=True)},
    "RTAB-Map": {"new.db": rtabmap(), "old.db": rtabmap(version="0.11.3", depth="png"),
                 "float.db": rtabmap(depth="float", optimized=False)},
    "ScanNet .sens": {"png.sens": sens(1, 1), "raw.sens": sens(0, 0), "jpeg.sens": sens(2, 1)},
    "ScanNet export": {"exported": lambda path, _: writer("scannet_world").Recording().export(path)},
    "3RScan sequence": {"folder": sequence, "zip": sequence_zip},
}  # fmt: skip


def osm(path, world, *, text=None):
    plain = world.town.write_osm(path.with_name("plain.source"))
    writer("io.osm.test_osm").write(path, text or plain.read_text("utf-8"))
    plain.unlink()
    path.with_name(path.name.split(".", maxsplit=1)[0] + ".source.osm").unlink()


def areas(path, world):
    osm(path, world, text=writer("io.osm.test_osm").WORLD)


def rooms(*, osmag):
    def draw(path, _):
        hall = writer("indoor.mapping.test_osm").HALL
        path.write_bytes(encode_rooms(hall, osmag=osmag, generator="campaign"))

    return draw


def recorded(name):
    return lambda path, _: shutil.copy(writer("io.osm.test_overpass").DATA / name, path)


def gltf(folder, _):
    module = writer("io.mesh.test_gltf")
    folder.mkdir()
    glb = writer("io.conftest").Glb(folder / "a.glb")
    module.filled(glb)
    module.as_text(glb, "a.bin")
    shutil.rmtree(folder / "parts")
    (folder / "a.bin").write_bytes(glb.bytes)
    (folder / "a.glb").unlink()


def textured(path, _):
    writer("io.mesh.test_gltf").filled(writer("io.conftest").Glb(path))


def obj(folder, _):
    module = writer("io.mesh.test_obj")
    (folder / "textures").mkdir(parents=True)
    (folder / "textures/wood grain.png").write_bytes(module.png())
    (folder / "room.mtl").write_text(module.MATERIALS)
    (folder / "room.obj").write_text(module.ROOM)


def ply(form):
    def draw(path, _):
        module = writer("io.mesh.test_ply")
        points = [(x, y, 0.1 * (x + y)) for x in range(4) for y in range(4)]
        rows = [[4 * x + y, 4 * x + 4 + y, 4 * x + 5 + y] for x in range(3) for y in range(3)]
        colour = {c: ("uchar", [90] * 16) for c in ("red", "green", "blue")}
        vertices = module.vertices(points, **colour, objectId=("short", [7] * 8 + [9] * 8))
        path.write_bytes(module.ply(form, vertices, module.faces(*rows)))

    return draw


def scannet(folder, _):
    world = writer("scannet_world")
    world.Scan(folder / world.NAME)


def weights(path, _):
    from placegraph.outdoor.network.weights import Weights, write_weights

    module = writer("cities")
    arrays = module.adding(module.random_arrays(module.SMALL), 0.3)
    write_weights(path, Weights(module.SMALL, arrays, {"plan": {}, "curves": []}))


def overture(folder, _):
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


MAPS = {
    "OSM .osm": {"areas.osm": areas},
    "OSM .osm.pbf": {"town.osm.pbf": osm, "areas.osm.pbf": areas},
    "OSM .osm.gz, .osm.bz2": {"town.osm.gz": osm, "areas.osm.bz2": areas},
    "OSM of Overpass": {"overpass.osm": recorded("overpass_muehlenend.osm")},
    "Overpass answers": {"answer.xml": recorded("overpass_muehlenend.osm")},
    "Nominatim answers": {"answer.json": recorded("nominatim_muehlenend.json")},
    "OSM rooms": {"rooms.osm": rooms(osmag=False), "rooms.osmag": rooms(osmag=True)},
    "GLB": {"textured.glb": textured},
    "glTF": {"gltf": gltf},
    "OBJ and MTL": {"obj": obj},
    "PLY": {"text.ply": ply("ascii"), "big.ply": ply("binary_big_endian")},
    "ConceptGraphs": {"run": lambda p, _: writer("graphs.test_conceptgraphs").write(p, mesh=False)},
    "3RScan scan": {"scans": lambda p, _: writer("dataset.test_scan3r").ScanFolder(p).write()},
    "ScanNet scan": {"scans": scannet},
    "SceneGraphFusion": {
        "out": lambda p, _: writer("dataset.test_scenegraphfusion").Output(p, every=7)
    },
    ".weights": {"small.weights": weights},
    "Overture": {"release": overture},
}  # fmt: skip
