"""Meshes of a given number of triangles, for benchmarks: fewer, coloured at vertices, or more."""

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
SPACING = 0.02  # distance between samples of the colour of a surface [m]
MOST_SAMPLES = 4_000_000


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


def coarse(mesh: Mesh, target: int, rng: np.random.Generator) -> Mesh:
    """Mesh of about `target` triangles and the same objects, coloured at its vertices alone.

    A vertex gets the mean colour of the surface that is nearer to it than to other vertices of its
    object, from about one sample a `SPACING` squared.
    """
    vertices, triangles, owner = decimate(mesh.vertices, mesh.triangles, target, mesh.object_of)
    points, colours, of = painted_samples(mesh, rng)
    shades = np.full((len(vertices), 3), 255, np.uint8)
    for row in np.unique(owner):
        mine = np.unique(triangles[owner == row])
        shades[mine] = mean_colours(points[of == row], colours[of == row], vertices[mine])
    return Mesh.plain(vertices, triangles, owner, shades)


def painted_samples(
    mesh: Mesh, rng: np.random.Generator
) -> tuple[Floats, NDArray[np.uint8], NDArray[np.int32]]:
    """Points (N, 3) [m] spread over the surface, their colours (N, 3) and objects (N,)."""
    area = 0.5 * np.linalg.norm(mesh.normals(), axis=1)
    grain = max(SPACING**2, float(area.sum()) / MOST_SAMPLES)
    rows = np.repeat(np.arange(len(mesh)), rng.poisson(area / grain) + 1).astype(np.int32)
    root, split = np.sqrt(rng.random(len(rows))), rng.random(len(rows))
    shares = np.stack([1.0 - root, root * (1.0 - split), root * split], axis=1)
    points = np.einsum("nkd,nk->nd", mesh.vertices[mesh.triangles[rows]], shares)
    u, v = shares[:, 1].astype(np.float32), shares[:, 2].astype(np.float32)
    return points, mesh.colour_at(rows, u, v), mesh.object_of[rows]


def mean_colours(
    points: Floats, colours: NDArray[np.uint8], vertices: Floats32
) -> NDArray[np.uint8]:
    """Mean colour (V, 3) of the points (N, 3) nearest to each vertex; of the nearest if none is."""
    from scipy.spatial import cKDTree

    _, nearest = cKDTree(vertices).query(points)
    count = np.bincount(nearest, minlength=len(vertices))
    sums = [np.bincount(nearest, colours[:, k], len(vertices)) for k in range(3)]
    mean = np.stack(sums, axis=1) / np.maximum(count, 1)[:, None]
    bare = np.flatnonzero(count == 0)
    if bare.size:
        mean[bare] = colours[cKDTree(points).query(vertices[bare])[1]]
    return np.rint(mean).astype(np.uint8)


COARSE = 20_000  # triangles of the coarse house
OFFICE_TRIANGLES = 80_000


def house(data: Path, cache: Path) -> SceneMap:
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
    """Return the path of a map, and delete the maps that older code made."""
    cache.mkdir(parents=True, exist_ok=True)
    path = cache / f"{name}_{code_key(INDOOR)}.scene"
    for old in cache.glob(f"{name}_{'[0-9a-f]' * 16}.scene"):
        if old != path:
            old.unlink()
    return path
