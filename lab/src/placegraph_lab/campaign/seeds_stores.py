"""Sound stores of many maps, small: libraries, worlds, both in shards, vectors, and Overture's tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from placegraph.indoor.library import library_of
from placegraph.indoor.library.library import SceneLibrary
from placegraph_lab.campaign.seeds import writer
from placegraph_lab.campaign.seeds_maps import Draw, Places, _city


def _rooms(folder: Path, places: Places) -> SceneLibrary:
    folder.mkdir()
    places.room.save(folder / "room.scene")
    library = library_of({}, encoders="labels")
    library.add("room", folder / "room.scene")
    return library


def _library(folder: Path, places: Places) -> None:
    _rooms(folder, places).save(folder / "rooms.library")


def _shards(folder: Path, places: Places) -> None:
    """One map under four names, two a shard; the folder is a world as well."""
    from placegraph_scale.library.write import Listed, write_shards

    entry = _rooms(folder, places).entry("room")
    listed = [Listed(f"room {i}", entry, "../room.scene") for i in range(4)]
    write_shards(folder / "rooms.shards", listed, encoders=("labels",), size=2)


def _world(folder: Path, places: Places) -> None:
    _library(folder, places)
    _city(folder / "town.city", places)


def _planet(folder: Path, places: Places) -> None:
    """A world of shards, and its table of words."""
    from placegraph_lab.worlds.shards import write_shards

    write_shards(_town(folder, places), folder, 16)


def _indexed(path: Path, places: Places) -> None:
    """A town's map with the index of its viewpoints, which only large ones have by themselves."""
    from placegraph.outdoor.map.city import City

    City.save(_town(path, places), path, index=True)


def _town(path: Path, places: Places) -> Any:  # noqa: ANN401  # a CityMap
    city = places.city(path.parent)
    for name in ("town.osm", "town.city"):
        (path.parent / name).unlink()
    return city


def _vectors(bits: int) -> Draw:
    def draw(path: Path, places: Places) -> None:
        _town(path, places).encoded.keep(path, name="town", bits=bits)

    return draw


def _overture(folder: Path, _places: Places) -> None:
    """Places, buildings and streets, a file each."""
    module = writer("formats.place.test_overture")
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


STORES: dict[str, dict[str, Draw]] = {
    "Overture": {"release": _overture},
    ".city with an index": {"town.city": _indexed},
    ".library": {"library": _library},
    "libraries in shards": {"shards": _shards},
    "worlds": {"world": _world},
    "worlds in shards": {"planet": _planet},
    ".vectors": {"8.vectors": _vectors(8), "16.vectors": _vectors(16), "32.vectors": _vectors(32)},
}
"""Of each format its seeds: a name of a file or folder, and what draws it there."""
