"""Dense backbones of timm: made, filled with weights, asked for a grid of features."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from placegraph.core.geometry import Camera
from placegraph.errors import InputError, MissingExtraError, OptionError, ServiceError
from placegraph.indoor.map.scene import Scene
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame
from placegraph_learn.torch_files import read_state, select_device

_HEADS = ("head", "fc", "classifier", "fc_norm", "attn_pool")
"""Parts of a checkpoint that a backbone has no use for."""


class Backbone:
    """A network of timm that turns an image into a grid of features.

    Raises `MissingExtraError`: timm is not installed, or its torchvision is another PyTorch's;
    `OptionError`: there is no such model, layer or device, or it has no features of places;
    `InputError`: the file is missing, cut short, or holds another network's weights;
    `ServiceError`: no file is given, and the hub cannot be reached.

    `model`: name in timm, of any network with features of places: ViTs, convolutional networks.
    `pretrained`: with the weights that timm's hub has, where no file is given; without, drawn by
        chance (the same each time), which only tests want.
    `weights`: File: a state dict of PyTorch, or safetensors, spelled as timm or as its authors
        spell it.
    `layer`: which of the network's stages or blocks, counted from 0, or from the end by -1.
    `device`: `cpu`, `cuda` or `auto`.
    """

    def __init__(
        self,
        model: str,
        *,
        pretrained: bool = True,
        weights: str | Path | None = None,
        layer: int = -1,
        device: str = "auto",
    ) -> None:
        timm = import_timm()
        if not timm.is_model(model):
            raise OptionError(f"timm has no model {model!r}; timm.list_models() lists them.")
        self._device = select_device(torch, device)
        self.name, self._layer = model, layer
        network = _made(timm, model, pretrained=pretrained and weights is None)
        if weights is not None:
            _fill(network, _state(Path(weights), model), weights, model)
        digest = hashlib.sha256()
        for name, value in sorted(network.state_dict().items()):
            digest.update(name.encode() + str(value.dtype).encode())
            digest.update(value.detach().cpu().contiguous().numpy().tobytes())
        self.digest = digest.hexdigest()[:12]
        """Twelve hexadecimal digits of the weights."""
        self._network = network.eval().requires_grad_(requires_grad=False).to(self._device)
        self._mean, self._deviation = (
            np.array(network.pretrained_cfg[key], np.float32) for key in ("mean", "std")
        )
        self.cell, self.dimension = self._measured(weights)

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return features (rows, columns, f) of an image (h, w, 3) whose sides are multiples of `cell`."""
        scaled = (image.astype(np.float32) / 255.0 - self._mean) / self._deviation
        pixels = torch.from_numpy(np.ascontiguousarray(scaled.transpose(2, 0, 1)))[None]
        with torch.inference_mode():
            (found,) = self._network.forward_intermediates(
                pixels.to(self._device),
                indices=[self._layer],
                norm=True,
                output_fmt="NCHW",
                intermediates_only=True,
            )
        out: NDArray[np.float32] = found[0].permute(1, 2, 0).float().cpu().numpy()
        return out

    def _measured(self, weights: str | Path | None) -> tuple[int, int]:
        """Return side of a cell [px] and length of a feature, of what comes out for an image."""
        side = 2 * max(int(stage["reduction"]) for stage in self._network.feature_info)
        try:
            found = self(np.zeros((side, 2 * side, 3), np.uint8))
        except Exception as error:  # timm's networks fail in many ways
            raise OptionError(
                f"{self.name} (layer {self._layer}) returns no grid of features for an image that "
                f"is not square ({format_error(error)}); choose a ViT or a convolutional network, and one "
                "of its layers."
            ) from error
        if not np.isfinite(found).all():
            raise InputError(f"{weights} contains numbers that are not finite; download it again.")
        rows, columns, dimension = found.shape
        if not rows or side % rows or columns != 2 * rows:
            raise OptionError(
                f"{self.name}: the features of {side} px are {rows} x {columns}, which is not a "
                "grid; choose another layer."
            )
        return side // rows, dimension


def import_timm() -> Any:  # noqa: ANN401  # the module
    """Import timm; raises `MissingExtraError` where it is missing or does not fit PyTorch."""
    try:
        import timm
    except (ImportError, RuntimeError) as error:  # RuntimeError: torchvision of another PyTorch
        raise MissingExtraError(
            "Image features need timm, and the torchvision of your PyTorch version: pip install "
            f"'placegraph[learn]' ({format_error(error)})."
        ) from error
    return timm


def _made(timm: Any, model: str, *, pretrained: bool) -> Any:  # noqa: ANN401
    """Return network without a head; of images of any size where it is a transformer."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        for options in ({"dynamic_img_size": True}, {}):
            try:
                return timm.create_model(model, pretrained=pretrained, num_classes=0, **options)
            except TypeError:  # networks that take any size anyhow know no such option
                if not options:
                    raise
            except Exception as error:
                if not pretrained:
                    raise OptionError(
                        f"timm cannot create {model} ({format_error(error)}); choose another model."
                    ) from error
                raise ServiceError(
                    f"The weights of {model} cannot be downloaded ({format_error(error)}); download them "
                    "elsewhere, and give weights=FILE."
                ) from error
    raise AssertionError


def _state(path: Path, model: str) -> dict[str, Any]:
    """Return weights by name from a file; nothing in it is run."""
    if path.suffix != ".safetensors":
        return read_state(torch, path, model)
    try:
        with safe_open(path, "pt") as file:  # copied: whoever cuts the file short later ends nobody
            return {key: file.get_tensor(key).clone() for key in file.keys()}  # noqa: SIM118
    except FileNotFoundError as error:
        raise InputError(
            f"{path} does not exist; give weights= the file with the weights of {model!r}."
        ) from error
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(
            f"{path} cannot be read as weights of {model!r} ({format_error(error)}); download it again."
        ) from error


def _fill(network: Any, state: dict[str, Any], path: str | Path, model: str) -> None:  # noqa: ANN401
    """Put weights into a network; what is left over of a head is passed over, and nothing else."""
    # checkpoints of the authors, and of other image sizes, are translated by timm's own module
    own = getattr(sys.modules[type(network).__module__], "checkpoint_filter_fn", None)
    try:
        fitting = own(state, network) if own else state
        missing, over = network.load_state_dict(fitting, strict=False)
    except Exception as error:  # of shapes, and of whatever the filter did not expect
        raise InputError(
            f"{path} contains weights of another network than {model!r} ({format_error(error)}); give the "
            "weights of this one."
        ) from error
    over = [key for key in over if not key.startswith(_HEADS)]
    for what, keys in (("lacks", missing), ("has in addition", over)):
        if keys:
            raise InputError(
                f"{path} {what} {keys[0]!r} and {len(keys) - 1} more, so it has the weights of "
                f"another network than {model!r}; give the weights of this one."
            )


def format_error(error: Exception) -> str:
    """Return an error's message in one line."""
    return " ".join((str(error).strip() or type(error).__name__).split())[:160]


MODEL = "vit_small_patch14_dinov2.lvd142m"
TEMPERATURE = 0.1
"""A guess: cosines of one network's features are spread wider than those of another's."""
_CELLS = 16  # along the longer side, if no size is asked for: 9 x 16 patches, Sec. 3.3
_RAYS = 4  # cast through a patch, across and down
_NEAR = 0.1  # a depth reading belongs to the surface that is this near [m] ...
_SLOPE = 0.05  # ... and this share of its depth


class FeaturesEncoder:
    """Patches by a backbone's features, objects by the mean feature of the patches that saw them.

    Raises `OptionError`: the size is less than a patch, or the temperature not positive;
    `MissingExtraError`, `InputError` or `ServiceError`: as `Backbone` does.

    `model`: name in timm: DINOv2, DINOv3, SigLIP and other ViTs, or a convolutional network.
    `pretrained`, `weights`, `layer`, `device`: of `Backbone`.
    `size`: longer side of the images that the network sees [px]; as much as gives 16 patches if not
        given. The shorter follows from the image; both are whole numbers of patches.
    `temperature`: cosine that counts one nat.
    """

    name = "features"

    def __init__(
        self,
        model: str = MODEL,
        *,
        pretrained: bool = True,
        weights: str | Path | None = None,
        size: int | None = None,
        layer: int = -1,
        temperature: float = TEMPERATURE,
        device: str = "auto",
    ) -> None:
        if not temperature > 0:
            raise OptionError(f"temperature is {temperature}; it must be greater than 0.")
        self.temperature = temperature
        self._backbone = Backbone(
            model, pretrained=pretrained, weights=weights, layer=layer, device=device
        )
        cell = self._backbone.cell
        if size is not None and size < cell:
            raise OptionError(f"size is {size}; {model} has patches of {cell} px.")
        self._cells = _CELLS if size is None else size // cell
        self._layer = layer

    @property
    def dimension(self) -> int:
        """Numbers of a vector, d."""
        return self._backbone.dimension

    @property
    def key(self) -> str:
        """Its name, the network's, a digest of its weights, the layer and the patches of an image."""
        backbone = self._backbone
        return f"features {backbone.name} {backbone.digest} {self._layer} {self._cells}"

    def patches(self, image: Frame) -> NDArray[np.float32]:
        """Return unit vectors (rows, columns, d) of a frame's patches; raises `InputError` as `rgb` does."""
        from PIL import Image

        rgb = image.rgb()
        height, width = rgb.shape[:2]
        longer, shorter = max(height, width), min(height, width)
        other = max(1, round(self._cells * shorter / longer))
        rows, columns = (self._cells, other) if height > width else (other, self._cells)
        cell = self._backbone.cell
        small = Image.fromarray(rgb).resize(
            (columns * cell, rows * cell), Image.Resampling.BICUBIC, reducing_gap=3.0
        )
        return _unit(self._backbone(np.asarray(small)))

    def camera(self, image: Frame) -> Camera:
        """Return camera of the colour image."""
        return image.camera

    def objects(self, scene: Scene, captures: Sequence[Capture] = ()) -> NDArray[np.float32]:
        """Return unit vectors (N, d) of a map's objects; zero of what no image shows.

        Patches count by the square of their share of the object: one that shows half of it and half
        of another says little. Rays whose depth reading lies elsewhere than the map's surface see
        something else, and do not count. Raises `OptionError` where there is no image.
        """
        if not any(len(capture) for capture in captures):
            raise OptionError(
                "captures: features of objects come from images of the map; give captures with poses."
            )
        sums = np.zeros((len(scene), self.dimension))
        for capture in captures:
            for frame in capture:
                vectors = self.patches(frame)
                patch, row, share = find_patch_objects(scene, frame, vectors.shape[:2])
                seen = vectors.reshape(-1, self.dimension)[patch]
                np.add.at(sums, row, seen * share[:, None] ** 2)
        return _unit(sums.astype(np.float32))


def find_patch_objects(
    scene: Scene, frame: Frame, grid: tuple[int, int]
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
    """Return the objects of a map in the patches of a frame whose odometry is map_from_camera.

    Returns patches (K,), row by row, rows of objects (K,), and the share (K,) of the patch's rays
    that see the object.
    """
    rows, columns = grid
    y, x = np.mgrid[: rows * _RAYS, : columns * _RAYS]
    uv = np.stack(
        [
            (x.ravel() + 0.5) * frame.camera.width / (columns * _RAYS),
            (y.ravel() + 0.5) * frame.camera.height / (rows * _RAYS),
        ],
        axis=-1,
    )
    rays = frame.camera.directions(uv)
    pose = frame.odometry
    hits = scene.caster.cast(pose[:3, 3], rays @ pose[:3, :3].T)
    objects = np.where(hits.triangle >= 0, scene.mesh.object_of[np.maximum(hits.triangle, 0)], -1)
    objects[~_agreed(frame, rays, hits.distance)] = -1
    patch = (y // _RAYS * columns + x // _RAYS).ravel()
    keys, counts = np.unique((patch * len(scene) + objects)[objects >= 0], return_counts=True)
    return keys // len(scene), keys % len(scene), counts / _RAYS**2


def _agreed(
    frame: Frame, rays: NDArray[np.float64], depth: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Return whether readings, where there are any, agree with the map's depth (R,) along rays (R, 3)."""
    readings = frame.depth()
    if readings is None:
        return np.ones(len(rays), np.bool_)
    camera = frame.depth_camera or frame.camera
    with np.errstate(invalid="ignore"):
        column, row = np.floor(camera.project(rays)).T
        inside = (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
    at = np.where(inside, row, 0).astype(np.intp), np.where(inside, column, 0).astype(np.intp)
    reading = np.where(inside, readings[at], np.nan)
    with np.errstate(invalid="ignore"):
        off = np.abs(reading - depth) > _NEAR + _SLOPE * reading
    return ~off


def _unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return (vectors / np.maximum(lengths, 1e-9)).astype(np.float32)
