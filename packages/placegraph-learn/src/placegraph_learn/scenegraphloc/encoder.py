"""The encoder itself: images and maps through the network of SceneGraphLoc."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import InputError, OptionError
from placegraph.indoor.map.scene import Scene
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame
from placegraph_learn.scenegraphloc.features import (
    FEATURES,
    RELATIONS,
    ImageFeatures,
    features_named,
    read_attributes,
)
from placegraph_learn.scenegraphloc.inputs import (
    POINTS,
    PointSource,
    batch_rooms,
    object_views,
    quarter_turns,
    rooms_of,
)
from placegraph_learn.scenegraphloc.weights import Weights, read_weights
from placegraph_learn.torch_files import select_device

TEMPERATURE = 0.1
"""Cosine that counts one nat where the file does not say: that of the training loss."""
PUBLISHED = "dinov2"
"""Features that the published network was trained on."""


class SceneGraphLocEncoder:
    """The network of SceneGraphLoc as an `Encoder`.

    Raises `MissingExtraError`: a library that the features need is not installed; `InputError`: a
    file is missing, cut short, or not what it should be (`weights.read_weights`); `OptionError`: no
    weights are given, an option is out of range, or the features are not the network's.

    `weights`: snapshot of the authors, or what `placegraph scene train` wrote; or `Weights` read
        before.
    `features`: image features that the network was trained on: one of `FEATURES`, or any
        `ImageFeatures`; if not given those that the file names, and DINOv2's where it names none.
    `feature_weights`: file with the weights of the features; without one they are fetched where
        there are any.
    `attributes`: file with the attribute words in the order of training (`words.read_attributes`).
        Without it the attributes of objects are vectors of zeros, as in networks trained here
        without.
    `rotate`: turn images before they are encoded: None each upright, by its gravity; True all
        clockwise once, as 3RScan's as they are stored need (`read_scan3r_sequence` has already
        turned them); False none.
    `points`: where the points of objects come from (`inputs.rooms_of`).
    `views`: False: no images of the map are used, and all objects count as never seen.
    `temperature`: cosine that counts one nat, instead of the file's.
    `device`: ``cpu``, ``cuda`` or ``auto``.
    `seed`: draws the points: the same seed, the same vectors.
    """

    name = "scenegraphloc"

    def __init__(
        self,
        weights: Path | str | Weights | None = None,
        *,
        features: str | ImageFeatures | None = None,
        feature_weights: Path | str | None = None,
        attributes: Path | str | None = None,
        rotate: bool | None = None,
        points: PointSource = "surface",
        views: bool = True,
        temperature: float | None = None,
        device: str = "cpu",
        seed: int = 0,
    ) -> None:
        if weights is None:
            raise OptionError(
                "weights: none are given; give a snapshot of SceneGraphLoc, or train one with "
                "`placegraph scene train`."
            )
        self._device = select_device(torch, device)
        held = read_weights(weights) if isinstance(weights, str | Path) else weights
        self.network = held.network.to(self._device).eval()
        self.features = _features(features, feature_weights, held.notes, device)
        self.rotate, self.points, self.views, self.seed = rotate, points, views, seed
        self.attributes = () if attributes is None else read_attributes(attributes)
        widths = self.network.widths
        if widths.feature != self.features.dimension:
            raise OptionError(
                f"features: {self.features.key} has {self.features.dimension} numbers, but the "
                f"network was trained on {widths.feature}; choose the features of its training."
            )
        if widths.relations != len(RELATIONS):
            raise InputError(
                f"weights: the network has {widths.relations} relation words, but 3DSSG has "
                f"{len(RELATIONS)}; give weights trained on 3DSSG's."
            )
        if self.attributes and len(self.attributes) != widths.attributes:
            raise OptionError(
                f"attributes: the file has {len(self.attributes)} words, but the network has "
                f"{widths.attributes}; give the file of its training."
            )
        self.temperature = _number(held.notes, "temperature", TEMPERATURE, temperature, 10.0)
        self._points = int(_number(held.notes, "points", POINTS, None, POINTS))
        settings = f"{points}{seed}{'' if views else ',no views'}"
        words = f",{len(self.attributes)} attributes" if self.attributes else ""
        self.key = f"{self.name}:{held.digest}:{self.features.key}:{settings}{words}"

    @property
    def dimension(self) -> int:
        """Numbers of a vector."""
        return self.network.widths.embedding

    def patches(self, image: Frame) -> NDArray[np.float32]:
        """See `Encoder.patches`; the grid is that of the features, in the image's own orientation."""
        turns = quarter_turns(image, self.rotate)
        grid = self.features.grid(np.ascontiguousarray(np.rot90(image.rgb(), -turns)))
        with torch.inference_mode():
            table = torch.from_numpy(np.ascontiguousarray(grid)).to(self._device)
            vectors = torch.nn.functional.normalize(
                self.network.patches(table[None])[0], dim=-1, eps=1e-12
            )
        out: NDArray[np.float32] = np.ascontiguousarray(np.rot90(vectors.cpu().numpy(), turns))
        return out

    def camera(self, image: Frame) -> Camera:
        """Return camera of the colour image."""
        return image.camera

    def objects(self, scene: Scene, captures: Sequence[Capture] = ()) -> NDArray[np.float32]:
        """See `Encoder.objects`; scenes that were merged are encoded each for itself (App. D).

        Raises `OptionError`: there are no captures, and the encoder was not told to do without
        (`views=False`); `InputError`: an image is broken.
        """
        if self.views and not captures:
            raise OptionError(
                f"captures: none is given for {scene.source or 'the map'}, but {self.name} needs "
                "images of the map; give captures, or views=False."
            )
        seen = object_views(
            scene, captures if self.views else (), self.features, rotate=self.rotate
        )
        rng = np.random.default_rng(self.seed)
        rooms = rooms_of(
            scene, seen, attributes=self.attributes, count=self.network.widths.attributes,
            source=self.points, rng=rng,
        )  # fmt: skip
        out = np.zeros((len(scene), self.dimension), np.float32)
        with torch.inference_mode():
            for rows, room in rooms:
                vectors = self.network.objects(
                    batch_rooms([room.with_points(self._points)], device=self._device)
                )
                unit = torch.nn.functional.normalize(vectors, dim=-1, eps=1e-12)
                out[rows] = unit.cpu().numpy()
        return out


def _features(
    features: str | ImageFeatures | None,
    weights: Path | str | None,
    notes: dict[str, str],
    device: str,
) -> ImageFeatures:
    trained = notes.get("features", "")
    if features is None:
        known = next((name for name in FEATURES if trained.startswith(name)), None)
        if trained and known is None:
            raise OptionError(
                f"features: the network was trained on {trained!r}; give these features."
            )
        features = known or PUBLISHED
    made = features_named(features, weights=weights, device=device) if isinstance(
        features, str) else features  # fmt: skip
    if trained and made.key != trained:
        raise OptionError(
            f"features are {made.key!r}, but the network was trained on {trained!r}; give these."
        )
    return made


def _number(
    notes: dict[str, str], name: str, otherwise: float, given: float | None, most: float
) -> float:
    """A number above 0: what is given, or what the file says, or else what was published."""
    try:
        value = float(notes.get(name, otherwise)) if given is None else given
    except ValueError:
        value = 0.0
    if not 0.0 < value <= most:
        raise OptionError(f"{name} is {value}; it must be greater than 0 and at most {most:g}.")
    return value
