"""Commands that write, what each of them makes, and what one that was killed may leave behind."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from unittest.mock import patch

from placegraph.demo.world import FLAT, TOWN, unpack

TEXT = "A bakery is north of me."
OLD = b"what was there before"
RUN = ("--tum", "a.tum", "--png", "a.png", "--overlay", "b.png", "--record", "a.run")
DRAWN = (
    *(f"{name}.png" for name in ("colour", "depth", "objects", "objects_preview", "overlay")),
    "objects.json",
)
"""What `scene render` makes."""


@dataclass(frozen=True)
class Writing:
    """A command that writes files: each is the old one or the new one, whole, at any moment."""

    what: str
    words: tuple[str, ...]  # of `placegraph`; files by their names in the folder of the trial
    makes: tuple[str, ...]  # files, or one folder
    leaves: tuple[str, ...] = ()
    """Patterns of what the docs say that a killed one leaves, beside those of every file."""
    old: str | None = ""
    """Input that is the old file, where the command changes one; else some bytes; None: there is none."""
    ends: str = ""  # file of a folder that is written last: where it is there, all are

    def made(self, name: str) -> bool:
        """Whether it makes a file of this name; what it keeps for itself aside."""
        return any(name == m or name.startswith(f"{m}/") for m in self.makes) and not self.keeps(
            name
        )

    def before(self, inputs: Path, folder: Path) -> dict[str, bytes]:
        """Lay the old files into a folder; their contents by name."""
        old: dict[str, bytes] = {}
        if self.ends:  # what is unfinished is gone on with
            if (folder / self.ends).exists():
                shutil.rmtree(folder / self.makes[0])
            return old
        for name in self.makes:
            path = folder / name
            if self.old is None:
                path.unlink(missing_ok=True)
                continue
            old[name] = (inputs / self.old).read_bytes() if self.old else OLD
            path.write_bytes(old[name])
        return old

    def keeps(self, name: str) -> bool:
        """Whether a file of this name may stay, whatever comes after a kill."""
        return any(fnmatch(name, pattern) for pattern in self.leaves)

    def allows(self, name: str) -> bool:
        """Whether a file of this name may be there after a kill."""
        last = name.rpartition("/")[2]
        own = [Path(made).name for made in self.makes]
        unfinished = [f".{each}.{end}" for each in own for end in ("tmp", "lock")]
        return self.made(name) or last in unfinished or self.keeps(name)


def prepare(folder: Path) -> Path:
    """Inputs of all commands: the demo's world, a city, a scene, a library and a bag of it."""
    from placegraph.indoor.build import build_scene
    from placegraph.indoor.library import SceneLibrary
    from placegraph.io.capture.capture import open_capture
    from placegraph.outdoor.city import build_city
    from placegraph_lab.worlds.bags import BagWriter, Layout, write_capture

    unpack(folder)
    town = build_city(folder / f"{TOWN}.osm", folder / "town.city")
    with patch("placegraph.core.mapfile.PAGE", 1):  # as in the map of a large city
        town.save(folder / "indexed.city", index=True)
    scene = build_scene(folder / f"{FLAT}.glb", folder / "flat.scene")
    capture = open_capture(folder / "walk")
    scene.diff(capture, scene.localize(capture, seed=0)).save(folder / "changes.json")
    library = SceneLibrary()
    for name in ("home1", "home3"):
        library.add(name, folder / f"{name}.scene")
    library.save(folder / "homes.library")
    with BagWriter(folder / "walk.mcap") as bag:
        write_capture(bag, open_capture(folder / "window", labels=None), Layout())
    return folder


def writings(inputs: Path) -> list[Writing]:
    """Every command that writes."""
    osm, flat, city = inputs / f"{TOWN}.osm", inputs / "flat.scene", inputs / "town.city"
    window = inputs / "window"
    every = [
        ("city build", (osm, "-o", "a.city"), ("a.city",)),
        ("city embed", (city, "-o", "a.vectors"), ("a.vectors",)),
        ("city locate", (city, TEXT, "--html", "a.html", "--png", "a.png"), ("a.html", "a.png")),
        ("city info", (city, "--png", "a.png"), ("a.png",)),
        ("scene build", (inputs / f"{FLAT}.glb", "-o", "a.scene"), ("a.scene",)),
        ("scene localize", (flat, window, *RUN), RUN[1::2]),
        ("scene anchor", (flat, "--pose", "7.4,43.7,10,90", "-o", "a.scene"), ("a.scene",)),
        ("scene diff", (flat, window, "-o", "a.json", "--png", "a.png"), ("a.json", "a.png")),
        ("scene update", (flat, inputs / "changes.json", "-o", "a.scene"), ("a.scene",)),
        ("scene encode", (flat, "-o", "a.scene", "--encoder", "appearance"), ("a.scene",)),
        ("scene export", (flat, "a.glb", "--force"), ("a.glb",)),
        ("scene render", (flat, "-o", ".", "--pose", "2,2,1.6,0", "--capture", window), DRAWN),
        ("library build", (inputs / "home1.scene", "-o", "a.library"), ("a.library",)),
        ("bag localize", (inputs / "walk.mcap", flat, "-o", "a.mcap"), ("a.mcap",)),
    ]  # fmt: skip
    found = [Writing(w, (*w.split(), *map(str, words)), makes) for w, words, makes in every]
    found[-1] = replace(found[-1], leaves=(".a.mcap.*",), old=None)
    tiles = (osm, "-o", "a.world", "--zoom", "15", "--overlap", "50", "--workers", "2")
    shards = (inputs / "homes.library", "-o", "a.shards", "--size", "1")
    homes = {
        "library add": ("a.library", inputs / "home2.scene"),
        "library remove": ("a.library", "home1"),
    }
    folders = {
        "world build": (tiles, "a.world", "world.json"),
        "library shard": (shards, "a.shards", "usual.shard"),
    }
    return [
        *found,
        *(
            Writing(w, (*w.split(), *map(str, words)), ("a.library",), old="homes.library")
            for w, words in homes.items()
        ),
        *(
            Writing(
                w, (*w.split(), *map(str, words)), (name,), (f"{name}/.*", f"{name}/*/.*"),
                ends=f"{name}/{last}",
            )
            for w, (words, name, last) in folders.items()
        ),
    ]  # fmt: skip
