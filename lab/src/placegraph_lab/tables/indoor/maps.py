"""Maps of the house and the office, and meshes of a given number of triangles, for benchmarks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.errors import OptionError
from placegraph.indoor.build import build_scene
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.fuse import fuse
from placegraph.indoor.mapping.simplify import simplify
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import open_capture
from placegraph.io.mesh.ply import write_ply
from placegraph_lab.tables.indoor.windows import HALVES, true_poses
from placegraph_lab.tables.runner import INDOOR, code_key

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints = NDArray[np.int32]
OFFICE_TRIANGLES = 80_000


def decimate(
    vertices: ArrayLike, triangles: ArrayLike, target: int, group: ArrayLike | None = None
) -> tuple[Floats32, Ints, Ints]:
    """Collapse edges until about `target` triangles are left.

    `vertices`: (V, 3) [m]; `triangles`: (T, 3) rows of vertices; `target`: triangles that are
    wanted; more are left where collapsing on would tear the surface; `group`: (T,) object of a
    triangle; surfaces of two objects do not merge where they touch.

    Returns `vertices`: (V', 3) float32 [m]; `triangles`: (T', 3) int32; `group`: (T',) int32, zeros
    where none was given.
    """
    if target < 1:
        raise OptionError(f"target is {target}; it must be at least 1.")
    mesh = simplify(Mesh.plain(vertices, triangles, group), error=np.inf, target=target)
    return mesh.vertices, mesh.triangles, mesh.object_of


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
