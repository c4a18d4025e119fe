"""Maps and captures that questions are asked of: built when first needed, once."""

from functools import cache
from pathlib import Path

import numpy as np
from golden_answers import read

import placegraph as pg
from placegraph.indoor.mapping.from_capture import FromCapture
from placegraph_lab.worlds.home.home import home, scene_of
from placegraph_lab.worlds.town.town import Town

DATA = Path(__file__).resolve().parents[3] / "shared/data"
EXTRACTS = {
    "monaco": "monaco_2025.osm.pbf",
    "toronto": "toronto_downtown_2020.osm.bz2",
    "manhattan": "manhattan_2025.osm.pbf",
}


def home_scene(seed):
    """Scene map of a drawn home."""
    rng = np.random.default_rng(seed)
    return scene_of(home(rng).furnish(rng))


class Worlds:
    """Everything lies in `folder`; the same is built once."""

    data = DATA

    def __init__(self, folder):
        self.folder = Path(folder)
        # answers are those of the files, so maps are opened as anybody would
        self.city, self.scene, self.home = cache(self._city), cache(self._scene), cache(self._home)

    def _city(self, name):
        """City map and its file."""
        file = self.folder / f"{name}.city"
        source = DATA / "osm" / EXTRACTS[name] if name in EXTRACTS else None
        pg.build_city(source or Town.load("hafenstadt").write_osm(self.folder / "town.osm"), file)
        return pg.open_map(file), file

    def _scene(self, name):
        """Scene map and its file."""
        file = self.folder / f"{name}.scene"
        if name == "office":
            first = FromCapture(frames=slice(0, 186, 3))
            pg.build_scene(DATA / "office", file, capture=first)
        else:
            detail = "small" if name == "small" else "default"
            pg.build_scene(DATA / "house/map/house.glb", file, detail=detail)
        return pg.open_map(file), file

    def _home(self, seed):
        """File of a drawn home's map."""
        file = self.folder / f"home{seed}.scene"
        home_scene(seed).save(file)
        return file

    def capture(self, number, **options):
        """Sequence of the house."""
        return pg.open_capture(DATA / f"house/seq{number:02}", **options)

    def truth(self, number):
        """The same with true poses as its odometry."""
        return self.capture(number, poses="trajectory")

    def office(self):
        return pg.open_capture(DATA / "office")

    def classes(self, number):
        """Sequence of the house whose images say classes instead of instances."""
        folder, source = self.folder / f"classes{number}", DATA / f"house/seq{number:02}"
        if not folder.exists():
            folder.mkdir()
            for name in ("rgb", "depth", "camera.json", "odometry.tum", "gravity.txt"):
                (folder / name).symlink_to(source / name)
            (folder / "labels").symlink_to(source / "instances")
            things = read(DATA / "house/map/objects.json")
            names = ", ".join(f'"{t["id"] + 1}": "{t["label"]}"' for t in things)
            (folder / "labels.json").write_text(f"{{{names}}}", encoding="utf-8")
        return pg.open_capture(folder)
