"""Scene: one scene graph of objects with one coarse mesh, landmarks, and quantities derived from them."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.estimate import ObjectRef
from placegraph.core.geo import Anchor, no_anchor_error, sort_anchors
from placegraph.core.geojson import make_collection, make_feature, polygon_geometry
from placegraph.core.graph import SceneGraph
from placegraph.core.mapfile import MapFile
from placegraph.core.pickling import PickleFields
from placegraph.errors import OptionError
from placegraph.indoor.map import textures
from placegraph.indoor.map.mesh import Mesh, Surface, sort_triangles

if TYPE_CHECKING:
    from placegraph.indoor.rays import RayCaster


def quantize_vectors(vectors: NDArray[np.float32]) -> tuple[NDArray[np.int8], NDArray[np.float32]]:
    """Return integers (N, E) from -127 to 127 and scales (N,) whose product is near vectors (N, E).

    Off by at most 1/250 of a vector's largest entry; doing it again changes nothing.
    """
    most = np.abs(vectors).max(axis=1, initial=0.0).astype(np.float64)
    mantissa, exponent = np.frexp(most / 127.0)
    # few bits, so that products are exact
    scales = np.ldexp(np.ceil(mantissa * 4096.0) / 4096.0, exponent).astype(np.float32)
    divisor = np.where(scales > 0, scales, np.float32(1.0))
    return np.rint(vectors / divisor[:, None]).astype(np.int8), scales


def dequantize_vectors(
    numbers: NDArray[np.int8], scales: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return vectors (N, E) of `quantize_vectors`."""
    return numbers.astype(np.float32) * scales[:, None]


MAX_LANDMARKS = 20_000  # Largest number of landmarks of a scene
DESCRIPTOR_SIZE = 32  # Numbers of a descriptor
LANDMARK_GRAIN = 0.0005  # Step of a map file's coordinates [m]
_UNIT = 127.0
_CELL = 0.5  # neighbours in the file are neighbours in space [m]: differences compress


@dataclass(frozen=True, eq=False)
class Landmarks(PickleFields):
    """L points with compact descriptors, as `placegraph.indoor.refine.correspondences` makes them."""

    points: NDArray[np.float32]
    """(L, 3) [m, map], in whole steps of `LANDMARK_GRAIN`."""
    vectors: NDArray[np.int8]
    """(L, WIDTH) unit vectors times 127."""

    def __post_init__(self) -> None:
        shapes, count = (self.points.shape, self.vectors.shape), len(self.points)
        if shapes != ((count, 3), (count, DESCRIPTOR_SIZE)) or not np.isfinite(self.points).all():
            raise OptionError(
                f"landmarks: shapes are {shapes}, expected finite numbers of shapes (L, 3) "
                f"and (L, {DESCRIPTOR_SIZE})."
            )

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def of(cls, points: ArrayLike, vectors: ArrayLike) -> Landmarks:
        """Quantize landmarks at points (L, 3) [m] with unit vectors (L, DESCRIPTOR_SIZE), in file order."""
        points = np.asarray(points, np.float64).reshape(-1, 3)
        steps = np.rint(points / LANDMARK_GRAIN)
        order = np.lexsort((*steps.T, *np.floor(points / _CELL).T))
        rounded = np.rint(np.asarray(vectors, np.float64).reshape(-1, DESCRIPTOR_SIZE) * _UNIT)
        return cls(
            (steps[order] * LANDMARK_GRAIN).astype(np.float32), rounded[order].astype(np.int8)
        )

    @cached_property
    def unit_vectors(self) -> NDArray[np.float32]:
        """(L, WIDTH) float32."""
        numbers = self.vectors.astype(np.float32)
        return numbers / np.maximum(np.linalg.norm(numbers, axis=1, keepdims=True), 1.0)

    def translate(self, shift: ArrayLike) -> Landmarks:
        """Return landmarks shifted by (3,) [m]."""
        points = self.points.astype(np.float64) + np.asarray(shift, np.float64)
        return Landmarks(points.astype(np.float32), self.vectors)

    @staticmethod
    def concatenate(parts: Sequence[Landmarks | None]) -> Landmarks | None:
        """Return those of several scenes; None where none has any."""
        known = [part for part in parts if part is not None]
        if not known:
            return None
        return Landmarks(
            np.concatenate([part.points for part in known]),
            np.concatenate([part.vectors for part in known]),
        )

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return columns of a map file."""
        steps = np.rint(self.points.astype(np.float64) / LANDMARK_GRAIN).astype(np.int32)
        return {"landmark_points": steps, "landmark_vectors": self.vectors}

    @classmethod
    def read(cls, file: MapFile) -> Landmarks | None:
        """Return landmarks of a map file's columns; None of a file that has none."""
        if not {"landmark_points", "landmark_vectors"} & set(file.arrays):
            return None
        steps = file.array("landmark_points", "<i4", 2).astype(np.float64)
        return cls(
            (steps * LANDMARK_GRAIN).astype(np.float32), file.array("landmark_vectors", "|i1", 2)
        )


T = TypeVar("T")
S = TypeVar("S", bound="Scene")  # A scene, or the map that it is


@dataclass(frozen=True, eq=False, repr=False)
class Scene(PickleFields):
    """Objects with a coarse mesh, in map axes: z up, gravity -z, metres; what a `SceneMap` holds.

    All stages take it, and none changes it. Row i of `graph`, `attributes` and `scene_of` is one
    object, and row i is what `mesh.object_of` names.
    """

    graph: SceneGraph
    """Ids, labels, names, relations, embeddings; positions and extents are boxes of the mesh."""
    mesh: Mesh
    attributes: tuple[dict[str, str], ...]
    """(N,) what else is known of each object."""
    floors: NDArray[np.float64]
    """(S,) height of the floor of each merged scene [m, map]; one of a plain map."""
    scenes: tuple[str, ...]
    """(S,) names of the merged scenes."""
    scene_of: NDArray[np.int32]
    """(N,) int32, row of the scene of each object."""
    scene_from_map: NDArray[np.float64]
    """(S, 4, 4) rigid transforms into each merged scene's own frame."""
    source: str
    """Name of the file the map was built from."""
    encoded: tuple[bytes, ...]
    """The mesh's textures as the map file holds them: PNG or JPEG."""
    encoder: str = ""
    """Key of the encoder that the graph's embeddings are of; empty: nobody said."""
    landmarks: Landmarks | None = None
    """Points of its surfaces that images show again; None: the map was built without."""
    viewpoints: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    """(V, 3) where the cameras were that the map was made from [m, map]; none of a mesh."""
    anchors: tuple[Anchor, ...] = ()
    """Candidate anchors on Earth, best first; empty if unknown."""
    own_agreement: NDArray[np.float64] | None = None
    """(S, 9) means and deviations of the agreement of the frames that each scene was made of (`reach` of
    `pose/agreement.py`), and the share of it that repeats itself; NaN: unknown. None: of no scene known."""

    @classmethod
    def create(
        cls,
        mesh: Mesh,
        ids: Sequence[str],
        labels: Sequence[str],
        *,
        floor: float,
        names: Sequence[str] = (),
        attributes: Sequence[Mapping[str, str]] = (),
        relations: Sequence[tuple[int, str, int]] = (),
        scene: str = "scene",
        source: str = "",
        encoded: tuple[bytes, ...] | None = None,
    ) -> Self:
        """Map of one scene.

        Raises `OptionError`: there is no object, or no triangle; columns do not fit; the floor is
        not a number.

        `mesh`: triangles of the objects; every object has at least one. Coordinates are snapped to
            the file's steps (`Mesh.quantize`), triangles brought into its order (`mesh_order`),
            textures decoded from what the file will hold.
        `ids`, `labels`, `names`: of the N objects.
        `floor`: height of the floor [m, map].
        `attributes`, `relations`: of each object, or of none; edges (source row, relation, target
            row).
        `scene`, `source`: names for messages.
        `encoded`: encoded textures, if there are any already.
        """
        if not np.isfinite(floor):
            raise OptionError(f"floor is {floor}; it must be a height in metres.")
        if not len(ids):
            raise OptionError(
                "ids: there is no object; give at least one object and its triangles."
            )
        blobs = textures.encode_arrays(mesh.textures) if encoded is None else encoded
        mesh = sort_triangles(
            replace(mesh.quantize(), textures=textures.decode_textures(blobs, source or scene))
        )
        bare = np.flatnonzero(np.isnan(mesh.object_bounds(len(ids))[:, 0, 0]))
        if bare.size:
            raise OptionError(
                f"objects: {ids[bare[0]]!r} has no triangle; remove it, or give it triangles."
            )
        return cls(
            graph=make_graph(mesh, ids, labels, names, relations), mesh=mesh, encoded=blobs,
            attributes=tuple(dict(a) for a in attributes) or ({},) * len(ids),
            floors=np.array([floor], np.float64), scenes=(scene,),
            scene_of=np.zeros(len(ids), np.int32), scene_from_map=np.eye(4)[None], source=source,
        )  # fmt: skip

    def __post_init__(self) -> None:
        n, s = len(self.graph), len(self.scenes)
        for name, dtype, shape in (
            ("floors", np.float64, (s,)),
            ("scene_of", np.int32, (n,)),
            ("scene_from_map", np.float64, (s, 4, 4)),
            ("viewpoints", np.float64, (len(self.viewpoints), 3)),
        ):
            column = np.array(getattr(self, name), dtype)
            if column.shape != shape or not np.isfinite(column).all():
                raise OptionError(
                    f"{name}: shape is {column.shape}, expected {shape} finite numbers."
                )
            column.flags.writeable = False
            object.__setattr__(self, name, column)
        if self.own_agreement is not None and self.own_agreement.shape != (s, 9):
            raise OptionError(
                f"own_agreement: shape is {self.own_agreement.shape}, expected {(s, 9)}."
            )
        if not n or not len(self.mesh) or not s:
            raise OptionError("A scene map needs at least one object, one triangle and one scene.")
        if len(self.attributes) != n or len(self.encoded) != len(self.mesh.textures):
            raise OptionError("attributes, encoded: give one per object and one per texture.")
        if int(self.mesh.object_of.max()) >= n:
            raise OptionError(
                "mesh: a triangle belongs to no object; assign every triangle to an object."
            )
        if not 0 <= int(self.scene_of.min()) <= int(self.scene_of.max()) < s:
            raise OptionError("scene_of: an index is outside the scenes.")
        object.__setattr__(self, "anchors", sort_anchors(self.anchors, self.scenes))

    def __len__(self) -> int:
        return len(self.graph)

    def __reduce__(self) -> tuple[Any, ...]:
        """Textures travel as the map file holds them."""
        make, (cls, values, cached) = super().__reduce__()
        mesh = replace(self.mesh, textures=textures.EncodedTextures(self.encoded, self.source))
        return make, (cls, values | {"mesh": mesh}, cached)

    def __repr__(self) -> str:
        merged = f", {len(self.scenes)} scenes" if len(self.scenes) > 1 else ""
        size = f"{len(self)} objects, {len(self.mesh):,} triangles{merged}"
        return f"{type(self).__name__}({self.source!r}, {size})"

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """(2, 3) float64, lowest and highest corner of the mesh [m]."""
        box = self.mesh.bounds()
        box.flags.writeable = False
        return box

    @cached_property
    def scene_bounds(self) -> NDArray[np.float64]:
        """(S, 2, 3) float64, lowest and highest corner of each merged scene [m, map]."""
        half = self.graph.extents / 2 if self.graph.extents is not None else 0.0
        boxes = np.empty((len(self.scenes), 2, 3))
        for s in range(len(self.scenes)):
            own = self.scene_of == s
            boxes[s, 0] = (self.graph.positions - half)[own].min(axis=0, initial=np.inf)
            boxes[s, 1] = (self.graph.positions + half)[own].max(axis=0, initial=-np.inf)
        boxes.flags.writeable = False
        return boxes

    @cached_property
    def caster(self) -> RayCaster:
        """Casts rays at the mesh; made on first use."""
        from placegraph.indoor.rays import RayCaster

        return RayCaster(self.mesh.vertices, self.mesh.triangles)

    @cached_property
    def surface(self) -> Surface:
        """The mesh as compiled code reads it; made on first use."""
        return Surface.of(self.mesh)

    @cached_property
    def normals(self) -> NDArray[np.float32]:
        """(T, 3) float32 unit normals of the mesh's triangles, zero of those without area."""
        doubled = self.mesh.normals()
        lengths = np.maximum(np.linalg.norm(doubled, axis=1, keepdims=True), 1e-12)
        return (doubled / lengths).astype(np.float32)

    def compute_once(self, key: Hashable, make: Callable[[Self], T]) -> T:
        """Return a value derived from the map: made once for each key, cached as long as the map."""
        if key not in self._derived:
            self._derived[key] = make(self)
        return self._derived[key]

    @cached_property
    def _derived(self) -> dict[Hashable, Any]:
        return {}

    @cached_property
    def has_colours(self) -> bool:
        """Whether surfaces have colours to compare: not all of them the same."""
        textures = self.mesh.textures
        first = textures[0][0, 0]
        if np.ptp(self.mesh.colours, axis=0).any():
            return True
        return any((t[::8, ::8] != first).any() or (t != first).any() for t in textures)

    def scene_at(self, point: ArrayLike) -> int:
        """Return row of the merged scene in whose bounds a point (2,) x, y [m] lies, or the nearest."""
        boxes, point = self.scene_bounds[:, :, :2], np.asarray(point, np.float64)
        outside = np.maximum(np.maximum(boxes[:, 0] - point, point - boxes[:, 1]), 0.0)
        return int(outside.sum(axis=1).argmin())

    def row_of(self, id_: str) -> int:
        """Return row of the object with this id; `OptionError` where there is none."""
        row = self._rows.get(id_)
        if row is None:
            raise OptionError(f"{id_!r} is not an object of {self.source or 'this map'}.")
        return row

    @cached_property
    def _rows(self) -> dict[str, int]:
        return {id_: i for i, id_ in enumerate(self.graph.ids)}

    def anchored(self, *anchors: Anchor) -> Self:
        """Map that stands on Earth as these candidates say; of none, map that stands nowhere.

        Raises `OptionError` where their probabilities add up to more than 1, for each merged scene.
        """
        return replace(self, anchors=anchors)

    def anchors_of(self, scene: str) -> tuple[Anchor, ...]:
        """Return candidates of one of the merged scenes, best first, in the axes of this map."""
        return tuple(a for a in self.anchors if a.scene in {"", scene})

    def with_embeddings(self, embeddings: ArrayLike, *, encoder: str = "") -> Self:
        """Map whose objects carry these vectors (N, E), rounded to 8 bits as its file holds them.

        `encoder`: key of the encoder that they are of (`placegraph.indoor.encode.Encoder.key`).
        """
        vectors = np.asarray(embeddings, np.float32)
        if vectors.ndim == 2 and np.isfinite(vectors).all():  # else the graph says what is wrong
            vectors = dequantize_vectors(*quantize_vectors(vectors))
        return replace(self, graph=replace(self.graph, embeddings=vectors), encoder=encoder)


def make_graph(
    mesh: Mesh,
    ids: Sequence[str],
    labels: Sequence[str],
    names: Sequence[str],
    relations: Sequence[tuple[int, str, int]],
) -> SceneGraph:
    """Make the graph of N objects in the boxes of their triangles; edges (source, relation, target)."""
    boxes = mesh.object_bounds(len(ids))
    return SceneGraph(
        ids=tuple(ids), labels=tuple(labels), names=tuple(names),
        positions=boxes.mean(axis=1), extents=boxes[:, 1] - boxes[:, 0],
        sources=np.array([s for s, _, _ in relations], np.int64),
        relations=tuple(r for _, r, _ in relations),
        targets=np.array([t for _, _, t in relations], np.int64),
    )  # fmt: skip


def make_object_ref(scene: Scene, row: int) -> ObjectRef:
    """Return object in this row; its place is that of the likeliest anchor."""
    graph = scene.graph
    anchors = scene.anchors_of(scene.scenes[scene.scene_of[row]])
    place = anchors[0].to_earth(graph.positions[row])[:2].tolist() if anchors else ()
    name = graph.names[row] if graph.names else ""
    return ObjectRef(graph.ids[row], graph.labels[row], name, *place)


_RING = np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)])


def make_geojson(scene: Scene) -> dict[str, Any]:
    """Return the FeatureCollection of a map's objects; see also `SceneMap.to_geojson`."""
    graph, mesh = scene.graph, scene.mesh
    found = []
    for row, (low, high) in enumerate(mesh.object_bounds(len(graph))):
        name = scene.scenes[scene.scene_of[row]]
        anchors = scene.anchors_of(name)
        if not anchors:
            raise no_anchor_error(name)
        corners = np.where(_RING, high[:2], low[:2])
        there = anchors[0].to_earth(np.column_stack([corners, np.full(len(_RING), low[2])]))
        properties = {
            "id": graph.ids[row], "label": graph.labels[row], "name": graph.names[row],
            "room": scene.attributes[row].get("room", ""), "scene": name,
            "level": anchors[0].level, "building": anchors[0].building,
            "height": round(float(there[0, 2]), 3), "tall": round(float(high[2] - low[2]), 3),
        }  # fmt: skip
        found.append(make_feature(polygon_geometry([there[:, :2]]), properties))
    return make_collection(found)
