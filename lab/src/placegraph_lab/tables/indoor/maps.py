"""The maps of the indoor benchmark: the house, the house in fewer triangles, halves of the office.

They lie in a cache folder; a fingerprint of the code that makes them stands in their names.
"""

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
from placegraph_lab.tables.indoor.decimate import coarse
from placegraph_lab.tables.indoor.windows import HALVES, true_poses
from placegraph_lab.tables.runner import INDOOR, fingerprint

MAKING = (*INDOOR, "placegraph_lab/tables/indoor/decimate.py")
"""Code that decides what the maps are."""
COARSE = 20_000
"""Triangles of the coarse house."""
OFFICE_TRIANGLES = 80_000


def house(data: Path, cache: Path) -> SceneMap:
    """The house as published, in full detail: 86 objects, 145,117 textured triangles."""
    path = place(cache, "house")
    if not path.exists():
        build_scene(data / "house/map/house.glb", path, detail="full")
    return SceneMap.open(path)


def coarse_house(data: Path, cache: Path, triangles: int = COARSE) -> SceneMap:
    """The house in fewer triangles and without textures: colours of vertices are all it has."""
    path = place(cache, f"house_{triangles}")
    if not path.exists():
        whole = house(data, cache)
        mesh = coarse(whole.mesh, triangles, np.random.default_rng(0))
        with_mesh(whole, mesh).save(path)
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


def with_mesh(scene: SceneMap, mesh: Mesh) -> SceneMap:
    """Map of the same objects with another mesh."""
    graph = scene.graph
    edges = zip(graph.sources.tolist(), graph.relations, graph.targets.tolist(), strict=True)
    return SceneMap.create(
        mesh,
        graph.ids,
        graph.labels,
        floor=float(scene.floors[0]),
        names=graph.names,
        attributes=scene.attributes,
        relations=list(edges),
        scene=scene.scenes[0],
        source=scene.source,
    )


def place(cache: Path, name: str) -> Path:
    """Where a map belongs; those that older code made are deleted."""
    cache.mkdir(parents=True, exist_ok=True)
    path = cache / f"{name}_{fingerprint(MAKING)}.scene"
    for old in cache.glob(f"{name}_{'[0-9a-f]' * 16}.scene"):
        if old != path:
            old.unlink()
    return path
