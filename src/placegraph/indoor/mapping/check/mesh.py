"""Checks of a scene map's triangles: soup, doubles, colour."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.check.finding import Found

_DOUBLES = 0.01
"""Share of triangles that lie on another."""
_SOUP = 0.5
"""Share of edges that belong to one triangle alone: faces that hang on nothing."""
_CROSSED = 0.02
"""Share of edges that belong to three triangles or more."""
_BARE = 0.2
"""Share of the surface that is white and without texture."""


def mesh_findings(scene: Scene) -> Iterator[Found]:
    """What is odd about the triangles."""
    corners = _welded(scene)
    yield from _doubles(scene, corners)
    yield from _edges(corners)
    yield from _colours(scene)


def _welded(scene: Scene) -> NDArray[np.int64]:
    """(T, 3) corners as numbers of places: vertices at one place are one, whatever their colour."""
    grain, _ = scene.mesh.steps()
    steps = np.rint(scene.mesh.vertices / np.float32(grain)).astype(np.int64)
    steps -= steps.min(axis=0)
    span = steps.max(axis=0) + 1
    keys = (steps[:, 0] * span[1] + steps[:, 1]) * span[2] + steps[:, 2]
    place = np.unique(keys, return_inverse=True)[1]
    return place[scene.mesh.triangles]


def _doubles(scene: Scene, corners: NDArray[np.int64]) -> Iterator[Found]:
    ordered = np.sort(corners, axis=1)
    count = int(corners.max()) + 1
    first = ordered[:, 0] * count + ordered[:, 1]
    order = np.lexsort([ordered[:, 2], first])
    same = (np.diff(first[order]) == 0) & (np.diff(ordered[order, 2]) == 0)
    share = float(same.sum()) / len(corners)
    if share > _DOUBLES:
        rows = np.unique(scene.mesh.object_of[order[1:][same]])
        yield (
            "warning" if share > 10 * _DOUBLES else "note",
            f"{share:.0%} of the triangles lie on another one: the mesh is there twice.",
            [scene.graph.ids[i] for i in rows.tolist()],
            "Delete double faces in the file; they cost bytes and time, and flicker in colour.",
        )


def _edges(corners: NDArray[np.int64]) -> Iterator[Found]:
    edges = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), 1)
    keys = np.sort(edges[:, 0] * (int(corners.max()) + 1) + edges[:, 1])
    starts = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]]))
    uses = np.diff(np.append(starts, len(keys)))
    crossed, alone = float((uses > 2).mean()), float((uses == 1).mean())
    if crossed > _CROSSED:
        yield (
            "note",
            f"{crossed:.0%} of the edges belong to more than two triangles: the mesh is not manifold.",
            [],
            "Placegraph does not mind; programs that need closed surfaces do.",
        )
    if alone > _SOUP:
        yield (
            "note",
            f"{alone:.0%} of the edges belong to a single triangle: the mesh is a soup of faces.",
            [],
            "Merge vertices by distance in the file: the map becomes smaller.",
        )


def _colours(scene: Scene) -> Iterator[Found]:
    mesh = scene.mesh
    if not scene.coloured:
        white = (mesh.colours == 255).all() and all((t == 255).all() for t in mesh.textures)
        said = "has no colours" if white else "is of one colour all over"
        yield (
            "warning" if white else "note",
            f"The map {said}: images cannot be compared with it, depth and labels alone can.",
            [],
            "Export textures or vertex colours with the file"
            + ("." if white else ", if it has any."),
        )
        return
    blank = np.array([bool((t == 255).all()) for t in mesh.textures])
    bare = blank[mesh.texture_of] & (mesh.colours[mesh.triangles] == 255).all(axis=(1, 2))
    areas = np.linalg.norm(mesh.normals(), axis=1)
    share = float(areas[bare].sum() / max(float(areas.sum()), 1e-12))
    if share > _BARE:
        whole = np.bincount(mesh.object_of, areas, len(scene))
        white = np.bincount(mesh.object_of, areas * bare, len(scene))
        rows = np.flatnonzero(white > 0.9 * np.maximum(whole, 1e-12))
        yield (
            "note",
            f"{share:.0%} of the surface is pure white without texture: its colour may be missing.",
            [scene.graph.ids[i] for i in rows.tolist()],
            "Export its materials with the file, if it is not white.",
        )
