"""Textures brought to the vertices, for files that know colours by vertex alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.scene import Scene
from placegraph.io.mesh.model import Model, Picture, Thing

_SAMPLES = np.array(
    [(0.90, 0.05), (0.70, 0.25), (0.70, 0.05), (0.50, 0.40), (0.50, 0.10), (0.40, 0.30)]
)
"""Shares of a corner and of the next one at points of the corner's part of a triangle."""


def painted(scene: Scene) -> Model:
    """The map as a model without textures, whose vertices belong to one object each.

    A vertex has the mean colour of the texture around it, times its own colour: a wall of two
    triangles becomes even, a finely cut or scanned surface looks as before.
    """
    mesh, graph = scene.mesh, scene.graph
    # where textures or objects meet, each has its own vertex
    codes = (mesh.object_of.astype(np.int64) * len(mesh.textures) + mesh.texture_of)[:, None]
    keys = codes * len(mesh.vertices) + mesh.triangles
    _, first, corner = np.unique(keys, return_index=True, return_inverse=True)
    row = mesh.triangles.ravel()[first]
    triangles = corner.reshape(-1, 3).astype(np.int64)
    return Model(
        path=Path(scene.source or "scene"),
        things=tuple(
            Thing(id_, label, name, dict(attributes))
            for id_, label, name, attributes in zip(
                graph.ids, graph.labels, graph.names, scene.attributes, strict=True
            )
        ),
        vertices=mesh.vertices[row].astype(np.float64),
        triangles=triangles,
        thing_of=mesh.object_of.astype(np.int64),
        colours=_tinted(mesh, triangles, mesh.colours[row]),
        uv=np.zeros((len(row), 2)),
        picture_of=np.zeros(len(triangles), np.int64),
        pictures=(Picture(None),),
        relations=tuple(
            (int(s), relation, int(t))
            for s, relation, t in zip(graph.sources, graph.relations, graph.targets, strict=True)
        ),
        floor=float(scene.floors[0]) if len(scene.floors) == 1 else None,
    )


def _tinted(
    mesh: Mesh, triangles: NDArray[np.int64], colours: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Colours (W, 3) of the vertices that triangles (T, 3) name, times the texture around them."""
    white = replace(mesh, colours=np.full_like(mesh.colours, 255))
    count = len(triangles)
    areas = np.maximum(np.linalg.norm(mesh.normals(), axis=1), 1e-12)
    sums, weights = np.zeros((len(colours), 3)), np.zeros(len(colours))
    rows = np.repeat(np.arange(count, dtype=np.int32), len(_SAMPLES))
    for k in range(3):
        shares = np.zeros((len(_SAMPLES), 3))
        shares[:, k], shares[:, (k + 1) % 3] = _SAMPLES.T
        shares[:, (k + 2) % 3] = 1.0 - _SAMPLES.sum(axis=1)
        u, v = np.tile(shares[:, 1:], (count, 1)).astype(np.float32).T
        texels = white.colour_at(rows, u, v).reshape(count, -1, 3).mean(axis=1)
        for channel in range(3):
            sums[:, channel] += np.bincount(
                triangles[:, k], areas * texels[:, channel], len(colours)
            )
        weights += np.bincount(triangles[:, k], areas, len(colours))
    tint = sums / weights[:, None]
    return np.rint(colours * tint / 255.0).astype(np.uint8)
