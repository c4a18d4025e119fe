"""Encoders turn patches of images and objects of maps into comparable vectors (Sec. 3.1).

An `Encoder` knows no map: its vectors of patches and of objects are compared by cosine. `bind_encoder`
ties one to a map; the result, a `MapEncoder`, says patch by patch which objects a frame may show.
`encoder` makes encoders by name:

``labels``
    a segmentation's labels against the objects' (`labels.LabelsEncoder`);
``appearance``
    colour and texture of a patch against those of the surfaces (`appearance.AppearanceEncoder`);
``features``
    features of any backbone of timm, pooled over images of the map (extra ``learn``);
``scenegraphloc``
    the network of SceneGraphLoc (extra ``learn``).

Other distributions add encoders by entry points of the group `placegraph.encoders`.
"""

from __future__ import annotations

import ast
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from placegraph.core import plugins
from placegraph.core.geometry import Camera
from placegraph.errors import MapError, OptionError
from placegraph.indoor.likelihood.observe import MapEncoder, Patches
from placegraph.indoor.map.scene import Scene
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame

__all__ = [
    "ENCODERS",
    "Encoder",
    "MapEncoder",
    "Patches",
    "bind_encoder",
    "encoder",
    "make_map_encoder",
    "parse_encoder",
]

BUILT_IN = {
    "labels": ("placegraph.indoor.encode.labels", "LabelsEncoder"),
    "appearance": ("placegraph.indoor.encode.appearance", "AppearanceEncoder"),
}
EXTRA = {"features": "learn", "scenegraphloc": "learn"}
"""Extras of encoders that other distributions of placegraph bring."""
ENCODERS = (*BUILT_IN, *EXTRA)  # Names that `encoder` knows, beside those of other plugins


@runtime_checkable
class Encoder(Protocol):
    """Turns patches and objects into vectors of one space; knows no map."""

    @property
    def name(self) -> str:
        """Name, such as ``labels``."""

    @property
    def key(self) -> str:
        """Name and everything else that decides the vectors: only vectors of equal keys compare."""

    @property
    def dimension(self) -> int:
        """Length d of a vector."""

    @property
    def temperature(self) -> float:
        """Cosine that counts one nat.

        softmax(cosines / temperature) over the objects of a map is what a patch is believed to show.
        """

    def patches(self, image: Frame) -> NDArray[np.float32] | None:
        """Return vectors (rows, columns, d) of a frame's patches, unit or zero: says nothing.

        The grid is the encoder's own. None where the frame has nothing for this encoder.
        Raises `InputError` where an image is broken.
        """

    def camera(self, image: Frame) -> Camera:
        """Return camera whose image the grid divides."""

    def objects(self, scene: Scene, captures: Sequence[Capture] = ()) -> NDArray[np.float32]:
        """Return vectors (N, d) of a map's objects, unit or zero: nothing is known of it.

        `captures`: images of the map itself, their odometry being map_from_camera. Raises
        `OptionError` where the encoder needs some and there are none.
        """


def encoder(name: str, **options: Any) -> Encoder:  # noqa: ANN401  # of the encoder named
    """Make an encoder by name, one of `ENCODERS`; options are those of its class.

    Options may stand in the name: ``"scenegraphloc weights=a.pth views=False"`` (`parse_encoder`).

    Raises
    ------
    OptionError
        No encoder has this name, or an option is wrong.
    MissingExtraError
        A distribution that it needs is not installed.

    """
    name, parsed = parse_encoder(name)
    if name in BUILT_IN:
        module, kind = BUILT_IN[name]
        made = getattr(import_module(module), kind)
    elif name in EXTRA or name in plugins.plugins(plugins.ENCODERS):
        made = plugins.load_plugin(plugins.ENCODERS, name, EXTRA.get(name, ""))
    else:
        raise OptionError(f"encoder is {name!r}; choose one of {', '.join(ENCODERS)}.")
    try:
        return cast("Encoder", made(**(parsed | options)))
    except TypeError as error:  # an option that the class does not have
        raise OptionError(f"encoder {name!r}: {error}.") from error


def parse_encoder(text: str) -> tuple[str, dict[str, Any]]:
    """Split text like ``scenegraphloc weights=a.pth views=False`` into a name and options.

    Values are literals of Python, or else text. Raises `OptionError` where an option has no value.
    """

    def literal(value: str) -> Any:  # noqa: ANN401
        try:
            return ast.literal_eval(value)
        except (ValueError, SyntaxError):
            return value

    try:
        name, *pairs = shlex.split(text) or [""]
        options = dict(pair.split("=", 1) for pair in pairs)
    except ValueError as error:
        raise OptionError(f"{text!r}: give a name, and options as NAME=VALUE.") from error
    return name, {key: literal(value) for key, value in options.items()}


@dataclass(frozen=True, slots=True, eq=False)
class BoundEncoder:
    """Encoder with its vectors of one map's objects."""

    encoder: Encoder
    vectors: NDArray[np.float32]  # (N, d) of the objects

    def encode(self, frame: Frame) -> Patches | None:
        """Return cosines of a frame's patches with all objects; None where it has nothing to encode.

        Raises `OptionError` where names are to be read, and the frame has ids of instances alone.
        """
        named = self.encoder.name == "labels"
        image = encode_patches(self.encoder, frame)
        if named and image is None and frame.label_kind == "instances":
            raise OptionError(
                "encoder 'labels': the label images hold object ids without names. Remove "
                "encoder to compare ids, or open label images, if there are any: "
                'open_capture(path, labels="labels").'
            )
        if image is None or not image.any():
            return None
        flat = image.reshape(-1, image.shape[2])
        telling = flat.any(axis=1)
        # patches that say the very same, as those of one label do, are compared once
        vectors, row = np.unique(flat[telling], axis=0, return_inverse=True)
        rows = np.full(len(flat), -1, np.int32)
        rows[telling] = row.ravel()
        return Patches(
            camera=self.encoder.camera(frame),
            grid=image.shape[:2],
            rows=rows,
            table=vectors @ self.vectors.T,
            temperature=self.encoder.temperature,
            named=named,
        )


def bind_encoder(encoder: Encoder, scene: Scene, captures: Sequence[Capture] = ()) -> MapEncoder:
    """Bind an encoder to a map, with the vectors that the map holds or new ones.

    Raises `MapError`: the map's vectors are another encoder's; `OptionError`: the map has no
    vectors, and the encoder needs images to make them.
    """
    return BoundEncoder(encoder, encode_objects(encoder, scene, captures))


def make_map_encoder(given: str | Encoder | MapEncoder, scene: Scene) -> MapEncoder:
    """Bind an encoder, given by name or as it is, to a map; raises as `encoder` and `bind_encoder`."""
    if isinstance(given, str):  # which has an `encode` too
        given = encoder(given)
    return bind_encoder(given, scene) if isinstance(given, Encoder) else given


def check_vectors(
    vectors: NDArray[np.float32], encoder: Encoder, scene: Scene
) -> NDArray[np.float32]:
    """Return vectors (N, d) of unit length, or zero; raises `OptionError` where they are no such thing."""
    vectors = np.asarray(vectors, np.float32)
    if vectors.shape != (len(scene), encoder.dimension) or not np.isfinite(vectors).all():
        raise OptionError(
            f"encoder {encoder.key}: vectors are {vectors.shape} in "
            f"{scene.source or 'the map'}, expected {(len(scene), encoder.dimension)} "
            "finite numbers."
        )
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(lengths > 1e-6, lengths, np.inf), np.float32)


def encode_patches(encoder: Encoder, frame: Frame) -> NDArray[np.float32] | None:
    """Return an encoder's vectors (rows, columns, d) of a frame; None where it has none.

    Raises `OptionError` where they are no finite vectors of the encoder's own length.
    """
    seen = frame.has_colour or frame.label_camera is not None
    image = encoder.patches(frame) if seen else None
    if image is None:
        return None
    if image.ndim != 3 or image.shape[2] != encoder.dimension or not np.isfinite(image).all():
        raise OptionError(
            f"encoder {encoder.key}: patches are {image.shape} in frame {frame.index}, "
            f"expected finite numbers of shape (rows, columns, {encoder.dimension})."
        )
    return image


def encode_objects(
    encoder: Encoder, scene: Scene, captures: Sequence[Capture] = ()
) -> NDArray[np.float32]:
    """Return an encoder's vectors (N, d) of a map's objects; raises as `bind_encoder` does."""
    if scene.graph.embeddings is not None and scene.encoder == encoder.key and not captures:
        return check_vectors(scene.graph.embeddings, encoder, scene)
    try:
        return check_vectors(encoder.objects(scene, captures), encoder, scene)
    except OptionError as error:
        if scene.graph.embeddings is None or captures:
            raise
        raise MapError(
            f"{scene.source or 'The map'} has vectors of the encoder {scene.encoder or '?'}, but "
            f"the frames are encoded by {encoder.key}; use the same encoder for both ({error})"
        ) from error
