"""The world of `placegraph demo`, which ships with the library as files: the one drawing of it.

Two towns, a flat, a film taken there after an armchair was moved and a chair taken away, three frames
by a window of it, and homes that stand beside the flat in a library.
"""

from __future__ import annotations

import lzma
import tempfile
import zipfile
from pathlib import Path

import numpy as np

from placegraph.demo.world import FLAT, TOWNS
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.walks import stroll, write_walk
from placegraph_lab.worlds.home.home import home, scene_of
from placegraph_lab.worlds.town.town import Town

WAY = "41"  # rooms that the camera comes through
FRAMES = 18
WINDOW = "o1"  # A spot by a window, and where somebody goes from there
HOMES = 4


def write_demo_world(out: Path) -> None:
    """Draw the world into a folder as `placegraph.demo` ships it: the large files packed."""
    out.mkdir(parents=True, exist_ok=True)
    for town in TOWNS:
        Town.load(town).write_osm(out / f"{town}.osm")
    with tempfile.TemporaryDirectory() as folder:
        film = write_flat(Path(folder))
        glb = film.with_name(f"{FLAT}.glb").read_bytes()
        (out / f"{FLAT}.glb.xz").write_bytes(lzma.compress(glb, preset=9))
        _pack(film, out / "walk.zip")
        _pack(film.with_name("window"), out / "window.zip")
    for i in range(HOMES):
        rng = np.random.default_rng(i)
        scene_of(home(rng).furnish(rng)).save(out / f"home{i + 1}.scene")


def write_flat(folder: Path) -> Path:
    """Write the flat as a .glb file, and two films of walks through it beside it; return the longer."""
    drawing, rng = Flat.load(FLAT), np.random.default_rng(0)
    interior = drawing.furnish(rng)
    interior.write_glb(folder / f"{FLAT}.glb")
    now = interior.moved("armchair", (0.5, -0.2), 0.6).without("chair 1")
    walk = stroll(drawing, rng, frames=FRAMES, through=WAY, speed=1.1)
    film = write_walk(now, walk, folder / "walk", rng)
    write_walk(now, stroll(drawing, rng, frames=3, through=WINDOW), folder / "window", rng)
    return film


def _pack(folder: Path, path: Path) -> None:
    """Write the files of a folder as a ZIP without dates; the same files give the same bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                entry = zipfile.ZipInfo(file.relative_to(folder).as_posix())
                entry.compress_type = zipfile.ZIP_DEFLATED
                archive.writestr(entry, file.read_bytes())
