"""Makers of shipped files: mean appearance, decoys, and the demo's world.

The mean appearance is the mean over places of the mean vector of their objects. Places are a drawn
flat, furnished several times, and procedural homes of seeds below 1000; tables use larger seeds.
"""

from __future__ import annotations

import lzma
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from placegraph.demo.town import FLAT, TOWNS
from placegraph.errors import OptionError
from placegraph.indoor.encode import appearance
from placegraph.indoor.library import SceneLibrary
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.interior import Interior
from placegraph_lab.worlds.flat.walks import stroll, write_walk
from placegraph_lab.worlds.home.home import home, scene_of
from placegraph_lab.worlds.town.town import Town

_A_LINE = 11  # numbers


def interiors(homes: int, flat: str, times: int) -> Iterator[Interior]:
    """Yield homes of the first seeds, then a flat furnished several times."""
    for seed in range(homes):
        rng = np.random.default_rng(seed)
        yield home(rng).furnish(rng)
    for seed in range(times):
        yield Flat.load(flat).furnish(np.random.default_rng(seed))


def print_usual(homes: int, flat: str, times: int, report: Callable[[str], None]) -> None:
    """Print the lines for appearance.py, and their difference from the present ones."""
    if not homes + times:
        raise OptionError("homes and times are 0; choose a home or a flat to look at.")
    places = interiors(homes, flat, times)
    means = []
    for interior in places:
        vectors, cells = appearance.surfaces(scene_of(interior))
        if cells.any():
            means.append(vectors[cells > 0].mean(axis=0, dtype=np.float64))
    found = np.asarray(np.mean(means, axis=0), np.float64)
    before = appearance._USUAL  # noqa: SLF001  # what is replaced
    words = [f"{number:.3f}," for number in found.tolist()]
    rows = [words[i : i + _A_LINE] for i in range(0, len(words), _A_LINE)]
    report("\n".join("        " + " ".join(f"{word:>7}" for word in row).lstrip() for row in rows))
    report(f"# off from those of appearance.py by {np.abs(found - before).max():.4f} at most")


COUNT = 32
FIRST_SEED = 700_000
ENCODERS = ("labels", "appearance")


def write_decoys(out: Path, report: Callable[[str], None]) -> None:
    """Draw, map and sign the homes, and write their library."""
    library = SceneLibrary(ENCODERS)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent) as folder:
        for i in range(COUNT):
            rng = np.random.default_rng(FIRST_SEED + i)
            path = Path(folder) / f"home {i}.scene"
            scene_of(home(rng).furnish(rng), name=path.stem).save(path)
            library.add(path.stem, path)
            report(f"{path.stem} {len(library.entry(path.stem).signature)}")
        library.save(out)
    report(f"{out}: {out.stat().st_size:,} bytes")


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
    now = interior.move_object("armchair", (0.5, -0.2), 0.6).without("chair 1")
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
