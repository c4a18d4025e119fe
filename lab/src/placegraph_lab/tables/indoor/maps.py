"""Maps of the house and of halves of the office, made once for each state of the code."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from placegraph.indoor.build import build_scene
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.fuse import fuse
from placegraph.indoor.mapping.simplify import simplify
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import open_capture
from placegraph.io.mesh.ply import write_ply
from placegraph_lab.tables.indoor.windows import HALVES, true_poses
from placegraph_lab.tables.runner import INDOOR, code_key

OFFICE_TRIANGLES = 80_000


def house(data: Path, cache: Path) -> SceneMap:
    path = place(cache, "house")
    if not path.exists():
        build_scene(data / "house/map/house.glb", path, detail="full")
    return SceneMap.open(path)


def office(data: Path, cache: Path, half: str, triangles: int = OFFICE_TRIANGLES) -> SceneMap:
    """One half of the office, fused with its true poses: the half that `HALVES[half]` names."""
    low, high = HALVES[half][0]
    path = place(cache, f"office_{low}_{high}")
    if not path.exists():
        folder = data / "office"
        capture, truth = open_capture(folder), true_poses(folder)
        fused = fuse(capture[low:high].frames, truth[low:high])
        mesh = Mesh.plain(fused.vertices, fused.triangles, colours=fused.colours)
        mesh = simplify(mesh, error=np.inf, target=triangles)
        ply = path.with_suffix(".ply")
        write_ply(ply, mesh.vertices, mesh.triangles, mesh.colours)
        build_scene(ply, path, segment=False, detail="full")
        ply.unlink()
    return SceneMap.open(path)


def place(cache: Path, name: str) -> Path:
    """Return the path of a map, and delete the maps that older code made."""
    cache.mkdir(parents=True, exist_ok=True)
    path = cache / f"{name}_{code_key(INDOOR)}.scene"
    for old in cache.glob(f"{name}_{'[0-9a-f]' * 16}.scene"):
        if old != path:
            old.unlink()
    return path
