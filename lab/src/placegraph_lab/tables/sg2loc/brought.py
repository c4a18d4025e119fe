"""Sets that users bring: 3RScan and ScanNet, in folders as their authors hand them out."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import InputError
from placegraph.indoor.build import build_scene
from placegraph.indoor.scene_map import SceneMap
from placegraph_io.dataset.scan3r_rooms import read_rooms
from placegraph_io.dataset.scannet_files import axis_alignment
from placegraph_lab.tables.indoor.maps import place
from placegraph_lab.tables.pairs import scan3r, scannet
from placegraph_lab.tables.pairs.scannet_register import register_scans
from placegraph_lab.tables.runner import INDOOR, fingerprint
from placegraph_lab.tables.sg2loc.sets import LAYOUT, Set, Walk, kept

if TYPE_CHECKING:
    from placegraph_lab.tables.runner import Run


def of_3rscan(run: Run, split: scan3r.Split) -> Set:
    """3RScan: each scan of a split is asked in one other of its room, drawn, as far as they are there."""
    root = run.shared / "3RScan"
    rooms = read_rooms(root / "3RScan.json")
    lists = root / "files"
    listed = any((lists / name).exists() for name in scan3r.LISTS.values())
    there = [
        replace(room, scans=tuple(s for s in room.scans if _has(root, s.id)))
        for room in scan3r.split_rooms(rooms, lists if listed else None)[split]
    ]
    pairs = scan3r.cross_temporal_pairs(there, "one", rng=np.random.default_rng(0))
    if not pairs:
        raise InputError(f"{root} holds no two scans of one room of the split {split!r}. {LAYOUT}")
    walks = [Walk(p.name, p.map, partial(scan3r.recorded, root, p), p.changed) for p in pairs]
    run.say(f"3RScan, {split}: {len(pairs)} pairs of {sum(len(r.scans) for r in there)} scans.")

    def scene(scan: str) -> SceneMap:
        path = place(run.cache, f"3rscan_{scan}")
        if not path.exists():
            build_scene(scan3r.scan_folder(root, scan), path)
        return SceneMap.open(path)

    rooms_of = {scan.id: room.reference for room in there for scan in room.scans}
    return Set("3RScan", tuple(walks), kept(scene), rooms_of, 10.0)


def _has(root: Path, scan: str) -> bool:
    return any((folder / scan).is_dir() for folder in (root, root / "scenes"))


def of_scannet(run: Run) -> Set:
    """ScanNet: pairs of scans of a room, one image in 25; what cannot be registered is left out."""
    scans = _Scans(run)
    listed = scans.root / "pairs.txt"
    pairs = (
        scannet.read_pairs(listed)
        if listed.exists()
        else scannet.derive_pairs(scannet.scans_in(scans.folder))
    )
    known = [found for pair in pairs if (found := scans.registered(pair)) is not None]
    run.say(f"ScanNet: {len(known)} of {len(pairs)} pairs are registered.")
    if not known:
        raise InputError(f"{scans.root}: no two scans of a room could be registered. {LAYOUT}")
    walks = [Walk(p.name, p.map, partial(scannet.recorded, scans.folder, p)) for p in known]
    rooms_of = {walk.map: walk.map.partition("_")[0] for walk in walks}
    return Set("ScanNet", tuple(walks), kept(scans.scene), rooms_of, 30 / scannet.EVERY)


class _Scans:
    """ScanNet's scans, annotated and, where SceneGraphFusion was run, with its scene graphs."""

    def __init__(self, run: Run) -> None:
        self.root = run.shared / "ScanNet"
        self.folder = self.root / "scans" if (self.root / "scans").is_dir() else self.root
        self._cache = run.cache
        self._journal = replace(run, name="sg2loc_registered").journal()

    def _predicted(self, scan: str) -> Path:
        return self.root / "SceneGraphFusion" / scan

    def scene(self, scan: str) -> SceneMap:
        """Map that is asked: the predicted graph where there is one, in the recording's axes."""
        if not self._predicted(scan).is_dir():
            return self._annotated(scan)
        path = place(self._cache, f"scenegraphfusion_{scan}")
        if not path.exists():
            mesh = self.folder / scan / f"{scan}_vh_clean_2.ply"
            build_scene(self._predicted(scan), path, reader={"mesh": mesh})
        return SceneMap.open(path)

    def _annotated(self, scan: str) -> SceneMap:
        path = place(self._cache, f"scannet_{scan}")
        if not path.exists():
            build_scene(self.folder / scan, path)
        return SceneMap.open(path)

    def registered(self, pair: scannet.ScanPair) -> scannet.ScanPair | None:
        """The pair with what leads into the axes of `scene`; None where nobody can tell."""
        motion = pair.map_from_query
        if motion is None:
            key = f"{fingerprint(INDOOR)} {pair.name}"
            if key not in self._journal:
                two = self._annotated(pair.map), self._annotated(pair.query)
                found = register_scans(*two, np.random.default_rng(0))
                self._journal.put(key, None if found is None else found.tolist())
            if self._journal[key] is None:
                return None
            motion = np.array(self._journal[key])
        if self._predicted(pair.map).is_dir():
            motion = np.linalg.inv(axis_alignment(self.folder / pair.map)) @ motion
        return replace(pair, map_from_query=motion)
