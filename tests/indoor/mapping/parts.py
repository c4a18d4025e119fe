"""Parts of drawn maps."""

from dataclasses import replace

import numpy as np

from placegraph.indoor.scene_map import SceneMap


def only(scene, keep):
    mesh, graph = scene.mesh, scene.graph
    rows = np.unique(mesh.object_of[keep])
    place = np.full(len(scene), -1)
    place[rows] = np.arange(len(rows))
    mesh = replace(
        mesh,
        triangles=mesh.triangles[keep],
        object_of=place[mesh.object_of[keep]].astype(np.int32),
        texture_of=mesh.texture_of[keep],
    )
    ids, labels, names = ([c[i] for i in rows] for c in (graph.ids, graph.labels, graph.names))
    floor = float(scene.floors[0])
    return SceneMap.create(mesh, ids, labels, names=names, floor=floor, encoded=scene.encoded)
