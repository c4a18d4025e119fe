"""RoMa, the paper's matcher (Sec. 3.6), and its successor: dense warps of two images.

RoMa (Edstedt et al., CVPR 2024) and Tiny RoMa come from `romatch`, RoMa v2 (Edstedt et al. 2025) from
`romav2`. RoMa's code and weights and those of v2 are under the MIT licence; DINOv2 and XFeat, which
RoMa and its tiny kind are built on, under Apache-2.0; DINOv3, whose weights are within those of v2 and
whose code the library fetches when a network is first made, has a licence of its own (Meta's DINOv3
License): read it before you use v2. All want a GPU: on a processor a pair takes a minute, with
`kind="tiny"` a second. Features of the query are computed anew for each view: the libraries offer no
other way.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from numpy.typing import NDArray

from placegraph.errors import MissingExtraError, OptionError, ServiceError
from placegraph.indoor.refine.matching.matches import (
    Matches,
    ViewByView,
    Warp,
    check_range,
    is_blank,
    thin_matches,
)
from placegraph_learn.torch_files import check_weights, read_state, select_device

KINDS = ("indoor", "outdoor", "tiny")
SETTINGS = ("turbo", "fast", "base", "precise")
_PATCH = 14  # DINOv2's
_SMALLEST = 32  # in smaller images there is nothing to match [px]


@dataclass(eq=False, kw_only=True)
class _DenseMatcher(ViewByView):
    """Dense matches, the surest of each block of pixels.

    Raises `MissingExtraError`: the library is not installed, or does not load; `InputError`:
    weights are missing, no weights, or another network's; `ServiceError`: no file is given and a
    hub cannot be reached; `OptionError`: an option is out of its range, or the library cannot run
    on this device.
    """

    name = ""
    weights: Path | str | None = None
    """File with the weights; None: from the authors' releases, kept in PyTorch's cache."""
    device: str = "auto"
    """`cpu`, `cuda` or `auto`."""
    count: int = 2000
    """Most matches of a view."""
    least: float = 0.05
    """Smallest certainty of a match."""
    margin: int = 4
    """Matches nearer than this to where the map ends in a view are left out [px]."""

    def __post_init__(self) -> None:
        check_range(count=(self.count, 1, 1e6), least=(self.least, 0, 1))
        check_range(margin=(self.margin, 0, 1e4))
        self._network = self._made(select_device(torch, self.device))
        self._network.eval()

    def _made(self, device: Any) -> Any:  # noqa: ANN401
        """Return the network with its weights."""
        raise NotImplementedError

    def _warps(self, ours: NDArray[np.uint8], view: NDArray[np.uint8]) -> list[Warp]:
        """Return the network's warps between two images."""
        raise NotImplementedError

    def match_view(
        self, ours: NDArray[np.uint8], view: NDArray[np.uint8], mask: NDArray[np.bool_] | None
    ) -> Matches:
        """Return matches of the query (H, W, 3) with one view; see `Matcher.match`."""
        sizes = ours.shape[:2], view.shape[:2]
        if is_blank(ours) or is_blank(view) or min(min(s) for s in sizes) < _SMALLEST:
            return Matches.empty()
        found = self._warps(ours, view)
        return thin_matches(
            found, *sizes, count=self.count, least=self.least, mask=mask, margin=self.margin
        )


@dataclass(eq=False, kw_only=True)
class RomaMatcher(_DenseMatcher):
    """Matches of RoMa (`roma_indoor.pth`, ...), or of its tiny kind; errors as of `_DenseMatcher`."""

    name = "roma"
    backbone: Path | str | None = None
    """File with DINOv2's weights (`dinov2_vitl14_pretrain.pth`); None: from its own hub. The tiny one
    needs none."""
    kind: str = "indoor"
    """`indoor`, `outdoor`, or `tiny`."""
    size: int = 560
    """Side of the square that images are first brought to [px], a multiple of 14; of the tiny one the
    longest side of larger images, whose memory grows with its fourth power."""
    fine: int = 864
    """The same for the second look [px]; 0: none."""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise OptionError(
                f"kind is {self.kind!r}; choose one of {', '.join(map(repr, KINDS))}."
            )
        if self.size % _PATCH or self.size <= 0 or self.fine % 8 or self.fine < 0:
            raise OptionError(
                f"size is {self.size} and fine {self.fine}; they must be multiples of {_PATCH} "
                "and of 8."
            )
        super().__post_init__()

    def _made(self, device: Any) -> Any:  # noqa: ANN401
        """Return RoMa with its weights and DINOv2's, or the tiny one, whose weights include XFeat's."""
        zoo = _imported("romatch.models.model_zoo", self.name)
        urls, weights = zoo.weight_urls, self.weights
        if self.kind == "tiny":
            xfeat = _imported("kornia.feature", self.name).XFeat()
            state = _state(weights, urls["tiny_roma_v1"]["outdoor"], self.name)
            with check_weights(weights, self.name):
                return zoo.tiny_roma_v1_model(weights=state, xfeat=xfeat.net).to(device)
        state = _state(weights, urls["romatch"][self.kind], self.name)
        under = _state(self.backbone, urls["dinov2"], "DINOv2")
        make = zoo.roma_indoor if self.kind == "indoor" else zoo.roma_outdoor
        with check_weights(weights or self.backbone, self.name):
            return make(
                device=device,
                weights=state,
                dinov2_weights=under,
                coarse_res=self.size,
                upsample_res=self.fine or self.size,
                upsample_preds=bool(self.fine),
                use_custom_corr=False,  # an extension of its own that few have
            )

    def _warps(self, ours: NDArray[np.uint8], view: NDArray[np.uint8]) -> list[Warp]:
        """Return RoMa's answer by direction.

        A symmetric network puts both side by side: on the left the query's pixels and where they lie
        in the view, on the right the view's pixels and where they lie in the query.
        """
        from PIL import Image

        both = [Image.fromarray(np.ascontiguousarray(image)) for image in (ours, view)]
        if self.kind == "tiny":  # the others resize by themselves
            for image in both:
                image.thumbnail((self.size, self.size))
        # the tiny network leaves the batch's axis out
        warp, certainty = (_plain(t) for t in self._network.match(*both))
        warp = warp[0] if warp.ndim > 3 else warp
        certainty = certainty[0] if certainty.ndim > 2 else certainty
        half = warp.shape[1] // 2
        symmetric = self._network.symmetric
        parts = [slice(0, half), slice(half, None)] if symmetric else [slice(None)]
        return [Warp(warp[:, p, :2], warp[:, p, 2:], certainty[:, p]) for p in parts]


@dataclass(eq=False, kw_only=True)
class RomaV2Matcher(_DenseMatcher):
    """Matches of RoMa v2 (`romav2.0.1.pt`); errors as of `_DenseMatcher`.

    Its library runs on the GPU where PyTorch sees one, and lets nobody choose.
    """

    name = "romav2"
    setting: str = "fast"
    """`turbo` (320 px), `fast` (512), `base` (640) or `precise` (800, then 1280, both ways)."""

    def __post_init__(self) -> None:
        if self.setting not in SETTINGS:
            known = ", ".join(map(repr, SETTINGS))
            raise OptionError(f"setting is {self.setting!r}; choose one of {known}.")
        super().__post_init__()
        self._network.apply_setting(self.setting)

    def _made(self, device: Any) -> Any:  # noqa: ANN401
        romav2 = _imported("romav2", self.name)
        taken = _imported("romav2.device", self.name).device
        if self.device != "auto" and device.type != taken.type:
            raise OptionError(
                f"device is {self.device!r}, but romav2 always runs on {taken.type!r} here; "
                "hide the GPU from PyTorch, or use device='auto'."
            )
        with check_weights(self.weights, self.name), _weights_from(self.weights):
            return romav2.RoMaV2()

    def _warps(self, ours: NDArray[np.uint8], view: NDArray[np.uint8]) -> list[Warp]:
        """Return RoMa v2's answer by direction: `warp_AB` (1, h, w, 2) and `overlap_AB` (1, h, w, 1)."""
        answer = self._network.match(ours.copy(), view.copy())
        ab, certainty = _plain(answer["warp_AB"])[0], _plain(answer["overlap_AB"])[0, ..., 0]
        found = [Warp(_own(ab), ab, certainty)]
        if answer.get("warp_BA") is not None:
            ba, certainty = _plain(answer["warp_BA"])[0], _plain(answer["overlap_BA"])[0, ..., 0]
            found.append(Warp(ba, _own(ba), certainty))
        return found


def _imported(package: str, name: str) -> Any:  # noqa: ANN401  # the module
    """A package of the extra `roma`; `MissingExtraError` where it is missing or does not load."""
    import importlib

    try:
        return importlib.import_module(package)
    except (ImportError, RuntimeError) as error:  # RuntimeError: a torchvision for another torch
        raise MissingExtraError(
            f"The matcher {name!r} needs {package}: pip install 'placegraph[roma]' "
            f"({' '.join(str(error).split())[:120]})."
        ) from error


def _plain(tensor: Any) -> NDArray[np.float32]:  # noqa: ANN401
    """Return float32 array of a tensor on any device."""
    array: NDArray[np.float32] = tensor.detach().float().cpu().numpy()
    return array


def _own(warp: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return normalised coordinates (h, w, 2) of a warp's own pixels."""
    height, width = warp.shape[:2]
    y, x = ((2.0 * np.arange(n) + 1.0) / n - 1.0 for n in (height, width))
    grid: NDArray[np.float32] = np.stack(np.meshgrid(x, y), axis=-1).astype(np.float32)
    return grid


def _state(path: Path | str | None, url: str, name: str) -> dict[str, Any]:
    """Return weights from a file, else from a hub; nothing in either is run."""
    if path is not None:
        return read_state(torch, Path(path), name)
    try:
        state: dict[str, Any] = torch.hub.load_state_dict_from_url(
            url, map_location="cpu", weights_only=True
        )
    except OSError as error:  # urllib's errors are such
        raise ServiceError(
            f"{url} cannot be reached ({error}); download it elsewhere and give the file as "
            "weights=, and as backbone= for DINOv2."
        ) from error
    return state


@contextmanager
def _weights_from(weights: Path | str | None) -> Iterator[None]:
    """While a network is made, its weights come from a file, or from the hub without running them.

    The library knows no file: it asks PyTorch's hub as it is made, and would unpickle what comes.
    """
    fetch = torch.hub.load_state_dict_from_url

    def load(url: str, **options: Any) -> Any:  # noqa: ANN401
        if weights is not None:
            return read_state(torch, Path(weights), "romav2")
        return fetch(url, **{**options, "weights_only": True})

    try:
        with patch.object(torch.hub, "load_state_dict_from_url", load):
            yield
    except OSError as error:  # urllib's errors are such
        raise ServiceError(
            f"RoMa v2's hub cannot be reached ({error}); download romav2.0.1.pt elsewhere and give "
            "the file as weights=. The code of DINOv3 comes from another hub."
        ) from error
