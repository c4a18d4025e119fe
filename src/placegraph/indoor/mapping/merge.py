"""Several scenes side by side in one map: a building, or the large environments of App. D."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.graph import SceneGraph
from placegraph.errors import OptionError
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.scene import Landmarks, S, Scene

GAP = 2.0  # Free space between the boxes of neighbouring scenes [m]


def merge_scenes(scenes: Mapping[str, S], out_path: str | PathLike[str] | None = None) -> S:
    """Map that holds all these scenes, in a row along x with a gap of 2 m, floors at z = 0.

    Scenes are shifted, never turned. Ids become `scene/id`; relations stay within their scenes.
    `scene_from_map` of the result leads back into each scene's own frame, and each scene stays
    where it stands on Earth. A scene that was merged
    of several itself is moved as a whole, and its parts are named `scene/part`.

    Parameters
    ----------
    scenes
        Scene maps by name; names hold no slash.
    out_path
        Map file to write (atomically); None writes nothing.

    Raises
    ------
    OptionError
        There is no scene, a name is empty or holds a slash, or only some have embeddings, or of
        different lengths.
    MapError, MapLockedError
        The map cannot be written.

    """
    _check_scenes(scenes)
    shifts = _place_scenes(list(scenes.values()))
    moved = [_shift_scene(name, m, s) for (name, m), s in zip(scenes.items(), shifts, strict=True)]
    first_objects = _first_rows([len(m) for m in moved])
    first_scenes = _first_rows([len(m.scenes) for m in moved])
    meshes = [m.mesh for m in moved]
    first_vertices = _first_rows([len(m.vertices) for m in meshes])
    first_textures = _first_rows([len(m.textures) for m in meshes])
    merged = replace(
        moved[0],
        graph=_join_graphs([m.graph for m in moved], first_objects),
        mesh=Mesh(
            vertices=np.concatenate([m.vertices for m in meshes]),
            triangles=_offset_columns([m.triangles for m in meshes], first_vertices),
            object_of=_offset_columns([m.object_of for m in meshes], first_objects),
            colours=np.concatenate([m.colours for m in meshes]),
            uv=np.concatenate([m.uv for m in meshes]),
            texture_of=_offset_columns([m.texture_of for m in meshes], first_textures),
            textures=_join_tuples([m.textures for m in meshes]),
        ).quantize(),
        attributes=_join_tuples([m.attributes for m in moved]),
        floors=np.concatenate([m.floors for m in moved]),
        scenes=_join_tuples([m.scenes for m in moved]),
        scene_of=np.concatenate([m.scene_of + n for m, n in zip(moved, first_scenes, strict=True)]),
        scene_from_map=np.concatenate([m.scene_from_map for m in moved]),
        source=", ".join(scenes),
        encoded=_join_tuples([m.encoded for m in moved]),
        landmarks=Landmarks.concatenate([m.landmarks for m in moved]),
        viewpoints=np.concatenate([m.viewpoints for m in moved]),
        anchors=_join_tuples([m.anchors for m in moved]),
        own_agreement=_join_own_agreement(moved),
    )
    if out_path is not None:
        from placegraph.indoor.map.scene_file import save_scene

        save_scene(merged, out_path)
    return merged


def _join_own_agreement(maps: Sequence[Scene]) -> NDArray[np.float64] | None:
    """Return the agreement (S, 9) of the frames that scenes were made of; None where none is known."""
    if all(m.own_agreement is None for m in maps):
        return None
    unknown = [np.full((len(m.scenes), 9), np.nan) for m in maps]
    known = [m.own_agreement for m in maps]
    return np.concatenate([u if k is None else k for k, u in zip(known, unknown, strict=True)])


def _check_scenes(scenes: Mapping[str, Scene]) -> None:
    if not scenes:
        raise OptionError("scenes: the list is empty; give at least one scene map.")
    for name in scenes:
        if not name or "/" in name:
            raise OptionError(f"scenes: {name!r} is not a valid name; use one without a slash.")
    widths = {
        None if m.graph.embeddings is None else m.graph.embeddings.shape[1] for m in scenes.values()
    }
    if len(widths) > 1:
        raise OptionError(
            f"embeddings: their lengths differ ({sorted(map(str, widths))}); use the same "
            "encoder for all scenes."
        )
    encoders = {m.encoder for m in scenes.values()}
    if len(encoders) > 1:
        raise OptionError(
            "embeddings: they were made by different encoders "
            f"({', '.join(sorted(encoders))}); use the same encoder for all scenes."
        )


def _place_scenes(maps: Sequence[Scene]) -> list[NDArray[np.float64]]:
    """Shift (3,) of each scene: boxes in a row along x from 0, centred in y, lowest floor at 0."""
    shifts, x = [], 0.0
    for scene in maps:
        low, high = scene.bounds
        shift = np.array([x - low[0], -(low[1] + high[1]) / 2.0, -scene.floors.min()])
        # Whole steps of the finest mesh keep its coordinates as they are; floors are exact.
        shift[:2] = np.round(shift[:2] * 16.0) / 16.0
        shifts.append(shift)
        x += high[0] - low[0] + GAP
    return shifts


def _shift_scene(name: str, scene: S, shift: NDArray[np.float64]) -> S:
    back = np.eye(4)
    back[:3, 3] = -shift
    parts = [f"{name}/{part}" for part in scene.scenes] if len(scene.scenes) > 1 else [name]
    graph = replace(
        scene.graph,
        ids=tuple(f"{name}/{id_}" for id_ in scene.graph.ids),
        positions=scene.graph.positions + shift,
    )
    return replace(
        scene,
        graph=graph,
        mesh=scene.mesh.translate(shift),
        landmarks=scene.landmarks and scene.landmarks.translate(shift),
        viewpoints=scene.viewpoints + shift,
        floors=scene.floors + shift[2],
        scenes=tuple(parts),
        scene_from_map=scene.scene_from_map @ back,
        anchors=tuple(
            anchor.shift_origin(shift, scene=part)
            for scene_name, part in zip(scene.scenes, parts, strict=True)
            for anchor in scene.anchors_of(scene_name)
        ),
    )


def _join_graphs(graphs: list[SceneGraph], starts: list[int]) -> SceneGraph:
    embeddings = [g.embeddings for g in graphs if g.embeddings is not None]
    extents = [np.zeros_like(g.positions) if g.extents is None else g.extents for g in graphs]
    return SceneGraph(
        ids=_join_tuples([g.ids for g in graphs]),
        labels=_join_tuples([g.labels for g in graphs]),
        names=_join_tuples([g.names for g in graphs]),
        positions=np.concatenate([g.positions for g in graphs]),
        extents=np.concatenate(extents),
        embeddings=np.concatenate(embeddings) if embeddings else None,
        sources=np.concatenate([g.sources + n for g, n in zip(graphs, starts, strict=True)]),
        targets=np.concatenate([g.targets + n for g, n in zip(graphs, starts, strict=True)]),
        relations=_join_tuples([g.relations for g in graphs]),
    )


def _offset_columns(columns: list[NDArray[np.int32]], starts: list[int]) -> NDArray[np.int32]:
    return np.concatenate([c + np.int32(n) for c, n in zip(columns, starts, strict=True)])


def _first_rows(counts: list[int]) -> list[int]:
    return [0, *np.cumsum(counts).tolist()[:-1]]


def _join_tuples(columns: Sequence[Sequence[Any]]) -> tuple[Any, ...]:
    return tuple(entry for column in columns for entry in column)
