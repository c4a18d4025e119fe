"""DINOv2 as the published network was trained on it: values of one block, from timm."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from placegraph.errors import InputError, MissingExtraError, OptionError, ServiceError

MODEL = "vit_giant_patch14_dinov2.lvd142m"
"""Name of DINOv2 ViT-g/14 without registers in timm."""
BLOCK = 31
"""Of 40, counted from 0."""
LONG, SHORT, SQUARE = 224, 126, 224
"""Sides of images, and of crops, as the network sees them [px]."""
MEAN = np.array([0.485, 0.456, 0.406], np.float32)
DEVIATION = np.array([0.229, 0.224, 0.225], np.float32)
_OFFSET = 0.1
"""DINOv2 stretches its table of positions to a grid this much [cells] larger than the image's."""


class DinoFeatures:
    """Value vectors of a block of a vision transformer: of patches, and of crops by the class token.

    Parameters
    ----------
    model
        Vision transformer of timm with a class token and a fused `qkv`; left as it is.
    name
        What it is called, with its weights: goes into `key`.
    block
        Row of the block, counted from 0.

    Raises
    ------
    OptionError
        The transformer has no such block, or its patches do not fill `LONG` and `SHORT`.

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
            raise OptionError(f"{name}: patches of {self._patch} px do not fill {LONG} x {SHORT}.")

    @classmethod
    def load(
        cls,
        weights: Path | str | None = None,
        *,
        model: str = MODEL,
        block: int = BLOCK,
        device: str = "cpu",
    ) -> DinoFeatures:
        """DINOv2 by timm, with weights from a file or, without one, from timm's own hub.

        Raises
        ------
        MissingExtraError
            PyTorch or timm is not installed, or they do not fit each other.
        InputError
            The file is missing, cut short, or holds another network.
        ServiceError
            No file is given and the hub cannot be reached.
        OptionError
            There is no such model, block or device.

        """
        timm = _timm()
        made = _created(timm, model, weights)
        from placegraph.core.networks import device_for

        name = f"{model}:{_digest(made)}"
        return cls(made, name=name, block=block, device=device_for(_torch(), device))

    def grid(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Features (9, 16, f), or (16, 9, f) of an upright image; as `ImageFeatures.grid`."""
        upright = image.shape[0] > image.shape[1]
        # a turned image is resized as it was taken: resizing rounds rows and columns in turn
        small = _resized(np.rot90(image) if upright else image, LONG, SHORT)
        values = self._values(np.rot90(small, -1) if upright else small)[1:]
        rows, columns = SHORT // self._patch, LONG // self._patch
        shape = (columns, rows) if upright else (rows, columns)
        return values.reshape(*shape, self.dimension)

    def crop(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Feature (f,) of the class token of a crop, stretched; as `ImageFeatures.crop`."""
        out: NDArray[np.float32] = self._values(_resized(image, SQUARE, SQUARE))[0]
        return out

    def _values(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Values (1 + patches, f), unit vectors, of the class token and the patches."""
        torch = _torch()
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
        """Table of positions (1, 1 + patches, f), stretched to a grid as DINOv2 does it."""
        torch = _torch()
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
        raise OptionError(f"timm knows no model {model!r}; DINOv2 ViT-g/14 is {MODEL!r}.")
    if weights is not None:
        with _torch().device("meta"):  # its own numbers would be drawn, and thrown away
            made = timm.create_model(model, num_classes=0)
        return _filled(made, model, Path(weights))
    try:
        return timm.create_model(model, pretrained=True, num_classes=0)
    except Exception as error:  # timm raises whatever its hub does
        raise ServiceError(
            f"The weights of {model} cannot be fetched ({_why(error)}); give feature_weights a file."
        ) from error


def _filled(made: Any, model: str, path: Path) -> Any:  # noqa: ANN401
    """A model with the weights of a file, spelled as timm or as DINOv2's authors do."""
    from timm.models.vision_transformer import checkpoint_filter_fn

    from placegraph_learn.scenegraphloc.weights import read_state

    state, _ = read_state(path, f"name the weights of {model}")
    try:
        own = checkpoint_filter_fn({key: value.float() for key, value in state.items()}, made)
        made.load_state_dict(own, assign=True)  # those of the file: ViT-g's are 4.5 GB
    except Exception as error:  # of keys and shapes that are another network's
        raise InputError(f"{path}: not the weights of {model} ({_why(error)}).") from error
    return made


def _why(error: Exception) -> str:
    return " ".join((str(error).strip() or type(error).__name__).split())[:160]


def _digest(model: Any) -> str:  # noqa: ANN401
    import hashlib

    digest = hashlib.sha256()
    for name, value in sorted(model.state_dict().items()):
        digest.update(name.encode())
        digest.update(value.cpu().contiguous().numpy())
    return digest.hexdigest()[:12]


def _resized(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    if not image.size:
        raise OptionError(f"image: shape {image.shape}; it needs at least one pixel.")
    picture = Image.fromarray(np.ascontiguousarray(image))
    return np.asarray(picture.resize((width, height), Image.Resampling.BICUBIC))


def _torch() -> Any:  # noqa: ANN401  # the module
    try:
        import torch
    except ImportError as error:
        raise MissingExtraError(
            "DINOv2 needs PyTorch and timm: pip install 'placegraph[learn]'."
        ) from error
    return torch


def _timm() -> Any:  # noqa: ANN401  # the module
    _torch()
    try:
        import timm
    except (ImportError, RuntimeError) as error:  # a torchvision of another PyTorch
        raise MissingExtraError(
            f"timm cannot be imported ({str(error).splitlines()[0][:80]}); install it with the "
            "torchvision that belongs to your PyTorch: pip install 'placegraph[learn]'."
        ) from error
    return timm
