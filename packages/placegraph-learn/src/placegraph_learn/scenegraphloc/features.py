"""Image features that the network starts from: of patches, and of crops of objects.

The published network takes DINOv2's (`dino.DinoFeatures`). Anything that satisfies `ImageFeatures`
will do, for a network trained on it; `ColourFeatures` needs no weights.
"""

from __future__ import annotations

import hashlib
import json
from os import PathLike
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from placegraph.core.files import check_regular
from placegraph.errors import InputError, OptionError, ServiceError
from placegraph.indoor.map.relations import ABOVE, NEXT_TO
from placegraph_learn.features import format_error, import_timm
from placegraph_learn.scenegraphloc.weights import read_state
from placegraph_learn.torch_files import select_device

GRID = (9, 16)
"""Rows and columns of patches of an image that is wider than high; the other way round else."""
FEATURES = ("dinov2", "colour")
NONE = "none"
RELATIONS = (
    NONE, "supported by", "left", "right", "front", "behind", "close by", "inside", "bigger than",
    "smaller than", "higher than", "lower than", "same symmetry as", "same as", "attached to",
    "standing on", "lying on", "hanging on", "connected to", "leaning against", "part of",
    "belonging to", "build in", "standing in", "cover", "lying in", "hanging in", "same color",
    "same material", "same texture", "same shape", "same state", "same object type", "messier than",
    "cleaner than", "fuller than", "more closed", "more open", "brighter than", "darker than",
    "more comfortable than",
)  # fmt: skip
"""3DSSG's relations, in the order of its `relationships.txt`."""

_ROW = {word: row for row, word in enumerate(RELATIONS)} | {
    # ours that 3DSSG says otherwise; "same room" it does not say
    NEXT_TO: RELATIONS.index("close by"),
    ABOVE: RELATIONS.index("higher than"),
}


class ImageFeatures(Protocol):
    """Turns images and crops of them into features of one space."""

    @property
    def key(self) -> str:
        """Cache key of the features, which are comparable only with equal keys."""

    @property
    def dimension(self) -> int:
        """Numbers of a feature, f."""

    def grid(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return features (rows, columns, f), unit vectors, of an image (H, W, 3), sRGB, any size."""

    def crop(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return one feature (f,), a unit vector, of an image (H, W, 3) that shows one thing."""


def features_named(
    name: str, *, weights: Path | str | None = None, device: str = "cpu"
) -> ImageFeatures:
    """Return features by name, one of `FEATURES`; `weights` are a file with those of DINOv2.

    Raises `OptionError`: there are none of this name, or `weights` are given to what has none;
    `InputError`, `MissingExtraError` or `ServiceError`: as `dino.DinoFeatures.load`.
    """
    if name == "dinov2":
        return DinoFeatures.load(weights, device=device)
    if name != "colour":
        raise OptionError(f"features is {name!r}; choose one of {', '.join(FEATURES)}.")
    if weights is not None:
        raise OptionError("feature_weights: colour features have no weights; remove it.")
    return ColourFeatures()


_CELL = 8  # pixels of a patch, each way, that statistics are made of
_LEVELS = (0.1, 0.5, 0.9)
_WEIGHTS = np.repeat(np.array([0.8, 3.0, 5.0, 4.0, 1.0]), [4, 4, 4, 4, 1]).astype(np.float32)
"""Weights of brightness, two chromaticities, edges and a constant, which give them like magnitudes."""


class ColourFeatures:
    """Levels of brightness and chromaticity, and the directions of edges, of each patch.

    A baseline and a stand-in for tests and synthetic worlds: 17 numbers that say little of what a
    thing is, but need no weights and no time.
    """

    key = "colour-1"
    dimension = len(_WEIGHTS)

    def grid(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """See `ImageFeatures.grid`."""
        rows, columns = GRID if image.shape[1] >= image.shape[0] else GRID[::-1]
        return _statistics(image, rows, columns)

    def crop(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """See `ImageFeatures.crop`."""
        out: NDArray[np.float32] = _statistics(image, 1, 1, 4 * _CELL)[0, 0]
        return out


def _resized(
    image: NDArray[np.uint8], width: int, height: int, method: Image.Resampling
) -> NDArray[np.uint8]:
    if not image.size:
        raise OptionError(f"image has shape {image.shape}; it must have at least one pixel.")
    picture = Image.fromarray(np.ascontiguousarray(image))
    return np.asarray(picture.resize((width, height), method))


def _statistics(
    picture: NDArray[np.uint8], rows: int, columns: int, cell: int = _CELL
) -> NDArray[np.float32]:
    small = _resized(picture, columns * cell, rows * cell, Image.Resampling.BOX)
    image = small.astype(np.float32) / np.float32(255.0)
    total = image.sum(axis=2)
    bright = np.log(total + 0.1)
    red = (image[..., 0] - image[..., 2]) / (total + 0.1)
    green = (2.0 * image[..., 1] - image[..., 0] - image[..., 2]) / (total + 0.1)

    def blocks(plane: NDArray[np.floating]) -> NDArray[np.floating]:
        h, w = plane.shape
        cut = plane.reshape(rows, h // rows, columns, w // columns)
        return cut.swapaxes(1, 2).reshape(rows, columns, -1)

    parts = []
    for plane in (bright, red, green):
        cells = blocks(plane)
        parts += [*np.quantile(cells, _LEVELS, axis=2), cells.mean(axis=2)]
    down, across = np.gradient(bright)
    strength = np.hypot(down, across)
    turn = np.arctan2(down, across)  # an edge and its reverse are one direction
    for k in range(4):
        near = np.cos(2.0 * (turn - k * np.pi / 4.0))
        parts.append(blocks(strength * np.maximum(near, 0.0)).mean(axis=2))
    parts.append(np.ones((rows, columns)))
    out = np.stack(parts, axis=2).astype(np.float32) * _WEIGHTS
    unit: NDArray[np.float32] = out / np.linalg.norm(out, axis=2, keepdims=True)
    return unit


def relation_row(relation: str) -> int | None:
    """Return row of an edge's name in `RELATIONS`; None where 3DSSG has nothing like it."""
    return _ROW.get(relation.strip().lower())


def read_attributes(path: str | PathLike[str]) -> tuple[str, ...]:
    """Return attribute words in their order: a JSON list, or a text file with one a line.

    The published network counts the 164 of `obj_attr.pkl`, which comes with SGAligner's data:
    write its words in such a file. Raises `InputError` where the file is missing, empty, no text,
    or names a word twice.
    """
    try:
        text = check_regular(Path(path)).read_text(encoding="utf-8")
        listed = json.loads(text) if text.lstrip().startswith("[") else text.splitlines()
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            f"{path} is not a list of attributes ({str(error)[:100]}); give a text file with one "
            "word per line."
        ) from error
    if not all(isinstance(word, str) for word in listed):
        raise InputError(f"{path}: an attribute is not a word; give a list of words.")
    words = tuple(word.strip().lower() for word in listed if word.strip())
    if not words or len(set(words)) < len(words):
        what = "contains no words" if not words else "repeats a word"
        raise InputError(
            f"{path} {what}; give each attribute of the training once, in the same order."
        )
    return words


MODEL = "vit_giant_patch14_dinov2.lvd142m"
"""Name of DINOv2 ViT-g/14 without registers in timm."""
BLOCK = 31
"""Transformer block whose output is used: number 31 of 40, counted from 0."""
LONG, SHORT, SQUARE = 224, 126, 224
"""Sides of images, and of crops, as the network sees them [px]."""
MEAN = np.array([0.485, 0.456, 0.406], np.float32)
DEVIATION = np.array([0.229, 0.224, 0.225], np.float32)
_OFFSET = 0.1
"""DINOv2 stretches its table of positions to a grid this much [cells] larger than the image's."""


class DinoFeatures:
    """Value vectors of a block of a vision transformer: of patches, and of crops by the class token.

    Raises `OptionError`: the transformer has no such block, or its patches do not fill `LONG` and
    `SHORT`.

    `model`: vision transformer of timm with a class token and a fused `qkv`; left as it is.
    `name`: what it is called, with its weights: goes into `key`.
    `block`: row of the block, counted from 0.
    """

    def __init__(self, model: Any, *, name: str, block: int = BLOCK, device: Any = "cpu") -> None:  # noqa: ANN401
        self.key = f"dinov2:{name}:value{block}"
        self._model = model.to(device).eval().requires_grad_(False)
        self._block, self._device = block, device
        if not 0 <= block < len(model.blocks):
            raise OptionError(f"block is {block}; {name} has {len(model.blocks)}, counted from 0.")
        self.dimension = int(model.embed_dim)
        self._patch = int(model.patch_embed.patch_size[0])
        if any(side % self._patch for side in (LONG, SHORT, SQUARE)):
            raise OptionError(
                f"{name}: patches of {self._patch} px do not fill images of {LONG} x {SHORT}; "
                "choose another model."
            )

    @classmethod
    def load(
        cls,
        weights: Path | str | None = None,
        *,
        model: str = MODEL,
        block: int = BLOCK,
        device: str = "cpu",
    ) -> DinoFeatures:
        """Return DINOv2 by timm, with weights from a file or, without one, from timm's own hub.

        Raises `MissingExtraError`: timm is not installed, or does not fit PyTorch; `InputError`:
        the file is missing, cut short, or holds another network; `ServiceError`: no file is given
        and the hub cannot be reached; `OptionError`: there is no such model, block or device.
        """
        made = _created(import_timm(), model, weights)

        name = f"{model}:{_digest(made)}"
        return cls(made, name=name, block=block, device=select_device(torch, device))

    def grid(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return features (9, 16, f), or (16, 9, f) of an upright image; as `ImageFeatures.grid`."""
        upright = image.shape[0] > image.shape[1]
        # a turned image is resized as it was taken: resizing rounds rows and columns in turn
        small = _resized(
            np.rot90(image) if upright else image, LONG, SHORT, Image.Resampling.BICUBIC
        )
        values = self._values(np.rot90(small, -1) if upright else small)[1:]
        rows, columns = SHORT // self._patch, LONG // self._patch
        shape = (columns, rows) if upright else (rows, columns)
        return values.reshape(*shape, self.dimension)

    def crop(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return feature (f,) of the class token of a crop, stretched; as `ImageFeatures.crop`."""
        out: NDArray[np.float32] = self._values(
            _resized(image, SQUARE, SQUARE, Image.Resampling.BICUBIC)
        )[0]
        return out

    def _values(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return values (1 + patches, f), unit vectors, of the class token and the patches."""
        scaled = (image.astype(np.float32) / 255.0 - MEAN) / DEVIATION
        pixels = torch.from_numpy(np.ascontiguousarray(scaled.transpose(2, 0, 1)))[None]
        model = self._model
        with torch.inference_mode():
            x = model.patch_embed.proj(pixels.to(self._device))  # (1, f, rows, columns)
            shape = x.shape[2:]
            x = torch.cat([model.cls_token, x.flatten(2).transpose(1, 2)], dim=1)
            x = model.norm_pre(x + self._positions(*shape))
            for block in model.blocks[: self._block]:
                x = block(x)
            last = model.blocks[self._block]
            values = last.attn.qkv(last.norm1(x))[0, :, -self.dimension :]
            values = torch.nn.functional.normalize(values, dim=-1, eps=1e-12)
        out: NDArray[np.float32] = values.cpu().numpy()
        return out

    def _positions(self, rows: int, columns: int) -> Any:  # noqa: ANN401  # a tensor
        """Return table of positions (1, 1 + patches, f), stretched to a grid as DINOv2 does it."""
        table = self._model.pos_embed
        side = round((table.shape[1] - 1) ** 0.5)
        if (rows, columns) == (side, side):
            return table
        square = table[:, 1:].reshape(1, side, side, -1).permute(0, 3, 1, 2)
        scale = (rows + _OFFSET) / side, (columns + _OFFSET) / side
        grid = torch.nn.functional.interpolate(square, scale_factor=scale, mode="bicubic")
        return torch.cat([table[:, :1], grid.flatten(2).transpose(1, 2)], dim=1)


def _created(timm: Any, model: str, weights: Path | str | None) -> Any:  # noqa: ANN401
    if not timm.is_model(model):
        raise OptionError(f"timm has no model {model!r}; DINOv2 ViT-g/14 is {MODEL!r}.")
    if weights is not None:
        with torch.device("meta"):  # its own numbers would be drawn, and thrown away
            made = timm.create_model(model, num_classes=0)
        # a model with the weights of a file, spelled as timm or as DINOv2's authors do
        from timm.models.vision_transformer import checkpoint_filter_fn

        state, _ = read_state(Path(weights), f"give the weights of {model}")
        try:
            own = checkpoint_filter_fn({key: value.float() for key, value in state.items()}, made)
            made.load_state_dict(own, assign=True)  # those of the file: ViT-g's are 4.5 GB
        except Exception as error:  # of keys and shapes that are another network's
            raise InputError(
                f"{weights}: not the weights of {model} ({format_error(error)})."
            ) from error
        return made
    try:
        return timm.create_model(model, pretrained=True, num_classes=0)
    except Exception as error:  # timm raises whatever its hub does
        raise ServiceError(
            f"The weights of {model} cannot be downloaded ({format_error(error)}); download them elsewhere, "
            "and give the file as feature_weights."
        ) from error


def _digest(model: Any) -> str:  # noqa: ANN401
    digest = hashlib.sha256()
    for name, value in sorted(model.state_dict().items()):
        digest.update(name.encode())
        digest.update(value.cpu().contiguous().numpy())
    return digest.hexdigest()[:12]
