"""Sound files of every format that the lab itself can write, small: the inputs that fuzzing mutates.

`load_layouts` adds the formats that another Python file can write, such as those of the tests.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from placegraph.core.geo import Anchor
from placegraph.core.geometry import Camera
from placegraph.indoor.build import scene_of_model
from placegraph.indoor.library import make_library
from placegraph.indoor.library.library import SceneLibrary
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.frame import Capture, Frame
from placegraph.io.mesh.model import Model, ModelObject, Texture
from placegraph.outdoor.city import CityMap, build_city
from placegraph_io.graphs.spark_dsg import box_corners, box_piece, join_pieces
from placegraph_lab.worlds.bags import BagWriter, Layout, write_capture
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.walks import stroll, write_walk
from placegraph_lab.worlds.town.town import Town

Draw = Callable[[Path, "SeedWorld"], None]
Seeds = dict[str, dict[str, Draw]]
"""By format the names of its files or folders, and the function that writes each."""

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
POSE = np.array([[1, 0, 0, 2.5], [0, 0, 1, 0.2], [0, -1, 0, 1.5], [0, 0, 0, 1.0]])


def save_image(path: Path, array: np.ndarray) -> None:
    """Write an image, with its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(array)).save(path)


def box_model(boxes: Mapping[str, Any]) -> Model:
    """Return a model of boxes, each given by its lowest and highest corner [m]."""
    spans = np.array(list(boxes.values()), np.float64)
    corners = [box_corners(s.mean(axis=0), s[1] - s[0], np.eye(3)) for s in spans]
    columns: dict[str, Any] = dict(join_pieces([box_piece(c, i) for i, c in enumerate(corners)]))
    return Model(
        path=Path("boxes"), objects=tuple(ModelObject(str(i), label) for i, label in enumerate(boxes, 1)),
        picture_of=np.zeros(12 * len(boxes), np.int64), pictures=(Texture(None),),
        **columns,
    )  # fmt: skip


class SeedWorld:
    """A town, a room and views of both, of which seeds are written."""

    @cached_property
    def town(self) -> Town:
        """The drawn town."""
        return Town.parse(TOWN)

    def city(self, folder: Path) -> CityMap:
        """Build the town's map in a folder."""
        self.town.write_osm(folder / "town.osm")
        return build_city(folder / "town.osm", folder / "town.city")

    @cached_property
    def room(self) -> SceneMap:
        """Five boxes, georeferenced."""
        covariance = np.diag([1.0, 1.0, 1.0, 1e-4])
        anchor = Anchor(8.0, 53.0, 40.0, 0.3, covariance, "Hotel Hansa", level="0")
        return scene_of_model(box_model(BOXES)).anchored(anchor)

    @cached_property
    def frames(self) -> list[Frame]:
        """Two views of the room, with depth and labels."""
        found = []
        for i in range(2):
            pose = POSE.copy()
            pose[0, 3] += 0.1 * i
            view = self.room.render(pose, SMALL, samples=1)
            found.append(
                Frame.from_arrays(
                    view.colour, SMALL, depth=np.nan_to_num(view.depth), depth_camera=SMALL,
                    labels=view.objects + 1, label_camera=SMALL,
                    label_names=dict(enumerate(BOXES, 1)), odometry=pose, stamp=float(i), index=i,
                )
            )  # fmt: skip
        return found


def _capture_folder(folder: Path, _world: SeedWorld) -> None:
    drawing, rng = Flat.load("study"), np.random.default_rng(1)
    walk = stroll(drawing, rng, frames=3)
    write_walk(drawing.furnish(rng), walk, folder, rng, camera=Camera(96, 72, 80, 80, 48, 36))


def _bag(container: str, *, packed: bool = False, layout: Layout | None = None) -> Draw:
    def draw(path: Path, world: SeedWorld) -> None:
        with BagWriter(path, container, packed=packed) as bag:  # type: ignore[arg-type]
            write_capture(bag, Capture.from_frames(world.frames), layout)

    return draw


def _osm(path: Path, world: SeedWorld) -> None:
    world.town.write_osm(path)


def _export(path: Path, world: SeedWorld) -> None:
    world.room.export(path)


def _city(path: Path, world: SeedWorld) -> None:
    world.city(path.parent)
    (path.parent / "town.osm").unlink()


def _scene(path: Path, world: SeedWorld) -> None:
    world.room.save(path)


def _run(path: Path, world: SeedWorld) -> None:
    from placegraph.indoor.pose.record import write_run

    options = FilterOptions(record=True, colour=True)
    write_run(path, world.room.localize(world.frames, options=options, refine=False))


def _track(path: Path, world: SeedWorld) -> None:
    with world.room.live(SMALL, background=False) as live:
        for frame in world.frames:
            live.move(frame.stamp, frame.odometry)
        live.place(POSE, np.eye(6) * 0.01)
        live.save(path)


def _changes(path: Path, world: SeedWorld) -> None:
    later = {**BOXES, "lamp": ((3, 3, 0), (3.2, 3.2, 1.4)), "chair": ((3, 1, 0), (3.5, 1.5, 0.9))}
    del later["bookcase"]
    world.room.diff(scene_of_model(box_model(later))).save(path)


def _build_library(folder: Path, world: SeedWorld) -> SceneLibrary:
    folder.mkdir()
    world.room.save(folder / "room.scene")
    library = make_library({}, encoders="labels")
    library.add("room", folder / "room.scene")
    return library


def _library(folder: Path, world: SeedWorld) -> None:
    _build_library(folder, world).save(folder / "rooms.library")


def _library_shards(folder: Path, world: SeedWorld) -> None:
    """Write one map under four names, two a shard; the folder is a world as well."""
    from placegraph_scale.library.write import NamedEntry, write_shards

    entry = _build_library(folder, world).entry("room")
    listed = [NamedEntry(f"room {i}", entry, "../room.scene") for i in range(4)]
    write_shards(folder / "rooms.shards", listed, encoders=("labels",), size=2)


def _world(folder: Path, world: SeedWorld) -> None:
    _library(folder, world)
    _city(folder / "town.city", world)


def _town_map(path: Path, world: SeedWorld) -> CityMap:
    city = world.city(path.parent)
    for name in ("town.osm", "town.city"):
        (path.parent / name).unlink()
    return city


def _world_shards(folder: Path, world: SeedWorld) -> None:
    from placegraph_lab.worlds.shards import write_shards

    folder.mkdir()
    write_shards(_town_map(folder / "town.city", world), folder, 16)


def _indexed_city(path: Path, world: SeedWorld) -> None:
    """Write a town's map with the index of viewpoints, which only large maps have by default."""
    from placegraph.outdoor.map.city import City

    City.save(_town_map(path, world), path, index=True)


def _vectors(bits: int) -> Draw:
    def draw(path: Path, world: SeedWorld) -> None:
        _town_map(path, world).encoded.save_embeddings(path, name="town", bits=bits)

    return draw


_PACKED = Layout(images="packed", poses="odometry")
MAPS: Seeds = {
    "OSM .osm": {"town.osm": _osm}, "OSM rooms": {"rooms.osm": _export}, "GLB": {"room.glb": _export},
    "PLY": {"room.ply": _export}, "Spark-DSG": {"dsg.json": _export}, ".city": {"town.city": _city},
    ".scene": {"room.scene": _scene}, ".run": {"walk.run": _run}, ".track": {"robot.track": _track},
    "changes": {"changes.json": _changes}, ".city with an index": {"town.city": _indexed_city},
    ".library": {"library": _library}, "libraries in shards": {"shards": _library_shards},
    "worlds": {"world": _world}, "worlds in shards": {"planet": _world_shards},
    ".vectors": {"8.vectors": _vectors(8), "16.vectors": _vectors(16), "32.vectors": _vectors(32)},
}  # fmt: skip
CAPTURES: Seeds = {
    "capture folder": {"folder": _capture_folder},
    "bags MCAP": {"plain": _bag("mcap"), "packed": _bag("mcap", packed=True),
                  "compressed": _bag("mcap", layout=_PACKED)},
    "bags db3": {"rosbag2": _bag("sqlite3"), "compressed": _bag("sqlite3", layout=_PACKED)},
    "bags rosbag1": {"walk.bag": _bag("rosbag1"), "packed.bag": _bag("rosbag1", packed=True)},
}  # fmt: skip


def load_layouts(file: Path | None) -> tuple[Seeds, Seeds, list[str]]:
    """Return seeds of maps and of captures, and sentences: the lab's own and those of a Python file.

    The file defines `MAPS` and `CAPTURES` as here, and `read_sentences() -> list[str]`.
    """
    maps, captures = ({n: dict(seeds) for n, seeds in own.items()} for own in (MAPS, CAPTURES))
    if file is None:
        return maps, captures, []
    spec = importlib.util.spec_from_file_location("campaign_layouts", file)
    assert spec is not None and spec.loader is not None  # noqa: S101, PT018  # a .py file
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for own, added in ((maps, module.MAPS), (captures, module.CAPTURES)):
        for name, seeds in added.items():
            own.setdefault(name, {}).update(seeds)
    return maps, captures, module.read_sentences()
